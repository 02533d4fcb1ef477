# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Steady states, holding inputs, eigenvalues and folds against their analytic figures."""

from dataclasses import replace

import numpy as np
import pytest

from koopman_ros.plants import (
    eigenvalues,
    equilibrium,
    equilibrium_input,
    EquilibriumError,
    fold,
    one_state_reactor,
    scalar_example,
    two_state_example,
    two_state_reactor,
)

NOMINAL = 324.475443431599


@pytest.mark.parametrize(('coolant', 'guess', 'temperature'), [
    (300.0, 320.0, NOMINAL),
    (300.0, 326.0, NOMINAL),
    (300.0, 336.0, 333.773476),
    (292.287569, 316.0, 314.475443),
])
def test_one_state_equilibria(coolant, guess, temperature):
    state = equilibrium(one_state_reactor(), [coolant], [guess])
    np.testing.assert_allclose(state, [temperature], rtol=0, atol=1e-6)


def test_equilibrium_is_exact_to_rounding():
    state = equilibrium(one_state_reactor(), [300.0], [310.0])
    np.testing.assert_allclose(state, [NOMINAL], rtol=1e-12)


@pytest.mark.parametrize(('guess', 'expected', 'values'), [
    ([0.9, 320.0], [0.877253, 324.475443], [-1.0489 - 0.5388j, -1.0489 + 0.5388j]),
    ([0.5, 350.0], [0.499918, 350.005529], [-0.454227, 2.834443]),
    ([0.2, 370.0], [0.208761, 369.704913], [1.357 - 1.540j, 1.357 + 1.540j]),
])
def test_two_state_equilibria(guess, expected, values):
    system = two_state_reactor()
    state = equilibrium(system, [300.0], guess)
    np.testing.assert_allclose(state, expected, rtol=0, atol=1e-6)
    # Figures given to four decimals carry half of the fifth.
    np.testing.assert_allclose(eigenvalues(system, state), values, rtol=0, atol=5e-4)


def test_saddle_eigenvalues():
    system = two_state_reactor()
    saddle = equilibrium(system, [300.0], [0.5, 350.0])
    np.testing.assert_allclose(
        eigenvalues(system, saddle), [-0.454227, 2.834443], rtol=0, atol=1e-6)


def test_slope_at_the_one_state_fixed_point():
    system = one_state_reactor()
    np.testing.assert_allclose(
        eigenvalues(system, system.nominal_state), [-0.957887316], rtol=0, atol=1e-9)


@pytest.mark.parametrize(('temperature', 'coolant', 'tolerance'), [
    (NOMINAL, 300.0, 1e-9),
    (NOMINAL - 10.0, 292.287569, 1e-6),
    # The lowest and highest coolant that keep the reactor between 305 and 327 K.
    (305.0, 281.3, 0.05),
    (327.0, 300.9, 0.05),
])
def test_input_that_holds_a_temperature(temperature, coolant, tolerance):
    u = equilibrium_input(one_state_reactor(), [temperature])
    np.testing.assert_allclose(u, [coolant], rtol=0, atol=tolerance)


def test_linear_feed_forward_settles_off_its_setpoint():
    system = one_state_reactor()
    slope = system.drift_jacobian(system.nominal_state)
    linear = system.nominal_input + np.linalg.solve(system.B, -slope @ [-10.0])
    np.testing.assert_allclose(linear, [295.421299], rtol=0, atol=1e-6)
    offset = equilibrium(system, linear, [318.0]) - (system.nominal_state - 10.0)
    np.testing.assert_allclose(offset, [3.3009], rtol=0, atol=5e-5)


def test_fold_of_the_one_state_reactor():
    state, u = fold(one_state_reactor(), 310.0, 340.0)
    np.testing.assert_allclose(state, [329.369601], rtol=0, atol=1e-6)
    np.testing.assert_allclose(u, [301.183717], rtol=0, atol=1e-6)
    np.testing.assert_allclose(eigenvalues(one_state_reactor(), state), [0.0], atol=1e-10)


