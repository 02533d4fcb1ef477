# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Whatever happens to the controllers of shipped plants: their commands, and their records."""

from collections.abc import Mapping
from dataclasses import replace
import math
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from koopman_ros import plants
from koopman_ros.control import Controller, Mode, State
from koopman_ros.control.events import (
    apply,
    Event,
    EventOutcome,
    Initialisation,
    ManualCommand,
    Measurement,
    ModeChange,
    SetpointRequest,
    Silence,
)
from koopman_ros.core.paths import model_path
from koopman_ros.core.status import StatusCode
from koopman_ros.event_log import records
from koopman_ros.event_log.loop import replay
from koopman_ros.model import LiftedModel, load_with_digest
from koopman_ros.parameters.controller import built, table_of
from koopman_ros.parameters.plant import PlantTable
from support.closed_loops import content, EPOCH, SECOND

WILD = [math.nan, math.inf, -math.inf, 1e300, -1e300, 1.7e308, 0.0, -0.0, 5e-324]
# of the half-ranges of the trained range, from its middle
shares = st.one_of(st.floats(-1.0, 1.0), st.floats(-3.0, 3.0), st.sampled_from(WILD))
waits = st.one_of(st.just(1.0), st.sampled_from([0.3, 4.0, 0.0, -1.0, -30.0, 3600.0, -1e6]))
kinds = st.sampled_from(['run'] * 4 + ['measure', 'part', 'silence', 'setpoint', 'one setpoint',
                                       'schedule', 'manual', 'mode', 'restart'])
sequences = st.lists(st.tuples(kinds, st.lists(shares, min_size=4, max_size=4), waits),
                     min_size=1, max_size=15)


def tuned(values: Mapping[str, Any], model: LiftedModel) -> Controller:
    return built(table_of(model, values).snapshot(values), model)


class Run:
    """The controller of a plant as its file tunes it, on the plant, and what it records."""

    def __init__(self, system: str, **parameters: float) -> None:
        self.model, digest = load_with_digest(model_path(system))
        table = table_of(self.model, {'system': system})
        self.values = table.values(table.snapshot(parameters))
        self.controller = tuned(self.values, self.model)
        self.identity = {'name': system, 'digest': digest}
        plant = PlantTable({'system': system})
        self.equations = plant.system(plant.snapshot({}))
        self.period_ns = round(plant.snapshot({}).sample_period * SECOND)

    def begin(self) -> None:
        self.plant = plants.Process(self.equations, EPOCH, self.equations.nominal_state,
                                    self.equations.nominal_input)
        self.texts: list[str] = []
        self.runs = 0
        self.start()

    def start(self) -> None:
        self.state, self.number, self.runs = State(), 0, self.runs + 1
        self.write(records.START, records.snapshot(self.state, self.values, self.identity))

    def write(self, event: str, fields: Mapping[str, object]) -> None:
        self.texts.append(records.EventRecord(str(self.runs), self.number, event, fields).text())
        self.number += 1

    def do(self, event: Event) -> EventOutcome:
        outcome = apply(self.controller, self.state, event)
        self.state = outcome.state
        if not isinstance(event, Silence) or outcome.command is not None:
            self.write(*records.fields_of(event, outcome))
        if outcome.command is not None:
            self.plant = self.plant.commanded(outcome.command, self.plant.time_ns)
        return outcome

    def sample(self) -> np.ndarray:
        """Let the plant go on by a sample, and return what is measured."""
        self.plant = self.plant.until(self.plant.time_ns + self.period_ns)
        return self.plant.x


def limited(system: str, share: float) -> Run:
    """Return the run of a plant whose inputs take so many seconds from one limit to the other."""
    model = Run(system).model
    return Run(system, **{f'{name}.rate_limit': float(width) / share for name, width in zip(
        model.inputs.names, model.inputs.upper - model.inputs.lower, strict=True)})


RUNS = {name: (Run(name), limited(name, 10.0))
        for name in ('two_tanks', 'quadruple_tank', 'two_state_example')}


