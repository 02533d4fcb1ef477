# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Set-points for some of the states: tanks, and other models, whose steady states are known."""

import math

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import lsq_linear

from koopman_ros.control import Controller, InputLimits, SetpointRequest, State, Tuning, Weights
from koopman_ros.control.setpoint import advance, Setpoint
from koopman_ros.control.steady_state import steady_state_target
from koopman_ros.core.status import StatusCode
from koopman_ros.core.steady_state import Goal
from koopman_ros.core.units import NANOSECONDS as SECOND
from koopman_ros.estimation import Estimate
from koopman_ros.evaluation import at, run_closed_loop, run_loop
from koopman_ros.model import Coordinates, LiftedModel, linearised_model, Provenance
from koopman_ros.model.observables import PolynomialObservables
from koopman_ros.model.steady_state import model_steady_state
from koopman_ros.plants import Actuator, Process
from koopman_ros.plants.library.quadruple_tank import QuadrupleTank
from support.closed_loops import EPOCH

LEVELS, FLOWS = ('h1', 'h2', 'h3'), ('q1', 'q2')


def tanks(slope, gain, *, level=1.0, flow=3.0):
    """Return dh/dt = slope (h - level) + gain (q - flow), levels from 0 m to 2 m."""
    n, m = np.shape(gain)
    # scales that are no half-ranges, so that units count
    states = Coordinates(LEVELS[:n], ('m',) * n, np.full(n, level), np.full(n, 0.5),
                         np.zeros(n), np.full(n, 2.0 * level))
    inputs = Coordinates(FLOWS[:m], ('L/s',) * m, np.full(m, flow), np.full(m, 2.0),
                         np.zeros(m), np.full(m, 2.0 * flow))
    return linearised_model(np.array(slope), np.array(gain), states, inputs, 's',
                            Provenance('tanks'))


# dh1/dt = -0.2 (h1 - 1) + 0.1 (q - 3) and dh2/dt = 0.2 (h1 - 1) - 0.1 (h2 - 1): at rest
# 2 (h1 - 1) = h2 - 1 = q - 3
SERIES = tanks([[-0.2, 0.0], [0.2, -0.1]], [[0.1], [0.0]])
# dh1/dt = -(h1 - 1) + (q1 - 3) and dh2/dt = (h1 - 1) - (h2 - 1) + (q2 - 3)
BOTH = tanks([[-1.0, 0.0], [1.0, -1.0]], [[1.0, 0.0], [0.0, 1.0]])
# a third tank beside, of its own pump, fed by the second one as well
THREE = tanks([[-0.2, 0.0, 0.0], [0.2, -0.1, 0.0], [0.0, 0.05, -0.1]],
              [[0.1, 0.0], [0.0, 0.0], [0.0, 0.1]])


def loop(model, *controlled, lower=0.0, upper=6.0, **others):
    n_u = model.n_u
    return Controller(model, Tuning.for_model(
        model, state_weight=np.ones(model.n_x), input_weight=np.ones(n_u),
        limits=InputLimits(np.broadcast_to(lower, n_u).astype(float),
                           np.broadcast_to(upper, n_u).astype(float), np.full(n_u, np.inf)),
        controlled=controlled, observer_bandwidth=0.3, **others))


def stepped(controller, state, x, second):
    return controller.step(state, np.array(x), EPOCH + second * SECOND)


def asked(controller, value, state=None, **others):
    return controller.request_setpoint(state or State(), np.atleast_1d(value), **others)


def disturbed(controller, x, w):
    """Return a state in which a disturbance (n_x,), in units per second, is estimated."""
    state = stepped(controller, State(), x, 0)[0]
    return state._replace(estimate=Estimate(
        state.estimate.x, np.array(w) / controller.model.states.scale))


# The target.

