# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A regular step is the same, bit for bit, as without a way of its own."""

from koopman_ros.control.regular import Regular
import numpy as np
import pytest

from koopman_ros.control import State
from koopman_ros.lifting import load
from koopman_ros.parameters.controller import built, table_of
from koopman_ros.replay.records import encoded
from koopman_ros.resources import model_path
from support.odd_events import odd_event


@pytest.mark.parametrize(('name', 'given', 'seconds', 'usual'), [
    ('reactor_nz4', {'coolant_temperature.rate_limit': 0.02}, 1.0, 50),
    ('reactor_nz3', {'disturbance_bandwidth': 0.0, 'setpoint_filter': 5.0}, 1.0, 50),
    ('two_tanks', {'system': 'two_tanks'}, 0.5, 25),
])
def test_it_answers_and_remembers_the_same(
        name: str, given: dict[str, object], seconds: float, usual: int) -> None:
    model, answered = load(model_path(name)), 0
    parameters = table_of(model, given).snapshot(given)
    ours, theirs = built(parameters, model), built(parameters, model)
    # as if nothing were regular
    vars(theirs)['_regular'] = None
    assert isinstance(ours._regular, Regular)
    rng, state = np.random.default_rng(1), State()
    for k in range(120):
        if k % 30 == 20:
            asked = ours.controlled.center + 0.1 * rng.uniform(-1.0, 1.0) * ours.controlled.scale
            state, _ = theirs.request_setpoint(state, asked)
        event = odd_event(model, rng, state, seconds)
        answered += ours._regular.step(
            state, event[0], event[1], np.zeros(model.n_u), seconds, seconds, seconds, 0, True
        ) is not None
        one, two = ours.step(state, *event), theirs.step(state, *event)
        assert one[1].tolist() == two[1].tolist()
        assert encoded(one[0]) == encoded(two[0])
        assert repr(one[2]) == repr(two[2])
        for part in ('measurement', 'command'):
            assert repr(getattr(one[2], part)) == repr(getattr(two[2], part))
        if two[2].target is not None:
            assert one[2].target.residual == pytest.approx(two[2].target.residual, nan_ok=True)
        state = two[0]
    assert answered > usual
