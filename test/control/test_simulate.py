# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The sampled closed loop: laws on plants against references of their own, and what happens."""

from dataclasses import dataclass, replace
import math

import numpy as np
import pytest
from scipy.linalg import expm

from koopman_ros.control import (
    at,
    Controller,
    exchange,
    Initialisation,
    InputLimits,
    LAWS,
    LevelSettings,
    ManualCommand,
    Mode,
    ModeChange,
    perfect,
    restart,
    SetpointRequest,
    Settings,
    simulate,
    SupervisorSettings,
)
from koopman_ros.lifting import Coordinates, LiftedModel, linearised_model, Provenance
from koopman_ros.plants import (
    Actuator,
    ControlAffineSystem,
    Process,
    two_state_example,
    two_state_reactor,
)
from koopman_ros.signals import Outputs
from support.closed_loops import COOLANT, REACTOR, SETPOINT, shipped, START
from validation.paper.optimal_control import exact_two_state_model

NAN = math.nan
EVERYWHERE = 1e9  # half widths: the margin of a law that acts anywhere


def random_pair() -> ControlAffineSystem:
    """Return dx/dt = A x + B u with two states and two inputs, one of its modes unstable."""
    rng = np.random.default_rng(4)
    A, B = rng.normal(size=(2, 2)) + 0.3 * np.eye(2), rng.normal(size=(2, 2)) + 2.0 * np.eye(2)
    return ControlAffineSystem(
        'random pair', ('x1', 'x2'), ('1', '1'), ('u1', 'u2'), ('1/min', '1/min'), 'min',
        lambda x: x @ A.T, lambda x: np.broadcast_to(A, (*x.shape[:-1], 2, 2)), B, np.zeros(2),
        np.zeros(2))


def exact(system: ControlAffineSystem) -> LiftedModel:
    """Return the linear model of a plant about its nominal point, known out to ten."""
    def coordinates(names: tuple[str, ...], units: tuple[str, ...]) -> Coordinates:
        scale = 1.0 + np.arange(float(len(names)))
        return Coordinates(names, units, np.zeros(len(names)), scale, -10.0 * scale,
                           10.0 * scale)

    states = coordinates(system.state_names, system.state_units)
    inputs = coordinates(system.input_names, system.input_units)
    return linearised_model(
        system.drift_jacobian(system.nominal_state), system.B, states, inputs, system.time_unit,
        Provenance(system.name))


@dataclass(frozen=True)
class Case:
    """A model on its plant."""

    model: LiftedModel
    plant: ControlAffineSystem
    start: np.ndarray  #: (n,) of the plant
    goal: np.ndarray  #: (n,) of the set-point
    held: np.ndarray  #: (n_u,) input that holds it, by other means
    seconds: float  #: between samples; sixty of them are simulated
    bounds: tuple[float, float]  #: of each input


PAIR = random_pair()
GOAL = np.array([0.5, -1.0])
CASES = {
    **{name: Case(shipped(name), REACTOR, np.array([START]), np.array([SETPOINT]),
                  np.array([COOLANT]), 5.0, (278.15, 305.15))
       for name in ('reactor_nz3', 'reactor_nz4')},
    'two states': Case(exact_two_state_model(), two_state_example(), np.array([0.1, 1.0]),
                       np.zeros(2), np.zeros(1), 0.5, (-50.0, 50.0)),
    'random pair': Case(
        exact(PAIR), PAIR, np.array([-2.0, 1.0]), GOAL,
        np.linalg.solve(PAIR.B, -PAIR.drift(GOAL)), 12.0, (-50.0, 50.0))}
each_case = pytest.mark.parametrize('case', CASES.values(), ids=CASES)


def controller(case: Case, law: str = 'sdre', bandwidth: float = 0.0, **settings: object
               ) -> Controller:
    n_x, n_u = case.model.n_x, case.model.n_u
    low, high = case.bounds
    return Controller(case.model, Settings.for_model(
        case.model, state_weight=np.full(n_x, 3.0), input_weight=np.ones(n_u),
        limits=InputLimits(np.full(n_u, low), np.full(n_u, high), np.full(n_u, np.inf)),
        **{'observer_bandwidth': bandwidth / case.seconds, 'supervisor': SupervisorSettings(
            (LevelSettings(law, EVERYWHERE),)), **settings}))


def process(case: Case) -> Process:
    return Process(case.plant, 0, case.start, case.plant.nominal_input)


def run(case: Case, *events, law='sdre', bandwidth=0.0, samples=60, plant=None, **others):
    """Simulate a case from its start to its goal, unless other things are to happen."""
    return simulate(
        controller(case, law, bandwidth), plant or process(case),
        events or [at(0.0, SetpointRequest(0, case.goal))], period=case.seconds,
        duration=samples * case.seconds, **others)


