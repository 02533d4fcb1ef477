# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The state of a running controller, and the commands that follow from events and silences."""

from collections.abc import Callable
from dataclasses import replace
import math
import threading
from typing import NamedTuple

import numpy as np

from koopman_ros.control import (
    Controller,
    events,
    HOLD,
    Mode,
    SAFE,
    State,
    StepReport,
    Supervisor,
)
from koopman_ros.control.events import Event, EventOutcome, Measurement, Silence
from koopman_ros.core.arrays import Array
from koopman_ros.core.status import StatusCode
from koopman_ros.core.time_base import Advance
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.ros.timing import Timing

_WATCH_STEP = NANOSECONDS // 2  # of plant time between two commands without a measurement
_OVERDUE = 3.0  # usual intervals after which a measurement no longer decides the next command
_SETTLED = 1e-4  # of an input's range: such a change of the command in a watch step is none
_CAUSES = {None: StatusCode.NO_MEASUREMENT, Advance.OLD: StatusCode.STAMPS_STAND,
           Advance.TWO_SOURCES: StatusCode.TWO_SOURCES}
# A step that the watchdog has overtaken so often is given up, and its measurement with it.
_ATTEMPTS = 2


class Commanded(NamedTuple):
    """A command without a measurement."""

    report: StepReport
    stamp_ns: int


