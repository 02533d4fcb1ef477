# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The supervisor: laws in their order, hold, safe input, and back with hysteresis."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq

from koopman_ros.control import (
    ClearSafeState,
    Controller,
    InputLimits,
    Mode,
    ModeChange,
    State,
    Supervisor,
    Tuning,
)
from koopman_ros.control.recovery import rest_under, SafeStateRecovery
from koopman_ros.control.supervisor import Condition, FallbackOrder, LevelRequest, RULES
from koopman_ros.core.status import reason, StatusCode
from koopman_ros.evaluation import exchange
from koopman_ros.model import Coordinates, linearised_model, Provenance, TrainingStates
from koopman_ros.parameters.model_checks import rests_outside
from studies.robustness.disturbances import CHANGED
from studies.robustness.loop import changed_reactor
from support.closed_loops import (
    controller,
    largest_step,
    levels,
    REACTOR,
    Reactor,
    SAFE,
    say,
    SECOND,
    settled,
    shipped,
    START,
)

ORDER = FallbackOrder(('sdre', 'linear'), (0.2, 1.0), hold_timeout=60.0, recovery_time=10.0)


FAR = reason(StatusCode.OUTSIDE_TRAINING, ranges=(('T', 1.0, 2.0),), margin=0.2, level='sdre')
NO_LAW = reason(StatusCode.LAW_FAILED, level='linear', cause=reason(StatusCode.COMMAND_NOT_FINITE))
BEST = LevelRequest('sdre')
LINEAR = LevelRequest('linear', FAR)
LATE = LevelRequest('linear', NO_LAW, passing=True)
HOLD = LevelRequest('hold', NO_LAW)
BLIND = LevelRequest('hold', reason(StatusCode.NO_MEASUREMENT), passing=True)


NO_INPUT = reason(StatusCode.COMMAND_NOT_FINITE)
OF_RULES = [
    (Condition.STATE_UNKNOWN, None, BLIND.reason, 'hold', None, True),
    (Condition.LAW_FAILED, 'sdre', NO_INPUT, 'linear', StatusCode.LAW_FAILED, False),
    (Condition.LAW_FAILED, 'linear', NO_INPUT, 'hold', StatusCode.LAW_FAILED, False),
    (Condition.LAW_MISSED, 'sdre', NO_INPUT, 'linear', StatusCode.LAW_FAILED, True),
    (Condition.LAW_LOST, 'sdre', None, 'linear', StatusCode.LOST_HERE, False),
    (Condition.OUTSIDE, 'sdre', None, 'linear', StatusCode.OUTSIDE_TRAINING, False),
    (Condition.FAR_OUTSIDE, 'linear', None, 'safe', StatusCode.OUTSIDE_TRAINING, False),
    (Condition.HELD_TOO_LONG, None, NO_LAW, 'safe', StatusCode.HELD_TOO_LONG, False),
    (Condition.RECOVERING, None, FAR, None, StatusCode.RECOVERING, False),
    (Condition.LATCHED, None, FAR, 'safe', StatusCode.SAFE_LATCHED, False),
    (Condition.CLEARABLE, None, FAR, 'safe', StatusCode.LATCH_CLEARABLE, False)]


@pytest.mark.parametrize(('condition', 'law', 'cause', 'level', 'code', 'passing'), OF_RULES)
def test_each_condition_has_a_level_and_a_reason(condition, law, cause, level, code, passing):
    found = ORDER.request(condition, law, **({} if cause is None else {'cause': cause}))
    assert found.level == level or level is None
    assert found.passing == passing
    if code is None:
        assert found.reason is cause
    else:
        assert (found.reason.code, found.reason.cause, found.reason.values.get('level')) == (
            code, cause, law)


def test_the_table_has_every_condition_and_latches_the_safe_input_alone():
    assert set(RULES) == set(Condition) == {row[0] for row in OF_RULES}
    assert {rule.level for rule in RULES.values() if rule.latched} == {'safe'}