@each_case
@pytest.mark.parametrize('law', LAWS)
def test_each_law_brings_each_plant_to_its_setpoint(case, law):
    # the linear law leaves the reactor off its set-point, and the observer makes up for it
    bandwidth = 0.4 if (law, case.plant) == ('linear', REACTOR) else 0.0
    found = run(case, law=law, bandwidth=bandwidth)
    assert set(found.levels) == {law}
    size = case.model.states.scale
    np.testing.assert_allclose((found.states[-1] - case.goal) / size, 0.0, atol=5e-3)
    np.testing.assert_allclose(
        (found.commands[-1] - case.held) / case.model.inputs.scale, 0.0, atol=2e-2)
    assert np.all((found.commands >= case.bounds[0]) & (found.commands <= case.bounds[1]))


@each_case
def test_rows_are_what_the_plant_did(case):
    found = run(case, samples=5)
    n_x, n_u = case.model.n_x, case.model.n_u
    np.testing.assert_array_equal(found.times, case.seconds * np.arange(6.0))
    assert [a.shape for a in (found.states, found.measured, found.setpoints)] == [(6, n_x)] * 3
    assert found.commands.shape == found.inputs.shape == (6, n_u)
    np.testing.assert_array_equal(found.measured, found.states)
    np.testing.assert_array_equal(found.setpoints[-1], case.goal)
    # what is commanded acts from then on
    np.testing.assert_array_equal(found.inputs[1:], found.commands[:-1])
    plant = process(case)
    for number, command in enumerate(found.commands[:-1]):
        plant = replace(plant, u=command).until(round((number + 1) * case.seconds * 1e9))
        np.testing.assert_array_equal(plant.x, found.states[number + 1])


def test_a_linear_plant_follows_its_matrix_exponential():
    found = run(CASES['random pair'], samples=20)
    A, B = PAIR.drift_jacobian(np.zeros(2)), PAIR.B
    both = expm(np.block([[A, B], [np.zeros((2, 4))]]) * CASES['random pair'].seconds / 60.0)
    expected = found.states[:-1] @ both[:2, :2].T + found.commands[:-1] @ both[:2, 2:].T
    np.testing.assert_allclose(found.states[1:], expected, rtol=1e-8)


@each_case
def test_a_simulation_in_two_parts_is_the_same(case):
    whole, first = run(case, samples=12), run(case, samples=4)
    plant = first.loop.plant.until(round(5 * case.seconds * 1e9))
    second = simulate(first.loop.controller, plant, period=case.seconds,
                      duration=7 * case.seconds, state=first.loop.state)
    for name in ('states', 'commands', 'setpoints', 'inputs'):
        np.testing.assert_array_equal(
            np.concatenate([getattr(first, name), getattr(second, name)]), getattr(whole, name))


# What is measured.

@each_case
def test_outputs_in_other_units_give_the_same_loop(case):
    C = np.diag(1.0 + np.arange(float(case.model.n_x))) * 4.0
    usual = run(case, samples=20)
    names = tuple(f'y{k}' for k in range(case.model.n_x))
    found = simulate(
        replace(controller(case), outputs=Outputs(names, names, C)), process(case),
        [at(0.0, SetpointRequest(0, case.goal))], period=case.seconds,
        duration=20 * case.seconds)
    np.testing.assert_array_equal(found.measured, found.states @ C)
    np.testing.assert_allclose(found.commands, usual.commands, rtol=1e-9, atol=1e-9)


def test_a_plant_with_more_states_than_the_model_needs_to_know_what_is_measured():
    plant = two_state_reactor()
    there = Process(plant, 0, plant.nominal_state, plant.nominal_input)
    case = CASES['reactor_nz4']
    found = simulate(controller(case), there, duration=3.0, C=np.array([[0.0, 1.0]]))
    np.testing.assert_array_equal(found.measured, found.states[:, 1:])
    with pytest.raises(ValueError, match=r'plant has 2 states and the model 1: give C \(1, 2\)'):
        simulate(controller(case), there, duration=3.0)
    with pytest.raises(ValueError, match=r'incompatible C: expected \(1, 2\) .* got \(2, 2\)'):
        simulate(controller(case), there, duration=3.0, C=np.eye(2))