def test_fold_without_input():
    state, u = fold(scalar_example(), -1.0, 2.0)
    np.testing.assert_allclose(state, [0.0], atol=1e-15)
    assert u.shape == (0,)


def test_double_root_is_found():
    np.testing.assert_allclose(equilibrium(scalar_example(), [], [0.1]), [0.0], atol=1e-11)


def test_equilibrium_at_the_origin_with_a_scale_of_one():
    state = equilibrium(two_state_example(), [2.0], [3.0, 3.0])
    np.testing.assert_allclose(state, [0.0, -2.0], atol=1e-12)


def test_steady_state_needs_no_input_where_the_drift_vanishes():
    assert equilibrium_input(scalar_example(), [0.0]).shape == (0,)


@pytest.mark.parametrize('guess', [305.0, 324.0, 335.0])
def test_input_above_the_fold_has_no_equilibrium(guess):
    message = (r'one-state reactor: no steady state found for coolant_temperature = 310 K from '
               rf'temperature = {guess:.0f} K; the search ended at .* K; start nearer')
    with pytest.raises(EquilibriumError, match=message):
        equilibrium(one_state_reactor(), [310.0], [guess])


def test_equilibrium_outside_the_bounds_of_the_model_is_refused():
    system = replace(two_state_example(), state_lower=-1.0)
    with pytest.raises(EquilibriumError, match=r'no steady state .* ended at x1 = .*, x2 = -2'):
        equilibrium(system, [2.0], [0.5, -0.5])


def test_singular_jacobian_is_refused():
    system = replace(scalar_example(), drift=np.ones_like,
                     drift_jacobian=lambda x: np.zeros((*x.shape, 1)))
    with pytest.raises(EquilibriumError, match='no steady state found for no input from x = 1'):
        equilibrium(system, [], [1.0])


@pytest.mark.parametrize(('system', 'state', 'message'), [
    (two_state_reactor(), [0.8, 324.0],
     r'no input holds concentration = 0\.8 mol/L, temperature = 324 K: '
     r'concentration still changes by 0\.0924 mol/L/min; choose a steady state'),
    (scalar_example(), [1.0], 'no input holds x = 1: x still changes by 1 1/s'),
])
def test_state_that_no_input_holds(system, state, message):
    with pytest.raises(EquilibriumError, match=message):
        equilibrium_input(system, state)


def test_tolerance_of_the_holding_input():
    rounded = [0.877253, 324.475443]
    with pytest.raises(EquilibriumError, match='concentration still changes'):
        equilibrium_input(two_state_reactor(), rounded)
    u = equilibrium_input(two_state_reactor(), rounded, tolerance=1e-6)
    np.testing.assert_allclose(u, [300.0], atol=1e-4)


def test_fold_is_for_one_state():
    with pytest.raises(ValueError, match='two-state example has 2 states'):
        fold(two_state_example(), 0.0, 1.0)


def test_range_without_a_fold():
    message = r'does not change sign in \[305, 310\] K: it is .* 1/min at the ends; widen'
    with pytest.raises(EquilibriumError, match=message):
        fold(one_state_reactor(), 305.0, 310.0)


@pytest.mark.parametrize(('call', 'message'), [
    (lambda: equilibrium(one_state_reactor(), [300.0, 1.0], [320.0]),
     r'incompatible u: expected \(1,\), got \(2,\)'),
    (lambda: equilibrium(one_state_reactor(), [300.0], 320.0),
     r'incompatible guess: expected \(1,\), got \(\)'),
    (lambda: equilibrium_input(one_state_reactor(), [1.0, 2.0]),
     r'incompatible state: expected \(1,\), got \(2,\)'),
    (lambda: eigenvalues(one_state_reactor(), [np.nan]), 'state must be finite'),
])
def test_arguments_that_do_not_fit(call, message):
    with pytest.raises(ValueError, match=message):
        call()
