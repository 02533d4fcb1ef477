# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""States that are not measured: filters against Kalman's equations, and the reactor's saddle."""

from dataclasses import replace
import itertools
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm, solve_discrete_are

from koopman_ros.control import (
    Controller,
    Initialisation,
    InputLimits,
    Mode,
    SensorLimits,
    SetpointRequest,
    State,
    Supervisor,
    Tuning,
)
from koopman_ros.control.laws.pi import PIParameters
from koopman_ros.core.arrays import Array
from koopman_ros.core.signals import Outputs
from koopman_ros.core.status import StatusCode
from koopman_ros.estimation import (
    Estimate,
    Estimator,
    ExtendedKalmanFilter,
    History,
    UnscentedKalmanFilter,
)
from koopman_ros.estimation.kalman_filters import uncertainty
from koopman_ros.evaluation import at, exchange, Loop, run_loop
from koopman_ros.evaluation.loop import LoopRun
from koopman_ros.model import Coordinates, LiftedModel, linearised_model, Provenance
from koopman_ros.plants import Process, steady_state, two_state_reactor
from koopman_ros.plants.library.reactor import ReactorParameters
from studies.general.systems import SADDLE
from studies.true_model import TrueModel
from support.closed_loops import content, SECOND, shipped
from support.random_lifts import coordinates, random_lift

FILTERS = [ExtendedKalmanFilter, UnscentedKalmanFilter]
SYSTEM = two_state_reactor(nominal_state=SADDLE)
TRUTH = TrueModel.of(SYSTEM, np.array([0.1, 325.0]), np.array([0.95, 375.0]), np.array([278.15]),
                     np.array([305.15]))
TEMPERATURE = Outputs(('temperature',), ('K',), np.array([[0.0, 1.0]]))
NOISE = 0.1  # K
WIDE = InputLimits(np.array([253.15]), np.array([373.15]), np.ones(1))


def linear(A: Array, B: Array) -> LiftedModel:
    A, B = np.asarray(A), np.asarray(B)
    return linearised_model(A, B, coordinates('x', len(A)), coordinates('u', B.shape[1]), 'min',
                            Provenance('linear'))


def first(model: LiftedModel, n_y: int) -> Outputs:
    states = model.states
    return Outputs(states.names[:n_y], states.units[:n_y], np.eye(model.n_x)[:n_y])


def kalman(kind: type[Estimator], model: LiftedModel, outputs: Outputs, *, noise: float = 0.1,
           disturbance_noise: float = 0.05, error: float = 0.3) -> Any:
    """Return a filter; the former noise is per root second, errors are in scaled deviations."""
    return kind(model, outputs, Tuning.for_model(
        model, measurement_noise=noise,
        disturbance_noise=disturbance_noise * np.sqrt(60.0) * model.inputs.scale,
        initial_error=error * model.states.scale).for_signals(model, outputs.names), None)


def oscillator() -> LiftedModel:
    return linear([[-0.2, 1.0], [-1.5, -0.1]], [[0.0], [0.7]])


@pytest.mark.parametrize('kind', FILTERS)
@pytest.mark.parametrize('seconds', [2.0, 20.0])
def test_a_linear_plant_is_filtered_as_by_the_riccati_equation(kind, seconds):
    model = oscillator()
    one = kalman(kind, model, first(model, 1))
    estimate = Estimate(np.zeros(2), np.zeros(2))
    for _ in range(400):
        estimate = one.predict(estimate, np.zeros(1), seconds)
        predicted = estimate.covariance
        estimate = one.correct(estimate, estimate.x, seconds)
    # the same by scipy: x and the disturbance, which acts like the input
    A = np.zeros((3, 3))
    A[:2] = np.hstack((model.A, model.B))
    F = expm(A * seconds / 60.0)
    H = np.array([[model.states.scale[0], 0.0, 0.0]])
    wanders = F @ np.diag([0.0, 0.0, seconds * 0.05 ** 2]) @ F.T
    expected = solve_discrete_are(F.T, H.T, wanders, np.array([[0.1 ** 2]]))
    spread = np.block([[np.eye(2), np.zeros((2, 1))], [np.zeros((2, 2)), model.B]])
    expected = spread @ expected @ spread.T
    assert predicted == pytest.approx(expected, abs=1e-4 * np.max(np.abs(expected)))