@each_case
def test_noise_is_that_of_its_seed(case):
    noise = 0.01 * case.model.states.scale
    first, again, other = (run(case, samples=40, noise=noise, seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.commands, again.commands)
    assert not np.array_equal(first.commands, other.commands)
    added = (first.measured - first.states) / noise
    assert 0.6 < np.std(added) < 1.4
    assert abs(np.corrcoef(added[:-1].ravel(), added[1:].ravel())[0, 1]) < 0.4


@each_case
@pytest.mark.parametrize('fault', [NAN, None], ids=['NaN', 'silence'])
def test_a_sensor_that_fails_holds_the_command_until_it_is_back(case, fault):
    def sensor(y, seconds):
        blind = 10.0 <= seconds / case.seconds < 15.0
        return y if not blind else None if fault is None else np.full_like(y, fault)

    found = run(case, sensor=sensor)
    assert set(found.levels[10:15]) == {'hold'}
    assert np.all(np.isnan(found.measured[10:15]))
    np.testing.assert_array_equal(found.commands[10:15], found.commands[[9] * 5])
    assert found.levels[15] == 'sdre'
    np.testing.assert_allclose(
        (found.states[-1] - case.goal) / case.model.states.scale, 0.0, atol=5e-3)


def test_silence_from_the_start_commands_nothing():
    found = run(CASES['reactor_nz4'], samples=3, sensor=lambda y, _: None)
    assert np.all(np.isnan(found.commands))
    np.testing.assert_array_equal(found.inputs, [REACTOR.nominal_input] * 4)


@pytest.mark.parametrize(('stamp', 'back'), [
    (lambda time_ns: 10 ** 18 + time_ns, []),
    # after a minute the clock is set back by half an hour
    (lambda time_ns: 10 ** 18 + time_ns - (time_ns >= 6 * 10 ** 10) * 18 * 10 ** 11, [12])])
def test_stamps_are_those_of_the_clock(stamp, back):
    found = run(CASES['reactor_nz4'], stamp=stamp)
    assert [n for n, report in enumerate(found.reports)
            if report.measurement.clock_went_back] == back
    assert abs(found.states[-1, 0] - SETPOINT) < 0.01


# What happens to the controller.

def steps(found) -> float:
    return float(np.max(np.abs(np.diff(found.commands, axis=0))))


def at_rest(case, *events, **others):
    """Simulate a loop that starts at its goal."""
    there = Process(case.plant, 0, case.goal, case.held)
    return run(case, at(0.0, Initialisation(case.held)), *events, plant=there, **others)


@each_case
def test_a_hand_over_at_rest_is_not_felt(case):
    later = 10.0 * case.seconds
    heavier = replace(controller(case).settings, input_weight=np.full(case.model.n_u, 9.0))
    for what in (exchange(Controller(case.model, heavier)), restart, ModeChange(Mode.MANUAL)):
        found = at_rest(case, at(later, what), samples=20)
        assert steps(found) < 1e-3 * float(np.max(case.model.inputs.scale))
        assert (found.levels[-1] == 'manual') is isinstance(what, ModeChange)


@each_case
def test_the_operator_moves_the_input_of_a_loop(case):
    by = 0.5 * case.model.inputs.scale
    found = at_rest(case, at(0.0, ModeChange(Mode.MANUAL)),
                    at(5.0 * case.seconds, ManualCommand(case.held + by)), samples=10)
    np.testing.assert_array_equal(found.commands[:5], [case.held] * 5)
    np.testing.assert_allclose(found.commands[5:], [case.held + by] * 6, rtol=1e-12)


def test_what_is_refused_ends_the_simulation_with_the_reason():
    with pytest.raises(ValueError, match='set-point 200 K is outside the trained range 305 K to'):
        run(CASES['reactor_nz4'], at(1.0, SetpointRequest(0, np.array([200.0]))))


# What stands between command and plant.

@each_case
def test_an_actuator_is_late_and_reaches_less(case):
    low, high = case.bounds
    held = case.plant.nominal_input
    reach = Actuator(0.5 * (low + held[0]), 0.5 * (high + held[0]), delay=2.0 * case.seconds)
    found = run(case, plant=replace(process(case), actuator=reach), samples=20)
    np.testing.assert_array_equal(found.inputs[:3], [held] * 3)
    np.testing.assert_array_equal(
        found.inputs[3:], np.clip(found.commands[:-3], reach.lower, reach.upper))


@pytest.mark.parametrize(('sensor', 'follows'), [
    (None, True), (perfect, False), (lambda u, seconds: u + 4.0 * (seconds > 30.0), True)])
def test_a_measured_input_shows_whether_it_follows(sensor, follows):
    case = CASES['reactor_nz4']
    stuck = replace(process(case), actuator=Actuator(lower=298.15))
    tolerance = np.array([2.0 if follows is False else 30.0])
    found = simulate(controller(case, input_tolerance=tolerance), stuck,
                     [at(0.0, SetpointRequest(0, case.goal))], duration=60.0, input_sensor=sensor)
    assert found.reports[-1].measurement.follows is follows


# The end.

def test_it_ends_where_it_is_told_and_where_the_plant_cannot_go_on():
    case = CASES['reactor_nz4']
    found = run(case, stop=lambda x, u, report: bool(x[0] < START - 5.0))
    assert np.flatnonzero(found.states[:, 0] < START - 5.0).tolist() == [len(found.times) - 1]
    assert found.failure == ''
    hot = replace(process(case), x=np.array([340.0]), u=np.array([305.15]))
    ran_away = run(case, at(0.0, ModeChange(Mode.MANUAL)),
                   at(0.0, ManualCommand(np.array([305.15]))), plant=hot)
    assert 'left its bounds' in ran_away.failure
    assert len(ran_away.times) == len(ran_away.reports) < 60


@pytest.mark.parametrize(('change', 'message'), [
    ({'duration': -1.0}, r'duration is -1\.0 s, must be finite and at least 0'),
    ({'duration': math.inf}, 'duration is inf s'),
    ({'period': 0.0}, r'period is 0\.0 s, must be finite and above 0'),
    ({'noise': np.ones(2)}, 'incompatible noise: expected one number for each of temperature')])
def test_arguments_that_make_no_sense_are_refused(change, message):
    case = CASES['reactor_nz4']
    with pytest.raises(ValueError, match=message):
        simulate(controller(case), process(case), **{'duration': 5.0, **change})
