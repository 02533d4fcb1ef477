# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The replay: a loop over the records of controllers, which gives their commands again."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeAlias

from koopman_ros.control import Controller, Setpoint, State
from koopman_ros.control.events import apply, Measurement, SetpointRequest
from koopman_ros.core.arrays import Array
from koopman_ros.event_log import records
from koopman_ros.model import LiftedModel

# The model of a name and a digest; raises RecordError where there is none.
FindModel: TypeAlias = Callable[[str, str], LiftedModel]
# The controller of parameters by name and a model; raises ValueError where they do not fit.
Build: TypeAlias = Callable[[Mapping[str, Any], LiftedModel], Controller]


@dataclass(frozen=True)
class Alternative:
    """Another model, whose commands are compared with the recorded ones."""

    model: LiftedModel
    digest: str  #: SHA-256 of its file
    #: that replace recorded ones, by name
    parameters: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class ReplayedSample:
    """A command: recorded, replayed, and that of the alternative; all in the model's units."""

    stamp_ns: int  #: of the measurement that it answers, or of the silence
    measured: Array | None  #: (n_y,) or None in silence
    setpoint: Array | None  #: (n_c,) that was tracked according to the replay, or None
    recorded: Array  #: (n_u,)
    replayed: Array | None  #: (n_u,) or None where the state is not known
    alternative: Array | None  #: (n_u,) or None


@dataclass(frozen=True)
class Lost:
    """Records that are missing."""

    run: str  #: of the controller
    first: int  #: number of the first one
    last: int  #: number of the last one


@dataclass
class Replay:
    """The result of a replay."""

    #: one for each command, in the order of the records
    samples: list[ReplayedSample] = field(default_factory=list)
    lost: list[Lost] = field(default_factory=list)  #: records that are missing
    runs: int = 0  #: how often the controller was started, as far as it shows
    begins_late: int = 0  #: runs whose first records are missing
    rejected: int = 0  #: requests that were rejected
    #: names of those in force, in the order of their use
    models: list[str] = field(default_factory=list)
    #: the last one in force, or None where no state was found
    controller: Controller | None = None
    #: its parameters by name
    parameters: Mapping[str, Any] = field(default_factory=dict)


def replay(recorded: Iterable[records.EventRecord], find_model: FindModel, build: Build,
           alternative: Alternative | None = None) -> Replay:
    """
    Apply recorded events again.

    Records come in the order of receipt; those of several runs may alternate. The alternative
    answers the same measurements under the set-points that were tracked. Raises RecordError for
    records that cannot be replayed.
    """
    result = Replay()
    runs: dict[str, _ReplayRun] = {}
    for record in recorded:
        if record.run not in runs:
            runs[record.run] = _ReplayRun(result, find_model, build, alternative)
            result.runs += 1
            result.begins_late += record.event != records.START
        try:
            runs[record.run].take(record)
        except records.RecordError:
            raise
        except (ArithmeticError, AttributeError, IndexError, KeyError, TypeError, ValueError
                ) as error:
            raise records.RecordError(
                f'record {record.number} of run {record.run} cannot be replayed '
                f'({type(error).__name__}: {error})') from error
    return result


class _ReplayRun:
    """A run of a controller, and the alternative."""

    def __init__(self, result: Replay, find_model: FindModel, build: Build,
                 alternative: Alternative | None) -> None:
        self._result, self._find_model, self._build = result, find_model, build
        self._other = alternative
        self._next: int | None = None  # number of the next record
        self._state: State | None = None  # None while it is not known
        self._other_state = State()
        self._parameters: dict[str, Any] = {}
        self._controller: Controller
        self._other_controller: Controller

    def take(self, record: records.EventRecord) -> None:
        """Replay the next record."""
        self._count(record)
        state = self._state
        if record.event == records.START or (record.event == records.SNAPSHOT and state is None):
            self._begin(record)
        elif record.event == records.SNAPSHOT:
            return
        elif state is None:
            self._keep(record, None, None, None)
        elif record.event in (records.PARAMETERS, records.MODEL):
            self._exchange(record, state)
        else:
            self._apply(record, state)

    def _count(self, record: records.EventRecord) -> None:
        """Forget the state behind a lost record."""
        if self._next is not None and record.number < self._next:
            raise records.RecordError(
                f'record {record.number} of run {record.run} is repeated, or follows record '
                f'{self._next - 1}: the bag is out of order')
        if self._next is not None and record.number > self._next:
            self._result.lost.append(Lost(record.run, self._next, record.number - 1))
            self._state = None
        self._next = record.number + 1

    def _begin(self, record: records.EventRecord) -> None:
        self._parameters = {}
        controller = self._put_in_force(record, None)
        self._state = records.state_of(record)
        command, n_u = self._state.command, controller.model.n_u
        if command is not None and command.shape != (n_u,):
            raise records.RecordError(
                f'record {record.number} of run {record.run} cannot be replayed: its command has '
                f'shape {command.shape} for {n_u} inputs')
        if self._other is not None:
            same = self._other.digest == record.fields['model']['digest']
            self._other_controller = self._tuned(controller.model if same else self._other.model)
            self._other_state = self._other_controller.switch_to(controller, self._state)

    def _exchange(self, record: records.EventRecord, state: State) -> None:
        """Activate other parameters or another model."""
        before = self._controller
        self._state = self._put_in_force(record, before.model).switch_to(before, state)
        if self._other is not None and 'parameters' in record.fields:
            before = self._other_controller
            self._other_controller = self._tuned(before.model)
            self._other_state = self._other_controller.switch_to(before, self._other_state)

    def _put_in_force(self, record: records.EventRecord, model: LiftedModel | None) -> Controller:
        self._parameters |= record.fields.get('parameters', {})
        if model is None or 'model' in record.fields:
            name, digest = record.fields['model']['name'], record.fields['model']['digest']
            if name not in self._result.models:
                self._result.models.append(name)
            model = self._find_model(name, digest)
        self._controller = self._build(self._parameters, model)
        self._result.controller, self._result.parameters = self._controller, self._parameters
        return self._controller

    def _tuned(self, model: LiftedModel) -> Controller:
        assert self._other is not None
        return self._build({**self._parameters, **self._other.parameters}, model)

    def _apply(self, record: records.EventRecord, state: State) -> None:
        event = records.event_of(record)
        outcome = apply(self._controller, state, event)
        self._state = outcome.state
        self._result.rejected += outcome.rejected is not None
        target = None if outcome.report is None else outcome.report.target
        active = None if target is None else target.setpoint
        other = None
        # it may reject a request: then the tracked set-point counts
        if self._other is not None and not isinstance(event, SetpointRequest):
            if active is not None and isinstance(event, Measurement):
                self._other_state = self._other_state._replace(
                    setpoint=Setpoint(active, active))
            answered = apply(self._other_controller, self._other_state, event)
            self._other_state, other = answered.state, answered.command
        self._keep(record, active, outcome.command, other)

    def _keep(self, record: records.EventRecord, setpoint: Array | None, replayed: Array | None,
              other: Array | None) -> None:
        """Keep the command of a record, where it has one."""
        if (command := record.fields.get('command')) is not None:
            measured = record.fields.get('measured')
            self._result.samples.append(ReplayedSample(
                record.stamp_ns, None if measured is None else records.float_array(measured),
                setpoint, records.float_array(command), replayed, other))
