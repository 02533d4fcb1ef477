# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Closed loops, sampled and in continuous time, against references of their own."""

from dataclasses import dataclass, replace
import itertools
import math

import numpy as np
import pytest
from scipy.linalg import solve_continuous_are

from koopman_ros.control import Controller, InputLimits, Mode, Tuning
from koopman_ros.control.events import Initialisation, ManualCommand, ModeChange, SetpointRequest
from koopman_ros.control.laws import Feedback, feedback, Form, LAWS, Weights
from koopman_ros.core.signals import Outputs
from koopman_ros.core.solvers import solve_riccati
from koopman_ros.evaluation.loop import at, exchange, restart, run_closed_loop, run_loop
from koopman_ros.model import Coordinates, LiftedModel, linearised_model, Provenance
from koopman_ros.plants import (
    Actuator,
    ControlAffineSystem,
    Process,
    two_state_example,
    two_state_reactor,
)
from studies.paper.optimal_control import exact_two_state_model
from support.closed_loops import COOLANT, REACTOR, SETPOINT, shipped, START
from support.random_lifts import coordinates

EVERYWHERE = 100.0  # half-ranges: the margin of a law that acts anywhere


def random_pair() -> tuple[ControlAffineSystem, LiftedModel]:
    """Return dx/dt = A x + B u, two of each and an unstable mode, and its model out to ten."""
    rng = np.random.default_rng(4)
    A, B = rng.normal(size=(2, 2)) + 0.3 * np.eye(2), rng.normal(size=(2, 2)) + 2.0 * np.eye(2)
    system = ControlAffineSystem(
        'random pair', ('x1', 'x2'), ('1', '1'), ('u1', 'u2'), ('1/min', '1/min'), 'min',
        lambda x: x @ A.T, B, np.zeros(2), np.zeros(2),
        drift_jacobian=lambda x: np.broadcast_to(A, (*x.shape[:-1], 2, 2)))
    scale = np.array([1.0, 2.0])
    states, inputs = (
        Coordinates(names, units, np.zeros(2), scale, -10.0 * scale, 10.0 * scale)
        for names, units in ((system.state_names, system.state_units),
                             (system.input_names, system.input_units)))
    return system, linearised_model(A, B, states, inputs, 'min', Provenance(system.name))


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


PAIR, PAIR_MODEL = random_pair()
GOAL = np.array([0.5, -1.0])
CASES = {
    **{name: Case(shipped(name), REACTOR, np.array([START]), np.array([SETPOINT]),
                  np.array([COOLANT]), 5.0, (278.15, 305.15))
       for name in ('reactor_nz3', 'reactor_nz4')},
    'two states': Case(exact_two_state_model(), two_state_example(), np.array([0.1, 1.0]),
                       np.zeros(2), np.zeros(1), 0.5, (-50.0, 50.0)),
    'random pair': Case(
        PAIR_MODEL, PAIR, np.array([-2.0, 1.0]), GOAL,
        np.linalg.solve(PAIR.B, -PAIR.drift(GOAL)), 12.0, (-50.0, 50.0))}
each_case = pytest.mark.parametrize('case', CASES.values(), ids=CASES)


def controller(case: Case, law: str = 'sdre', bandwidth: float = 0.0) -> Controller:
    n_x, n_u = case.model.n_x, case.model.n_u
    low, high = case.bounds
    return Controller(case.model, Tuning.for_model(
        case.model, state_weight=np.full(n_x, 3.0), input_weight=np.ones(n_u),
        limits=InputLimits(np.full(n_u, low), np.full(n_u, high), np.full(n_u, np.inf)),
        observer_bandwidth=bandwidth / case.seconds,
        fallback_order=(law,), learned_model_margin=EVERYWHERE, linear_model_margin=EVERYWHERE))


def process(case: Case) -> Process:
    return Process(case.plant, 0, case.start, case.plant.nominal_input)


def run(case: Case, *events, law='sdre', bandwidth=0.0, samples=60, plant=None, **others):
    """Simulate a case from its start to its goal, unless other things are to happen."""
    return run_loop(
        controller(case, law, bandwidth), plant or process(case),
        events or [at(0.0, SetpointRequest(0, case.goal))], period=case.seconds,
        duration=samples * case.seconds, **others)


# a PI law has no gain that would suit all of them: test_pi.py has its plants
@each_case
@pytest.mark.parametrize('law', sorted(set(LAWS) - {'pi'}))
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
def test_rows_reproduce_the_run_of_the_plant(case):
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


