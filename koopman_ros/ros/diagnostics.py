# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Status of the tasks of a node on /diagnostics, once a second and on change."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
import time

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions

from koopman_ros.parameters.wire import DIAGNOSTICS
from koopman_ros.plugs import contained
from koopman_ros.ros.codec import stamp_message
from koopman_ros.ros.hosted import HostableNode, wall_timer


class Level(Enum):
    """Severity of a status, as one byte."""

    OK = DiagnosticStatus.OK
    WARN = DiagnosticStatus.WARN
    ERROR = DiagnosticStatus.ERROR


@dataclass(frozen=True)
class Status:
    """What a node says of itself: a sentence, and figures with their units in the key."""

    level: Level
    message: str
    #: or a function, which is called only when they are published
    values: Mapping[str, object] | Callable[[], Mapping[str, object]] = field(
        default_factory=dict)


class Diagnostics:
    """
    Publish what the tasks of a node say of themselves, as diagnostic_updater would.

    :ivar hardware_id: names the plant.
    """

    hardware_id = ''

    def __init__(self, node: HostableNode) -> None:
        self._node = node
        self.tasks: list[DiagnosticTask] = []  #: that are reported
        # as everywhere, by parameter
        self._publisher = node.create_publisher(
            DiagnosticArray, DIAGNOSTICS, QoSProfile(depth=10),
            qos_overriding_options=QoSOverridingOptions.with_default_policies())
        wall_timer(node, 1.0, lambda: self.publish(self.tasks))

    def add(self, task: str, collect: Callable[[], Status]) -> DiagnosticTask:
        """Report a further task under the name ``<node>: <task>``."""
        name = f'{self._node.get_fully_qualified_name().lstrip("/")}: {task}'
        self.tasks.append(DiagnosticTask(self, name, collect))
        return self.tasks[-1]

    def remove(self, task: DiagnosticTask) -> None:
        """Report a task no more."""
        self.tasks.remove(task)

    def clear(self) -> None:
        """Report none any more."""
        self.tasks.clear()

    def publish(self, tasks: Sequence[DiagnosticTask]) -> None:
        """Publish the present status of some tasks in one message."""
        if not tasks:
            return
        message = DiagnosticArray(status=[task.status() for task in tasks])
        message.header.stamp = stamp_message(time.time_ns())
        self._publisher.publish(message)


class DiagnosticTask:
    """What one task of a node says of itself."""

    def __init__(self, diagnostics: Diagnostics, name: str, collect: Callable[[], Status]
                 ) -> None:
        self._diagnostics, self._name, self._collect = diagnostics, name, collect
        self._last: tuple[Level, str] | None = None

    def status(self) -> DiagnosticStatus:
        """Return its present status as a message."""
        status = self._collected()
        try:
            values = status.values() if callable(status.values) else status.values
        except Exception as error:
            status, values = _failed(error), {}
        self._last = (status.level, status.message)
        return DiagnosticStatus(
            level=status.level.value, name=self._name, message=status.message,
            hardware_id=self._diagnostics.hardware_id,
            values=[KeyValue(key=key, value=(
                f'{value:.9g}' if isinstance(value, float) else str(value)))
                for key, value in values.items()])

    def publish_if_changed(self) -> None:
        """Publish at once when the level or the sentence differ from the last ones."""
        # what is late in a part that was taken down has nobody to report to
        if self not in self._diagnostics.tasks:
            return
        status = self._collected()
        if (status.level, status.message) != self._last:
            self._diagnostics.publish([self])

    def _collected(self) -> Status:
        # a failure of a report does not end the loop that it reports on
        try:
            return self._collect()
        except Exception as error:
            return _failed(error)

    def destroy(self) -> None:
        """Report no more."""
        self._diagnostics.remove(self)


def _failed(error: Exception) -> Status:
    return Status(Level.ERROR, f'the status cannot be collected ({contained(error)})')
