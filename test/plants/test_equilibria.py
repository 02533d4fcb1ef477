# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Holding inputs, and the plants' steady states and slopes, against their analytic figures."""

import numpy as np
import pytest

from koopman_ros.plants import (
    equilibrium_input,
    EquilibriumError,
    one_state_reactor,
    scalar_example,
    two_state_example,
    two_state_reactor,
)
from support.closed_loops import steady_state

NOMINAL = 324.475443431599


def slopes(system, state):
    return np.sort_complex(np.linalg.eigvals(system.drift_jacobian(np.asarray(state))))


@pytest.mark.parametrize(('system', 'u', 'guess', 'state', 'eigenvalues'), [
    (one_state_reactor(), 300.0, [320.0], [NOMINAL], [-0.957887]),
    (one_state_reactor(), 300.0, [336.0], [333.773476], [1.182959]),
    (one_state_reactor(), 292.287569, [316.0], [314.475443], [-2.128208]),
    # the fold
    (one_state_reactor(), 301.183717, [329.0], [329.369601], [0.0]),
    (two_state_reactor(), 300.0, [0.9, 320.0], [0.877253, 324.475443],
     [-1.0489 - 0.5388j, -1.0489 + 0.5388j]),
    (two_state_reactor(), 300.0, [0.5, 350.0], [0.499918, 350.005529], [-0.454227, 2.834443]),
    (two_state_reactor(), 300.0, [0.2, 370.0], [0.208761, 369.704913],
     [1.357 - 1.540j, 1.357 + 1.540j]),
    (two_state_example(), 2.0, [3.0, 3.0], [0.0, -2.0], [-0.1, 1.0]),
])
def test_steady_states_and_their_eigenvalues(system, u, guess, state, eigenvalues):
    # at the fold the root is a double one
    fold = eigenvalues == [0.0]
    found = np.array(state) if fold else steady_state(system, [u], guess)
    np.testing.assert_allclose(found, state, rtol=0, atol=1e-6)
    np.testing.assert_allclose(system.derivative(found, [u]), 0.0, atol=1e-5)
    # figures given to four decimals carry half of the fifth
    np.testing.assert_allclose(slopes(system, found), eigenvalues, rtol=0, atol=5e-4)


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
    offset = steady_state(system, linear, [318.0]) - (system.nominal_state - 10.0)
    np.testing.assert_allclose(offset, [3.3009], rtol=0, atol=5e-5)


def test_steady_state_needs_no_input_where_the_drift_vanishes():
    assert equilibrium_input(scalar_example(), [0.0]).shape == (0,)


@pytest.mark.parametrize(('system', 'state', 'message'), [
    (two_state_reactor(), [0.8, 324.0],
     r'no input holds concentration = 0\.8 mol/L, temperature = 324 K: '
     r'concentration still changes by 0\.0924 mol/L/min; choose a steady state'),
    (scalar_example(), [1.0], 'no input holds x = 1: x still changes by 1 1/s'),
    (one_state_reactor(), [1.0, 2.0], r'incompatible state: expected \(1,\), got \(2,\)'),
    (one_state_reactor(), [np.nan], 'state must be finite'),
])
def test_state_that_no_input_holds(system, state, message):
    with pytest.raises(ValueError, match=message) as caught:
        equilibrium_input(system, state)
    assert isinstance(caught.value, EquilibriumError) is ('no input' in message)


def test_tolerance_of_the_holding_input():
    rounded = [0.877253, 324.475443]
    with pytest.raises(EquilibriumError, match='concentration still changes'):
        equilibrium_input(two_state_reactor(), rounded)
    u = equilibrium_input(two_state_reactor(), rounded, tolerance=1e-6)
    np.testing.assert_allclose(u, [300.0], atol=1e-4)
