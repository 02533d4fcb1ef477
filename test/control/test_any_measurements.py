# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Whatever is measured and asked for: finite commands within the limits, and never an error."""

import math

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np

from koopman_ros.control import Mode, State
from support.sampled_loops import controller, EPOCH, LOWER, RATE, SECOND, UPPER

TUNINGS = [controller(), controller(observer_bandwidth=0.0, transfer_time=0.0),
           controller('reactor_linear'), controller('reactor_nz3', input_weight=np.array([1e-4])),
           controller(sensor={'lower': np.array([-math.inf]), 'upper': np.array([math.inf]),
                              'rate': np.array([math.inf])})]

values = st.one_of(
    st.floats(300.0, 332.0), st.floats(), st.sampled_from(
        [math.nan, math.inf, -math.inf, 1e300, -1e300, -0.0, 0.0, 5e-324, 1.7e308, 324.4754]))
waits = st.one_of(
    st.just(SECOND), st.integers(0, 3 * SECOND), st.integers(-2 * SECOND, 10 * SECOND),
    st.sampled_from([0, 1, -1, 3600 * SECOND, -3600 * SECOND, -EPOCH, 10 ** 18]))
measured = st.tuples(st.just('measure'), values, waits)
events = st.one_of(
    measured, measured, measured,
    st.tuples(st.just('silence'), st.just(0.0), waits),
    st.tuples(st.just('setpoint'), values, waits),
    st.tuples(st.just('manual'), values, st.just(0)),
    st.tuples(st.just('mode'), st.sampled_from([0.0, 1.0]), st.just(0)),
    st.tuples(st.just('tuning'), st.integers(0, len(TUNINGS) - 1), st.just(0)),
    st.tuples(st.just('restart'), values, st.just(0)))


@settings(max_examples=80, deadline=None, derandomize=True)
@given(st.lists(events, min_size=1, max_size=40))
def test_no_sequence_of_events_brings_out_a_wild_command(sequence):
    loop, state, now = TUNINGS[0], State(), EPOCH
    for kind, value, wait in sequence:
        before, earlier = state.command, state.commanded_ns
        command = None
        if kind == 'measure':
            now = max(0, now + wait)
            state, command, report = loop.step(state, np.array([value]), now)
        elif kind == 'silence':
            now = max(0, now + wait)
            state, command, report = loop.hold(state, now)
        elif kind == 'setpoint':
            state, _ = loop.request_setpoint(state, np.array([value]), max(0, now + wait))
        elif kind == 'manual':
            state, _ = loop.request_manual_input(state, np.array([value]))
        elif kind == 'mode':
            state = loop.set_mode(state, Mode.MANUAL if value else Mode.AUTOMATIC)
        elif kind == 'tuning':
            other = TUNINGS[int(value)]
            state, loop = other.hand_over(loop, state), other
        else:
            state = loop.initialise(State(), np.array([value]))
        if command is None:
            continue
        assert math.isfinite(command[0])
        assert LOWER <= command[0] <= UPPER
        if before is not None and earlier is not None:
            elapsed = max(0.0, (now - earlier) / SECOND)
            assert abs(command[0] - before[0]) <= RATE * elapsed + 1e-9
        assert report.level in ('sdre', 'linear', 'hold', 'safe', 'manual')
        assert np.all(np.isfinite(state.estimate.w)) if state.estimate is not None else True
