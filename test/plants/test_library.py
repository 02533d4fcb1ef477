# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Tanks and pendulum of the library, against what is published and what is conserved."""

import numpy as np
import pytest
from scipy.linalg import eigvals

from koopman_ros.plants import (
    equilibrium_input,
    EquilibriumError,
    plant_class,
    simulate,
    steady_state,
)


def plant(name, **constants):
    return plant_class(name)(**constants).system()


def test_quadruple_tank_has_the_published_operating_point():
    # Johansson (2000), table of P-: levels in cm, of measurements; time constants in s, of a model
    system = plant('quadruple_tank')
    np.testing.assert_array_equal(system.nominal_input, [3.0, 3.0])
    np.testing.assert_allclose(
        100.0 * system.nominal_state, [12.4, 12.7, 1.8, 1.4], rtol=0, atol=0.2)
    slope = system.drift_jacobian(system.nominal_state)
    np.testing.assert_allclose(-1.0 / np.diag(slope), [62.0, 90.0, 23.0, 30.0], rtol=0, atol=1.0)
    x, u = steady_state(system, {'level_1': 0.10, 'level_2': 0.14})
    np.testing.assert_allclose(system.derivative(x, u), 0.0, atol=1e-15)
    np.testing.assert_array_equal(x[:2], [0.10, 0.14])
    # and the published zeros of pumps to lower levels, of which one is near the origin
    pencil = np.block([[slope, system.B], [np.eye(2, 4), np.zeros((2, 2))]])
    finite = [zero for zero in eigvals(pencil, np.diag([1.0] * 4 + [0.0] * 2))
              if abs(zero) < 1.0]
    np.testing.assert_allclose(np.sort_complex(finite), [-0.060, -0.018], rtol=0, atol=6e-4)


def test_quadruple_tank_of_the_other_setting_is_of_nonminimum_phase():
    # P+: levels and zeros of the same table
    system = plant('quadruple_tank', pump_gain_1=3.14e-6, pump_gain_2=3.29e-6, split_1=0.43,
                   split_2=0.34)
    slope = system.drift_jacobian(system.nominal_state)
    pencil = np.block([[slope, system.B], [np.eye(2, 4), np.zeros((2, 2))]])
    zeros = eigvals(pencil, np.diag([1.0] * 4 + [0.0] * 2))
    assert sum(0.0 < zero.real < 1.0 for zero in zeros) == 1


@pytest.mark.parametrize('name', ['two_tanks', 'quadruple_tank'])
def test_tanks_run_empty_and_conserve_volume(name):
    system = plant(name)
    run = simulate(system, system.nominal_state, np.zeros((60, 2)), 10.0)
    np.testing.assert_allclose(run.x[-1], 0.0, atol=1e-8)
    np.testing.assert_array_equal(system.drift(np.full(system.n_x, -1e-4)), 0.0)
    np.testing.assert_array_equal(system.drift_jacobian(np.zeros(system.n_x)), 0.0)


def test_a_tank_drains_in_the_time_of_torricelli():
    # d sqrt(h)/dt = -a / A sqrt(g / 2)
    system = plant('two_tanks')
    start, seconds = 0.2, 5.0
    end = simulate(system, [start, 0.1], [[0.0, 0.0]], seconds).x[-1, 0]
    fallen = 0.1781 / 15.52 * np.sqrt(9.81 / 2.0) * seconds
    assert end == pytest.approx((np.sqrt(start) - fallen) ** 2, rel=1e-8)


def test_two_tanks_are_held_by_the_pumps_that_make_up_for_their_outflow():
    system = plant('two_tanks')
    # 3.3 cm^3/s a volt; cm^2 sqrt(2 * 981 cm/s^2 * cm)
    flow = 0.1781 * np.sqrt(2.0 * 981.0 * np.array([10.0, 15.0]))
    np.testing.assert_allclose(equilibrium_input(system, [0.10, 0.15]),
                               [flow[0] / 3.3, (flow[1] - flow[0]) / 3.3], rtol=1e-12)


def test_the_heated_line_conserves_energy_and_matter_at_rest():
    # by hand, in mol, J and s: what is fed, and what leaves, reacts and is exchanged
    system = plant('heated_line')
    for celsius in (40.0, 50.0, 60.0):
        (c, kelvin), (valve,) = steady_state(system, {'temperature': 273.15 + celsius})
        reacted = 0.5e-3 * (2000.0 - 1000.0 * c)
        assert reacted == pytest.approx(
            0.3 * 4.41e5 * np.exp(-5650.0 / kelvin) * 1000.0 * c, rel=1e-9)
        jacket = 15.0 + 0.8 * valve
        assert 0.5e-3 * 4.18e6 * (celsius - 20.0) == pytest.approx(
            3e3 * (jacket - celsius) + 5.8e4 * reacted, rel=1e-9)


def test_a_pendulum_without_friction_keeps_its_energy_and_with_friction_stops():
    free = plant('pendulum', friction=0.0)
    run = simulate(free, [1.0, 0.5], np.zeros((100, 1)), 0.05)
    energy = 0.5 * 0.25 * run.x[:, 1] ** 2 + 0.5 * 9.81 * np.cos(run.x[:, 0])
    np.testing.assert_allclose(energy, energy[0], rtol=1e-8)
    assert np.max(run.x[:, 0]) > 5.0
    hanging = simulate(plant('pendulum'), [1.0, 0.0], np.zeros((800, 1)), 0.05).x[-1]
    np.testing.assert_allclose(hanging, [np.pi, 0.0], atol=1e-2)


def test_a_pendulum_at_thirty_degrees_is_held_by_half_the_torque_of_its_weight():
    # m g l sin 30 degrees
    np.testing.assert_allclose(
        equilibrium_input(plant('pendulum'), [np.pi / 6.0, 0.0]), [-0.25 * 9.81], rtol=1e-12)


def test_a_steady_state_is_found_by_some_of_its_states_or_rejected():
    pendulum = plant('pendulum')
    x, u = steady_state(pendulum, {'angle': 0.3})
    np.testing.assert_allclose(x, [0.3, 0.0], atol=1e-15)
    np.testing.assert_allclose(u, [-0.5 * 9.81 * np.sin(0.3)], rtol=1e-12)
    with pytest.raises(EquilibriumError, match=r'no input holds .*rate = 1 rad/s: angle still'):
        steady_state(pendulum, {'rate': 1.0})
    with pytest.raises(ValueError, match='state of pendulum: choose'):
        steady_state(pendulum, {'level': 1.0})
