# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A case of the campaign, and what was seen of it while it ran: plain figures, without ROS."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
import itertools
import math
from typing import NamedTuple, TYPE_CHECKING

import numpy as np

from koopman_ros.arrays import Array
from koopman_ros.demo import reactor
from koopman_ros.reasons import Code

if TYPE_CHECKING:
    from validation.faults.harness import FaultHarness

SETPOINT = 46.0  # degC; 5 K below the steady state that the reactor starts from
LOCKSTEP = {'lockstep': True, 'speed': 0.0, 'lockstep_timeout': 0.5}
RATE = reactor.coolant_parameters().rate_limit  # K/s
BAND = 0.3  # K around the set-point that counts as back


@dataclass(frozen=True)
class Case:
    """A fault, and what the loop is to make of it."""

    group: str  #: heading in the report
    name: str  #: by which it is called on the command line
    does: str  #: what is done, for the report
    #: does it; the runner has let the loop settle before, and lets it recover afterwards
    play: Callable[[FaultHarness], None]

    between: bool = False  #: whether messages are altered
    plant: Mapping[str, object] = field(default_factory=lambda: LOCKSTEP)  #: parameters
    controller: Mapping[str, object] = field(default_factory=dict)  #: parameters
    setpoint: float = SETPOINT  #: degC, requested at the start
    settle: float = 240.0  #: plant time from the start until it is played, s
    afterwards: float = 360.0  #: plant time that the loop runs on after the fault, s

    #: largest step between two commands, K; never less than the rate limit allows for the time
    #: between them, where a busy machine has missed measurements
    largest_step: float = RATE
    #: plant time from the end of the fault within which the reactor must be back, s
    recovery: float = 300.0
    bump: float = math.inf  #: largest step from the fault on, K, where nothing calls for any
    #: distance from the set-point that counts as back, K; infinity where none is asked
    band: float = BAND
    offset: float = math.inf  #: largest distance from the set-point in the last seconds, K
    worst: float = math.inf  #: largest distance from the set-point from the fault on, K
    #: regular expressions that diagnostics (``<node>: <task>: <sentence>``) must have matched from
    #: the beginning of the fault on
    says: tuple[str, ...] = ()
    code: Code | None = None  #: reason that the controller's records must have given since then
    allowed_errors: tuple[str, ...] = ()  #: statuses (``<node>: <task>``) that may end in ERROR


class Command(NamedTuple):
    """A coolant command, with the stamp that it carries."""

    seconds: float
    celsius: float
    stamp_ns: int


class Status(NamedTuple):
    """A status of diagnostics: whose, how bad (0 is OK, 1 WARN, 2 ERROR), and the sentence."""

    seconds: float
    name: str
    level: int
    message: str
    values: dict[str, str]


@dataclass
class Trace:
    """All that was seen of a case; times are plant time in seconds since the first measurement."""

    #: (when, true temperature before any fault of the sensor in degrees Celsius)
    samples: list[tuple[float, float]] = field(default_factory=list)
    #: what the operator wanted: (from when on, degrees Celsius)
    setpoints: list[tuple[float, float]] = field(default_factory=list)
    commands: list[Command] = field(default_factory=list)  #: as the controller published them
    coolants: dict[int, float] = field(default_factory=dict)  #: measured input in degC by stamp
    delivered: list[int] = field(default_factory=list)  #: stamps that reached the controller
    statuses: list[Status] = field(default_factory=list)  #: of all nodes
    #: what the controller recorded of itself: (plant time, text)
    records: list[tuple[float, str]] = field(default_factory=list)
    begin: float = math.inf  #: when the fault began
    end: float = math.inf  #: when the fault was over, or had been put in where it stays
    complaints: list[str] = field(default_factory=list)  #: what went wrong, in sentences
    notes: list[str] = field(default_factory=list)  #: figures worth a line in the report

    def reported(self) -> list[str]:
        """Return what diagnostics reported from the fault on: ``<node>: <task>: <sentence>``."""
        return [f'{status.name}: {status.message}' for status in self.statuses
                if status.seconds >= self.begin]

    def last(self, name: str) -> Status | None:
        """Return the last status of a task."""
        return next((s for s in reversed(self.statuses) if s.name == name), None)

    def steps(self) -> tuple[Array, Array]:
        """
        Return the times (N - 1,) of the commands after the first and their steps in K.

        A step is that from the command before, or from the measured input, whichever is
        less: when messages are lost it is not the one, and when the controller is a new one
        it need not be the other.
        """
        times = np.array([command.seconds for command in self.commands[1:]])
        steps = [min(abs(after.celsius - before.celsius),
                     abs(after.celsius - self.coolants.get(after.stamp_ns, math.inf)))
                 for before, after in itertools.pairwise(self.commands)]
        return times, np.array(steps, dtype=np.float64)

    def errors(self) -> tuple[Array, Array]:
        """Return the times (N,) of the samples and |T - set-point| (N,) in K."""
        samples = np.array(self.samples, dtype=np.float64).reshape(-1, 2)
        since, wanted = np.array(self.setpoints, dtype=np.float64).reshape(-1, 2).T
        latest = np.searchsorted(since, samples[:, 0], side='right') - 1
        asked = latest >= 0
        times, temperatures = samples[asked].T
        return times, np.abs(temperatures - wanted[latest[asked]])
