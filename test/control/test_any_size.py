# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Any number of states and inputs: limits, levels, noise and silence, one number per signal."""

import contextlib
from dataclasses import replace
import json
import math

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.linalg import expm

from koopman_ros.control import Arrival, Controller, InputLimits, Mode, SensorLimits, State, Tuning
from koopman_ros.core.signals import Outputs
from koopman_ros.core.status import StatusCode
from koopman_ros.event_log.records import decoded
from koopman_ros.model import LiftedModel, linearised_model, Provenance
from support.closed_loops import content, controller, EPOCH, SECOND
from support.random_lifts import coordinates, random_lift


def tuned(model: LiftedModel, outputs: Outputs | None = None, **changes: object) -> Controller:
    """Return a controller whose numbers differ from signal to signal."""
    states, inputs, n_u = model.states, model.inputs, np.arange(1.0, model.n_u + 1.0)
    measured = outputs or Outputs(states.names, states.units, np.eye(model.n_x))
    reach = np.abs(measured.C) @ (20.0 * states.scale)
    middle = measured.of(states.center)
    controlled = [name in measured.names or measured.names[0] == 'y0' for name in states.names]
    return Controller(model, replace(Tuning.for_model(
        model, state_weight=1.0 / states.scale ** 2, input_weight=n_u / inputs.scale ** 2,
        limits=InputLimits(inputs.lower - n_u, inputs.upper + n_u, 0.5 * n_u),
        setpoint_ramp=0.1 * states.scale[controlled], max_disturbance=2.0 * inputs.scale,
        sensor=SensorLimits(middle - reach, middle + reach, 0.1 * reach, 0.2 * reach, 5.0),
        observer_bandwidth=0.2, hold_timeout=5.0,
        bumpless_transfer_time=3.0), **changes), outputs)


def mixed(model: LiftedModel) -> Outputs:
    """Return measurements that each see two states."""
    n = model.n_x
    return Outputs(tuple(f'y{i}' for i in range(n)), ('1',) * n, np.eye(n) + 0.5 * np.eye(n, k=1))


def some(model: LiftedModel, n_y: int) -> Outputs:
    """Return measurements of the first states alone."""
    states = model.states
    return Outputs(states.names[:n_y], states.units[:n_y], np.eye(model.n_x)[:n_y])


WILD = [math.nan, math.inf, -math.inf, 1e300, -1e300, 1.7e308, 0.0, -0.0, 5e-324, -40.0]
shares = st.one_of(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.sampled_from(WILD), st.floats())
waits = st.one_of(st.just(1.0), st.sampled_from(
    [0.3, 4.0, 0.0, 1e-9, -1e-9, -1.0, -30.0, 3600.0, -3600.0, -1e9, 1e9]))
kinds = st.sampled_from(['measure'] * 6 + [
    'silence', 'setpoint', 'schedule', 'manual', 'mode', 'frozen', 'restart', 'successor'])
events = st.lists(st.tuples(kinds, st.lists(shares, min_size=4, max_size=4), waits),
                  min_size=1, max_size=30)
ENDLESS = {'lower': np.array([-math.inf]), 'upper': np.array([math.inf]),
           'rate': np.array([math.inf])}
REACTORS = [[first, first, *others] for first, *others in (
    [controller(), controller(observer_bandwidth=0.0, bumpless_transfer_time=0.0),
     controller(input_weight=np.array([1e-4]))],
    [controller('reactor_linear'), controller(sensor=ENDLESS)],
    [controller('reactor_nz3', setpoint_ramp=np.array([0.2])), controller('reactor_linear')])]