@each_case
def test_a_simulation_in_two_parts_is_the_same(case):
    whole, first = run(case, samples=12), run(case, samples=4)
    plant = first.loop.plant.until(round(5 * case.seconds * 1e9))
    second = run_loop(first.loop.controller, plant, period=case.seconds,
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
    found = run_loop(
        replace(controller(case), outputs=Outputs(names, names, C)), process(case),
        [at(0.0, SetpointRequest(0, case.goal))], period=case.seconds,
        duration=20 * case.seconds)
    np.testing.assert_array_equal(found.measured, found.states @ C)
    np.testing.assert_allclose(found.commands, usual.commands, rtol=1e-9, atol=1e-9)


def test_a_plant_with_more_states_than_the_model_needs_the_measured_names():
    plant = two_state_reactor()
    there = Process(plant, 0, plant.nominal_state, plant.nominal_input)
    case = CASES['reactor_nz4']
    found = run_loop(controller(case), there, duration=3.0, C=np.array([[0.0, 1.0]]))
    np.testing.assert_array_equal(found.measured, found.states[:, 1:])
    with pytest.raises(ValueError, match=r'plant has 2 states and the model 1: give C \(1, 2\)'):
        run_loop(controller(case), there, duration=3.0)
    with pytest.raises(ValueError, match=r'incompatible C: expected \(1, 2\) .* got \(2, 2\)'):
        run_loop(controller(case), there, duration=3.0, C=np.eye(2))


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
@pytest.mark.parametrize('fault', [math.nan, None], ids=['NaN', 'silence'])
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


def at_rest(case, *events, **others):
    """Simulate a loop that starts at its goal."""
    there = Process(case.plant, 0, case.goal, case.held)
    return run(case, at(0.0, Initialisation(case.held)), *events, plant=there, **others)


@each_case
def test_a_hand_over_at_rest_is_not_felt(case):
    later = 10.0 * case.seconds
    heavier = replace(controller(case).tuning, input_weight=np.full(case.model.n_u, 9.0))
    for what in (exchange(Controller(case.model, heavier)), restart, ModeChange(Mode.MANUAL)):
        found = at_rest(case, at(later, what), samples=20)
        assert np.max(np.abs(np.diff(found.commands, axis=0))) < 1e-3 * np.max(
            case.model.inputs.scale)
        assert (found.levels[-1] == 'manual') is isinstance(what, ModeChange)


@each_case
def test_the_operator_moves_the_input_of_a_loop(case):
    by = 0.5 * case.model.inputs.scale
    found = at_rest(case, at(0.0, ModeChange(Mode.MANUAL)),
                    at(5.0 * case.seconds, ManualCommand(case.held + by)), samples=10)
    np.testing.assert_array_equal(found.commands[:5], [case.held] * 5)
    np.testing.assert_allclose(found.commands[5:], [case.held + by] * 6, rtol=1e-12)


def test_an_event_at_the_time_of_a_sample_is_of_that_sample():
    """3 x 0.7 s is less than 2.1 s in floating-point numbers."""
    case = CASES['reactor_nz4']
    there = Process(case.plant, 0, case.goal, case.held)
    found = run_loop(
        controller(case), there, [at(0.0, Initialisation(case.held)), *(
            at(seconds, ModeChange(mode)) for seconds, mode in (
                (2.1, Mode.MANUAL), (4.2, Mode.AUTOMATIC)))], period=0.7, duration=5.6)
    manual = [level == 'manual' for level in found.levels]
    assert manual == [False] * 3 + [True] * 3 + [False] * 3


def test_a_rejected_request_ends_the_simulation_with_its_reason():
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


# The end.

def test_a_simulation_ends_at_its_time_and_where_the_plant_cannot_continue():
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
def test_arguments_that_make_no_sense_are_rejected(change, message):
    case = CASES['reactor_nz4']
    with pytest.raises(ValueError, match=message):
        run_loop(controller(case), process(case), **{'duration': 5.0, **change})


# A law in continuous time, against the analytic cost of the linear regulator.

JACOBIAN = np.array([[0.4, 1.0], [-0.3, -0.5]])
B = np.array([[0.2], [1.5]])
WEIGHTS = Weights(np.diag([2.0, 0.5]), np.array([[0.7]]))
STATES, INPUTS = coordinates('x', 2), coordinates('u', 1)


def linear_model(jacobian=JACOBIAN, B=B):
    return linearised_model(jacobian, B, coordinates('x', len(jacobian)), INPUTS, 'min',
                            Provenance('linear'))


def rate(x, u):
    return JACOBIAN @ (x - STATES.center) + B @ (u - INPUTS.center)


def test_the_cost_of_the_linear_regulator():
    model, x0 = linear_model(), np.array([3.6, -0.4])
    loop = run_closed_loop(model, rate, x0, STATES.center, WEIGHTS, 40.0)
    assert loop.failure == ''
    xi = STATES.to_deviation(x0)
    P = solve_continuous_are(model.A, model.B, WEIGHTS.Q, WEIGHTS.R)
    assert loop.cost == pytest.approx(xi @ P @ xi, rel=1e-7)
    assert (loop.times.shape, loop.states.shape, loop.inputs.shape) == ((301,), (301, 2), (301, 1))
    np.testing.assert_array_equal(loop.times, np.linspace(0.0, 40.0, 301))
    np.testing.assert_array_equal(loop.states[0], x0)
    np.testing.assert_allclose(loop.states[-1], STATES.center, rtol=0, atol=1e-5)
    np.testing.assert_allclose(loop.inputs[-1], INPUTS.center, rtol=0, atol=1e-5)
    K = np.linalg.solve(WEIGHTS.R, model.B.T @ P)
    np.testing.assert_allclose(loop.inputs[0], INPUTS.to_physical(-K @ xi), rtol=1e-10)


# A plant of one state, in deviations of its scale from its center.
SCALAR = linear_model(np.array([[-0.8]]), np.array([[0.6]]))
CENTER, SCALE = SCALAR.states.center, SCALAR.states.scale


def scalar_rate(x, u):
    return -0.8 * (x - CENTER) + 0.6 * (u - INPUTS.center)


def drive(start, duration=10.0, *, model=SCALAR, rate=scalar_rate, **others):
    return run_closed_loop(model, rate, CENTER + start * SCALE, CENTER,
                           Weights(np.eye(1), np.eye(1)), duration, **others)


def test_distance_from_the_training_box():
    """The box reaches two scales below and one above the center, three halves as its half."""
    for start, expected in ((0.5, 0.0), (1.75, 0.5), (-2.5, 1.0 / 3.0)):
        assert drive(start, 5.0).distance(SCALAR) == pytest.approx(expected, abs=1e-9)


# Failures.

def failing(law_input=None, solved=lambda x: True):
    """Return a law that pushes with `law_input` and has an answer where `solved` says so."""
    def law(model, x, target, weights):
        found = feedback(model, x, target, weights)
        u = found.u if law_input is None else law_input(x)
        riccati = found.riccati
        if not solved(x):
            riccati = solve_riccati(np.eye(1), np.zeros((1, 1)), np.eye(1), np.eye(1))
        return Feedback(u, Form.AVERAGED, riccati, found.loop)
    return law


UNSOLVED = 'no feedback gain: the Hamiltonian has no stable subspace'
STUCK = linear_model(np.array([[0.5]]), np.zeros((1, 1)))
# u = 3 x lets the state grow as exp(t), so that it is twice its scale away after log 5
PUSHING = failing(lambda x: 1.8 * SCALE * x / (0.6 * INPUTS.scale))


@pytest.mark.parametrize(('start', 'others', 'failure', 'earliest', 'latest'), [
    # noticed at the end of a step
    (0.4, {'law': PUSHING, 'escape': 2.0}, 'the state diverged', np.log(5.0) - 10.0 / 300, 4.0),
    (3.0, {'escape': 2.0}, 'the state diverged', 0.0, 1.0),
    # a law with a jump at the set-point keeps the steps tiny
    (0.1, {'law': failing(lambda x: -5.0 * np.sign(x)), 'max_evaluations': 500},
     'the law was evaluated 500 times before the end', 0.0, 10.0),
    # once the state is half a scale away, the rate grows without bound in finite time
    (0.0, {'rate': lambda x, u: 1e3 * (1.0 + (x - CENTER) ** 2), 'escape': 1e200},
     'the integration failed', 0.0, 1.0),
    (0.2, {'model': STUCK}, UNSOLVED, 0.0, 0.0),
    (1.0, {'law': failing(solved=lambda x: x[0] > 0.5)}, UNSOLVED, 0.1, 2.0),
], ids=['escapes', 'has escaped', 'chatters', 'explodes', 'not stabilisable', 'on the way'])
def test_a_loop_that_fails_returns_the_path_up_to_there(start, others, failure, earliest, latest):
    loop = drive(start, **others)
    assert loop.failure.startswith(failure)
    assert loop.cost == np.inf
    np.testing.assert_array_equal(loop.states[0], CENTER + start * SCALE)
    assert len(loop.times) == len(loop.states) == len(loop.inputs)
    assert earliest <= loop.times[-1] <= latest
    deviation = SCALAR.states.to_deviation(loop.states[:, 0])
    if others.get('law') is PUSHING:
        np.testing.assert_allclose(deviation, 0.4 * np.exp(loop.times), rtol=1e-6)
    elif failure == UNSOLVED and 'law' in others:
        # under the law of the regulator: e' = -1 e
        assert np.min(deviation) > 0.5
        np.testing.assert_allclose(
            deviation, np.exp(-np.hypot(0.8, SCALAR.B[0, 0]) * loop.times), rtol=1e-6)
    elif failure == UNSOLVED:
        assert np.all(np.isnan(loop.inputs))


def test_a_law_without_an_answer_at_a_time_of_the_report():
    """The integration steps over the state; the inputs to return need the law there."""
    def limited(calls):
        return drive(1.0, 5.0, law=failing(solved=lambda _: next(calls) < limit), samples=3)

    limit, calls = math.inf, itertools.count()
    assert limited(calls).failure == ''
    limit = next(calls) - 1
    loop = limited(itertools.count())
    assert loop.failure.startswith(UNSOLVED)
    assert len(loop.times) == len(loop.states) == len(loop.inputs)


# What does not fit.

SHAFT = linear_model()


@pytest.mark.parametrize(('change', 'message'), [
    ({'x_ref': [3.4, 9.0]}, r'x1 = 9 K is outside the trained range -2 K to 2\.5 K: choose'),
    ({'x_ref': [np.inf, 1.0]}, 'x0 = inf K is outside the trained range'),
    ({'x_ref': 3.0}, 'incompatible set-point: expected one number for each of x0, x1, got 3.0'),
    ({'x_ref': [3.0], 'controlled': ()}, 'incompatible set-point: expected one number for each'),
    # 0 = 0.4 a + b + 0.2 v and 0 = -0.3 a - 0.5 b + 1.5 v hold a and b on a line
    ({'x_ref': [3.4, 2.0]},
     r'no input of the model holds x0, x1 at \[3\.4, 2\.0\]; the nearest steady state is'),
    ({'x0': 3.0}, r'incompatible x0: expected \(2,\), got \(\)'),
    ({'x0': [3.0, np.nan]}, 'x0 must be finite'),
    ({'weights': Weights(np.eye(1), np.eye(1))}, r'incompatible Q: expected \(2, 2\), got \(1,'),
    ({'weights': Weights(np.eye(2), np.eye(2))}, r'incompatible R: expected \(1, 1\), got \(2,'),
])
def test_a_loop_of_mismatched_arguments_is_an_error(change, message):
    usual = {'x0': STATES.center, 'x_ref': STATES.center, 'weights': WEIGHTS, 'duration': 1.0}
    with pytest.raises(ValueError, match=message):
        run_closed_loop(SHAFT, rate, **{**usual, **change})


@pytest.mark.parametrize(('Q', 'R', 'message'), [
    (1.0, [[1.0]], r'incompatible Q: expected a square matrix, got \(\); Weights.physical takes'),
    ([[1.0, 2.0]], [[1.0]], r'incompatible Q: expected a square matrix, got \(1, 2\)'),
    ([[1.0, 2.0], [0.0, 1.0]], [[1.0]], 'Q must be symmetric, positive semidefinite and not zero'),
    ([[1.0, 2.0], [2.0, 1.0]], [[1.0]], 'Q must be symmetric, positive semidefinite and not zero'),
    ([[0.0]], [[1.0]], 'Q must be symmetric, positive semidefinite and not zero'),
    ([[np.nan]], [[1.0]], r'Q must be finite, but entry \[0, 0\] is nan'),
    ([[1.0]], [[0.0]], r'R must be symmetric, positive definite, got \[\[0\.0\]\]'),
    ([[1.0]], [[-1.0]], 'R must be symmetric, positive definite')])
def test_weights_that_are_none(Q, R, message):
    with pytest.raises(ValueError, match=message):
        Weights(Q, R)


def test_weights_in_the_units_of_the_signals():
    """With e = scale e_scaled, q e^2 is q scale^2 e_scaled^2."""
    weights = Weights.physical(SHAFT, [2.0, 0.0], [3.0])
    np.testing.assert_allclose(weights.Q, np.diag([2.0 * STATES.scale[0] ** 2, 0.0]))
    np.testing.assert_allclose(weights.R, [[3.0 * INPUTS.scale[0] ** 2]])
    with pytest.raises(ValueError, match=r'incompatible state weights: expected \(2,\), got \(\)'):
        Weights.physical(SHAFT, 1.0, [3.0])
    # the cost comes out in these units, whatever the scale
    loop = run_closed_loop(SHAFT, rate, [3.6, -0.4], STATES.center, Weights.physical(
        SHAFT, [2.0, 0.5], [0.7]), 40.0)
    P = solve_continuous_are(JACOBIAN, B, np.diag([2.0, 0.5]), [[0.7]])
    e = np.array([3.6, -0.4]) - STATES.center
    assert loop.cost == pytest.approx(e @ P @ e, rel=1e-7)
