# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A case of the campaign and its observations while it ran: plain figures, without ROS."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
import math
from typing import NamedTuple, TYPE_CHECKING

import numpy as np

from koopman_ros.core.arrays import Array
from koopman_ros.core.status import StatusCode
from studies.faults.plants import FaultPlant, LOCKSTEP, REACTOR

if TYPE_CHECKING:
    from studies.faults.harness import FaultHarness


@dataclass(frozen=True)
class FaultCase:
    """A fault and the expected reaction of the loop; values are in the units of the messages."""

    group: str  #: heading in the report
    name: str  #: by which it is called on the command line
    does: str  #: the fault in words, for the report
    #: does it; the runner has let the loop settle before, and lets it recover afterwards
    play: Callable[[FaultHarness], None]

    between: bool = False  #: whether messages are altered
    on: FaultPlant = REACTOR  #: plant of the loop
    plant: Mapping[str, object] = field(default_factory=lambda: LOCKSTEP)  #: parameters
    controller: Mapping[str, object] = field(default_factory=dict)  #: parameters
    setpoint: tuple[float, ...] = REACTOR.setpoint  #: requested at the start
    settle: float = REACTOR.settle  #: plant time from the start until it is played, s
    afterwards: float = REACTOR.afterwards  #: plant time that the loop runs on after it, s
    missing: tuple[str, ...] = ()  #: packages that its controller goes without

    #: largest step between two commands; never less than the rate limit allows for the time
    #: between them, where a busy machine has missed measurements
    largest_step: float = 0.0
    #: plant time from the end of the fault within which the plant must be back, s
    recovery: float = REACTOR.recovery
    bump: float = math.inf  #: largest step from the fault on, where nothing calls for any
    #: distance from the set-point that counts as back
    band: float = REACTOR.band
    offset: float = math.inf  #: largest distance from the set-point in the last seconds
    worst: float = math.inf  #: largest distance from the set-point from the fault on
    #: regular expressions that diagnostics (``<node>: <task>: <sentence>``) must have matched from
    #: the beginning of the fault on
    says: tuple[str, ...] = ()
    #: reason that the controller's records must have given since then
    code: StatusCode | None = None
    allowed_errors: tuple[str, ...] = ()  #: statuses (``<node>: <task>``) that may end in ERROR


class Command(NamedTuple):
    """A command, with the stamp that it carries."""

    seconds: float
    values: tuple[float, ...]  #: by input
    stamp_ns: int


class SeenStatus(NamedTuple):
    """A status of diagnostics: whose, how bad (0 is OK, 1 WARN, 2 ERROR), and the sentence."""

    seconds: float
    name: str
    level: int
    message: str
    values: dict[str, str]


@dataclass
class LoopTrace:
    """
    All that was seen of a case.

    Times are plant time in seconds since the first measurement, values those of the messages.
    """

    on: FaultPlant = REACTOR
    #: when, and the true states before any fault of a sensor
    samples: list[tuple[float, tuple[float, ...]]] = field(default_factory=list)
    #: what the operator wanted of the controlled states, and from when on
    setpoints: list[tuple[float, tuple[float, ...]]] = field(default_factory=list)
    commands: list[Command] = field(default_factory=list)  #: as the controller published them
    #: measured inputs by stamp and name
    applied: dict[int, dict[str, float]] = field(default_factory=dict)
    delivered: list[int] = field(default_factory=list)  #: stamps that reached the controller
    statuses: list[SeenStatus] = field(default_factory=list)  #: of all nodes
    #: what the controller recorded of itself: (plant time, text)
    records: list[tuple[float, str]] = field(default_factory=list)
    begin: float = math.inf  #: when the fault began
    end: float = math.inf  #: when the fault was over, or had been put in where it stays
    complaints: list[str] = field(default_factory=list)  #: failures, in sentences
    notes: list[str] = field(default_factory=list)  #: figures worth a line in the report

    def reported(self) -> list[str]:
        """Return the diagnostics from the fault on: ``<node>: <task>: <sentence>``."""
        return [f'{status.name}: {status.message}' for status in self.statuses
                if status.seconds >= self.begin]

    def last(self, name: str) -> SeenStatus | None:
        """Return the last status of a task."""
        return next((s for s in reversed(self.statuses) if s.name == name), None)

    def steps(self) -> tuple[Array, Array]:
        """
        Return the times (N - 1,) of the commands after the first and their largest steps.

        A step is that of an input from the previous command, or from its measurement,
        whichever is less: when messages are lost it is not the one, and when the controller is a
        new one it need not be the other.
        """
        times = np.array([command.seconds for command in self.commands[1:]])
        values = np.array([command.values for command in self.commands]).reshape(
            -1, len(self.on.inputs))
        measured = np.array([[self.applied.get(command.stamp_ns, {}).get(name, math.nan)
                              for name in self.on.inputs] for command in self.commands[1:]]
                            ).reshape(-1, len(self.on.inputs))
        # of commands that are infinite, too
        with np.errstate(invalid='ignore'):
            return times, np.max(np.fmin(
                np.abs(np.diff(values, axis=0)), np.abs(values[1:] - measured)), axis=1)

    def errors(self) -> tuple[Array, Array]:
        """Return the times (N,) of the samples and the largest distance (N,) from set-points."""
        held = [self.on.states.index(name) for name in self.on.controlled]
        times = np.array([seconds for seconds, _ in self.samples])
        states = np.array([x for _, x in self.samples]).reshape(-1, len(self.on.states))[:, held]
        since = np.array([seconds for seconds, _ in self.setpoints])
        wanted = np.array([r for _, r in self.setpoints]).reshape(-1, len(held))
        latest = np.searchsorted(since, times, side='right') - 1
        asked = latest >= 0
        return times[asked], np.max(np.abs(states[asked] - wanted[latest[asked]]), axis=1)