@pytest.mark.parametrize('w', [(0.0, 0.0), (0.02, 0.0), (0.0, -0.03), (-0.01, 0.04)])
def test_one_of_two_levels_is_held_under_a_disturbance(w):
    controller = loop(SERIES, 'h2')
    state = disturbed(controller, [1.0, 1.0], w)
    state, rejected = asked(controller, 1.4, state)
    assert rejected is None
    target = controller.levels['sdre'].target(
        np.array([1.4]), state.estimate.w, None)
    # 0.2 (h1 - 1) = 0.1 * 0.4 - w2 and 0.1 (q - 3) = 0.2 (h1 - 1) - w1
    h1 = 1.0 + (0.04 - w[1]) / 0.2
    np.testing.assert_allclose(controller.model.states.to_physical(target.x), [h1, 1.4],
                               rtol=0, atol=1e-9)
    np.testing.assert_allclose(controller.model.inputs.to_physical(target.u),
                               [3.0 + (0.04 - w[1] - w[0]) / 0.1], rtol=0, atol=1e-9)
    assert target.residual < 1e-9
    np.testing.assert_allclose(target.forcing + controller.model.drift(target.x), np.zeros(2),
                               rtol=0, atol=1e-9)


def test_inputs_to_spare_go_least_far_from_the_nominal_point():
    # h1 = 1 + a, q1 = 3 + a, q2 = 3 + r - a; in scaled deviations a / 0.5, a / 2 and (r - a) / 2:
    # the sum of squares is least where 4 a + 0.25 a = 0.25 (r - a)
    target = loop(BOTH, 'h2').levels['sdre'].target(
        np.array([1.9]), np.zeros(2), None)
    a = 0.9 / 18.0
    np.testing.assert_allclose(BOTH.states.to_physical(target.x), [1.0 + a, 1.9], atol=1e-9)
    np.testing.assert_allclose(BOTH.inputs.to_physical(target.u), [3.0 + a, 3.9 - a], atol=1e-9)


def test_an_input_makes_up_for_another_at_its_limit():
    controller = loop(BOTH, 'h2', upper=[3.5, 3.2])
    assert asked(controller, 1.65)[1] is None
    target = controller.levels['sdre'].target(
        np.array([1.65]), np.zeros(2), None)
    np.testing.assert_allclose(BOTH.inputs.to_physical(target.u), [3.45, 3.2], atol=1e-9)
    # both together reach 0.5 + 0.2
    rejected = asked(controller, 1.9)[1]
    assert rejected.values['nearest'] == pytest.approx(1.7, abs=1e-6)


def parabola(**others):
    """Return dx/dt = -(x - 1) + (u - 1), dy/dt = x^2 - y: at rest y = x^2 and u = x."""
    states = Coordinates(('x', 'y'), ('1', '1'), np.ones(2), np.ones(2), np.array([-1.5, -1.0]),
                         np.array([2.0, 4.0]))
    inputs = Coordinates(('u',), ('1',), np.ones(1), np.ones(1), -np.ones(1), np.full(1, 3.0))
    # of deviations: x^2 - y = 2 xi + xi^2 - eta
    A = np.array([[-1.0, 0.0, 0.0], [2.0, -1.0, 1.0], [0.0, 0.0, -2.0]])
    model = LiftedModel(PolynomialObservables(np.array([[1, 0], [0, 1], [2, 0]])), A,
                        np.array([[1.0], [0.0]]), states, inputs, 's', Provenance('parabola'),
                        readout=A[:2])
    return loop(model, 'y', lower=-5.0, upper=5.0, **others)


@pytest.mark.parametrize('y', [0.01, 0.25, 1.0, 2.25, 3.9])
def test_a_steady_state_that_is_not_linear_in_the_setpoint(y):
    controller = parabola()
    state, rejected = asked(controller, y)
    assert rejected is None
    report = stepped(controller, state, [1.0, 1.0], 0)[2]
    np.testing.assert_allclose(report.target.state, [math.sqrt(y), y], rtol=0, atol=1e-8)
    np.testing.assert_allclose(report.target.input, [math.sqrt(y)], rtol=0, atol=1e-8)


def test_of_two_steady_states_the_one_before_is_followed():
    controller = parabola()
    for sign in (1.0, -1.0):
        target = controller.levels['sdre'].target(
            np.array([0.81]), np.zeros(2), np.array([sign, 1.0, sign]))
        np.testing.assert_allclose(
            controller.model.states.to_physical(target.x), [0.9 * sign, 0.81], atol=1e-8)