def walk(requests, order=ORDER):
    """Return where requests, one a second, lead."""
    supervisors = [Supervisor()]
    for second, request in enumerate(requests):
        supervisors.append(supervisors[-1].at(order, request, second * SECOND))
    return supervisors[1:]


@pytest.mark.parametrize(('requests', 'expected'), [
    ([BEST, LINEAR, *[BEST] * 12], ['sdre', *['linear'] * 11, 'sdre', 'sdre']),
    ([LINEAR, *[BEST] * 8, LINEAR, *[BEST] * 11], [*['linear'] * 20, 'sdre']),
    ([*[HOLD] * 70, BEST, HOLD, *[BEST] * 11], [*['hold'] * 61, *['safe'] * 21, 'sdre']),
    ([BEST, BLIND, BEST], ['sdre', 'hold', 'sdre']),
    ([LINEAR, BLIND, LINEAR], ['linear', 'hold', 'linear']),
    ([LevelRequest('safe', FAR), BLIND, BLIND, *[BEST] * 11], [*['safe'] * 13, 'sdre']),
    ([LINEAR, BLIND, *[BEST] * 12], ['linear', 'hold', *['linear'] * 10, 'sdre', 'sdre']),
    ([LevelRequest('safe', FAR), *[LATE] * 11], [*['safe'] * 11, 'linear']),
    ([BEST, HOLD, *[LATE] * 11], ['sdre', *['hold'] * 11, 'linear'])],
    ids=['down at once and up after a while', 'a relapse starts the wait anew',
         'a hold becomes the safe input and stays it', 'a passing hold resumes the best',
         'a passing hold resumes the linear law', 'a passing hold stays safe',
         'a passing hold does not shorten a recovery',
         'a passing failure of the best law leaves the safe input to the next',
         'a passing failure of the best law leaves a hold to the next'])
def test_the_way_through_the_levels(requests, expected):
    assert [supervisor.level for supervisor in walk(requests)] == expected


def test_a_longer_hold_timeout_does_not_revoke_the_safe_input():
    supervisor = walk([HOLD] * 70)[-1]
    assert supervisor.level == 'safe'
    longer = replace(ORDER, hold_timeout=600.0)
    for second in range(70, 90):
        supervisor = supervisor.at(longer, HOLD, second * SECOND)
        assert supervisor.level == 'safe'


LATCHING = replace(ORDER, safe_latch=True)
L, C = StatusCode.SAFE_LATCHED, StatusCode.LATCH_CLEARABLE


@pytest.mark.parametrize(('requests', 'codes'), [
    ([LevelRequest('safe', FAR), *[BEST] * 12], [*[L] * 11, C, C]),
    ([LevelRequest('safe', FAR), *[BEST] * 12, HOLD, *[LINEAR] * 11], [
        *[L] * 11, C, C, *[L] * 11, C]),
    ([*[BLIND] * 62, *[BEST] * 11], [*[StatusCode.NO_MEASUREMENT] * 61, *[L] * 11, C])],
    ids=['after the data were left', 'with another cause meanwhile', 'after a silence'])
def test_a_latched_safe_input_stays_and_may_be_cleared_once_a_law_is_possible(requests, codes):
    supervisors = walk(requests, LATCHING)
    assert [supervisor.reason.code for supervisor in supervisors] == codes
    assert [supervisor.level == 'safe' for supervisor in supervisors] == [
        code in (L, C) for code in codes]


def test_only_the_operator_clears_a_latched_safe_input():
    loop = Reactor(controller(safe_latch=True, hold_timeout=5.0, recovery_time=3.0))
    loop.run(5)

    def cleared():
        state, rejected = loop.loop.controller.clear_safe_state(loop.loop.state)
        return state.supervisor, rejected and rejected.code

    assert cleared()[1] is StatusCode.NOT_LATCHED
    loop.loop = replace(loop.loop, state=loop.loop.state._replace(
        supervisor=Supervisor.latched_before()))
    assert levels(loop.run(5)) == ['safe']
    # manual mode and back does not, and the law has to be possible again for long enough
    loop.do(ModeChange(Mode.MANUAL), ModeChange(Mode.AUTOMATIC))
    assert levels(loop.run(3)) == ['safe']
    assert cleared()[1] is StatusCode.LATCH_KEPT
    loop.run(1)
    assert cleared() == (Supervisor(), None)
    loop.do(ClearSafeState())
    assert levels(loop.run(2)) == ['sdre']