def random_controllers(n_x: int, n_u: int, seed: int, all_states: bool, n_c: int
                       ) -> list[Controller]:
    model = random_lift(n_x, n_u=n_u, seed=seed)
    outputs = None if all_states else mixed(model)
    n_c = min(n_c, n_u, n_x)
    part = {'controlled': model.states.names[:n_c], 'setpoint_ramp': 0.1 * model.states.scale[
        :n_c]} if n_c else {}
    found = [tuned(model, outputs, **part), tuned(model, outputs),
             tuned(model, outputs, observer_bandwidth=0.0, **part)]
    if all_states and n_x > 1 and n_c:
        with contextlib.suppress(ValueError):
            # what is measured may leave the disturbance open
            found = [tuned(model, some(model, n_x - 1), estimator=filtering, **part)
                     for filtering in ('', 'extended_kalman_filter', 'unscented_kalman_filter')]
    return found


controllers = st.one_of(st.sampled_from(REACTORS), st.builds(
    random_controllers, st.integers(1, 4), st.integers(1, 3), st.integers(0, 5), st.booleans(),
    st.integers(0, 3)))


@settings(max_examples=60, deadline=None, derandomize=True)
@given(controllers=controllers, sequence=events)
@np.errstate(all='ignore')
def test_every_command_keeps_the_limits_of_each_input(controllers, sequence):
    loop, model = controllers[0], controllers[0].model
    limits, state, now = loop.tuning.limits, State(), EPOCH
    last = loop.measured.of(model.states.center)
    for kind, values, wait in sequence:
        before, earlier, then = state.command, state.commanded_ns, state.time_ns
        x = model.states.to_physical(np.array(values[:model.n_x]))
        u = model.inputs.to_physical(np.array(values[-model.n_u:]))
        now = max(SECOND, now + round(wait * SECOND))
        command = None
        match kind:
            case 'measure' | 'frozen':
                y = last if kind == 'frozen' else loop.measured.of(x)
                last, kept = y, content(state)
                state, command, report = result = loop.step(state, y, now)
                # pure: a controller built afresh, with nothing cached, gives the same
                again = decoded(json.loads(kept))
                assert content(replace(loop).step(again, y, now)) == content(result)
                ahead = SECOND if then is None else now - then
                arrival = report.measurement.arrival
                assert report.measurement.clock_went_back is (ahead < -SECOND)
                if before is not None:
                    assert (arrival is Arrival.LATE) is (-SECOND <= ahead < 0)
                    assert (arrival is Arrival.REPEATED) is (ahead == 0)
                    if -SECOND <= ahead <= 0:
                        assert (content(state), command.tolist()) == (kept, before.tolist())
                if arrival is Arrival.REJECTED:
                    assert report.reason is not None or state.mode is Mode.MANUAL
                assert arrival is not Arrival.ACCEPTED or np.all(np.isfinite(y))
            case 'silence':
                state, command, report = loop.hold(state, now)
            case 'setpoint' | 'schedule':
                names = loop.controlled.names
                # all of them, or the first one alone; anywhere, or in the trained range
                signals = None if values[-1] > 0.0 else names[:1]
                asked_of = loop.controlled.only(signals or names)
                r = x[[model.states.names.index(name) for name in asked_of.names]]
                if values[-2] > 0.0:
                    share = 0.5 + np.clip(values[:len(r)], -3.0, 3.0) / 6.0
                    r = asked_of.lower + share * (asked_of.upper - asked_of.lower)
                when = now * (kind == 'schedule')
                asked, rejected = loop.request_setpoint(state, r, when, signals)
                inside = asked_of.violation(r) == 0.0
                if rejected is None:
                    assert inside
                else:
                    assert asked is state
                    assert not inside or rejected.code in (
                        StatusCode.SETPOINT_NOT_HELD, StatusCode.NO_SETPOINT_HELD,
                        StatusCode.SETPOINT_UNMEASURED)
                if rejected is not None and rejected.code is StatusCode.SETPOINT_NOT_HELD:
                    # what is named as the nearest one can be asked for
                    held = dict(rejected.values['held'])
                    assert loop.controlled.only(tuple(held)).violation(
                        np.array(list(held.values()))) == 0.0
                    assert loop.request_setpoint(
                        state, np.array(list(held.values())), when, tuple(held))[1] is None
                state = asked
            case 'manual':
                asked, rejected = loop.request_manual_input(state, u)
                assert (rejected is None) == (
                    state.mode is Mode.MANUAL and bool(np.all(np.isfinite(u))))
                assert rejected is None or asked is state
                state = asked
            case 'mode':
                state = loop.set_mode(state, Mode.MANUAL if values[0] > 0.0 else Mode.AUTOMATIC)
            case 'restart':
                state = loop.initialise(State(), u)
            case 'successor':
                other = controllers[(values[0] > 0.0) + (values[1] > 0.0)]
                state, loop = other.switch_to(loop, state), other
        if command is None:
            continue
        assert command.shape == (model.n_u,)
        assert np.all((limits.lower <= command) & (command <= limits.upper))
        assert report.level in ('sdre', 'linear', 'hold', 'safe', 'manual')
        assert state.estimate is None or np.all(np.isfinite(state.estimate.w))
        if before is not None and earlier is not None:
            elapsed = max(0.0, (now - earlier) / SECOND)
            assert np.all(np.abs(command - before) <= limits.rate * elapsed + 1e-9)


