# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Diagnostics of a node, once a second and when the state changes, and an operator's words."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
import time

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from koopman_ros.lifting import LiftedModel
from koopman_ros.reasons import Words
from koopman_ros.ros.codec import stamp_message
from koopman_ros.ros.node import Owned
from koopman_ros.ros.topics import DIAGNOSTICS
from koopman_ros.units import Display, Displays

_SHOWN = {'K': Display('K', 'degC', '.2f')}
OPERATOR = Words(Displays({'temperature': 'K', 'coolant_temperature': 'K'}, _SHOWN))


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


class DiagnosticsPublisher:
    """Publish the status ``<node>: <task>`` of a node, as diagnostic_updater would."""

    def __init__(self, node: Node, task: str, hardware_id: str,
                 collect: Callable[[], Status]) -> None:
        self._name = f'{node.get_fully_qualified_name().lstrip("/")}: {task}'
        self._hardware_id = hardware_id
        self._collect = collect
        self._last: tuple[Level, str] | None = None
        self._owned = Owned(node)
        self._publisher = self._owned.keep(
            node.create_publisher(DiagnosticArray, DIAGNOSTICS, 10))
        self._owned.timer(1.0, self.publish)

    def destroy(self) -> None:
        """Report no more."""
        self._owned.destroy()

    def publish(self) -> None:
        """Publish the present status."""
        status = self._collect()
        self._last = (status.level, status.message)
        values = status.values() if callable(status.values) else status.values
        message = DiagnosticArray()
        message.header.stamp = stamp_message(time.time_ns())
        message.status.append(DiagnosticStatus(
            level=status.level.value, name=self._name, message=status.message,
            hardware_id=self._hardware_id,
            values=[KeyValue(key=key, value=(
                f'{value:.9g}' if isinstance(value, float) else str(value)))
                for key, value in values.items()]))
        self._publisher.publish(message)

    def publish_if_changed(self) -> None:
        """Publish at once when the level or the sentence differ from the last ones."""
        status = self._collect()
        if (status.level, status.message) != self._last:
            self.publish()


def words_of(model: LiftedModel) -> Words:
    """Return the words for the signals of a model."""
    return Words(Displays({name: unit for signals in (model.states, model.inputs)
                           for name, unit in zip(signals.names, signals.units, strict=True)},
                          _SHOWN))