def test_reasons_name_the_awaited_condition():
    recovering = walk([BEST, LINEAR, *[BEST] * 12])
    assert say(recovering[5].reason).startswith(f'{say(FAR)}: this has ended')
    assert say(recovering[5].reason).endswith(' 10 s')
    assert recovering[-1].reason is None
    assert say(walk([HOLD] * 62)[-1].reason) == f'{say(NO_LAW)}; held for longer than 60 s'
    # under the safe input for another reason, a hold is not said to last longer than it does
    blind = walk([LevelRequest('safe', FAR), *[BLIND] * 62])
    assert all(supervisor.reason is BLIND.reason for supervisor in blind[1:-1])
    assert say(blind[-1].reason) == f'{say(BLIND.reason)}; held for longer than 60 s'


@pytest.mark.parametrize(('level', 'outside', 'allowed', 'named'), [
    ('sdre', 0.2, 'sdre', None), ('sdre', 0.21, 'linear', 0.2),
    ('sdre', 1.01, 'safe', 1.0), ('linear', 0.11, 'linear', 0.1),
    ('linear', 0.1, 'sdre', None), ('linear', 0.9, 'linear', 0.1),
    ('safe', 0.51, 'safe', 0.5), ('safe', 0.5, 'linear', 0.1), ('safe', 0.05, 'sdre', None),
])
def test_thresholds_have_hysteresis(level, outside, allowed, named):
    request = Supervisor(level).allowed(ORDER, outside, ())
    assert request.level == allowed
    # the reason has the threshold that holds at this level
    assert (request.reason and request.reason.values['margin']) == named


# In the loop.

def test_a_reactor_that_starts_far_above_is_caught_by_the_linear_law():
    loop = Reactor(controller(), kelvin=331.0)
    loop.ask(320.0)
    samples = loop.run(460)
    assert levels(samples) == ['linear', 'sdre']
    assert samples[0].report.measurement.outside == pytest.approx(4.0 / 11.0)
    assert samples[0].report.target.outside == 0.0
    assert 'temperature 305 K to 327 K' in say(samples[0].report.reason)
    change = next(k for k, s in enumerate(samples) if s.report.level == 'sdre')
    assert abs(samples[change].command - samples[change - 1].command) < 0.01
    assert settled(samples, 320.0, 1e-3) < 450


def test_far_below_the_safe_input_is_commanded_and_left_again():
    loop = Reactor(controller(), kelvin=290.0)
    loop.ask(320.0)
    samples = loop.run(560)
    assert levels(samples) == ['safe', 'linear', 'sdre']
    assert min(s.command for s in samples) == SAFE
    assert largest_step(samples) <= 1.0 + 1e-9
    assert settled(samples, 320.0, 1e-3) < 560


@pytest.mark.parametrize('blind', [0, 10])
def test_a_reactor_about_to_run_away_is_cooled_whatever_the_sensor_does(blind):
    loop = Reactor(controller(), kelvin=340.0, coolant=300.0)
    loop.run(5)
    if blind:
        assert levels(loop.run(blind, lambda _: float('nan'))) == ['safe']
    samples = loop.run(420)
    assert max(s.temperature for s in loop.samples) < 345.0
    assert levels(samples)[-1] == 'sdre'


def test_a_disturbance_that_drives_the_reactor_out_is_overcome():
    loop = Reactor(controller())
    loop.run(10)
    loop.change(system=changed_reactor(heat_transfer=0.6))
    samples = loop.run(600)
    assert levels(samples) == ['sdre', 'linear', 'sdre']
    assert max(s.temperature for s in samples) < 333.0
    assert settled(samples, START, 1e-3) < 600