def test_sigma_points_of_one_state_have_the_mean_and_covariance_of_a_linear_flow():
    """Of so few, the one in the middle has a weight as well."""
    model = linear([[-0.4]], [[0.7]])
    start, u = Estimate(np.array([0.6]), np.array([0.3])), np.array([0.5])
    expected, found = (kalman(kind, model, first(model, 1)).predict(start, u, 20.0)
                       for kind in FILTERS)
    assert found.x == pytest.approx(expected.x, rel=1e-9)
    assert found.covariance == pytest.approx(expected.covariance, rel=1e-9)


@pytest.mark.parametrize('kind', FILTERS)
def test_the_covariance_follows_the_nonlinear_flow(kind):
    one = kalman(kind, TRUTH, TEMPERATURE, disturbance_noise=1e-4)
    x, w, u = np.array([0.2, -0.3]), np.array([0.0, 0.4]), np.array([0.5])
    P = 1e-8 * np.eye(4)
    found = one.predict(Estimate(x, w, P), u, 20.0)

    def flow(start: Array) -> Array:
        rate = TRUTH.rate_under(u, start[2:])
        done = solve_ivp(lambda _, x: rate(x), (0.0, 20.0 / 60.0), start[:2], rtol=1e-11,
                         atol=1e-12)
        return np.concatenate((done.y[:, -1], start[2:]))

    start = np.concatenate((x, w))
    F = np.array([(flow(start + d) - flow(start - d)) / 2e-5 for d in 1e-5 * np.eye(4)]).T
    # what wanders in the meantime acts on the temperature alone, by B
    before = P + np.pad(20.0 * np.outer(TRUTH.B, TRUTH.B) * 1e-4 ** 2, (2, 0))
    expected = F @ before @ F.T
    assert found.x == pytest.approx(flow(start)[:2], abs=1e-4)
    assert found.covariance == pytest.approx(expected, abs=2e-3 * np.max(np.abs(expected)))


@pytest.mark.parametrize(('factor', 'consistent'), [(1.0, True), (2.0, False), (0.5, False)])
def test_squared_innovations_match_the_stated_noise(factor, consistent):
    model, rng = oscillator(), np.random.default_rng(3)
    one = kalman(ExtendedKalmanFilter, model, first(model, 1), noise=0.1 * factor)
    F = expm(np.vstack((np.hstack((model.A, model.B)), np.zeros((1, 3)))) * 5.0 / 60.0)
    truth = np.zeros(3)
    estimate = one.restart(None, np.zeros(2), None)
    for _ in range(400):
        truth[2] += rng.normal(0.0, 0.05 * np.sqrt(5.0))
        truth = F @ truth
        estimate = one.predict(estimate, np.zeros(1), 5.0)
        y = model.states.scale[0] * truth[0] + rng.normal(0.0, 0.1)
        estimate = one.correct(estimate, np.array([y / model.states.scale[0], estimate.x[1]]), 5.0)
    lower, upper = estimate.innovation.expected
    assert (lower <= estimate.innovation.mean_square <= upper) is consistent


@pytest.mark.parametrize(('A', 'B', 'hidden'), [
    # a hidden integrator that nothing measured depends on
    ([[-1.0, 0.0], [0.0, 0.0]], [[1.0], [0.0]], True),
    # one that decays may stay unseen
    ([[-1.0, 0.0], [0.0, -0.5]], [[1.0], [0.0]], False),
    # the input does not reach what is measured: its rate has a disturbance of its own
    ([[-1.0, 0.0], [1.0, -0.5]], [[0.0], [1.0]], False)])
