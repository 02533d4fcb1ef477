# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Control-affine systems, their steady states and holding inputs; the plants of the library."""

from dataclasses import fields, FrozenInstanceError, replace
import pickle
import re

import numpy as np
import pytest

from koopman_ros.plants import (
    ControlAffineSystem,
    equilibrium_input,
    EquilibriumError,
    one_state_reactor,
    plant_class,
    ReactorParameters,
    scalar_example,
    two_state_example,
    two_state_reactor,
)
from support.closed_loops import steady_state

NOMINAL = 324.475443431599
REACTORS = [one_state_reactor, two_state_reactor]


# by name, with a range of their states
PLANTS = {
    'two_state_example': [0.5, 1.5, -2.0], 'reactor': [310.0, 324.0, 360.0],
    'two_state': [310.0, 324.0, 360.0], 'two_tanks': [0.02, 0.1, 0.4],
    'quadruple_tank': [0.02, 0.1, 0.4], 'pendulum': [-2.0, 0.1, 3.0],
    'heated_line': [290.0, 323.0, 360.0], '': [0.3, 0.7, 2.0]}


@pytest.fixture(params=PLANTS)
def plant_and_states(request):
    system = plant_class(request.param)().system() if request.param else scalar_example()
    rng = np.random.default_rng(0)
    states = np.array(PLANTS[request.param])[:, None] + rng.uniform(0.0, 0.5, (3, system.n_x))
    if request.param in ('two_state', 'heated_line'):
        states[:, 0] = [0.9, 0.5, 0.1]
    return system, states


def test_derivatives_of_a_plant(plant_and_states):
    """Jacobian by central differences, leading axes, drift and forcing, nominal point, pickle."""
    system, states = plant_and_states
    for j in range(system.n_x):
        step = np.zeros(system.n_x)
        step[j] = 1e-5 * system.state_scale[j]
        slope = (system.drift(states + step) - system.drift(states - step)) / (2.0 * step[j])
        np.testing.assert_allclose(
            system.drift_jacobian(states)[..., j], slope, rtol=1e-7, atol=1e-7)
    stacked = np.stack([states, states[::-1]])
    np.testing.assert_array_equal(system.drift(stacked)[0], system.drift(states))
    np.testing.assert_array_equal(system.drift(stacked)[1, 2], system.drift(states[0]))
    assert system.drift_jacobian(stacked).shape == (2, 3, system.n_x, system.n_x)
    u = np.linspace(1.0, 2.0, 3 * system.n_u).reshape(3, system.n_u)
    expected = [system.drift(x) + system.B @ v for x, v in zip(states, u, strict=True)]
    np.testing.assert_allclose(system.derivative(states, u), expected, rtol=1e-15)
    np.testing.assert_allclose(system.derivative(states[1], u[0]),
                               system.drift(states[1]) + system.B @ u[0], rtol=1e-15)
    rate = system.derivative(system.nominal_state, system.nominal_input)
    np.testing.assert_allclose(rate, 0.0, atol=1e-11)
    copy = pickle.loads(pickle.dumps(system))
    np.testing.assert_array_equal(copy.drift(states), system.drift(states))
    for name in ('B', 'nominal_state', 'nominal_input', 'state_lower', 'state_upper'):
        array = getattr(system, name)
        assert array.dtype == np.float64
        assert not array.flags.writeable
    with pytest.raises(FrozenInstanceError):
        system.B = np.zeros((1, 1))


