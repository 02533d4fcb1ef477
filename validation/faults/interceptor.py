# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
What lies between plant and controller: traces messages, and alters them where asked to.

An alteration turns one message into none or more; one with a memory is made anew for each case.
"""

from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import Temperature
from std_msgs.msg import String

from koopman_ros.demo import reactor
from koopman_ros.ros import topics
from koopman_ros.ros.codec import stamp_message, stamp_nanoseconds
from koopman_ros.units import NANOSECONDS
from validation.faults.case import Command, Status, Trace

# that wait to be read: a storm makes thousands while the harness is busy sending it
MOST_RECORDS = 100_000

PLANT_TEMPERATURE = 'plant/temperature'
PLANT_COOLANT = 'plant/coolant_setpoint'
# What a plant is started with when messages are altered.
REMAPPED = ('-r', f'{reactor.TEMPERATURE}:={PLANT_TEMPERATURE}',
            '-r', f'{reactor.COOLANT_SETPOINT}:={PLANT_COOLANT}')


class Packet(NamedTuple):
    """A stamped temperature on its way, in degrees Celsius."""

    stamp_ns: int
    celsius: float


Alteration = Callable[[Packet], list[Packet]]


def unchanged(packet: Packet) -> list[Packet]:
    """Pass a message on."""
    return [packet]


def changed(change: Callable[[Packet, Packet], Packet]) -> Alteration:
    """Replace each message; `change` takes the first message and this one."""
    first: list[Packet] = []

    def alter(packet: Packet) -> list[Packet]:
        first.append(packet)
        del first[1:]
        return [change(first[0], packet)]

    return alter


def value(change: Callable[[float, float], float]) -> Alteration:
    """Replace the value; `change` takes the seconds since the first message and the value."""
    return changed(lambda first, packet: packet._replace(celsius=change(
        (packet.stamp_ns - first.stamp_ns) / NANOSECONDS, packet.celsius)))


def frozen(what: str = 'celsius') -> Alteration:
    """Repeat the first value, or the first `stamp_ns`, for ever."""
    return changed(lambda first, packet: packet._replace(**{what: getattr(first, what)}))


def stamped(change: Callable[[int], int]) -> Alteration:
    """Replace the stamp in nanoseconds."""
    return lambda packet: [packet._replace(stamp_ns=change(packet.stamp_ns))]


def noise(deviation: float, seed: int = 0) -> Alteration:
    """Add normal noise of a standard deviation in K."""
    random = np.random.default_rng(seed)
    return value(lambda _, celsius: celsius + float(random.normal(0.0, deviation)))


def lost(share: float = 1.0, seed: int = 0) -> Alteration:
    """Lose a share of the messages, 1 for all."""
    random = np.random.default_rng(seed)
    return lambda packet: [] if random.random() < share else [packet]


def twice(packet: Packet) -> list[Packet]:
    """Deliver a message twice."""
    return [packet, packet]


def swapped() -> Alteration:
    """Deliver each two messages in the wrong order."""
    held: list[Packet] = []

    def alter(packet: Packet) -> list[Packet]:
        if not held:
            held.append(packet)
            return []
        return [packet, held.pop()]

    return alter


def delayed(messages: int) -> Alteration:
    """Deliver each message when so many later ones were sent."""
    waiting: deque[Packet] = deque()

    def alter(packet: Packet) -> list[Packet]:
        waiting.append(packet)
        return [waiting.popleft()] if len(waiting) > messages else []

    return alter


class Interceptor:
    """
    A trace of what plant and controller publish.

    Where it stands between them it is the actuator, too, which holds its last command when none
    arrives: so lock-step goes on whatever is lost.

    :param between: whether all messages between plant and controller pass through it.

    :ivar measurements: what is done to measurements on their way to the controller.
    :ivar commands: what is done to commands on their way to the plant.
    """

    def __init__(self, node: Node, between: bool) -> None:
        self.trace = Trace()
        self.measurements: Alteration = unchanged
        self.commands: Alteration = unchanged
        self.now = 0.0  # plant time in s since the first measurement
        self._node = node
        self._between = between
        self._stamp_ns: int | None = None  # of the last true temperature
        self._origin_ns = 0
        self._awaited = 0  # commands, for what was delivered
        self._held: float | None = None  # the command that the actuator stands at
        if between:
            self._to_controller = node.create_publisher(
                Temperature, reactor.TEMPERATURE, topics.LOOP_QOS)
            self._to_plant = node.create_publisher(Temperature, PLANT_COOLANT, topics.LOOP_QOS)
        for kind, topic, callback, qos in (
                (DiagnosticArray, topics.DIAGNOSTICS, self._on_diagnostics, topics.LOOP_QOS),
                (String, topics.CONTROLLER_EVENTS, self._on_record,
                 topics.profile(MOST_RECORDS, reliable=True)),
                (Temperature, reactor.COOLANT_TEMPERATURE, self._on_coolant, topics.LATCHED_QOS),
                (Temperature, reactor.COOLANT_SETPOINT, self._on_command, topics.LOOP_QOS)):
            node.create_subscription(kind, topic, callback, qos)

    def open(self) -> None:
        """Trace the plant from now on."""
        self._node.create_subscription(
            Temperature, PLANT_TEMPERATURE if self._between else reactor.TEMPERATURE,
            self._on_temperature, topics.LOOP_QOS)

    def _on_temperature(self, message: Temperature) -> None:
        stamp_ns = stamp_nanoseconds(message.header.stamp)
        if self._stamp_ns is None:
            self._origin_ns = stamp_ns
        elif stamp_ns <= self._stamp_ns:
            # another plant: its time goes on from here
            self._origin_ns += stamp_ns - self._stamp_ns - NANOSECONDS
        self._stamp_ns = stamp_ns
        self.now = (stamp_ns - self._origin_ns) / NANOSECONDS
        self.trace.samples.append((self.now, message.temperature))
        if not self._between:
            self.trace.delivered.append(stamp_ns)
            return
        arriving = self.measurements(Packet(stamp_ns, message.temperature))
        self._awaited = len(arriving)
        for packet in arriving:
            self.trace.delivered.append(packet.stamp_ns)
            self._to_controller.publish(_message(packet))
        if not arriving:
            self._actuate([])

    def _on_coolant(self, message: Temperature) -> None:
        self.trace.coolants[stamp_nanoseconds(message.header.stamp)] = message.temperature

    def _on_command(self, message: Temperature) -> None:
        packet = Packet(stamp_nanoseconds(message.header.stamp), message.temperature)
        self.trace.commands.append(Command(self.now, packet.celsius, packet.stamp_ns))
        if not self._between:
            return
        self._awaited -= 1
        arriving = self.commands(packet)
        if arriving:
            self._held = arriving[-1].celsius
        if self._awaited <= 0:
            self._actuate(arriving)

    def _actuate(self, arriving: list[Packet]) -> None:
        """Give the plant the last command that arrived, under the open stamp."""
        if self._held is None or self._stamp_ns is None:
            return
        for packet in (Packet(self._stamp_ns, self._held), *arriving[:-1]):
            self._to_plant.publish(_message(packet))

    def _on_record(self, message: String) -> None:
        self.trace.records.append((self.now, message.data))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self.trace.statuses += [
            Status(self.now, status.name, status.level[0], status.message,
                   {item.key: item.value for item in status.values}) for status in message.status]


def _message(packet: Packet) -> Temperature:
    message = Temperature(temperature=packet.celsius)
    # a stamp cannot show a time before zero
    message.header.stamp = stamp_message(max(packet.stamp_ns, 0))
    return message
