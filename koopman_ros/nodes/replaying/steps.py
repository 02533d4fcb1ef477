# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The control step replayed from a record.

The topics of a loop are recorded side by side, so that a request and a measurement of almost the
same time may have reached the controller in either order. Which one it was shows in the set-point
that was tracked from then on; nothing is taken from the commands, which are compared.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
import itertools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from koopman_ros.control import Controller, Mode, Report, Settings, State
from koopman_ros.nodes.messages import NANOSECONDS, stamp_nanoseconds, to_celsius, to_kelvin
from koopman_ros.nodes.replaying.inputs import Input, Silence, TakeOver
from koopman_ros.nodes.replaying.record import ControlRecord
from koopman_ros.nodes.translation import (
    answer,
    ask_manual_coolant,
    ask_setpoint,
    take_over,
    tracked_celsius,
    watch,
)

Array = NDArray[np.float64]

# How far apart a request and a measurement are recorded when their order is not to be trusted.
_CLOSE_NS = NANOSECONDS // 20
# In time constants, which leave less than a thousandth, and 2 % of a change of law or mode.
_MEMORY_OF_OBSERVER = 10.0
_MEMORY_OF_TRANSFER = 6.0
# Requests tried beyond the likeliest, in a whole run and for each of its inputs: without an end, a
# bag of requests and measurements of one time would take days.
_TRIALS, _TRIALS_EACH = 10_000, 20
# Nobody sends more requests in the time that is close.
_MOST_CLOSE = 200


@dataclass(frozen=True)
class Sample:
    """
    A measurement with what went before it, resolved for any controller.

    :param message: the measurement.
    :param coolant: that was in force then, in degrees Celsius, or None.
    :param operations: what else happened since the last one.
    :param active: set-point tracked, in K; NaN for none.
    :param recorded: what was commanded in degrees Celsius; NaN where nothing was recorded.
    :param replayed: the same by the replay.
    :param given: whether the replay takes the recorded command over here, because what it
        follows from is not in the bag: the run had begun before.
    """

    message: Any
    coolant: float | None
    operations: tuple[Input, ...]
    active: float
    recorded: float
    replayed: float
    given: bool

    @property
    def stamp_ns(self) -> int:
        """Stamp of the measurement."""
        return stamp_nanoseconds(self.message.header.stamp)


@dataclass(frozen=True)
class Replay:
    """
    A recorded run replayed through the control step.

    :param start: state before the first sample.
    :param given_seconds: for so long the recorded commands were taken over.
    :param samples: one for each measurement, in the order in which they came.
    :param adopted: set-points taken from the record of what was tracked, because no recorded
        request explains them.
    :param refused: requests that the replay refused.
    """

    start: State
    given_seconds: float
    samples: tuple[Sample, ...]
    adopted: int
    refused: int


def replay(record: ControlRecord, controller: Controller) -> Replay:
    """Replay a record through the control step with the model and the settings of its time."""
    run = _Run(record, controller)
    for entry in record.inputs:
        if entry.topic == record.names.setpoint:
            run.recorded += 1
        elif entry.topic == record.names.temperature:
            run.measure(entry)
        else:
            run.operate(entry)
    return Replay(run.start, run.given_seconds, tuple(run.samples), run.adopted, run.refused)


def commands_of(controller: Controller, replayed: Replay) -> Array:
    """
    Return what another controller commands for the same measurements and tracked set-points.

    :param controller: model and settings.
    :param replayed: the run with the model of its time.
    :return: (n,) degrees Celsius.
    """
    state = replayed.start
    commands = np.empty(len(replayed.samples))
    for k, sample in enumerate(replayed.samples):
        for operation in sample.operations:
            state = _operated(controller, state, operation)[0]
        if not math.isnan(sample.active):
            state = _tracking(state, sample.active)
        state, kelvin, _ = answer(controller, state, sample.message, sample.coolant)
        commands[k] = to_celsius(kelvin)
        if sample.given and not math.isnan(sample.recorded):
            state, commands[k] = _commanding(state, sample.recorded), sample.recorded
    return commands


@dataclass(frozen=True)
class _Attempt:
    """The answer to a measurement if that many requests were known."""

    known: int
    refused: int
    asked: State
    state: State
    kelvin: float
    report: Report