@pytest.mark.parametrize(('changes', 'message'), [
    ({'B': np.zeros((2, 2))}, r'incompatible B: expected \(2, 1\), got \(2, 2\)'),
    ({'B': np.zeros(2)}, r'incompatible B: expected \(2, 1\), got \(2,\)'),
    ({'B': [[np.nan], [1.0]]}, r'entry \[0, 0\] is'),
    ({'nominal_state': [0.0]}, r'incompatible nominal_state: expected \(2,\), got \(1,\)'),
    ({'nominal_input': [0.0, 1.0]}, r'incompatible nominal_input: expected \(1,\), got \(2,\)'),
    ({'state_units': ('1',)}, 'incompatible state_names and state_units'),
    ({'input_units': ()}, 'incompatible input_names and input_units'),
    ({'state_names': 'pv'}, "state_names is the string 'pv'"),
    ({'state_names': (), 'state_units': ()}, 'state_names is empty'),
    ({'state_units': ('1', 'furlng')}, "there is no unit 'furlng'"),
    ({'time_unit': 'h'}, "time_unit must be 's' or 'min', got 'h'"),
    ({'state_lower': [1.0, 2.0, 3.0]}, r'incompatible state_lower: expected \(2,\), got \(3,\)'),
    ({'state_lower': 1.0, 'state_upper': 1.0}, 'state_lower .* must lie below state_upper'),
    ({'drift': lambda x: x[..., :1]}, r'incompatible drift\(x\) .* expected \(2,\), got \(1,\)'),
    ({'drift': lambda x: x.reshape(-1, 2)[0]},
     r'incompatible drift\(x\) at x of shape \(2, 2\): expected \(2, 2\), got \(2,\)'),
    ({'drift_jacobian': lambda x: x}, r'incompatible drift_jacobian\(x\) .* expected \(2, 2\)'),
    ({'drift': lambda x: x * [-2.0, 3.0] - 1.0,
      'drift_jacobian': lambda x: np.broadcast_to(np.diag([-2.0, -3.0]), (*x.shape, 2))},
     'has -3 in row 1, column 1 .rate of x2 by x2. .* differences of drift give 3: correct it'),
    # zero at the nominal state, and of the wrong sign elsewhere
    ({'drift': lambda x: x ** 2, 'drift_jacobian': lambda x: -2.0 * x[..., None] * np.eye(2)},
     'row [01], column [01]'),
])
def test_an_error_of_construction_names_the_mismatch(changes, message):
    with pytest.raises(ValueError, match=message):
        replace(two_state_example(), **changes)


