# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""No failure of a law, an estimator or a number leaves the control step as an exception."""

from dataclasses import dataclass, replace
import itertools
import sys

import numpy as np
import pytest

from koopman_ros.control import Mode, State
from koopman_ros.control.events import (
    apply,
    Initialisation,
    ManualCommand,
    Measurement,
    ModeChange,
    SetpointRequest,
    Silence,
)
from koopman_ros.control.laws import LawResult, Linear
from koopman_ros.control.recovery import SafeStateRecovery
from koopman_ros.core.paths import model_path
from koopman_ros.core.status import StatusCode
from koopman_ros.estimation import (
    DisturbanceObserver,
    Estimate,
    ExtendedKalmanFilter,
    UnscentedKalmanFilter,
)
from koopman_ros.event_log import records
from koopman_ros.event_log.loop import replay
from koopman_ros.model import load
from koopman_ros.parameters.controller import built, table_of
from koopman_ros.parameters.signal_topics import plant_defaults
from support.closed_loops import SECOND

SYSTEMS = ('reactor', 'two_state', 'two_tanks', 'quadruple_tank', 'pendulum')
LEVELS = (('sdre', 'linear'), ('mpc', 'sdre', 'linear'), ('linear',))
ESTIMATORS = ('disturbance_observer', 'measured_state', 'extended_kalman_filter',
              'unscented_kalman_filter')
PARTLY = {'two_state': 'temperature', 'pendulum': 'angle'}  # systems, and the state measured
EXTREME = [np.nan, np.inf, -np.inf, 1e300, -1e155, 1e20, 1e6, 5e-324]


@dataclass(frozen=True)
class Failing:
    """Raises, or returns what it is given, where a law or an estimator would calculate."""

    failure: object

    def __call__(self, *args, **options):
        if isinstance(self.failure, BaseException):
            raise self.failure
        return self.failure


class UnprintableError(Exception):
    """An error without a text."""

    def __str__(self):
        raise ValueError


FAILURES = [ZeroDivisionError('of zero'), np.linalg.LinAlgError('singular'), SystemExit(3),
            GeneratorExit(), UnprintableError(), None, 'a text', np.full(1, np.nan)]
# results that have the right type and wrong parts
RESULTS = [LawResult(np.zeros(2), info=None), LawResult(np.zeros(2), plan='x'),
           LawResult(np.zeros(2), failure='x'), LawResult(np.zeros(5)), LawResult(None),
           LawResult(np.array([1.0, np.inf]))]
ESTIMATES = [Estimate(np.zeros(5), np.zeros(2)), Estimate(np.zeros(2), np.zeros(1)),
             Estimate(np.zeros(2), np.zeros(2), np.zeros((3, 3))),
             Estimate(np.zeros(2), np.zeros(2), None, 'x'),
             Estimate(np.full(2, np.nan), np.zeros(2))]


def failing(base, method, failure):
    """Return a class like another, one method of which fails."""
    return type('Broken', (base,), {method: Failing(failure)})


@pytest.fixture
def plugin(monkeypatch):
    """Return a function that makes a class known as ``broken_plugin:Broken``."""
    module = type(sys)('broken_plugin')
    monkeypatch.setitem(sys.modules, 'broken_plugin', module)

    def known(base, method, failure):
        module.Broken = failing(base, method, failure)
        return 'broken_plugin:Broken'

    return known


def values_of(system, measured=None, **parameters):
    """Return the parameters of a shipped plant's controller, with some changed, and its model."""
    model = load(model_path(plant_defaults(system, 'controller')['model']))
    given = {'system': system}
    if measured is not None:
        given['states_measured'] = tuple(
            f'{name} [{unit}]' for name, unit in zip(model.states.names, model.states.units,
                                                     strict=True) if name == measured)
    table = table_of(model, given)
    settings = table.amended(table.snapshot({}), **parameters)
    assert table.check(settings) == ''
    return table.values(settings), model


def build(values, model):
    return built(table_of(model, values).snapshot(values), model)


def tuned(system, measured=None, **parameters):
    return build(*values_of(system, measured, **parameters))