class _Run:
    """A replay on its way."""

    def __init__(self, record: ControlRecord, controller: Controller) -> None:
        self.start = _start(record)
        self.samples: list[Sample] = []
        self.recorded = 0  # requests before the present measurement, by the record
        self.adopted = self.refused = 0
        self._known = 0  # requests that the controller knows
        self._record = record
        self._controller = controller
        self._state = self.start
        self._requests = [entry for entry in record.inputs if entry.topic == record.names.setpoint]
        self._operations: list[Input] = []
        self._trials_left = _TRIALS + _TRIALS_EACH * len(record.inputs)
        # until the first command, when the run began before the bag
        self._begins_unknown = record.began_before
        # for so long, what is not in the bag is not yet forgotten
        self.given_seconds = _memory(controller.settings) if record.began_before else 0.0
        self._given_left = self.given_seconds
        self._last_ns: int | None = None
        # the set-point that was tracked, as far as it is known
        self._active = math.nan if record.active_before is None else record.active_before[1]

    def operate(self, entry: Input) -> None:
        """Take over what holds at once."""
        self._operations.append(entry)
        self._state, refused = _operated(self._controller, self._state, entry)
        self.refused += bool(refused)
        if entry.message is None:
            self._active, self._begins_unknown, self._given_left = math.nan, False, 0.0

    def measure(self, entry: Input) -> None:
        """Answer a measurement, knowing the requests that were known then."""
        if entry.active is not None:
            self._active = entry.active
        if self._begins_unknown and not math.isnan(self._active):
            self._state = _tracking(self._state, to_kelvin(self._active))
        given = self._is_given(entry)
        if self._state.command is None and not given:
            given = self._begin_from_coolant(entry)
        active, replayed = self._answer(entry)
        recorded = math.nan if entry.command is None else entry.command
        if given and entry.command is not None:
            self._state, replayed = _commanding(self._state, recorded), recorded
        self.samples.append(Sample(
            entry.message, entry.coolant, tuple(self._operations),
            math.nan if active is None else float(active[0]), recorded, replayed, given))
        self._operations = []

    def _is_given(self, entry: Input) -> bool:
        """Tell whether a command follows from what is not in the bag: the first one, and more."""
        stamp_ns, first = stamp_nanoseconds(entry.message.header.stamp), self._begins_unknown
        if self._last_ns is not None:
            self._given_left -= max(0, stamp_ns - self._last_ns) / NANOSECONDS
        self._last_ns = stamp_ns
        self._begins_unknown &= entry.command is None
        return first or self._given_left > 0.0

    def _begin_from_coolant(self, entry: Input) -> bool:
        """
        Find out whether a start was one from the coolant that was in force.

        :return: whether that follows from the first command alone, as the coolant itself was not
            recorded.
        """
        told, coolant = entry.coolant is not None, entry.coolant
        coolant = coolant if told else entry.command
        if coolant is None:
            return False
        start = Input('', entry.time_ns, TakeOver(coolant))
        state = _operated(self._controller, self._state, start)[0]
        from_coolant = to_celsius(answer(
            self._controller, state, entry.message, entry.coolant)[1])
        alone = to_celsius(self._attempt(entry, self.recorded).kelvin)
        took_over = entry.command in (None, from_coolant) and (told or alone != from_coolant)
        if took_over:
            self.operate(start)
        return took_over and not told

    def _answer(self, entry: Input) -> tuple[Array | None, float]:
        counts = self._counts(entry)
        likely = self._attempt(entry, counts[0])
        others = self._trials(entry, counts[1:])
        found = next((a for a in itertools.chain([likely], others) if self._fits(a.report)), None)
        if found is None:
            self.adopted += 1
            asked = _tracking(likely.asked, to_kelvin(self._active))
            found = _Attempt(likely.known, likely.refused, asked,
                             *answer(self._controller, asked, entry.message, entry.coolant))
        self._known = found.known
        self.refused += found.refused
        self._state = found.state
        return found.report.active_setpoint, to_celsius(found.kelvin)

    def _counts(self, entry: Input) -> list[int]:
        """Return how many requests may have been known at a measurement, the likeliest first."""
        likely = low = high = max(self._known, self.recorded)
        if self._record.tells_active:
            while (max(self._known, likely - _MOST_CLOSE) < low
                   and entry.time_ns - self._requests[low - 1].time_ns <= _CLOSE_NS):
                low -= 1
            while (high < min(len(self._requests), likely + _MOST_CLOSE)
                   and self._requests[high].time_ns - entry.time_ns <= _CLOSE_NS):
                high += 1
        return [likely, *(count for count in range(low, high + 1) if count != likely)]

    def _trials(self, entry: Input, counts: list[int]) -> Iterator[_Attempt]:
        """Yield the answers for other numbers of requests, as long as that is bearable."""
        for count in counts:
            self._trials_left -= 1 + count - self._known
            if self._trials_left < 0:
                return
            yield self._attempt(entry, count)

    def _attempt(self, entry: Input, known: int) -> _Attempt:
        asked, refused = self._state, 0
        for request in self._requests[self._known:known]:
            asked, reason = ask_setpoint(self._controller, asked, request.message)
            refused += bool(reason)
        return _Attempt(known, refused, asked, *answer(
            self._controller, asked, entry.message, entry.coolant))

    def _fits(self, report: Report) -> bool:
        """Tell whether the set-point tracked is the one that was, as far as that is known."""
        return (not self._record.tells_active or math.isnan(self._active)
                or tracked_celsius(report) == self._active)


def _start(record: ControlRecord) -> State:
    """Return what is known of the state before the first measurement."""
    state = State(mode=record.mode)
    if record.active_before is not None:
        state = _tracking(state, to_kelvin(record.active_before[1]))
    return state


def _memory(settings: Settings) -> float:
    """Return the seconds after which a controller has forgotten what it did not measure."""
    bandwidth = settings.observer_bandwidth
    observer = _MEMORY_OF_OBSERVER / bandwidth if bandwidth > 0.0 else 0.0
    return max(observer, _MEMORY_OF_TRANSFER * settings.transfer_time)


def _commanding(state: State, celsius: float) -> State:
    """Return the state with another command in force."""
    return replace(state, command=np.array([to_kelvin(celsius)]))


def _tracking(state: State, kelvin: float) -> State:
    """Return the state with a set-point in force, its schedule untouched."""
    value = np.array([kelvin])
    return replace(state, setpoint=replace(
        state.setpoint, requested=value, active=value, ramped=None))


def _operated(controller: Controller, state: State, entry: Input) -> tuple[State, str]:
    match entry.message:
        case None:
            return State(), ''
        case Mode() as mode:
            return controller.set_mode(state, mode), ''
        case Silence(stamp_ns):
            return watch(controller, state, stamp_ns)[0], ''
        case TakeOver() as coolant:
            return take_over(controller, state, coolant), ''
        case message:
            return ask_manual_coolant(controller, state, message)