@pytest.mark.parametrize('name', RUNS)
@settings(max_examples=8, deadline=None, derandomize=True)
@given(slow=st.booleans(), sequence=sequences)
@np.errstate(all='ignore')
def test_commands_keep_their_limits_and_follow_from_the_records(name, slow, sequence):
    run = RUNS[name][slow]
    limits, names = run.controller.tuning.limits, run.controller.controlled.names
    assert bool(np.all(np.isfinite(limits.rate))) is slow
    run.begin()
    commands = []

    def answered(event: Event) -> None:
        before, earlier = run.state.command, run.state.commanded_ns
        outcome = run.do(event)
        command = outcome.command
        if command is None:
            return
        commands.append(command)
        assert command.shape == (run.model.n_u,)
        assert np.all((limits.lower <= command) & (command <= limits.upper))
        if slow and before is not None and earlier is not None:
            elapsed = max(0.0, (event.stamp_ns - earlier) / SECOND)
            assert np.all(np.abs(command - before) <= limits.rate * elapsed + 1e-9)

    for kind, values, wait in sequence:
        x = run.model.states.to_physical(np.array(values[:run.model.n_x]))
        u = run.model.inputs.to_physical(np.array(values[-run.model.n_u:]))
        now = max(SECOND, run.plant.time_ns + round(wait * SECOND))
        r = x[[run.model.states.names.index(signal) for signal in names]]
        match kind:
            case 'run':
                for _ in range(6):
                    measured = run.sample()
                    answered(Measurement(run.plant.time_ns, measured, run.plant.u))
            case 'measure':
                answered(Measurement(now, x))
            case 'part':
                # one signal shows what it likes
                measured = np.array(run.sample())
                i = len(commands) % run.model.n_x
                measured[i] = x[i]
                answered(Measurement(run.plant.time_ns, measured))
            case 'silence':
                answered(Silence(now, StatusCode.NO_MEASUREMENT if values[0] > 0.0 else None))
            case 'setpoint':
                run.do(SetpointRequest(0, r))
            case 'one setpoint':
                i = len(commands) % len(names)
                run.do(SetpointRequest(0, r[i:i + 1], names[i:i + 1]))
            case 'schedule':
                run.do(SetpointRequest(now, r))
            case 'manual':
                run.do(ManualCommand(u))
            case 'mode':
                run.do(ModeChange(Mode.MANUAL if values[0] > 0.0 else Mode.AUTOMATIC))
            case 'restart':
                run.start()
                run.do(Initialisation(run.plant.u))

    recorded = [records.parse(text) for text in run.texts]
    found = replay(recorded, lambda *_: run.model, tuned)
    assert (found.lost, found.begins_late, found.runs) == ([], 0, run.runs)
    assert [sample.replayed.tobytes() for sample in found.samples] == [
        command.tobytes() for command in commands]
    # the state, too, from what was written down alone and by a controller that nothing has used
    again, state = replace(run.controller), State()
    for record in recorded:
        state = records.state_of(record) if record.event == records.START else apply(
            again, state, records.event_of(record)).state
    assert content(state) == content(run.state)


@pytest.mark.parametrize(('name', 'start', 'goal', 'samples'), [
    ('two_tanks', None, [0.1, 0.15], 250), ('quadruple_tank', None, [0.15, 0.1], 400),
    ('two_state_example', [0.2, 0.2], [0.0, 0.0], 600)])
def test_what_the_sequences_are_about_is_reached(name, start, goal, samples):
    """The plant is led to a set-point under a rate; one signal that is no number is refused."""
    run = RUNS[name][True]
    run.begin()
    if start is not None:
        run.plant = replace(run.plant, x=np.array(start))
    states, names = run.model.states, run.controller.controlled.names
    held = [states.names.index(signal) for signal in names]
    assert run.do(SetpointRequest(0, np.array(goal))).refused is None
    for _ in range(samples):
        measured = run.sample()
        outcome = run.do(Measurement(run.plant.time_ns, measured, run.plant.u))
    error = (run.plant.x[held] - goal) / (states.upper - states.lower)[held]
    np.testing.assert_allclose(error, 0.0, rtol=0, atol=1e-3)
    # by the best law
    assert outcome.report.depth == 0
    measured = np.array(run.sample())
    measured[-1] = math.nan
    assert run.do(Measurement(run.plant.time_ns, measured)).report.level == 'hold'