def test_without_a_law_the_command_is_held_then_safe_until_recovery():
    loop = Reactor(controller())
    loop.run(30)
    held = loop.samples[-1].command
    loop.do(exchange(controller(max_gain=1e-9)))
    samples = loop.run(100)
    assert levels(samples) == ['hold', 'safe']
    assert 'the gain exceeds its bound' in say(samples[0].report.reason)
    assert samples[0].report.command.law.form == ''
    assert {s.command for s in samples[:61]} == {held}
    loop.do(exchange(controller()))
    back = loop.run(40)
    assert levels(back) == ['safe', 'sdre']
    assert largest_step(back) <= 1.0 + 1e-9


# The way back from the safe input.

LEAD = 0.25


def rest_of(plant, coolant=SAFE):
    """Return the cold temperature at which a reactor rests under a coolant, in K."""
    return float(brentq(lambda T: plant.derivative(np.array([T]), np.array([coolant]))[0],
                        coolant, 320.0))


def narrow():
    """Return a lift that knows the shipped one's middle only."""
    model = shipped('reactor_nz4')
    center = model.states.center
    return replace(model, states=replace(model.states, lower=center - 1.5, upper=center + 1.5))


def rested(plant, model=None, noise=0.0):
    """Return a loop that finds its plant at rest under the safe coolant, far outside."""
    loop = Reactor(controller(model or 'reactor_nz4'), plant, rest_of(plant), noise=noise)
    loop.ask(START)
    return loop


def test_the_loop_recovers_after_a_dead_sensor():
    loop = Reactor(controller())
    loop.run(5)
    silent = loop.run(260, lambda _: None)[-1]
    assert (silent.report.level, silent.command) == ('safe', SAFE)
    assert silent.temperature == pytest.approx(rest_of(REACTOR), abs=0.1)
    assert settled(loop.run(320), START, 0.2) < 310


@pytest.mark.parametrize(('plant', 'model', 'noise', 'tolerance'), [
    (CHANGED['C_A +10 %'], None, 0.0, 0.2), (CHANGED['T_i +5 K'], None, 0.0, 0.2),
    (CHANGED['UA +20 %'], None, 0.1, 0.3), (REACTOR, narrow(), 0.0, 0.2)],
    ids=['C_A +10 %', 'T_i +5 K', 'UA +20 %, noisy sensor', 'lift of narrow data'])
def test_a_loop_recovers_from_the_rest_state_of_the_safe_input(plant, model, noise, tolerance):
    loop = rested(plant, model, noise)
    samples = loop.run(450 if model else 320)
    assert samples[-1].report.level == 'sdre'
    assert settled(samples, START, tolerance) < len(samples) - 1
    assert max(s.temperature for s in samples) < START + 1.5
    assert largest_step(samples) <= 1.0 + 1e-9


@pytest.mark.parametrize('noise', [0.0, 0.1])
def test_a_frozen_sensor_moves_the_coolant_no_further_than_the_lead(noise):
    plant = changed_reactor(heat_transfer=0.6)
    loop = rested(plant)
    rng = np.random.default_rng(1)
    samples = loop.run(200, lambda _: 298.0 + noise * rng.standard_normal())
    assert levels(samples) == ['safe']
    assert samples[-1].report.command.recovery == pytest.approx(LEAD, abs=0.6 * noise)
    # the plant that loses most of its cooling does not even then run away
    assert max(s.temperature for s in samples) < 327.0


def test_nothing_moves_before_the_plant_rests_and_the_safe_input_is_back_with_the_first_fault():
    loop = rested(CHANGED['UA +20 %'])
    assert {s.command for s in loop.run(30)} == {SAFE}
    led = loop.run(4)
    assert [s.report.command.recovery for s in led] == pytest.approx([LEAD] * 4, abs=0.1)
    assert led[-1].command == SAFE + 4.0
    blind = loop.run(5, lambda _: float('nan'))
    assert {s.report.command.recovery for s in blind} == {0.0}
    assert blind[-1].command == SAFE
    assert loop.run(1)[0].command == SAFE


