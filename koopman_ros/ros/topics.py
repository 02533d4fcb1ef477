# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The topics of the loop: names, types and quality of service, the same for every node."""

from collections.abc import Collection
import importlib
import reprlib
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.validate_topic_name import validate_topic_name
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import String

from koopman_ros.parameters.wire import (
    ACTIVE_SETPOINT,
    CLOCK,
    CONCENTRATION,
    CONTROLLER_EVENTS,
    CONTROLLER_STATE,
    COOLANT_SETPOINT,
    COOLANT_TEMPERATURE,
    DIAGNOSTICS,
    MANUAL_COOLANT_SETPOINT,
    PREDICTED_TEMPERATURE,
    SETPOINT,
    TEMPERATURE,
)

# JointState is the one stamped type of common_interfaces that carries named float64 values.
# Records are lines of JSON, which keep a float64 bit-identical at a third of the time.
TYPES = {
    TEMPERATURE: Temperature, CONCENTRATION: JointState, SETPOINT: Temperature,
    ACTIVE_SETPOINT: Temperature, COOLANT_SETPOINT: Temperature, COOLANT_TEMPERATURE: Temperature,
    MANUAL_COOLANT_SETPOINT: Temperature, PREDICTED_TEMPERATURE: Temperature,
    CONTROLLER_STATE: JointState, CONTROLLER_EVENTS: String, DIAGNOSTICS: DiagnosticArray,
    CLOCK: Clock}

# Every message counts: reliable, with room for a receiver that falls behind a fast plant.
LOOP_QOS = QoSProfile(depth=1000)
# A late joiner learns what is tracked, and which coolant is applied.
LATCHED_QOS = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
CLOCK_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
_QOS = {ACTIVE_SETPOINT: LATCHED_QOS, COOLANT_TEMPERATURE: LATCHED_QOS, CLOCK: CLOCK_QOS}


def qos(topic: str) -> QoSProfile:
    """Return the quality of service of a topic of the loop, or the default for any other."""
    return _QOS.get(topic, LOOP_QOS)


def of(topic: str) -> tuple[Any, str, QoSProfile]:
    """Return type, name and quality of service of a topic of the loop."""
    return TYPES[topic], topic, qos(topic)


def unusable(node: Node, names: Collection[str]) -> str:
    """Say which name a node cannot make a topic of, as with a substitution; '' for none."""
    for name in names:
        try:
            validate_topic_name(name)
        except InvalidTopicNameException as error:
            return f'topics: {" ".join(str(error).split())}'
        try:
            node.resolve_topic_name(name)
        except (RuntimeError, ValueError) as error:
            reason = ' '.join(str(error).split(', at /')[0].split())
            return f'topics: {reprlib.repr(name)} cannot be used ({reason}): choose another name'
    return ''


def profile(depth: int, *, reliable: bool, latched: bool = False) -> QoSProfile:
    """Return a quality of service that keeps the last messages, so many of them."""
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE)


def message_class(type_name: str) -> Any:
    """Return the class of a ``package/msg/Name``; LookupError where it is not installed."""
    try:
        package, kind, name = type_name.split('/')
        return getattr(importlib.import_module(f'{package}.{kind}'), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise LookupError(
            f'message type {type_name!r} is not installed here: source its workspace') from error
