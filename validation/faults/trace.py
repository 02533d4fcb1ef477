# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What happened in a case: plain figures, gathered while it ran and judged afterwards."""

from dataclasses import dataclass, field
import itertools
from typing import NamedTuple

import numpy as np

from koopman_ros.arrays import Array


class Sample(NamedTuple):
    """A true temperature of the reactor, in degrees Celsius, at a plant time in seconds."""

    seconds: float
    celsius: float


class Command(NamedTuple):
    """A coolant command in degrees Celsius, with the stamp that it carries."""

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
    """
    All that was seen of a case; times are plant time in seconds since the first measurement.

    :ivar samples: true temperatures, before any fault of the sensor.
    :ivar setpoints: what the operator wanted: (from when on, degrees Celsius).
    :ivar commands: as the controller published them.
    :ivar coolants: measured input: the coolant at a measurement, degC by the plant's stamp.
    :ivar delivered: stamps of the measurements that reached the controller.
    :ivar statuses: of all nodes.
    :ivar records: what the controller recorded of itself: (plant time, text).
    :ivar begin: when the fault began.
    :ivar end: when the fault was over, or had been put in where it stays.
    :ivar complaints: what went wrong while it ran, in sentences.
    :ivar notes: figures worth a line in the report.
    """

    samples: list[Sample] = field(default_factory=list)
    setpoints: list[tuple[float, float]] = field(default_factory=list)
    commands: list[Command] = field(default_factory=list)
    coolants: dict[int, float] = field(default_factory=dict)
    delivered: list[int] = field(default_factory=list)
    statuses: list[Status] = field(default_factory=list)
    records: list[tuple[float, str]] = field(default_factory=list)
    begin: float = np.inf
    end: float = np.inf
    complaints: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

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
                     abs(after.celsius - self.coolants.get(after.stamp_ns, np.inf)))
                 for before, after in itertools.pairwise(self.commands)]
        return times, np.array(steps, dtype=np.float64)

    def errors(self) -> tuple[Array, Array]:
        """Return the times (N,) of the samples and |T - set-point| (N,) in K."""
        samples = np.array(self.samples, dtype=np.float64).reshape(-1, 2)
        since = np.array([seconds for seconds, _ in self.setpoints])
        wanted = np.array([celsius for _, celsius in self.setpoints])
        latest = np.searchsorted(since, samples[:, 0], side='right') - 1
        asked = latest >= 0
        times, temperatures = samples[asked].T
        return times, np.abs(temperatures - wanted[latest[asked]])