def test_where_laws_fail_the_safe_coolant_is_not_left():
    """It is not the distance from the training data that keeps them off."""
    loop = Reactor(controller(max_gain=1e-9), REACTOR, rest_of(REACTOR), coolant=SAFE, noise=0.02)
    samples = loop.run(130)
    assert levels(samples) == ['hold', 'safe']
    assert 0.0 < samples[-1].report.measurement.outside < 0.5
    assert {s.command for s in samples} == {SAFE}


def test_a_hot_reactor_at_rest_keeps_the_safe_coolant():
    boundary = float(brentq(lambda T: REACTOR.derivative(np.array([T]), np.array([SAFE]))[0],
                            335.0, 380.0))
    loop = Reactor(controller(), kelvin=boundary - 1e-6, coolant=SAFE)
    samples = loop.run(120)
    assert samples[60].temperature > boundary - 0.2
    assert {s.command for s in samples} == {SAFE}


@pytest.mark.parametrize('side', [-1.0, 1.0])
def test_it_leads_back_from_either_side(side):
    """A plant dx/dt = u - x + 0.2 whose safe input takes it to 4 half-ranges from its nominal."""
    box = Coordinates(('x',), ('1',), np.zeros(1), np.ones(1), -np.ones(1), np.ones(1))
    model = linearised_model(-np.eye(1), np.eye(1), box, replace(box, names=('u',)), 's',
                             Provenance('plant'))
    step = Controller(model, Tuning.for_model(
        model, state_weight=np.ones(1), input_weight=np.ones(1),
        limits=InputLimits(np.array([-9.0]), np.array([9.0]), np.ones(1)),
        observer_bandwidth=0.5, bumpless_transfer_time=5.0, safe_value=np.array([4.0 * side])))
    state = step.initialise(State(), np.array([4.0 * side]))
    state, rejected = step.request_setpoint(state, np.array([-0.5 * side]))
    assert rejected is None
    x, shares = 4.0 * side + 0.2, []
    for second in range(1, 150):
        state, u, report = step.step(state, np.array([x]), second * SECOND)
        shares.append(report.command.recovery)
        x += (u[0] + 0.2 - x) * -np.expm1(-1.0)
    assert max(shares) > 0.5
    assert report.level == 'sdre'
    assert x == pytest.approx(-0.5 * side, abs=1e-3)


def test_the_input_is_ahead_of_the_plant_by_the_lead():
    way = SafeStateRecovery(2.0, 2.0, 0)
    assert way.share == 0.0
    assert way.moved(2.0, 29 * SECOND, 10.0, 0.0).share == 0.0
    led = way.moved(2.0, 30 * SECOND, 10.0, 0.0)
    # behind a dead time of 40 s, or twice that, the safe input may not have acted
    assert not way.moved(2.0, 109 * SECOND, 10.0, 40.0).led
    assert way.moved(2.0, 110 * SECOND, 10.0, 40.0).led
    assert led.share == LEAD
    half = led.moved(1.0, 31 * SECOND, 10.0, 0.0)
    assert half.share == pytest.approx(LEAD + 0.5)
    # what has been reached is not given up for noise, but the way starts anew further out
    assert half.moved(1.5, 32 * SECOND, 10.0, 0.0) == half
    assert half.moved(0.0, 33 * SECOND, 10.0, 0.0).share == 1.0
    assert half.moved(2.2, 34 * SECOND, 10.0, 0.0) == SafeStateRecovery(2.2, 2.2, 34 * SECOND)


def test_recovery_waits_for_a_plant_that_returns_unaided():
    way = SafeStateRecovery(2.0, 2.0, 0)
    for second in range(1, 60):
        way = way.moved(2.0 - 0.02 * second, second * SECOND, 10.0, 0.0)
        assert way.share == 0.0


# What a model tells of the safe input.

