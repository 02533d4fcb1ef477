# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The reactor's constants, its nominal point, and how both hold up when a constant changes."""

from dataclasses import fields

import numpy as np
import pytest

from koopman_ros.plants import (
    EquilibriumError,
    NOMINAL_COOLANT_TEMPERATURE,
    one_state_reactor,
    ReactorParameters,
    two_state_reactor,
)

REACTORS = [one_state_reactor, two_state_reactor]


def test_nominal_point_of_the_one_state_reactor():
    system = one_state_reactor()
    np.testing.assert_allclose(system.nominal_state, [324.475443431599], rtol=0, atol=1e-10)
    np.testing.assert_array_equal(system.nominal_input, [300.0])
    np.testing.assert_allclose(system.B, [[2.092050209]], rtol=0, atol=1e-9)


def test_nominal_point_of_the_two_state_reactor():
    system = two_state_reactor()
    np.testing.assert_allclose(
        system.nominal_state, [0.87725294608097, 324.475443431599], rtol=1e-13)
    np.testing.assert_allclose(system.B, [[0.0], [2.092050209]], rtol=0, atol=1e-9)


@pytest.mark.parametrize('build', REACTORS)
def test_units(build):
    system = build()
    assert system.time_unit == 'min'
    assert system.state_names[-1] == 'temperature'
    assert system.state_units[-1] == 'K'
    assert (system.input_names, system.input_units) == (('coolant_temperature',), ('K',))


@pytest.mark.parametrize('build', REACTORS)
@pytest.mark.parametrize('parameters', [
    ReactorParameters(heat_transfer_coefficient=6e4),
    ReactorParameters(heat_transfer_coefficient=6e4, feed_temperature=345.0),
    ReactorParameters(heat_transfer_coefficient=6e4, feed_temperature=355.0),
    ReactorParameters(feed_temperature=345.0),
])
def test_nominal_point_follows_the_parameters(build, parameters):
    system = build(parameters)
    assert system.nominal_input == [NOMINAL_COOLANT_TEMPERATURE]
    rate = system.derivative(system.nominal_state, system.nominal_input)
    np.testing.assert_allclose(rate, 0.0, atol=1e-10)
    assert np.all(np.linalg.eigvals(system.drift_jacobian(system.nominal_state)).real < 0.0)
    assert system.nominal_state[-1] < build().nominal_state[-1]


@pytest.mark.parametrize(('build', 'changes'), [
    (one_state_reactor, {'heat_transfer_coefficient': 4e4}),
    (one_state_reactor, {'feed_temperature': 355.0}),
    (two_state_reactor, {'heat_transfer_coefficient': 4e4}),
    # This one has a single steady state, at 364 K, and a limit cycle around it.
    (two_state_reactor, {'heat_transfer_coefficient': 7e4, 'feed_temperature': 400.0}),
])
def test_missing_stable_steady_state_is_an_error(build, changes):
    message = r'no stable steady state .* coolant temperature of 300 K.*give nominal_state'
    with pytest.raises(EquilibriumError, match=message):
        build(ReactorParameters(**changes))


@pytest.mark.parametrize('build', REACTORS)
def test_a_given_nominal_state_needs_no_steady_state(build):
    before = build()
    system = build(ReactorParameters(heat_transfer_coefficient=4e4),
                   nominal_state=before.nominal_state)
    np.testing.assert_array_equal(system.nominal_state, before.nominal_state)
    assert system.B[-1, 0] == pytest.approx(0.8 * before.B[-1, 0])


@pytest.mark.parametrize('build', REACTORS)
def test_nominal_state_of_the_wrong_shape_is_refused(build):
    with pytest.raises(ValueError, match=r'incompatible nominal_state: expected .* got \(3,\)'):
        build(nominal_state=[1.0, 2.0, 3.0])


def test_two_state_reactor_at_the_held_concentration_is_the_one_state_reactor():
    parameters = ReactorParameters()
    temperatures = np.linspace(300.0, 360.0, 7)
    states = np.stack([np.full(7, parameters.concentration), temperatures], axis=-1)
    np.testing.assert_array_equal(
        two_state_reactor(parameters).drift(states)[:, 1],
        one_state_reactor(parameters).drift(temperatures[:, None])[:, 0])


@pytest.mark.parametrize(('changes', 'rate'), [
    # At 350 K and 0.5 mol/L the Arrhenius factor is exp(-25), so the rates below need no solver.
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


@pytest.mark.parametrize('constant', fields(ReactorParameters), ids=lambda c: c.name)
def test_each_constant_is_refused_outside_its_range_with_its_unit(constant):
    unit = constant.metadata['unit'].replace('(', r'\(').replace(')', r'\)')
    for value in (np.nextafter(constant.metadata['upper'], np.inf), np.nan, -np.inf):
        message = rf'{constant.name} is .* {unit}, must lie in \[.*\] {unit}'
        with pytest.raises(ValueError, match=message):
            ReactorParameters(**{constant.name: value})
