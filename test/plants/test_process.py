# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A plant that runs in time; what stands between a command and its input; the sensor."""

from dataclasses import replace
import math

import numpy as np
import pytest

from koopman_ros.core.units import in_steps
from koopman_ros.core.units import NANOSECONDS as SECOND
from koopman_ros.plants import (
    Actuator,
    advance,
    ControlAffineSystem,
    IntegrationError,
    one_state_reactor,
    Process,
    scalar_example,
    sensor_noise,
)

SLOPE, GAIN = -0.7, 0.4  # 1/s, of the linear plant


def linear() -> ControlAffineSystem:
    """Return dx/dt = SLOPE x + GAIN u, in seconds."""
    return ControlAffineSystem(
        name='linear', state_names=('x',), state_units=('1',), input_names=('u',),
        input_units=('1',), time_unit='s', drift=lambda x: SLOPE * x,
        drift_jacobian=lambda x: np.full((*x.shape, 1), SLOPE), B=np.array([[GAIN]]),
        nominal_state=np.zeros(1), nominal_input=np.zeros(1))


def analytic(x: float, v: float, u: float, lag: float, seconds: float) -> tuple[float, float]:
    """Solve the linear plant whose input v goes to u with a lag."""
    grown, decayed = np.exp(SLOPE * seconds), np.exp(-seconds / lag)
    steady = GAIN * u * (grown - 1.0) / SLOPE
    transient = GAIN * (v - u) * (grown - decayed) / (SLOPE + 1.0 / lag)
    return x * grown + steady + transient, u + (v - u) * decayed


def actuated(actuator: Actuator, system: ControlAffineSystem | None = None) -> Process:
    system = linear() if system is None else system
    return Process(system, 0, system.nominal_state, system.nominal_input, actuator)


def given(plant: Process, value: float) -> Process:
    """Return a plant with a command given at its present time."""
    return plant.commanded(np.array([value]), plant.time_ns)


# Time.