@pytest.mark.parametrize('name', ['reactor_nz3', 'reactor_nz4'])
@pytest.mark.parametrize('coolant', [SAFE, 282.0, 292.0])
def test_a_model_gives_the_rest_state_of_the_safe_input(name, coolant):
    rest = rest_under(shipped(name), np.array([coolant]), 0.25)
    assert rest.x[0] == pytest.approx(rest_of(REACTOR, coolant), abs=0.05)
    assert rest.outside == pytest.approx(max(0.0, (305.0 - rest.x[0]) / 11.0))
    assert rest.holding is None


def test_a_lift_of_narrow_data_reports_a_safe_coolant_outside_its_range():
    for name in ('reactor_nz3', 'reactor_nz4', 'reactor_linear'):
        assert rests_outside(controller(name)) == ''
    narrowed = controller(narrow())
    # what holds the true reactor a quarter of half the width below the range
    edge = float(narrowed.model.states.lower[0]) - 0.25 * 1.5
    holding = float(brentq(lambda u: REACTOR.derivative(np.array([edge]), np.array([u]))[0],
                           SAFE, 305.0))
    assert narrowed.rest.holding[0] == pytest.approx(holding, abs=0.05)
    words = rests_outside(narrowed)
    assert 'under coolant_temperature.safe_value = 5 degC' in words
    assert 'leaves the trained range' in words
    assert ('record data there and train again, or set coolant_temperature.safe_value = 25.8'
            ) in words
    assert rests_outside(controller(narrow(), safe_value=np.array([holding + 0.1]))) == ''
    # of a value that the controller may not command there is no advice
    limits = replace(narrowed.tuning.limits, upper=np.array([holding - 1.0]))
    assert rests_outside(replace(narrowed, tuning=replace(
        narrowed.tuning, limits=limits))).endswith('record data there and train again')
    # and one that drives the reactor up
    hot = controller(safe_value=np.array([305.15]))
    assert hot.rest.holding[0] < 305.15
    assert 'or less' in rests_outside(hot)


def test_a_margin_is_at_least_the_spacing_of_the_training_states():
    """With three dimensions 256 states are farther apart than `learned_model_margin`."""
    cloud = np.random.default_rng(0).uniform([-1.0, -1.0, -1.0], [1.0, 1.0, 0.0], (2000, 3))
    data = TrainingStates.of(cloud, np.ones(3))
    spacing = data.fill_distance
    assert 0.15 < spacing < 0.2
    names = ('product', 'wall', 'jacket')
    model = replace(linearised_model(
        -0.01 * np.eye(3), np.full((3, 1), 0.01), Coordinates.spanning(
            names, ('K',) * 3, -np.ones(3), np.ones(3)),
        Coordinates.spanning(('heater',), ('kW',), -np.ones(1), np.ones(1)), 's',
        Provenance('vessel')), training_states=data)
    loop = Controller(model, replace(Tuning.for_model(model), controlled=names[:1]))
    assert loop.order.margins == (spacing, 0.5)

    def at(distance):
        """Return a state above the cloud, at so many half-ranges from it."""
        return np.array([0.0, 0.0, brentq(
            lambda z: model.distance(np.array([0.0, 0.0, z])) - distance, 0.1, 1.0)])

    state, found = State(), []
    for second, distance in enumerate([0.9 * spacing] + [1.1 * spacing] * 2 + [0.074] * 20):
        state, _, report = loop.step(state, at(distance) + 1e-9 * second, (second + 1) * SECOND)
        found.append(report.level)
    assert found[:3] == ['sdre', 'linear', 'linear']
    assert found[-1] == 'sdre'


@pytest.mark.parametrize('name', [
    'reactor_nz4', 'two_state_saddle', 'two_tanks', 'pendulum', 'fed_reactor', 'heated_line'])
def test_training_states_of_one_or_two_dimensions_are_closer_than_the_margins(name):
    model = shipped(name)
    assert Controller(model, Tuning.for_model(model)).order.margins == (0.1, 0.5)