class Checked:
    """Applies events, and checks each command: finite, in range, within the rate."""

    def __init__(self, controller):
        self.controller, self.state, self.reports = controller, State(), []

    def do(self, event):
        limits, before = self.controller.tuning.limits, self.state
        outcome = apply(self.controller, before, event)
        self.state = outcome.state
        if outcome.command is None:
            return outcome
        self.reports.append(outcome.report)
        report, n_u = outcome.report, len(limits.lower)
        if report.estimate is not None:
            # as the controller's diagnostics do
            assert report.estimate.disturbance.shape == (n_u,)
            assert report.estimate.at_bound in (True, False)
            assert report.estimate.state.shape == (self.controller.model.n_x,)
            assert report.estimate.deviation is None or len(report.estimate.deviation)
        assert isinstance(report.command.law.form, str)
        assert np.all((limits.lower <= outcome.command) & (outcome.command <= limits.upper))
        if before.command is not None and before.commanded_ns is not None:
            # stamps behind those of commands in a silence are of another clock
            since_ns = before.commanded_ns if (
                before.commanded_ns <= event.stamp_ns + SECOND) else before.time_ns
            elapsed = max(0.0, (event.stamp_ns - (since_ns or 0)) / SECOND)
            with np.errstate(invalid='ignore'):
                reach = np.where(np.isinf(limits.rate), np.inf, limits.rate * elapsed)
            assert np.all(np.abs(outcome.command - before.command) <= reach + 1e-9)
        return outcome

    @property
    def codes(self):
        """The codes of all reasons, with their causes."""
        found = set()
        for report in self.reports:
            why = report.reason
            while why is not None:
                found.add(why.code)
                why = why.cause
        return found