def test_a_state_that_cannot_be_seen_is_rejected(A, B, hidden):
    model = linear(A, B)
    if hidden:
        with pytest.raises(ValueError, match='do not determine the states x0, x1'):
            kalman(ExtendedKalmanFilter, model, first(model, 1))
    else:
        assert kalman(ExtendedKalmanFilter, model, first(model, 1))
        # also where the disturbance hardly wanders, as by default with a long dead time
        assert kalman(ExtendedKalmanFilter, model, first(model, 1),
                      disturbance_noise=1e-9)


def saddle(model: LiftedModel = TRUTH, **changes: object) -> Controller:
    """Return the controller of the temperature that knows nothing else."""
    return Controller(model, Tuning.for_model(model, **{
        'state_weight': np.array([0.0, 1.0]), 'input_weight': np.ones(1), 'limits': WIDE,
        'controlled': ('temperature',),
        'measurement_noise': np.array([NOISE]),
        'disturbance_noise': np.array([0.1 * np.sqrt(60.0)]),
        'initial_error': np.array([0.2, 2.0]),
        'fallback_order': ('sdre',), 'learned_model_margin': 0.3, **changes}), TEMPERATURE)


def run(one: Controller, *events: object, goal: float = 350.0, wrong: float = 0.0,
        **options: object) -> LoopRun:
    """Lead the reactor from rest at 350 K, with a wrong initial concentration."""
    x0, u0 = steady_state(SYSTEM, {'temperature': 350.0})
    return run_loop(one, Process(SYSTEM, 0, x0 + np.array([wrong, 0.0]), u0), [
        at(0.0, Initialisation(u0)), at(0.0, SetpointRequest(0, np.array([goal]))), *events],
        noise=np.array([NOISE]), **options)


def changed(**constants: float):
    plant = two_state_reactor(ReactorParameters(**constants), nominal_state=SADDLE)

    def change(loop: Loop) -> Loop:
        before = loop.plant
        return replace(loop, plant=Process(plant, before.time_ns, before.x, before.u))

    return change


@pytest.mark.parametrize(('estimator', 'constants', 'known'), [
    ('unscented_kalman_filter', {'heat_transfer_coefficient': 0.85 * 5e4}, True),
    ('extended_kalman_filter', {'feed_temperature': 355.0}, True),
    # one output has one disturbance: it is taken for one of the heat balance
    ('extended_kalman_filter', {'feed_concentration': 1.1}, False)])
def test_the_saddle_is_held_by_its_temperature_alone(estimator, constants, known):
    loop = run(saddle(estimator=estimator), at(60.0, changed(**constants)),
               at(300.0, SetpointRequest(0, np.array([345.0]))), duration=600.0, seed=1)
    T = loop.states[:, 1]
    assert set(loop.levels) == {'sdre'}
    assert np.max(np.abs(T[:300] - 350.0)) < 4.0
    assert abs(np.mean(T[200:300]) - 350.0) < 0.05
    assert abs(np.mean(T[500:]) - 345.0) < 0.05
    estimates = np.array([report.estimate.state[0] for report in loop.reports])
    error = estimates[500:] - loop.states[500:, 0]
    assert np.max(np.abs(error)) < (2e-3 if known else 0.06)
    # it says itself how well it knows what is not measured
    deviation = np.array([report.estimate.deviation[0] for report in loop.reports])
    assert deviation[0] == pytest.approx(0.2)
    assert not known or np.all(np.abs(error) < 5.0 * deviation[500:])


@pytest.mark.parametrize('wrong', [-0.2, 0.1])
def test_a_wrong_initial_estimate_of_an_unmeasured_state_is_corrected(wrong):
    loop = run(saddle(), wrong=wrong, duration=250.0, seed=2)
    assert set(loop.levels) == {'sdre'}
    assert abs(np.mean(loop.states[-100:, 1]) - 350.0) < 0.05


def test_a_sensor_that_is_lost_for_five_seconds_is_bridged_by_the_model():
    loop = run(saddle(), goal=355.0, duration=250.0, seed=3,
               sensor=lambda y, seconds: None if 8.0 < seconds < 14.0 else y)
    assert set(loop.levels) == {'sdre', 'hold'}
    assert np.max(loop.states[:, 1]) < 358.0
    assert abs(np.mean(loop.states[-100:, 1]) - 355.0) < 0.05
    deviations = np.array([report.estimate.deviation[1] for report in loop.reports[1:]])
    # it grows while nothing comes
    assert np.all(np.diff(deviations[8:12]) > 0.0)
    assert deviations[11] > 1.5 * deviations[6]


