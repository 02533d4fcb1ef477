# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Status of the tasks of a node on /diagnostics, once a second and on change."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions

from koopman_ros.core.plugins import contained
from koopman_ros.parameters.signal_topics import DIAGNOSTICS
from koopman_ros.ros.hosted import HostedNode, wall_timer


class Severity(Enum):
    """Severity of a status, as one byte."""

    OK = DiagnosticStatus.OK
    WARN = DiagnosticStatus.WARN
    ERROR = DiagnosticStatus.ERROR


@dataclass(frozen=True)
class TaskReport:
    """The status of a node: a sentence, and figures with their units in the key."""

    level: Severity
    message: str
    #: or a function, which is called only when they are published
    values: Mapping[str, object] | Callable[[], Mapping[str, object]] = field(
        default_factory=dict)


class Diagnostics:
    """
    Publish the status of the tasks of a node, as diagnostic_updater would.

    :ivar hardware_id: names the plant.
    """

    hardware_id = ''

    def __init__(self, node: HostedNode) -> None:
        self._node = node
        self.tasks: list[DiagnosticTask] = []  #: that are reported
        # as everywhere, by parameter
        self._publisher = node.create_publisher(
            DiagnosticArray, DIAGNOSTICS, QoSProfile(depth=10),
            qos_overriding_options=QoSOverridingOptions.with_default_policies())
        wall_timer(node, 1.0, self._publish_all)

    def add(self, task: str, collect: Callable[[], TaskReport]) -> DiagnosticTask:
        """Report a further task under the name ``<node>: <task>``."""
        return self.add_group(lambda: {task: collect()}, (task,))

    def add_group(self, collect: Callable[[], Mapping[str, TaskReport]], tasks: Sequence[str]
                  ) -> DiagnosticTask:
        """Report some tasks, whose statuses are collected together."""
        self.tasks.append(DiagnosticTask(self, tasks, collect))
        return self.tasks[-1]

    def clear(self) -> None:
        """Report no task any more."""
        self.tasks.clear()

    def _publish_all(self) -> None:
        self.publish([status for task in self.tasks for status in task.collect().items()])

    def publish(self, statuses: Sequence[tuple[str, TaskReport]]) -> None:
        """Publish the status of some tasks in one message."""
        if not statuses:
            return
        prefix = self._node.get_fully_qualified_name().lstrip('/')
        message = DiagnosticArray(status=[
            self._message(f'{prefix}: {name}', status) for name, status in statuses])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)

    def _message(self, name: str, status: TaskReport) -> DiagnosticStatus:
        try:
            values = status.values() if callable(status.values) else status.values
        except Exception as error:
            status, values = _failed(error), {}
        return DiagnosticStatus(
            level=status.level.value, name=name, message=status.message,
            hardware_id=self.hardware_id, values=[KeyValue(key=key, value=(
                f'{value:.9g}' if isinstance(value, float) else str(value)))
                for key, value in values.items()])


class DiagnosticTask:
    """One task of a node, or some whose statuses are collected together."""

    def __init__(self, diagnostics: Diagnostics, names: Sequence[str],
                 collect: Callable[[], Mapping[str, TaskReport]]) -> None:
        self._diagnostics, self._names, self._collect = diagnostics, names, collect
        self._last: dict[str, tuple[Severity, str]] = {}

    def collect(self) -> dict[str, TaskReport]:
        """Return the present status of each task."""
        # a failure of a report does not end the loop that it reports on
        try:
            found = dict(self._collect())
        except Exception as error:
            found = dict.fromkeys(self._names, _failed(error))
        self._last = {name: (status.level, status.message) for name, status in found.items()}
        return found

    def publish_if_changed(self) -> None:
        """Publish at once each task whose level or sentence differs from the last."""
        # a part that was shut down reports no late change
        if self not in self._diagnostics.tasks:
            return
        last = self._last
        self._diagnostics.publish([
            (name, status) for name, status in self.collect().items()
            if last.get(name) != self._last[name]])


def _failed(error: Exception) -> TaskReport:
    return TaskReport(Severity.ERROR, f'the status cannot be collected ({contained(error)})')