def random_events(controller, rng, count):
    """Yield events: most of them usual, some wild in value, stamp or order."""
    model, period = controller.model, SECOND if controller.model.n_x < 4 else SECOND // 2
    y, now = controller.measured.of(model.states.center), 10 * SECOND
    half = controller.measured.of(model.states.half_widths * model.states.scale)
    controlled = [model.states.names.index(name) for name in controller.controlled.names]

    def wild(value):
        value = np.array(value)
        value[rng.integers(len(value))] = rng.choice(EXTREME)
        return value

    for _ in range(count):
        now += int(rng.choice([period, period, period, period // 20, 7 * period, 100 * period,
                               86400 * SECOND, 0, -period // 2, -3600 * SECOND]))
        now = max(now, SECOND)
        match rng.choice(['usual'] * 6 + ['wild', 'applied', 'wild applied', 'silence',
                                          'set-point', 'one', 'scheduled', 'manual', 'mode',
                                          'restart']):
            case 'usual':
                yield Measurement(now, y + rng.uniform(-1.2, 1.2) * half + 0.01 * half
                                  * rng.normal(size=len(y)))
            case 'wild':
                yield Measurement(now, wild(y))
            case 'applied':
                yield Measurement(now, y + 0.1 * half * rng.normal(size=len(y)),
                                  model.inputs.center)
            case 'wild applied':
                yield Measurement(now, y + 0.1 * half * rng.normal(size=len(y)),
                                  wild(model.inputs.center))
            case 'silence':
                for k in range(3):
                    yield Silence(now + k * SECOND // 2)
            case 'set-point':
                x = model.states.center + rng.uniform(-1.1, 1.1) * (
                    model.states.half_widths * model.states.scale)
                yield SetpointRequest(0, x[controlled] if rng.random() < 0.8 else wild(
                    x[controlled]))
            case 'one':
                yield SetpointRequest(0, model.states.center[controlled[:1]],
                                      controller.controlled.names[:1])
            case 'scheduled':
                yield SetpointRequest(now + 3 * period, model.states.center[controlled])
            case 'restart':
                yield Initialisation(wild(model.inputs.center))
            case 'manual':
                yield ManualCommand(wild(model.inputs.center))
            case 'mode':
                yield ModeChange(rng.choice([Mode.MANUAL, Mode.AUTOMATIC]))


# each system with each estimator, and each of both with each order of levels
CASES = [(system, None, LEVELS[(i + j) % 3], estimator) for (i, system), (j, estimator)
         in itertools.product(enumerate(SYSTEMS), enumerate(ESTIMATORS))] + [
    (system, measured, levels, ESTIMATORS[2 + (i + j) % 2])
    for (i, (system, measured)), (j, levels)
    in itertools.product(enumerate(PARTLY.items()), enumerate(LEVELS))]


@pytest.mark.parametrize('system', SYSTEMS)
def test_random_events_on_every_law_and_estimator_end_in_a_command_that_a_replay_finds(system):
    """Seeds are the places in the table."""
    for seed, (name, measured, levels, estimator) in enumerate(CASES):
        if name != system:
            continue
        inputs = values_of(name)[1].inputs
        # some inputs take ten seconds from one limit to the other
        rates = {f'{one}.rate_limit': width / 10.0 for one, width in zip(
            inputs.names, (inputs.upper - inputs.lower).tolist(), strict=True) if seed % 2}
        options = [values_of(name, measured, fallback_order=order, estimator=estimator, **rates)
                   for order in (levels, *LEVELS)]
        (values, model), *others = options
        run, rng = Checked(build(values, model)), np.random.default_rng(seed)
        texts, commands = [], []

        def write(event, fields, texts=texts):
            texts.append(records.EventRecord('run', len(texts), event, fields).text())

        write(records.START, records.snapshot(
            run.state, values, {'name': name, 'digest': 'of the model'}))
        for event in random_events(run.controller, rng, 25):
            outcome = run.do(event)
            if outcome.command is not None:
                commands.append(outcome.command.tobytes())
            if not isinstance(event, Silence) or outcome.command is not None:
                write(*records.fields_of(event, outcome))
            if rng.random() < 0.05:
                changed = others[rng.integers(len(others))][0]
                before, run.controller = run.controller, build(changed, model)
                run.state = run.controller.switch_to(before, run.state)
                write(records.PARAMETERS, {'parameters': changed})
        # what is contained should be rare: a numerical cause is mended where it arises
        assert StatusCode.CALCULATION_FAILED not in run.codes, (measured, levels, estimator)
        found = replay(map(records.parse, texts), lambda *_, model=model: model, build)
        assert found.lost == []
        assert [sample.replayed.tobytes() for sample in found.samples] == commands


@pytest.mark.parametrize('failure', [*FAILURES, *RESULTS], ids=lambda _: '')
def test_a_law_that_fails_hands_over_to_the_next_level(plugin, failure):
    levels = (plugin(Linear, 'compute', failure), 'linear')
    run = Checked(tuned('two_tanks', fallback_order=levels))
    center = run.controller.model.states.center
    for k in range(5):
        run.do(Measurement((10 + k) * SECOND, center + 1e-4 * k))
    run.do(SetpointRequest(0, center + 1e-3))
    last = run.do(Measurement(20 * SECOND, center - 1e-4)).report
    assert last.level == 'linear'
    assert run.codes & {StatusCode.LAW_RAISED, StatusCode.COMMAND_NOT_FINITE}


@pytest.mark.parametrize(('method', 'failure'), [
    *(('correct', failure) for failure in (*FAILURES, *ESTIMATES)),
    # an error, a result of another type, and one of another size for the others
    *itertools.product(('predict', 'restart', 'as_input'), (
        FAILURES[0], FAILURES[1], FAILURES[6], ESTIMATES[0], ESTIMATES[4]))], ids=lambda _: '')
def test_an_estimator_that_fails_leads_to_a_hold_and_the_safe_input(plugin, method, failure):
    name = plugin(DisturbanceObserver, method, failure)
    run = Checked(tuned('two_tanks', estimator=name, hold_timeout=5.0))
    center = run.controller.model.states.center
    for k in range(12):
        run.do(Measurement((10 + k) * SECOND, center + 1e-4 * (k % 3)))
    run.do(Silence(23 * SECOND))
    # None, LinAlgError and numbers that are not finite mean that it cannot predict, and the
    # disturbance is only reported
    if method in ('correct', 'restart'):
        assert StatusCode.CALCULATION_FAILED in run.codes
    if method == 'correct':
        levels = {report.level for report in run.reports}
        assert levels <= {'hold', 'safe', 'sdre'}


def test_the_loop_recovers_when_an_estimator_works_again(monkeypatch):
    run = Checked(tuned('two_tanks'))
    center = run.controller.model.states.center
    for k in range(5):
        run.do(Measurement((10 + k) * SECOND, center + 1e-4 * k))
    with monkeypatch.context() as broken:
        broken.setattr(DisturbanceObserver, 'correct', Failing(ZeroDivisionError('once')))
        report = run.do(Measurement(15 * SECOND, center - 1e-4)).report
        assert (report.level, report.reason.code) == ('hold', StatusCode.CALCULATION_FAILED)
        assert 'ZeroDivisionError' in report.reason.values['error']
    assert run.do(Measurement(16 * SECOND, center + 2e-4)).report.level == 'sdre'


def test_an_interrupt_is_not_contained(plugin):
    law = plugin(Linear, 'compute', KeyboardInterrupt())
    run = Checked(tuned('two_tanks', fallback_order=(law,)))
    with pytest.raises(KeyboardInterrupt):
        run.do(Measurement(SECOND, run.controller.model.states.center))


def test_requests_and_a_hand_over_contain_a_failing_estimator(plugin):
    good = tuned('two_tanks')
    run = Checked(good)
    center = good.model.states.center
    for k in range(3):
        run.do(Measurement((10 + k) * SECOND, center + 1e-4 * k))
    failing_one = plugin(DisturbanceObserver, 'transferred', TypeError('bad'))
    bad = tuned('two_tanks', estimator=failing_one)
    state = bad.switch_to(good, run.state)
    assert state.command is run.state.command
    run.controller, run.state = bad, state
    run.do(ModeChange(Mode.MANUAL))
    run.do(ModeChange(Mode.AUTOMATIC))
    run.do(SetpointRequest(0, center))
    run.do(Measurement(20 * SECOND, center))


@pytest.mark.parametrize('kind', [ExtendedKalmanFilter, UnscentedKalmanFilter])
@pytest.mark.parametrize('seconds', [0.01, 0.1, 0.3, 1.0, 3.0, 100.0, 1e5])
def test_the_covariance_stays_positive_definite_over_any_gap(kind, seconds):
    """At the pendulum's unstable top a gap multiplies variances by up to exp(40)."""
    controller = tuned('pendulum', 'angle')
    level = next(iter(controller.levels.values()))
    estimator = kind(level.model, level.estimator.outputs, level.estimator.tuning, None)
    x, u = np.zeros(2), np.zeros(1)
    estimate = estimator.restart(None, x, u)
    rng = np.random.default_rng(0)
    for k in range(60):
        gap = seconds if k % 10 == 9 else 0.02
        try:
            found = estimator.predict(estimate, u, gap)
        except np.linalg.LinAlgError:
            found = None  # the state would be where the lift has no inverse
        predicted = replace(estimate, covariance=None) if found is None else found
        estimate = estimator.correct(predicted, 0.01 * rng.normal(size=2), gap)
        values = np.linalg.eigvalsh(estimate.covariance)
        assert np.all(np.isfinite(values))
        # one disturbance for two states: it is singular in the other direction, but for rounding
        assert values[0] > -1e-12 * values[-1]
        assert np.all(np.diag(estimate.covariance)[:2] > 0.0)


def test_a_recovery_that_has_come_to_the_training_data_by_itself_is_over():
    began = SafeStateRecovery(1.0, 1.0, 0)
    assert began.moved(0.0, SECOND, 10.0, 0.0) is None
    led = SafeStateRecovery(1.0, 1.0, 0, led=True).moved(0.0, SECOND, 10.0, 0.0)
    assert led.share == 1.0


@pytest.mark.parametrize('levels', [('mpc', 'sdre', 'linear'), ('mpc', 'linear')])
def test_plans_that_are_always_late_do_not_keep_the_safe_input(levels):
    """A sensor that was broken for a while; the deadline is missed by every plan."""
    run = Checked(tuned('reactor', fallback_order=levels, hold_timeout=5.0,
                        **{'mpc.time_limit': 1e-9}))
    center = run.controller.model.states.center
    for k in range(60):
        value = center + 0.01 * (k % 3)
        report = run.do(Measurement((10 + k) * SECOND, value if not 10 <= k < 30 else np.full(
            1, np.nan))).report
        if k == 29:
            assert report.level == 'safe'
    assert report.level == levels[1]