def test_a_state_transfers_to_a_model_in_other_units():
    states = TRUTH.states
    twice = replace(TRUTH, states=replace(states, scale=2.0 * states.scale),
                    A=TRUTH.A, B=0.5 * TRUTH.B)
    loop = run(saddle(), at(20.0, changed(heat_transfer_coefficient=0.9 * 5e4)),
               at(100.0, exchange(saddle(twice))), duration=101.0, seed=4)
    before, after = (loop.reports[k].estimate for k in (99, 100))
    assert after.deviation == pytest.approx(before.deviation, rel=0.05)
    assert after.disturbance == pytest.approx(before.disturbance, abs=0.5)
    assert abs(float(loop.commands[100, 0] - loop.commands[99, 0])) <= 1.0


def test_a_model_with_other_hidden_states_starts_from_the_measurement():
    # the same plant, its concentration in other words
    names = ('conversion', 'temperature')
    other = replace(TRUTH, states=Coordinates(
        names, ('1', 'K'), TRUTH.states.center, TRUTH.states.scale, TRUTH.states.lower,
        TRUTH.states.upper))
    loop = run(saddle(), at(100.0, exchange(saddle(other))), duration=250.0, seed=5)
    assert set(loop.levels) == {'sdre'}
    assert abs(np.mean(loop.states[200:, 1]) - 350.0) < 0.05


def test_more_inputs_than_outputs_and_fewer():
    # one disturbance for each output, whatever the inputs: no offset where the plant differs
    for n_u, n_y in ((2, 1), (1, 2), (1, 1)):
        model = random_lift(2, n_u=n_u, seed=1)
        one = kalman(ExtendedKalmanFilter, model, first(model, n_y))
        assert np.linalg.matrix_rank(one.initial_covariance[2:, 2:]) == n_y


def test_a_start_up_from_far_outside_the_data_arrives():
    # a PI law, which asks nothing of the model, until the data begin
    limits = InputLimits(np.array([278.15]), np.array([305.15]), np.ones(1))
    one = saddle(limits=limits, setpoint_ramp=np.array([0.1]), fallback_order=('sdre', 'pi'),
                 linear_model_margin=3.0, plugins={'pi': PIParameters([0.0, 8.0], [1.0, 120.0])})
    u0 = np.array([300.0])
    loop = run_loop(one, Process(SYSTEM, 0, np.array([0.95, 300.0]), u0), [
        at(0.0, Initialisation(u0)), at(5.0, SetpointRequest(0, np.array([350.0])))],
        duration=800.0, noise=np.array([NOISE]), seed=7)
    levels = loop.levels
    assert set(levels) == {'pi', 'sdre'}
    taken_over = levels.index('sdre')
    assert set(levels[taken_over:]) == {'sdre'}
    assert np.max(loop.states[:, 1]) < 351.0
    assert abs(np.mean(loop.states[-100:, 1]) - 350.0) < 0.05


def test_noise_that_is_not_given_is_that_of_the_record():
    model = oscillator()
    outputs, name = first(model, 1), model.states.names[0]
    known = replace(model, provenance=replace(
        model.provenance, metrics={f'noise_{name}': 0.125}))
    half = 0.5 * (model.states.upper[0] - model.states.lower[0])
    for noise, one, deadband, expected in (
            (0.0, model, 0.0, 1e-3 * half), (0.0, known, 0.0, 0.125), (0.5, known, 0.0, 0.5),
            (0.3, known, 0.4 * np.sqrt(3.0), 0.5)):
        given = Tuning.for_model(one, measurement_noise=noise, sensor=SensorLimits(
            np.full(1, -1e9), np.full(1, 1e9), report_on_change=np.ones(1),
            deadband=np.array([deadband])))
        assert uncertainty(one, outputs, given)[0] == pytest.approx([expected], rel=1e-12)