def test_no_jacobian_means_finite_differences(plant_and_states):
    system, states = plant_and_states
    found = replace(system, drift_jacobian=None)
    np.testing.assert_allclose(found.drift_jacobian(states), system.drift_jacobian(states),
                               rtol=1e-6, atol=1e-8)
    # those of the present drift
    halved = replace(found, drift=lambda x: 0.5 * system.drift(x))
    np.testing.assert_allclose(halved.drift_jacobian(states), 0.5 * found.drift_jacobian(states),
                               rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(('x', 'u', 'message'), [
    ([1.0], [1.0], r'incompatible x: expected \(\.\.\., 2\), got \(1,\)'),
    ([1.0, 2.0], [1.0, 2.0], r'incompatible u: expected \(\.\.\., 1\), got \(2,\)'),
    ([1.0, 2.0], 1.0, r'incompatible u: expected \(\.\.\., 1\), got \(\)'),
])
def test_an_error_of_the_derivative_names_the_mismatch(x, u, message):
    with pytest.raises(ValueError, match=message):
        two_state_example().derivative(x, u)


# Steady states and holding inputs, against their analytic figures.

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
    slopes = np.sort_complex(np.linalg.eigvals(system.drift_jacobian(found)))
    np.testing.assert_allclose(slopes, eigenvalues, rtol=0, atol=5e-4)


@pytest.mark.parametrize(('system', 'state', 'coolant', 'tolerance'), [
    (one_state_reactor(), [NOMINAL], 300.0, 1e-9),
    (one_state_reactor(), [NOMINAL - 10.0], 292.287569, 1e-6),
    # the lowest and highest coolant that keep the reactor between 305 and 327 K
    (one_state_reactor(), [305.0], 281.3, 0.05),
    (one_state_reactor(), [327.0], 300.9, 0.05),
])
def test_input_that_holds_a_state(system, state, coolant, tolerance):
    np.testing.assert_allclose(
        equilibrium_input(system, state), [coolant], rtol=0, atol=tolerance)


def test_of_several_inputs_that_hold_a_state_those_nearest_to_the_nominal_ones_are_found():
    nominal = np.array([2.0, 50.0])
    system = ControlAffineSystem(
        'mixer', ('level',), ('m',), ('a', 'b'), ('1', '1'), 's', lambda x: -x,
        np.array([[1.0, 0.04]]), np.array([4.0]), nominal)
    # in shares of the nominal ones, both inputs act alike
    np.testing.assert_allclose(equilibrium_input(system, [5.0]), 1.25 * nominal, rtol=1e-12)


@pytest.mark.parametrize(('system', 'state', 'message'), [
    (two_state_reactor(), [0.8, 324.0],
     r'no input holds concentration = 0\.8 mol/L, temperature = 324 K: '
     r'concentration still changes by 0\.0924 mol/L/min; choose a steady state'),
    # rounded, and so no longer steady
    (two_state_reactor(), [0.877253, 324.475443], 'no input holds .*concentration still changes'),
    (scalar_example(), [1.0], 'no input holds x = 1: x still changes by 1 1/s'),
    (one_state_reactor(), [1.0, 2.0], r'incompatible state: expected \(1,\), got \(2,\)'),
    (one_state_reactor(), [np.nan], 'state must be finite'),
])
def test_state_that_no_input_holds(system, state, message):
    with pytest.raises(ValueError, match=message) as caught:
        equilibrium_input(system, state)
    assert isinstance(caught.value, EquilibriumError) is ('no input' in message)


# The reactors and the examples of the paper.


@pytest.mark.parametrize(('build', 'changes'), [
    *((build, {'heat_transfer_coefficient': 4e4}) for build in REACTORS),
    (one_state_reactor, {'feed_temperature': 355.0}),
    # this one has a single steady state, at 364 K, and a limit cycle around it
    (two_state_reactor, {'heat_transfer_coefficient': 7e4, 'feed_temperature': 400.0}),
])
def test_missing_stable_steady_state_is_an_error_unless_a_nominal_state_is_given(build, changes):
    message = r'no stable steady state .* coolant temperature of 300 K.*give nominal_state'
    with pytest.raises(EquilibriumError, match=message):
        build(ReactorParameters(**changes))
    before = build()
    system = build(ReactorParameters(**changes), nominal_state=before.nominal_state)
    np.testing.assert_array_equal(system.nominal_state, before.nominal_state)
    gain = changes.get('heat_transfer_coefficient', 5e4) / 5e4
    assert system.B[-1, 0] == pytest.approx(gain * before.B[-1, 0])
    with pytest.raises(ValueError, match=r'incompatible nominal_state: expected .* got \(3,\)'):
        build(nominal_state=[1.0, 2.0, 3.0])


@pytest.mark.parametrize(('changes', 'rate'), [
    # at 350 K and 0.5 mol/L the Arrhenius factor is exp(-25), so the rates below need no solver
    ({}, [0.5 - 0.5 * 7.2e10 * np.exp(-25.0),
          0.5 * 7.2e10 * np.exp(-25.0) * 5e4 / 239.0 - 350.0 * 5e4 / 23900.0]),
    ({'pre_exponential_factor': 0.0, 'flow_rate': 50.0, 'feed_temperature': 340.0},
     [0.25, -5.0 - 350.0 * 5e4 / 23900.0]),
    ({'pre_exponential_factor': 0.0, 'heat_transfer_coefficient': 0.0, 'feed_concentration': 0.7},
     [0.2, 0.0]),
    ({'pre_exponential_factor': 0.0, 'volume': 200.0, 'density': 500.0, 'heat_capacity': 0.478},
     [0.25, -350.0 * 5e4 / 47800.0]),
])
def test_every_constant_enters_the_rates(changes, rate):
    system = two_state_reactor(ReactorParameters(**changes), nominal_state=[0.5, 350.0])
    np.testing.assert_allclose(system.drift(np.array([0.5, 350.0])), rate, rtol=1e-12, atol=1e-12)


def test_each_constant_is_rejected_outside_its_range_with_its_unit():
    for constant in fields(ReactorParameters):
        unit = re.escape(constant.metadata['unit'])
        for value in (np.nextafter(constant.metadata['upper'], np.inf), np.nan, -np.inf):
            message = rf'{constant.name} is .* {unit}, must lie in \[.*\] {unit}'
            with pytest.raises(ValueError, match=message):
                ReactorParameters(**{constant.name: value})
    with pytest.raises(ValueError, match='mu is nan 1/s, must lie in'):
        two_state_example(mu=np.nan)
    with pytest.raises(ValueError, match='lambda_ is inf 1/s, must lie in'):
        two_state_example(lambda_=np.inf)
