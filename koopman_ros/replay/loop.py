# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The replay: a loop over a controller's records, which gives its commands again."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

from koopman_ros.arrays import Array
from koopman_ros.control import Controller, Setpoint, State
from koopman_ros.control.events import apply, Measurement, SetpointRequest
from koopman_ros.lifting import LiftedModel
from koopman_ros.replay import records

# The model of a name and a digest, read anew each time; raises RecordError where there is none.
FindModel: TypeAlias = Callable[[str, str], LiftedModel]
# The tuning of a model that parameters by name stand for; raises ValueError where they do not fit.
Build: TypeAlias = Callable[[Mapping[str, Any], LiftedModel], Controller]


@dataclass(frozen=True)
class Alternative:
    """Another model, whose commands are compared with the recorded ones."""

    model: LiftedModel
    digest: str  #: SHA-256 of its file
    #: that replace recorded ones, by name
    parameters: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Sample:
    """A command: recorded, replayed, and that of the alternative; all in the model's units."""

    stamp_ns: int  #: of the measurement that it answers, or of the silence
    measured: Array | None  #: (n_y,) or None in silence
    setpoint: Array | None  #: (n_c,) that was tracked according to the replay, or None
    recorded: Array  #: (n_u,) what was commanded
    #: (n_u,) the same by the replay; None where it knows no state, before the first snapshot and
    #: behind a lost record
    replayed: Array | None
    alternative: Array | None  #: (n_u,) what the alternative commands, or None


@dataclass(frozen=True)
class Lost:
    """Records that are missing."""

    run: str  #: of the controller
    first: int  #: number of the first one
    last: int  #: number of the last one


@dataclass
class Replay:
    """What came of a replay."""

    #: one for each command, in the order of the records
    samples: list[Sample] = field(default_factory=list)
    lost: list[Lost] = field(default_factory=list)  #: records that are missing
    runs: int = 0  #: how often the controller was started, as far as it shows
    begins_late: int = 0  #: runs whose first records are missing
    refused: int = 0  #: requests that were refused
    #: names of those in force, in the order of their use
    models: list[str] = field(default_factory=list)
    #: the last one in force, or None where no state was found
    controller: Controller | None = None
    #: its parameters by name
    parameters: Mapping[str, Any] = field(default_factory=dict)


def replay(recorded: Iterable[records.Record], find_model: FindModel, build: Build,
           alternative: Alternative | None = None) -> Replay:
    """
    Apply what is recorded again.

    Records come in the order of receipt; those of several runs may alternate. The alternative
    answers the same measurements under the set-points that were tracked. Raises RecordError for
    records that cannot be replayed.
    """
    found = Replay()
    runs: dict[str, _Run] = {}
    for record in recorded:
        if record.run not in runs:
            runs[record.run] = _Run(found, find_model, build, alternative)
            found.runs += 1
            found.begins_late += record.event != records.START
        try:
            runs[record.run].take(record)
        except (ArithmeticError, AttributeError, IndexError, KeyError, TypeError, ValueError
                ) as error:
            if isinstance(error, records.RecordError):
                raise
            raise records.RecordError(
                f'record {record.number} of run {record.run} cannot be replayed '
                f'({type(error).__name__}: {error})') from error
    return found


class _Run:
    """A run of a controller on its way through the replay."""

    def __init__(self, found: Replay, find_model: FindModel, build: Build,
                 alternative: Alternative | None) -> None:
        self._found = found
        self._find_model = find_model
        self._build = build
        self._other = alternative
        self._next: int | None = None  # number of the next record
        self._state: State | None = None  # None while it is not known
        self._other_state = State()
        self._parameters: dict[str, Any] = {}
        self._controller: Controller
        self._other_controller: Controller

    def take(self, record: records.Record) -> None:
        """Replay the next record."""
        if self._next is not None:
            if record.number < self._next:
                raise records.RecordError(
                    f'record {record.number} of run {record.run} comes again, or after record '
                    f'{self._next - 1}: the bag is not in order')
            if record.number > self._next:
                self._found.lost.append(Lost(record.run, self._next, record.number - 1))
                self._state = None
        self._next = record.number + 1
        if record.event in (records.START, records.SNAPSHOT):
            if self._state is None or record.event == records.START:
                self._begin(record)
        elif self._state is None:
            self._keep(record, None, None, None)
        elif record.event in (records.PARAMETERS, records.MODEL):
            self._exchange(record, self._state)
        else:
            self._apply(record, self._state)

    def _begin(self, record: records.Record) -> None:
        self._parameters = dict(record.fields['parameters'])
        model = self._model(record)
        self._controller = self._build(self._parameters, model)
        self._found.controller, self._found.parameters = self._controller, self._parameters
        self._state = records.state_of(record)
        if self._other is not None:
            same = self._other.digest == record.fields['model']['digest']
            self._other_controller = self._tuned(
                self._controller.model if same else self._other.model)
            self._other_state = self._other_controller.hand_over(self._controller, self._state)

    def _exchange(self, record: records.Record, state: State) -> None:
        """Put other parameters or another model in force."""
        self._parameters.update(record.fields.get('parameters', {}))
        predecessor = self._controller
        model = self._model(record) if 'model' in record.fields else predecessor.model
        self._controller = self._build(self._parameters, model)
        self._found.controller, self._found.parameters = self._controller, self._parameters
        self._state = self._controller.hand_over(predecessor, state)
        if self._other is not None and 'parameters' in record.fields:
            predecessor = self._other_controller
            self._other_controller = self._tuned(predecessor.model)
            self._other_state = self._other_controller.hand_over(predecessor, self._other_state)

    def _apply(self, record: records.Record, state: State) -> None:
        event = records.event_of(record)
        outcome = apply(self._controller, state, event)
        self._state = outcome.state
        self._found.refused += outcome.refused is not None
        target = None if outcome.report is None else outcome.report.target
        active = None if target is None else target.setpoint
        other = None
        # it may refuse a request: it goes by what was tracked
        if self._other is not None and not isinstance(event, SetpointRequest):
            if active is not None and isinstance(event, Measurement):
                self._other_state = replace(
                    self._other_state, setpoint=Setpoint(active, active))
            answered = apply(self._other_controller, self._other_state, event)
            self._other_state, other = answered.state, answered.command
        self._keep(record, active, outcome.command, other)

    def _keep(self, record: records.Record, setpoint: Array | None, replayed: Array | None,
              other: Array | None) -> None:
        """Keep the command of a record, where it has one."""
        fields = record.fields
        if fields.get('command') is not None:
            measured = fields.get('measured')
            self._found.samples.append(Sample(
                record.stamp_ns, None if measured is None else records.float_array(measured),
                setpoint, records.float_array(fields['command']), replayed, other))

    def _model(self, record: records.Record) -> LiftedModel:
        name, digest = record.fields['model']['name'], record.fields['model']['digest']
        if name not in self._found.models:
            self._found.models.append(name)
        return self._find_model(name, digest)

    def _tuned(self, model: LiftedModel) -> Controller:
        assert self._other is not None
        return self._build({**self._parameters, **self._other.parameters}, model)