def test_an_instant_is_reached_in_the_units_of_the_plant() -> None:
    system = one_state_reactor()
    start = Process(system, 5 * SECOND, system.nominal_state - 3.0, system.nominal_input)
    later = start.until(65 * SECOND)
    assert later.time_ns == 65 * SECOND
    # one minute of a plant whose time unit is the minute
    np.testing.assert_array_equal(later.x, advance(system, start.x, start.u, 1.0))
    # xdot = x^2 has x(t) = x0 / (1 - x0 t), here in seconds
    start = Process(scalar_example(), 0, np.array([0.5]), np.zeros(0))
    assert start.until(3 * SECOND // 2).x[0] == pytest.approx(0.5 / (1.0 - 0.75), rel=1e-9)


def test_a_steady_state_stays_whatever_the_steps_and_a_runaway_is_an_error() -> None:
    process = actuated(Actuator(), one_state_reactor())
    for n in range(1, 11):
        process = process.until(n * SECOND)
    np.testing.assert_allclose(process.x, process.system.nominal_state, rtol=0.0, atol=1e-9)
    with pytest.raises(IntegrationError, match='temperature'):
        given(process, 320.0).until(3600 * SECOND)


# The lag.

@pytest.mark.parametrize('lag', [0.02, 1.0, 30.0])
def test_a_lag_is_that_of_the_analytic_solution(lag: float) -> None:
    plant = given(actuated(Actuator(lag=lag)), 2.0).until(3 * SECOND)
    expected = analytic(0.0, 0.0, 2.0, lag, 3.0)
    assert (plant.x[0], plant.u[0]) == pytest.approx(expected, abs=1e-9)
    plant = given(plant, -1.0).until(5 * SECOND)
    expected = analytic(*expected, -1.0, lag, 2.0)
    assert (plant.x[0], plant.u[0]) == pytest.approx(expected, abs=1e-9)


def test_a_lag_is_in_the_seconds_of_a_plant_in_minutes() -> None:
    system = one_state_reactor()
    late, at_once = (given(actuated(Actuator(lag=lag), system), 310.0).until(60 * SECOND)
                     for lag in (30.0, 0.0))
    assert late.u[0] == pytest.approx(310.0 - 10.0 * np.exp(-2.0), abs=1e-7)
    assert system.nominal_state[0] < late.x[0] < at_once.x[0] - 1.0


def test_a_lag_that_is_over_or_taken_away_leaves_the_command_itself() -> None:
    plant = given(actuated(Actuator(lag=1e-3)), 2.0).until(3600 * SECOND)
    assert plant.u[0] == 2.0
    assert plant.x[0] == pytest.approx(-2.0 * GAIN / SLOPE, rel=1e-9)
    plant = given(actuated(Actuator(lag=10.0)), 2.0).until(1 * SECOND)
    assert replace(plant, actuator=Actuator()).until(2 * SECOND).u[0] == 2.0


# The delay.

@pytest.mark.parametrize('samples', [0, 1, 3])
def test_a_delay_of_samples_shifts_the_commands(samples: int) -> None:
    values = [float(n * n) for n in range(10)]
    plant = actuated(Actuator(delay=0.1 * samples))
    acted = []
    for n, value in enumerate(values, start=1):
        # what acts in a hold is known at its end
        plant = given(plant, value).until(n * SECOND // 10)
        acted.append(plant.u[0])
    assert acted == [0.0] * samples + values[:len(values) - samples]


@pytest.mark.parametrize(('delay', 'lag'), [(0.4, 0.0), (0.5, 0.3)])
def test_a_delay_takes_effect_in_the_middle_of_a_hold_and_the_lag_follows(
        delay: float, lag: float) -> None:
    plant = given(actuated(Actuator(delay=delay, lag=lag)), 2.0).until(SECOND)
    assert (plant.x[0], plant.u[0]) == pytest.approx(
        analytic(0.0, 0.0, 2.0, max(lag, 1e-12), 1.0 - delay), abs=1e-9)


@pytest.mark.parametrize(('delay', 'lag', 'dead_time'), [
    (0.0, 0.0, 0.4), (0.1, 0.0, 0.3), (0.25, 0.3, 0.35)])
def test_an_input_acts_a_dead_time_after_it_is_applied(
        delay: float, lag: float, dead_time: float) -> None:
    plant = given(actuated(Actuator(delay=delay, lag=lag, dead_time=dead_time)), 2.0)
    same = given(actuated(Actuator(delay=delay, lag=lag)), 2.0)
    for n in range(1, 9):
        plant, same = (one.until(n * 17 * SECOND // 100) for one in (plant, same))
        assert plant.applied[0] == pytest.approx(same.u[0], abs=1e-9)
        late = 0.17 * n - delay - dead_time
        assert (plant.x[0], plant.u[0]) == pytest.approx(
            (0.0, 0.0) if late <= 0.0 else analytic(0.0, 0.0, 2.0, max(lag, 1e-12), late),
            abs=1e-9)
    assert plant.x[0] != 0.0


def test_a_command_supersedes_those_that_would_act_later() -> None:
    plant = given(given(actuated(Actuator(delay=5.0)), 1.0).until(SECOND), 2.0)
    plant = given(replace(plant, actuator=Actuator(delay=4.5)), 3.0)
    # of the first input, which is the only one
    assert plant.pending == ((5 * SECOND, 0, 1.0), (11 * SECOND // 2, 0, 3.0))
    plant = given(replace(plant, actuator=Actuator()), 4.0).until(20 * SECOND)
    assert plant.u[0] == plant.command[0] == 4.0
    # an earlier instant changes nothing
    assert plant.until(20 * SECOND) is plant.until(SECOND) is plant


def test_an_input_reaches_no_further_than_its_range_also_when_that_narrows() -> None:
    plant = given(actuated(Actuator(lower=-1.0, upper=1.5)), 2.0).until(SECOND)
    assert plant.u[0] == 1.5
    assert given(plant, -2.0).until(2 * SECOND).u[0] == -1.0
    plant = replace(plant, actuator=Actuator(upper=1.0)).until(2 * SECOND)
    assert plant.u[0] == 1.0
    assert replace(plant, actuator=Actuator()).until(3 * SECOND).u[0] == 2.0


def test_a_valve_of_equal_percentage_multiplies_its_gain_from_end_to_end() -> None:
    valve = Actuator(0.0, 100.0, rangeability=20.0)
    u = np.linspace(0.0, 100.0, 101)[:, None]
    effect = valve.effect(u)
    np.testing.assert_allclose(effect[[0, -1], 0], [0.0, 100.0], atol=1e-12)
    # equal percentage: the gain grows by the same factor for each percent, by 20 in all
    np.testing.assert_allclose(np.diff(effect[:, 0], 2) / np.diff(effect[:-1, 0]),
                               20.0 ** 0.01 - 1.0, rtol=1e-9)
    np.testing.assert_allclose(valve.position(effect), u, atol=1e-9)
    # of two inputs the other one is linear
    two = Actuator(0.0, 100.0, rangeability=np.array([1.0, 20.0]))
    np.testing.assert_allclose(two.effect(np.array([30.0, 30.0])), [30.0, effect[30, 0]])
    # the plant shows the position and feels the effect, with a lag before it, too
    plant = given(actuated(replace(valve, lag=1e-3)), 30.0).until(3600 * SECOND)
    assert plant.u[0] == 30.0
    assert plant.x[0] == pytest.approx(-effect[30, 0] * GAIN / SLOPE, rel=1e-9)
    plant = given(actuated(replace(valve, lag=2.0)), 30.0).until(SECOND)
    moved = np.linspace(0.0, 1.0, 2001)
    acted = valve.effect(30.0 * (1.0 - np.exp(-moved / 2.0))[:, None])[:, 0]
    assert plant.x[0] == pytest.approx(
        np.trapezoid(GAIN * acted * np.exp(SLOPE * (1.0 - moved)), moved), rel=1e-6)


# The sensor.

def test_noise_repeats_by_seed_and_sample() -> None:
    values = [sensor_noise(0.1, 7, n) for n in range(4000)]
    assert values == [sensor_noise(0.1, 7, n) for n in range(4000)]
    assert values[:5] != [sensor_noise(0.1, 8, n) for n in range(5)]
    # 4000 samples determine the standard deviation to about 1.1 % (one sigma)
    assert math.isclose(np.std(values), 0.1, rel_tol=0.05)
    assert abs(np.mean(values)) < 5 * 0.1 / math.sqrt(4000)
    assert sensor_noise(0.0, 7, 3) == 0.0
    # that of another signal is its own
    other = [sensor_noise(0.1, 7, n, 1) for n in range(1000)]
    assert abs(np.corrcoef(values[:1000], other)[0, 1]) < 0.15


@pytest.mark.parametrize(('value', 'resolution', 'shown'), [
    (25.34, 0.1, 25.3), (25.36, 0.1, 25.4), (-0.3, 0.25, -0.25), (7.0, 10.0, 10.0),
    (3.0, 10.0, 0.0), (51.3, 5e-324, 51.3), (1.0 / 3.0, 0.0, 1.0 / 3.0)])
def test_a_sensor_shows_multiples_of_its_resolution(
        value: float, resolution: float, shown: float) -> None:
    assert in_steps(value, resolution) == pytest.approx(shown, abs=1e-14)