def test_an_uncertain_measurement_has_more_noise_and_a_bad_one_is_missing():
    model, outputs = oscillator(), first(oscillator(), 1)

    def filtered(noise: float) -> Controller:
        return Controller(model, Tuning.for_model(
            model, controlled=(outputs.names[0],), measurement_noise=np.array([noise]),
            uncertain_noise_factor=4.0, estimator='extended_kalman_filter'), outputs)

    own, noisy = filtered(0.1), filtered(0.4)
    state, *_ = own.step(State(), model.states.center[:1], SECOND)
    y = model.states.center[:1] + 0.2
    after, _, report = own.step(state, y, 2 * SECOND, quality=(1,))
    assert content(after.estimate) == content(noisy.step(state, y, 2 * SECOND)[0].estimate)
    assert report.measurement.uncertain == outputs.names
    assert content(after.estimate) != content(own.step(state, y, 2 * SECOND)[0].estimate)
    *_, report = own.step(state, y, 2 * SECOND, quality=(2,))
    assert (report.level, report.reason.code) == ('hold', StatusCode.BAD_QUALITY)


@pytest.mark.parametrize('dead_time', [0.0, 2.5])
def test_late_values_correct_the_filter_at_their_own_times_in_any_order(dead_time):
    model, rng = oscillator(), np.random.default_rng(1)
    outputs = first(model, 1)
    loop = Controller(model, Tuning.for_model(
        model, controlled=(outputs.names[0],), measurement_noise=np.array([0.1]),
        dead_time=np.array([dead_time]), analysis_delay=np.array([0.0, 20.0]),
        analysis_noise=np.array([0.0, 0.2]), estimator='extended_kalman_filter'), outputs)
    own, state, steps = loop.estimation.level(Supervisor()).estimator, State(), []
    for second in range(30):
        y = model.states.center[:1] + rng.normal(0.0, 0.3, 1)
        # a silence in between
        before = state
        state, *_ = loop.hold(state, second * SECOND, None) if second == 20 else loop.step(
            state, y, second * SECOND, quality=(1,) if second == 15 else None)
        steps.append((second, before, state, None if second == 20 else (
            y - model.states.center[:1]) / model.states.scale[:1]))
    late = {11.4: 0.7, 19.8: -0.4, 24.0: 0.1}

    def textbook(estimate: Estimate, value: float) -> Estimate:
        P, r = estimate.covariance, (0.2 / model.states.scale[1]) ** 2
        gain = P[:, 1] / (P[1, 1] + r)
        step = gain * (value - estimate.x[1])
        return replace(estimate, x=estimate.x + step[:2], w=estimate.w + step[2:],
                       covariance=P - np.outer(gain, P[1]))

    # all in the order of their times
    estimate = steps[10][2].estimate
    for second, before, _, y in steps[11:]:
        edges = [second - 1.0, *(time for time in late if second - 1.0 < time < second), second]
        for begin, end in itertools.pairwise(edges):
            for seconds, u in before.applied.pieces(
                    round(begin * SECOND), round(end * SECOND), loop.estimation.dead_ns):
                estimate = own.predict(estimate, model.inputs.to_deviation(u), seconds)
            if end == second and y is not None:
                one = own if second != 15 else own.with_noise(np.array([3.0]))
                estimate = one.correct(estimate, np.append(y, estimate.x[1]), 1.0)
            if end in late:
                estimate = textbook(estimate, late[end])
    for order in itertools.permutations(late):
        now = state
        for time in order:
            value = model.states.center[1] + model.states.scale[1] * late[time]
            now, rejected = loop.take_analysis(now, model.states.names[1], value, round(
                time * SECOND))
            assert rejected is None
        assert now.estimate.x == pytest.approx(estimate.x, abs=1e-9)
        assert now.estimate.w == pytest.approx(estimate.w, abs=1e-9)
        assert now.estimate.covariance == pytest.approx(estimate.covariance, rel=1e-7, abs=1e-12)
    for signal, time in ((1, 5.0), (0, 25.0)):
        unchanged, rejected = loop.take_analysis(
            state, model.states.names[signal], model.states.center[signal], round(time * SECOND))
        assert (unchanged, rejected.code) == (state, StatusCode.ANALYSIS_REJECTED)
    assert loop.set_mode(state, Mode.MANUAL).history == History()