class ControlLoop:
    """
    Commands of a controller; called by the executor and, while that is busy, by a watchdog.

    The lock is held where the state changes and its command is sent, not while a measurement is
    answered, so that the watchdog goes on from the last state that commanded.

    :param timeout: s without news after which the command is held; 0 for none.
    :param send: sends a command (n_u,) with its stamp in ns.
    :param record: publishes an event and its outcome.
    :ivar active: whether the watch may command.
    """

    def __init__(self, controller: Controller, timing: Timing, timeout: float,
                 send: Callable[[Array, int], None], record: Callable[[Event, EventOutcome], None]
                 ) -> None:
        self.controller, self.timing, self.timeout = controller, timing, timeout
        self._send, self._record = send, record
        self.state, self.lock, self.active = State(), threading.Lock(), False
        # why the watch holds the command, and whether the law still changes it in a silence
        self._held_for: StatusCode | None = None
        self._settling = False

    def begin(self, timing: Timing, last: State, latched: bool) -> None:
        """
        Forget all but the mode and the requested set-points; the caller holds the lock.

        :param last: that commanded, of whose inputs some may still act.
        :param latched: whether the safe state is latched from before.
        """
        previous = self.state.setpoint
        self.state = State(self.state.mode,
                           replace(previous, active=None, ramped=None),
                           applied=last.applied, supervisor=(
                               Supervisor.latched_before() if latched else Supervisor()))
        self.timing, self._held_for, self._settling, self.active = timing, None, False, True

    def answer(self, event: Measurement, present: Array | None, arrived: tuple[float, int, int],
               news: bool) -> EventOutcome | None:
        """
        Answer a measurement; None where each step was overtaken by the watchdog.

        :param present: (n_u,) inputs from which the first command begins, or None.
        :param news: whether its stamp ends a silence.
        """
        for _ in range(_ATTEMPTS):
            before = state = self.state
            done: list[tuple[Event, EventOutcome]] = []
            if state.command is None and present is not None:
                initial = events.Initialisation(present)
                done.append((initial, events.apply(self.controller, state, initial)))
                state = done[0][1].state
            outcome = events.apply(self.controller, state, event)
            assert outcome.command is not None
            with self.lock:
                if self.state is not before:
                    # the answer must go on from the command of the watchdog
                    continue
                self.state = outcome.state
                self._send(outcome.command, event.stamp_ns)
                for made, led_to in (*done, (event, outcome)):
                    self._record(made, led_to)
                if news:
                    self.timing.note(event.stamp_ns, arrived)
                    self._held_for, self._settling = None, False
                self.timing.answered()
            return outcome
        return None

    def hold_between_sources(self, stamp_ns: int) -> Commanded | None:
        """Hold the command while two sources publish the measurement."""
        with self.lock:
            commanded = self._command(self.timing.silence, StatusCode.TWO_SOURCES, stamp_ns)
            if commanded is None and self.state.command is not None:
                self._send(self.state.command, stamp_ns)
            return commanded

    def watch(self, silence: float, acting: bool = False) -> Commanded | None:
        """
        Send a command that is due without a measurement, and return it.

        :param acting: whether the law may be computed for a request of the operator.
        """
        with self.lock:
            if not self.active:
                return None
            if self.timeout and silence > self.timeout and self.state.time_ns is not None:
                return self._command(silence, _CAUSES[self.timing.silence_cause(self.timeout)])
            if self._manual_waits(silence) or (acting and self._setpoint_waits(silence)):
                return self._command(silence, None)
            return None

    def change(self, event: Event) -> EventOutcome:
        """Apply an event without a command."""
        with self.lock:
            outcome = events.apply(self.controller, self.state, event)
            self.state = outcome.state
            self._record(event, outcome)
            if isinstance(event, events.ModeChange):
                # the law moves the command from where the operator left it
                self._settling = event.mode is Mode.AUTOMATIC
        return outcome

    def exchange(self, controller: Controller, record: Callable[[], None]) -> None:
        """Switch to another controller, and publish a record of the switch."""
        with self.lock:
            predecessor, self.controller = self.controller, controller
            self.state = controller.switch_to(predecessor, self.state)
            record()

    def _command(self, silence: float, cause: StatusCode | None, stamp_ns: int | None = None
                 ) -> Commanded | None:
        """
        Command without a measurement, if it is time to; the caller holds the lock.

        :param cause: as of :class:`Silence`.
        :param stamp_ns: of the command; None for the present time of the measurements' clock.
        """
        state = self.state
        now_ns = self.timing.now()[2] if state.time_ns is None else (
            state.time_ns + round(silence * NANOSECONDS))
        if state.commanded_ns is not None and cause is self._held_for and (
                now_ns - state.commanded_ns < _WATCH_STEP):
            return None
        event = Silence(now_ns, cause)
        outcome = events.apply(self.controller, state, event)
        if outcome.command is None or outcome.report is None:
            return None
        self.state, self._held_for = outcome.state, cause
        self.timing.commanded()
        if state.command is not None:
            limits = self.controller.tuning.limits
            self._settling = cause is None and bool((
                np.abs(outcome.command - state.command)
                > _SETTLED * (limits.upper - limits.lower)).any())
        stamp_ns = now_ns if stamp_ns is None else stamp_ns
        self._send(outcome.command, stamp_ns)
        self._record(event, outcome)
        return Commanded(outcome.report, stamp_ns)

    def _manual_waits(self, silence: float) -> bool:
        """Return whether a manual command is not reached and no measurement came lately."""
        state, wanted = self.state, self.state.manual_input
        return (state.mode is Mode.MANUAL and wanted is not None and state.command is not None
                and silence * NANOSECONDS > _WATCH_STEP and not np.array_equal(
                    self.controller.tuning.limits.within(wanted), state.command))

    def _setpoint_waits(self, silence: float) -> bool:
        """Return whether a set-point is not reached and a measurement is overdue."""
        state, setpoint = self.state, self.state.setpoint
        interval = 0.0 if math.isinf(state.interval) else state.interval
        if (state.mode is not Mode.AUTOMATIC or state.time_ns is None
                or state.supervisor.level in (HOLD, SAFE)
                or silence <= max(_OVERDUE * interval, 1.0)):
            return False
        now_ns, requested = state.time_ns + round(silence * NANOSECONDS), setpoint.requested
        moves = (requested is not None and setpoint.active is not None
                 and bool((np.abs(requested - setpoint.active) > 0.0).any()))
        return self._settling or moves or any(at <= now_ns for at, _ in setpoint.scheduled)