def test_where_no_input_holds_a_setpoint_the_law_goes_to_the_nearest_steady_state():
    controller = parabola()
    # y = x^2 + w2 is never below w2: a fold, where x has no effect on y
    state = disturbed(controller, [1.0, 1.0], [0.0, 0.0])
    state, rejected = asked(controller, 0.5, state)
    assert rejected is None
    state = state._replace(estimate=Estimate(state.estimate.x, np.array([0.0, 0.7])))
    state, command, report = controller.step(
        state, np.array([1.0, 1.0]), EPOCH + SECOND // 1000)
    assert np.all(np.isfinite(command))
    np.testing.assert_allclose(report.target.setpoint, [0.5])
    np.testing.assert_allclose(report.target.state, [0.0, 0.7], atol=0.02)
    rejected = asked(controller, -0.5)[1]
    assert (rejected.code, rejected.values['cause'].code) == (
        StatusCode.SETPOINT_NOT_HELD, StatusCode.NO_STEADY_STATE)
    assert rejected.values['nearest'] == pytest.approx(0.0, abs=1e-3)


def test_without_any_steady_state_the_law_fails_with_a_reason_and_nothing_raises():
    # two tanks that only fill, from one pump: 2 q and q cannot both balance a load
    controller = loop(tanks(np.zeros((2, 2)), [[2.0], [1.0]]))
    target, result = controller.best.compute(
        np.ones(2), Estimate(np.zeros(2), np.array([0.2, -0.2])), None, 1.0, None, None)
    assert target is None
    assert result.failure.code is StatusCode.NO_STEADY_STATE
    state = disturbed(controller, [1.0, 1.0], [0.1, -0.1])
    rejected = asked(controller, [1.2, 1.0], state)[1]
    assert (rejected.code, rejected.cause.code) == (
        StatusCode.NO_SETPOINT_HELD, StatusCode.NO_STEADY_STATE)


# What cannot be held.

@pytest.mark.parametrize(('value', 'upper', 'w', 'needed', 'nearest'), [
    # q - 3 = h2 - 1
    (1.9, 3.5, 0.0, 3.9, 1.5),
    (0.2, 6.0, 0.0, 2.2, 0.5),
    # a disturbance of the first tank is one of the pump: q - 3 = h2 - 1 - w1 / 0.1
    (1.9, 3.5, 0.03, 3.6, 1.8),
    (1.4, 3.5, -0.02, 3.6, 1.3),
    # neither what is tracked nor the nominal level can be held now; what the command leads to can
    (1.4, 3.5, -0.1, 4.4, 0.5)])
def test_a_rejection_names_the_nearest_level_and_the_required_pump_input(
        value, upper, w, needed, nearest):
    controller = loop(SERIES, 'h2', lower=2.5, upper=upper)
    state = disturbed(controller, [1.0, 1.0], [w, 0.0])
    same, rejected = asked(controller, value, state)
    assert same is state
    assert rejected.code is StatusCode.SETPOINT_NOT_HELD
    assert (rejected.values['signal'], rejected.values['value']) == ('h2', value)
    assert rejected.values['nearest'] == pytest.approx(nearest, abs=1e-5)
    why = rejected.cause
    assert (why.code, why.values['signal']) == (StatusCode.INPUT_NEEDED, 'q1')
    assert (why.values['lower'], why.values['upper']) == (2.5, upper)
    assert why.values['value'] == pytest.approx(needed, abs=1e-9)
    assert asked(controller, rejected.values['nearest'], state)[1] is None


def test_another_level_that_would_overflow_rejects_too():
    # h1 - 1 = (0.1 (h2 - 1) - w2) / 0.2 may go to 2 m and by the margin of 0.1 half-ranges beyond
    controller = loop(SERIES, 'h2', lower=-9.0, upper=9.0)
    state = disturbed(controller, [1.0, 1.0], [0.0, -0.2])
    rejected = asked(controller, 1.6, state)[1]
    assert rejected.code is StatusCode.SETPOINT_NOT_HELD
    assert rejected.cause.code is StatusCode.STATE_LEAVES
    assert rejected.cause.values['signal'] == 'h1'
    assert rejected.cause.values['value'] == pytest.approx(2.3, abs=1e-9)
    assert rejected.values['nearest'] == pytest.approx(1.2, abs=1e-5)


def test_a_limit_tightened_afterwards_withdraws_nothing():
    wide, narrow = loop(SERIES, 'h2'), loop(SERIES, 'h2', upper=3.5)
    state, rejected = asked(wide, 1.9)
    assert rejected is None
    state = stepped(wide, state, [1.0, 1.0], 0)[0]
    state = narrow.switch_to(wide, state)
    state, command, report = stepped(narrow, state, [1.0, 1.0], 1)
    np.testing.assert_array_equal(report.target.setpoint, [1.9])
    assert command[0] <= 3.5


def test_every_level_with_one_pump_has_to_be_a_steady_state():
    controller = loop(SERIES)
    # 2 (h1 - 1) = h2 - 1
    assert asked(controller, [1.2, 1.4])[1] is None
    rejected = asked(controller, [1.4, 1.4])[1]
    assert (rejected.code, rejected.cause.code) == (
        StatusCode.SETPOINT_NOT_HELD, StatusCode.NO_STEADY_STATE)
    held = dict(rejected.values['held'])
    # the foot of the perpendicular: (0.4, 0.4) . (1, 2) / 5 = 0.24
    assert held == pytest.approx({'h1': 1.24, 'h2': 1.48}, abs=1e-4)


def test_the_nearest_of_two_levels_is_that_of_least_squares():
    # q1 - 3 = h1 - 1 = a and q2 - 3 = b = (h2 - 1) - a: with b at 0.2, a^2 + (a + 0.2 - 0.9)^2 is
    # least at a = 0.35
    controller = loop(BOTH, upper=[3.5, 3.2])
    rejected = asked(controller, [1.0, 1.9])[1]
    assert dict(rejected.values['held']) == pytest.approx({'h1': 1.35, 'h2': 1.55}, abs=1e-5)
    # one alone moves the other as far as it needs, unless that was requested
    state = stepped(controller, State(), [1.0, 1.0], 0)[0]
    rejected = asked(controller, 1.9, state, signals=('h2',))[1]
    assert dict(rejected.values['held']) == pytest.approx({'h2': 1.7}, abs=1e-5)
    state = asked(controller, 1.0, state, signals=('h1',))[0]
    rejected = asked(controller, 1.9, state, signals=('h2',))[1]
    assert dict(rejected.values['held']) == pytest.approx({'h1': 1.0, 'h2': 1.2}, abs=1e-5)


# Several signals.

def test_a_setpoint_for_one_of_two_signals_keeps_the_other():
    controller = loop(THREE, 'h2', 'h3')
    state = stepped(controller, State(), [1.0, 1.0, 1.0], 0)[0]
    state, rejected = asked(controller, 1.3, state, signals=('h3',))
    assert rejected is None
    np.testing.assert_array_equal(state.setpoint.requested, [1.0, 1.3])
    state, rejected = asked(controller, [0.9, 1.2], state, signals=('h3', 'h2'))
    assert rejected is None
    np.testing.assert_array_equal(state.setpoint.requested, [1.2, 0.9])
    report = stepped(controller, state, [1.0, 1.0, 1.0], 1)[2]
    # 0.05 (h2 - 1) - 0.1 (h3 - 1) + 0.1 (q2 - 3) = 0
    np.testing.assert_allclose(report.target.state, [1.1, 1.2, 0.9], rtol=0, atol=1e-9)
    np.testing.assert_allclose(report.target.input, [3.2, 2.8], rtol=0, atol=1e-9)


def test_one_signal_rejected_is_brought_nearest_by_itself():
    # q2 - 3 = (h3 - 1) - 0.5 (h2 - 1) is at most 0.5
    controller = loop(THREE, 'h2', 'h3', upper=3.5)
    state = stepped(controller, State(), [1.0, 1.0, 1.0], 0)[0]
    state, rejected = asked(controller, 1.4, state, signals=('h2',))
    assert rejected is None
    rejected = asked(controller, 1.9, state, signals=('h3',))[1]
    assert rejected.values['signal'] == 'h3'
    assert dict(rejected.values['held']) == pytest.approx({'h2': 1.4, 'h3': 1.7}, abs=1e-5)


def test_before_the_first_measurement_the_other_signal_stays_open():
    controller = loop(THREE, 'h2', 'h3')
    state, rejected = asked(controller, 1.3, signals=('h3',))
    assert rejected is None
    report = stepped(controller, state, [0.9, 1.1, 1.0], 0)[2]
    np.testing.assert_array_equal(report.target.setpoint, [1.1, 1.3])


def test_schedules_are_kept_per_signal():
    controller, tracked = loop(THREE, 'h2', 'h3'), []
    state = stepped(controller, State(), [1.0, 1.0, 1.0], 0)[0]
    for value, second, signals in (
            ([1.1, 1.2], 2, None), (1.3, 4, ('h2',)), (1.4, 4, ('h3',)), (0.9, 6, ('h3',))):
        state, rejected = asked(controller, value, state, signals=signals,
                               effective_ns=EPOCH + second * SECOND)
        assert rejected is None
    assert len(state.setpoint.scheduled) == 3
    # at once: this ends what was scheduled for h2, and leaves h3 what was
    state, rejected = asked(controller, 0.8, state, signals=('h2',))
    assert rejected is None
    for second in range(1, 8):
        state, _, report = stepped(controller, state, [1.0, 1.0, 1.0], second)
        tracked.append(report.target.setpoint.tolist())
    assert tracked == [[0.8, 1.0], [0.8, 1.2], [0.8, 1.2], [0.8, 1.4], [0.8, 1.4], [0.8, 0.9],
                       [0.8, 0.9]]
    assert state.setpoint.scheduled == ()


@pytest.mark.parametrize('early', [False, True])
def test_a_signal_that_nobody_requested_makes_room(early):
    # at rest h2 - 1 = (h1 - 1) + (q2 - 3) with h1 - 1 = q1 - 3: with q2 at 2.9 or more, h1 at 1.2
    # leaves h2 no lower than 1.1
    controller = loop(BOTH, 'h1', 'h2', lower=[0.0, 2.9])
    state = State() if early else stepped(controller, State(), [1.0, 1.0], 0)[0]
    state, rejected = asked(controller, 1.2, state, signals=('h1',))
    assert rejected is None
    state, _, report = stepped(controller, state, [1.0, 1.0], 1)
    assert report.target.setpoint == pytest.approx([1.2, 1.1], abs=1e-5)
    # which is no request: what is requested counts with what was requested
    for value, allowed in ((1.15, True), (1.0, False)):
        state, rejected = asked(controller, value, state, signals=('h2',))
        assert (rejected is None) is allowed
    state, _, report = stepped(controller, state, [1.0, 1.0], 2)
    assert report.target.setpoint == pytest.approx([1.2, 1.15])
    assert asked(controller, 1.3, state, signals=('h1',))[1] is not None
    state, rejected = asked(controller, [1.1, 1.0], state)
    assert rejected is None


def test_a_signal_that_nobody_requested_makes_room_when_a_schedule_is_due():
    controller = loop(BOTH, 'h1', 'h2', lower=[0.0, 2.9])
    state = stepped(controller, State(), [1.0, 1.0], 0)[0]
    state, rejected = asked(controller, 1.2, state, effective_ns=EPOCH + 2 * SECOND,
                            signals=('h1',))
    assert rejected is None
    # the time of the other has not come, and it is requested at once
    for second, expected in ((1, [1.0, 1.0]), (2, [1.2, 1.1])):
        state, _, report = stepped(controller, state, [1.0, 1.0], second)
        assert report.target.setpoint == pytest.approx(expected, abs=1e-5)


def test_a_request_that_is_due_for_one_signal_leaves_the_ramp_of_the_other():
    asked = Setpoint(np.array([1.4, 1.0]), np.array([1.0, 1.0]), ((5, np.array([np.nan, 0.9])),))
    found = advance(asked, np.ones(2), loop(THREE, 'h2', 'h3').controlled, np.full(2, 0.1), 5, 1.0)
    assert found.requested.tolist() == [1.4, 0.9]
    assert found.active == pytest.approx([1.1, 0.9])


@pytest.mark.parametrize(('signals', 'value', 'message'), [
    (('h1',), [1.0], r"signals must be some of h2, h3, each once, got \['h1'\]"),
    (('h2', 'h2'), [1.0, 1.0], 'each once'),
    ((), [], 'some of h2, h3'),
    (('h2',), [1.0, 1.0], 'incompatible set-point: expected one number for each of h2'),
    (None, [1.0, 1.0, 1.0], 'expected one number for each of h2, h3')])
def test_requests_that_fit_no_signal_are_errors(signals, value, message):
    with pytest.raises(ValueError, match=message):
        asked(loop(THREE, 'h2', 'h3'), value, signals=signals)


@pytest.mark.parametrize(('model', 'names', 'message'), [
    (THREE, ('h3', 'h2'), 'some of the states h1, h2, h3, each once and in this order'),
    (THREE, ('h2', 'h2'), 'each once'),
    (THREE, ('temperature',), 'some of the states h1, h2, h3, .* got temperature'),
    (tanks(-np.eye(3), np.ones((3, 1))), ('h1', 'h2'),
     r'2 signals \(h1, h2\): list')])
def test_signals_that_cannot_be_controlled_are_rejected(model, names, message):
    with pytest.raises(ValueError, match=message):
        loop(model, *names)


def test_a_successor_keeps_the_setpoints_of_the_same_signals():
    before = loop(THREE, 'h2', 'h3')
    state = stepped(before, State(), [1.0, 1.0, 1.0], 0)[0]
    state = asked(before, [1.2, 1.3], state)[0]
    state = stepped(before, state, [1.0, 1.0, 1.0], 1)[0]
    again = loop(THREE, 'h2', 'h3', bumpless_transfer_time=5.0).switch_to(before, state)
    np.testing.assert_array_equal(again.setpoint.active, [1.2, 1.3])
    other = loop(THREE, 'h1', 'h3')
    moved = other.switch_to(before, state)
    report = stepped(other, moved, [1.1, 1.0, 0.9], 2)[2]
    np.testing.assert_array_equal(report.target.setpoint, [1.1, 0.9])


# The loop, and its records.

class Tanks:
    """Tanks under a load that no model knows, in their exact motion."""

    def __init__(self, model, load, x, u, time_ns=0):
        self.model, self.load, self.x, self.u, self.time_ns = model, load, x, u, time_ns
        self.applied = u

    def commanded(self, command, _):
        return Tanks(self.model, self.load, self.x, command, self.time_ns)

    def until(self, time_ns):
        model, n, seconds = self.model, self.model.n_x, (time_ns - self.time_ns) / SECOND
        rate = model.B @ model.inputs.to_deviation(self.u) + self.load / model.states.scale
        block = expm(seconds * np.block([
            [model.A, rate[:, None]], [np.zeros((1, n + 1))]]))
        xi = block[:n, :n] @ model.states.to_deviation(self.x) + block[:n, n]
        return Tanks(model, self.load, model.states.to_physical(xi), self.u, time_ns)


def test_the_controlled_levels_arrive_and_the_others_where_they_are_needed():
    controller, load = loop(THREE, 'h2', 'h3'), np.array([0.01, -0.02, 0.015])
    run = run_loop(controller, Tanks(THREE, load, np.ones(3), np.full(2, 3.0)), [
        at(5.0, SetpointRequest(0, np.array([1.3]), ('h2',))),
        at(5.0, SetpointRequest(0, np.array([0.8]), ('h3',)))], duration=400.0)
    assert run.setpoints.shape == (401, 2)
    assert run.levels[-1] == 'sdre'
    # 0.2 (h1 - 1) = 0.1 * 0.3 + 0.02
    np.testing.assert_allclose(run.states[-1], [1.25, 1.3, 0.8], rtol=0, atol=1e-6)
    np.testing.assert_allclose(run.reports[-1].target.state, [1.25, 1.3, 0.8], rtol=0, atol=1e-6)
    # 0.1 (q1 - 3) = 0.2 * 0.25 - 0.01, 0.1 (q2 - 3) = -0.1 * 0.2 - 0.05 * 0.3 - 0.015
    np.testing.assert_allclose(run.commands[-1], [3.4, 2.5], rtol=0, atol=1e-6)


def test_the_lower_two_of_four_tanks_under_a_model_that_is_not_the_plant():
    tank = QuadrupleTank()
    plant = tank.system()
    x, u = plant.nominal_state, plant.nominal_input
    states, inputs = (Coordinates(names, units, center, 0.5 * center, 0.2 * center, 1.8 * center)
                      for names, units, center in (
                          (plant.state_names, plant.state_units, x),
                          (plant.input_names, plant.input_units, u)))
    model = linearised_model(plant.drift_jacobian(x), plant.B, states, inputs, 's',
                             Provenance('four tanks'))
    controller = loop(model, 'level_1', 'level_2', upper=6.0)
    wanted = x[:2] * [1.2, 0.85]
    run = run_loop(controller, Process(plant, 0, x, u, Actuator(), u), [
        at(10.0, SetpointRequest(0, wanted[:1], ('level_1',))),
        at(300.0, SetpointRequest(0, wanted[1:], ('level_2',)))], duration=2500.0, period=5.0)
    # what leaves a tank, a sqrt(2 g h), fills the one below, beside what the pumps give
    flow = np.array([tank.orifice_1, tank.orifice_2]) * np.sqrt(2.0 * 9.81 * wanted)
    k = np.array([tank.pump_gain_1, tank.pump_gain_2])
    pumps = np.linalg.solve(np.array([[tank.split_1, 1.0 - tank.split_2],
                                      [1.0 - tank.split_1, tank.split_2]]) * k, flow)
    upper = np.array([(1.0 - tank.split_2) * k[1] * pumps[1] / tank.orifice_3,
                      (1.0 - tank.split_1) * k[0] * pumps[0] / tank.orifice_4])
    rest = np.array([*wanted, *upper ** 2 / (2.0 * 9.81)])
    np.testing.assert_allclose(run.states[-1], rest, rtol=1e-4)
    np.testing.assert_allclose(run.reports[-1].target.state, rest, rtol=1e-4)
    np.testing.assert_allclose(run.commands[-1], pumps, rtol=1e-4)
    np.testing.assert_array_equal(run.setpoints[30], [wanted[0], x[1]])


def test_a_continuous_loop_settles_at_the_steady_state_of_its_setpoint():
    weights = Weights(np.eye(2), np.eye(1))
    centers = SERIES.states.center, SERIES.inputs.center

    def rate(x, u):
        return np.array([[-0.2, 0.0], [0.2, -0.1]]) @ (x - 1.0) + np.array([0.1, 0.0]) * (u - 3.0)

    run = run_closed_loop(SERIES, rate, centers[0], np.array([1.4]), weights, 300.0,
                          controlled=('h2',))
    np.testing.assert_allclose(run.states[-1], [1.2, 1.4], rtol=0, atol=1e-6)
    np.testing.assert_allclose(run.inputs[-1], [3.4], rtol=0, atol=1e-5)
    with pytest.raises(ValueError, match=r'holds y at \[-0\.5\]; the nearest'):
        run_closed_loop(parabola().model, rate, np.ones(2), np.array([-0.5]), weights, 1.0,
                        controlled=('y',))


@pytest.mark.parametrize(('model', 'controlled', 'asked', 'w'), [
    # the pump of the first tank would have to give 7 L/s
    (SERIES, ('h2',), [5.0], [0.0, 0.0]),
    (SERIES, ('h2',), [2.0], [-0.15, 0.0]),
    (BOTH, ('h1', 'h2'), [2.0, 2.0], [-3.0, -4.0]),
    (THREE, ('h2', 'h3'), [2.0, 1.8], [-0.05, 0.0, -0.2])])
def test_where_a_pump_does_not_suffice_the_nearest_level_is_found(model, controlled, asked, w):
    level = loop(model, *controlled).best
    w = np.array(w) / model.states.scale
    places = [model.states.names.index(name) for name in controlled]
    wanted = (np.array(asked) - model.states.center[places]) / model.states.scale[places]
    ends, n = level.input_range, model.n_x
    found = model_steady_state(
        model, w, np.zeros(n + model.n_u), np.concatenate((np.full(n, -np.inf), ends[0])),
        np.concatenate((np.full(n, np.inf), ends[1])), Goal(np.array(places), wanted))
    # linear: all steady states are x = -A^-1 (B u + w), so that bounded least squares has it
    slope = -np.linalg.solve(model.A, model.B)
    rest = -np.linalg.solve(model.A, w)
    best = lsq_linear(slope[places], wanted - rest[places], ends)
    assert found[n:] == pytest.approx(best.x, abs=1e-8)
    assert found[:n] == pytest.approx(slope @ best.x + rest, abs=1e-8)
    # which is where the law goes; a single pump at its end goes there by itself
    estimate = Estimate(np.zeros(model.n_x), w)
    target = level.compute(np.array(asked), estimate, None, 1.0, None, None)[0]
    assert target.u == pytest.approx(best.x, abs=1e-8) or (
        model.n_u == 1 and target.u > ends[1] and best.x == pytest.approx(ends[1]))


@pytest.mark.parametrize('seed', range(10))
def test_inputs_that_suffice_exactly_hold_the_setpoint(seed):
    """Whichever way their sum is rounded."""
    rng = np.random.default_rng(seed)
    upper = rng.uniform(0.2, 1.0, 2)
    # the first pump does more for each L/s, and would go beyond its range
    gain = np.array([rng.uniform(0.2, 0.3), rng.uniform(0.02, 0.04)])
    model = tanks([[-1.0]], [gain])
    found = steady_state_target(model, np.array([model.B[0] @ upper]), limits=(-upper, upper))
    assert found.u == pytest.approx(upper, abs=1e-8)


def test_no_state_of_a_target_is_further_off_than_that_of_a_prediction():
    def target(outflow):
        w = np.array([0.0, -outflow]) / SERIES.states.scale
        found = steady_state_target(SERIES, np.array([1.0]), w, controlled=np.array([1]))
        return None if found is None else SERIES.states.to_physical(found.x)

    # 1.5 m in the second tank would take 11.25 m in the first, which is beyond 10 half-ranges
    np.testing.assert_allclose(target(2.0), [11.0, 1.0])
    # from which the second would be at -19 m
    assert target(4.0) is None


def test_of_more_states_than_inputs_behind_a_lag_the_target_is_a_compromise():
    """A mass on a spring behind an actuator: its place can be held, its speed only at 0."""
    A, B = np.array([[0.0, 1.0, 0.0], [-1.0, -0.5, 1.0], [0.0, 0.0, -2.0]]), np.eye(3)[:, 2:] * 2.0
    states, inputs = (Coordinates.spanning(names, ('1',) * len(names), np.full(len(names), -2.0),
                                           np.full(len(names), 2.0))
                      for names in (('place', 'speed', 'applied_force'), ('force',)))
    model = linearised_model(A, B, states, inputs, 's', Provenance('spring'))
    spring = Controller(model, Tuning.for_model(model))
    assert spring.controlled.names == ('place', 'speed')
    state = spring.step(State(), np.zeros(2), 0)[0]
    state, rejection = spring.request_setpoint(state, np.array([0.5, 0.0]))
    assert rejection is None
    x, period = np.zeros(3), 0.1
    ahead = expm(period * np.block([[A, B], [np.zeros((1, 4))]]))[:3]
    for k in range(1, 200):
        state, command, _ = spring.step(state, x[:2], k * round(period * SECOND))
        x = ahead @ np.append(x, command)
    np.testing.assert_allclose(x, [0.5, 0.0, 0.5], atol=0.01)
    # a speed cannot be held
    assert spring.request_setpoint(state, np.array([0.5, 0.4]))[1] is not None