@pytest.mark.parametrize(('n', 'all_states'), [(1, True), (2, False), (3, True)])
def test_a_disturbed_plant_is_brought_to_its_setpoint(n, all_states):
    rng = np.random.default_rng(n)
    A, B = rng.normal(size=(n, n)) - 1.5 * np.eye(n), np.eye(n) + 0.2 * rng.normal(size=(n, n))
    model = linearised_model(
        A, B, coordinates('x', n), coordinates('u', n), 'min', Provenance('linear'))
    loop = tuned(model, None if all_states else mixed(model))
    A, B = model.A, model.B
    # the plant's exact motion over a second, with a load that the model does not know
    load = 0.2 * rng.normal(size=n)
    block = expm(np.block([[A, np.eye(n)], [np.zeros((n, 2 * n))]]) / 60.0)
    motion, integral = block[:n, :n], block[:n, n:]
    wanted = model.states.to_physical(np.full(n, 0.4))
    state, rejected = loop.request_setpoint(State(), wanted)
    assert rejected is None
    x = np.zeros(n)
    for k in range(600):
        state, command, report = loop.step(
            state, loop.measured.of(model.states.to_physical(x)), (k + 10) * SECOND)
        x = motion @ x + integral @ (B @ model.inputs.to_deviation(command) + load)
    assert report.level == 'sdre'
    np.testing.assert_allclose(x, 0.4, rtol=0, atol=1e-6)
    np.testing.assert_allclose(state.estimate.w, load, rtol=0, atol=1e-5)


def test_an_array_of_another_size_is_rejected():
    good = tuned(random_lift(2, n_u=2))
    for name in ('state_weight', 'input_weight', 'setpoint_ramp', 'max_disturbance',
                 'tracking_tolerance', 'safe_value'):
        for wrong in (np.ones(1), np.ones(3), np.ones((2, 1))):
            with pytest.raises((ValueError, TypeError), match=r'one (number )?(for each of|per)'):
                Controller(good.model, replace(good.tuning, **{name: wrong}))
    for part, names in (('limits', ('lower', 'upper', 'rate')),
                        ('sensor', ('lower', 'upper', 'rate', 'jump'))):
        whole = getattr(good.tuning, part)
        with pytest.raises(ValueError, match=rf'{names[0]}.* one number (for each of|per)'):
            Controller(good.model, replace(good.tuning, **{part: replace(
                whole, **{item: getattr(whole, item)[:1] for item in names})}))


@pytest.mark.parametrize('estimator', ['disturbance_observer', 'measured_state'])
def test_estimators_that_need_every_state_say_so(estimator):
    model = random_lift(2, n_u=1)
    with pytest.raises(ValueError, match='does not determine all 2 states'):
        tuned(model, some(model, 1), estimator=estimator)