def test_measurements_count_at_their_own_times_and_those_that_are_no_use_not_at_all():
    model, rng = oscillator(), np.random.default_rng(0)
    outputs = first(model, 1)
    one = Controller(model, Tuning.for_model(
        model, state_weight=np.ones(2), input_weight=np.ones(1), controlled=(outputs.names[0],),
        limits=InputLimits(model.inputs.lower, model.inputs.upper, np.ones(1)),
        measurement_noise=np.array([0.1]),
        disturbance_noise=0.05 * np.sqrt(60.0) * model.inputs.scale,
        initial_error=0.3 * model.states.scale, estimator='extended_kalman_filter'), outputs)
    own = kalman(ExtendedKalmanFilter, model, outputs)
    state, now, expected, before = State(), 10 ** 12, None, None
    for k in range(60):
        seconds = float(rng.choice([0.4, 1.0, 2.5]))
        elapsed = round(seconds * 1e9)
        now += elapsed
        y = model.states.center[:1] + rng.normal(0.0, 0.3, 1)
        lost = k % 7 == 3
        state, command, _ = one.step(state, np.full(1, np.nan) if lost else y, now)
        deviation = (y - model.states.center[:1]) / model.states.scale[:1]
        if expected is None:
            expected = own.restart(None, np.append(deviation, 0.0), None)
        else:
            expected = own.predict(expected, before, elapsed / 1e9)
            if not lost:
                expected = own.correct(expected, np.append(deviation, expected.x[1]), 0.0)
        if k:
            # first guesses differ
            assert state.estimate.x == pytest.approx(expected.x, abs=1e-9)
        else:
            expected = state.estimate
        assert state.estimate.covariance == pytest.approx(expected.covariance, rel=1e-9, abs=1e-12)
        before = model.inputs.to_deviation(command)
        # the same again, and one that was overtaken
        for late in (0, 10 ** 8):
            state, repeated, _ = one.step(state, y + 5.0, now - late)
            assert repeated == command


def test_another_fallback_order_keeps_the_estimated_rate():
    """From a PI law to levels of which the last has another model than the first."""
    model, plant = shipped('two_state'), two_state_reactor()

    def with_levels(*levels: str, **plugins: object) -> Controller:
        return Controller(model, Tuning.for_model(
            model, controlled=('temperature',), fallback_order=levels, plugins=plugins,
            measurement_noise=np.array([0.02]), disturbance_noise=np.array([0.1])), TEMPERATURE)

    x0, u0 = steady_state(plant, {'temperature': 312.15})
    loop = run_loop(
        with_levels('pi', pi=PIParameters([0.0, 3.0], [1.0, 60.0])), Process(plant, 0, x0, u0), [
            at(0.0, Initialisation(u0)), at(0.0, SetpointRequest(0, np.array([312.15]))),
            at(20.0, exchange(with_levels('sdre', 'linear')))],
        duration=80.0, noise=np.array([0.02]), seed=9)
    assert set(loop.levels[22:]) == {'sdre'}
    assert np.max(np.abs(loop.states[:, 1] - 312.15)) < 0.3


def test_an_estimate_that_strayed_from_the_data_is_corrected():
    def strayed(loop: Loop) -> Loop:
        estimate = loop.state.estimate
        return replace(loop, state=loop.state._replace(estimate=replace(
            estimate, x=estimate.x + np.array([2.0, 0.0]), covariance=None)))

    loop = run(saddle(), at(20.0, strayed), duration=60.0, seed=8)
    assert loop.levels[20] == 'safe'
    assert loop.levels[-1] == 'sdre'
    error = [report.estimate.state[0] - x[0] for report, x in zip(
        loop.reports, loop.states, strict=False)]
    assert error[20] > 0.5
    assert np.max(np.abs(error[26:])) < 0.05
