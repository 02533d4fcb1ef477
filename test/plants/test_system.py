# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The control-affine system: shapes, names and derivatives."""

from dataclasses import FrozenInstanceError, replace
import pickle

import numpy as np
import pytest

from koopman_ros.plants import (
    ControlAffineSystem,
    one_state_reactor,
    scalar_example,
    two_state_example,
    two_state_reactor,
)

PLANTS = {
    'scalar example': (scalar_example, [0.3, 0.7, 2.0]),
    'two-state example': (two_state_example, [0.5, 1.5, -2.0]),
    'one-state reactor': (one_state_reactor, [310.0, 324.0, 360.0]),
    'two-state reactor': (two_state_reactor, [310.0, 324.0, 360.0]),
}


@pytest.fixture(params=PLANTS)
def plant_and_states(request: pytest.FixtureRequest) -> tuple[ControlAffineSystem, np.ndarray]:
    build, values = PLANTS[request.param]
    system = build()
    rng = np.random.default_rng(0)
    states = np.array(values)[:, None] + rng.uniform(0.0, 0.5, (3, system.n_x))
    if system.name == 'two-state reactor':
        states[:, 0] = [0.9, 0.5, 0.1]
    return system, states


def test_jacobian_agrees_with_central_differences(plant_and_states):
    system, states = plant_and_states
    for j in range(system.n_x):
        step = np.zeros(system.n_x)
        step[j] = 1e-5 * system.state_scale[j]
        slope = (system.drift(states + step) - system.drift(states - step)) / (2.0 * step[j])
        np.testing.assert_allclose(
            system.drift_jacobian(states)[..., j], slope, rtol=1e-7, atol=1e-7)


def test_functions_are_batched_over_leading_axes(plant_and_states):
    system, states = plant_and_states
    stacked = np.stack([states, states[::-1]])
    np.testing.assert_array_equal(system.drift(stacked)[0], system.drift(states))
    np.testing.assert_array_equal(system.drift(stacked)[1, 2], system.drift(states[0]))
    assert system.drift_jacobian(stacked).shape == (2, 3, system.n_x, system.n_x)


def test_derivative_is_drift_plus_forcing(plant_and_states):
    system, states = plant_and_states
    u = np.linspace(1.0, 2.0, 3 * system.n_u).reshape(3, system.n_u)
    expected = [system.drift(x) + system.B @ v for x, v in zip(states, u, strict=True)]
    np.testing.assert_allclose(system.derivative(states, u), expected, rtol=1e-15)
    np.testing.assert_allclose(system.derivative(states, u)[1],
                               system.derivative(states[1], u[1]), rtol=1e-15)


def test_nominal_point_is_a_steady_state(plant_and_states):
    system, _ = plant_and_states
    rate = system.derivative(system.nominal_state, system.nominal_input)
    np.testing.assert_allclose(rate, 0.0, atol=1e-11)


def test_system_survives_pickling(plant_and_states):
    system, states = plant_and_states
    copy = pickle.loads(pickle.dumps(system))
    np.testing.assert_array_equal(copy.drift(states), system.drift(states))


def test_arrays_are_float64_and_read_only(plant_and_states):
    system, _ = plant_and_states
    for name in ('B', 'nominal_state', 'nominal_input', 'state_lower', 'state_upper'):
        array = getattr(system, name)
        assert array.dtype == np.float64
        assert not array.flags.writeable
    with pytest.raises(FrozenInstanceError):
        system.B = np.zeros((1, 1))


def test_no_input_works_throughout():
    system = scalar_example()
    assert (system.n_x, system.n_u) == (1, 0)
    assert system.B.shape == (1, 0)
    np.testing.assert_array_equal(system.derivative([3.0], []), [9.0])
    np.testing.assert_array_equal(system.derivative([[3.0], [2.0]], np.zeros((2, 0))),
                                  [[9.0], [4.0]])


@pytest.mark.parametrize(('unit', 'seconds'), [('min', 60.0), ('s', 1.0)])
def test_time_units(unit, seconds):
    assert replace(two_state_example(), time_unit=unit).seconds_per_time_unit == seconds


def test_state_scale_is_the_nominal_magnitude_and_one_at_zero():
    system = replace(two_state_example(), nominal_state=[-3.0, 0.0])
    np.testing.assert_array_equal(system.state_scale, [3.0, 1.0])


def test_descriptions_carry_names_and_units():
    assert two_state_reactor().describe_state(np.array([0.5, 350.0])) == (
        'concentration = 0.5 mol/L, temperature = 350 K')
    assert two_state_example().describe_state(np.array([1.0, -2.0])) == 'x1 = 1, x2 = -2'


@pytest.mark.parametrize(('changes', 'message'), [
    ({'B': np.zeros((2, 2))}, r'incompatible B: expected \(2, 1\), got \(2, 2\)'),
    ({'B': np.zeros(2)}, r'incompatible B: expected \(2, 1\), got \(2,\)'),
    ({'B': [[np.nan], [1.0]]}, r'B must be finite: entry \[0, 0\] is nan'),
    ({'nominal_state': [0.0]}, r'incompatible nominal_state: expected \(2,\), got \(1,\)'),
    ({'nominal_input': [0.0, 1.0]}, r'incompatible nominal_input: expected \(1,\), got \(2,\)'),
    ({'state_units': ('1',)}, r'incompatible state_units: expected \(2,\), got \(1,\)'),
    ({'input_units': ()}, r'incompatible input_units: expected \(1,\), got \(0,\)'),
    ({'state_names': (), 'state_units': ()}, 'state_names is empty'),
    ({'time_unit': 'h'}, "time_unit is 'h', must be one of 'min', 's'"),
    ({'state_lower': [1.0, 2.0, 3.0]}, r'incompatible state_lower: expected \(2,\), got \(3,\)'),
    ({'state_lower': 1.0, 'state_upper': 1.0}, 'state_lower .* must lie below state_upper'),
    ({'drift': lambda x: x[..., :1]}, r'incompatible drift\(x\) .* expected \(2,\), got \(1,\)'),
    ({'drift': lambda x: x.reshape(-1, 2)[0]},
     r'incompatible drift\(x\) at x of shape \(2, 2\): expected \(2, 2\), got \(2,\)'),
    ({'drift_jacobian': lambda x: x}, r'incompatible drift_jacobian\(x\) .* expected \(2, 2\)'),
])
def test_construction_names_what_does_not_fit(changes, message):
    with pytest.raises(ValueError, match=message):
        replace(two_state_example(), **changes)


@pytest.mark.parametrize(('x', 'u', 'message'), [
    ([1.0], [1.0], r'incompatible x: expected \(\.\.\., 2\), got \(1,\)'),
    ([1.0, 2.0], [1.0, 2.0], r'incompatible u: expected \(\.\.\., 1\), got \(2,\)'),
    ([1.0, 2.0], 1.0, r'incompatible u: expected \(\.\.\., 1\), got \(\)'),
])
def test_derivative_names_what_does_not_fit(x, u, message):
    with pytest.raises(ValueError, match=message):
        two_state_example().derivative(x, u)


@pytest.mark.parametrize(('rates', 'message'), [
    ({'mu': np.nan}, 'mu is nan 1/s, must be finite'),
    ({'lambda_': np.inf}, 'lambda_ is inf 1/s, must be finite'),
])
def test_rates_must_be_finite(rates, message):
    with pytest.raises(ValueError, match=message):
        two_state_example(**rates)
