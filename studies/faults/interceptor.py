# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The connection of plant and controller: traces messages, and alters them on request.

An alteration turns one packet into none or more; one with a memory is built again for each case.
"""

from collections import deque
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from std_msgs.msg import String

from koopman_ros.core.message_fields import MessageField
from koopman_ros.core.synchronizer import SampleSynchronizer
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.ros import topics
from koopman_ros.ros.signals import by_topic
from koopman_ros.ros.time_conversion import stamp_message, stamp_nanoseconds
from studies.faults.case import Command, LoopTrace, SeenStatus
from studies.faults.plants import FaultPlant

# that wait to be read: a storm makes thousands while the harness is busy sending it
MOST_RECORDS = 100_000

_BEHIND = 'plant/'  # before the topics of a plant whose messages are altered


def remapped(on: FaultPlant) -> tuple[str, ...]:
    """Return the parameters of a plant whose messages are altered."""
    wiring = on.wiring
    topics_ = dict.fromkeys(place.topic for places in (
        wiring.measured, wiring.commands, wiring.measured_disturbances, wiring.late)
        for place in places.values())
    return tuple(word for topic in topics_ for word in ('-r', f'{topic}:={_BEHIND}{topic}'))


class Packet(NamedTuple):
    """Stamped values on their way, by signal and in the units of their messages."""

    stamp_ns: int
    values: Mapping[str, float]


Alteration = Callable[[Packet], list[Packet]]


def unchanged(packet: Packet) -> list[Packet]:
    """Pass a message on."""
    return [packet]


def part(alter: Alteration, *names: str) -> Alteration:
    """Alter the values of some signals in a packet; the others pass."""
    def altered(packet: Packet) -> list[Packet]:
        own, rest = ({name: value for name, value in packet.values.items()
                      if (name in names) is wanted} for wanted in (True, False))
        arriving, passed = alter(packet._replace(values=own)), packet._replace(values=rest)
        # together where they still have one stamp, as in one message
        for i, other in enumerate(arriving):
            if other.stamp_ns == passed.stamp_ns:
                arriving[i] = other._replace(values={**rest, **other.values})
                return arriving
        return [passed, *arriving]

    return altered


def changed(change: Callable[[Packet, Packet], Packet]) -> Alteration:
    """Replace each packet; `change` takes the first packet and this one."""
    first: list[Packet] = []

    def alter(packet: Packet) -> list[Packet]:
        first.append(packet)
        del first[1:]
        return [change(first[0], packet)]

    return alter


def value(change: Callable[[float, float], float]) -> Alteration:
    """Replace each value; `change` takes the seconds since the first packet and the value."""
    return changed(lambda first, packet: packet._replace(values={
        name: change((packet.stamp_ns - first.stamp_ns) / NANOSECONDS, shown)
        for name, shown in packet.values.items()}))


def frozen(what: str = 'values') -> Alteration:
    """Repeat the first `values`, or the first `stamp_ns`, for ever."""
    return changed(lambda first, packet: packet._replace(**{what: getattr(first, what)}))


def stamped(change: Callable[[int], int]) -> Alteration:
    """Replace the stamp in nanoseconds."""
    return lambda packet: [packet._replace(stamp_ns=change(packet.stamp_ns))]


def noise(deviation: float, seed: int = 0) -> Alteration:
    """Add normal noise of a standard deviation."""
    random = np.random.default_rng(seed)
    return value(lambda _, shown: shown + float(random.normal(0.0, deviation)))


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
    """Deliver each message after this number of later ones."""
    waiting: deque[Packet] = deque()

    def alter(packet: Packet) -> list[Packet]:
        waiting.append(packet)
        return [waiting.popleft()] if len(waiting) > messages else []

    return alter


class Sender:
    """Publishes packets, the values of one topic in one message."""

    def __init__(self, node: Node, places: Mapping[str, MessageField], before: str = '') -> None:
        self._places = places
        self._parts = [(node.create_publisher(kind, f'{before}{topic}', topics.LOOP_QOS), kind,
                        names) for topic, kind, names in by_topic(places)]
        self.publishers = [publisher for publisher, *_ in self._parts]

    def __call__(self, packet: Packet) -> None:
        """Publish the values of a packet."""
        for publisher, kind, names in self._parts:
            own = {name: packet.values[name] for name in names if name in packet.values}
            if own:
                publisher.publish(message_of(kind, self._places, own, packet.stamp_ns))


class Interceptor:
    """
    A trace of the messages of plant and controller.

    Where it stands between them it is the actuator, too, which holds its last command when none
    arrives: so lock-step goes on whatever is lost.

    :param between: whether all messages between plant and controller pass through it.

    :ivar measurements: alteration of measurements on their way to the controller.
    :ivar commands: alteration of commands on their way to the plant.
    :ivar disturbances: alteration of measured disturbances.
    :ivar late: alteration of the values of an analyser.
    """

    def __init__(self, node: Node, on: FaultPlant, between: bool) -> None:
        self.trace = LoopTrace(on)
        self.measurements: Alteration = unchanged
        self.commands: Alteration = unchanged
        self.disturbances: Alteration = unchanged
        self.late: Alteration = unchanged
        self.now = 0.0  # plant time in s since the first measurement
        self._node = node
        self._between = between
        self._stamp_ns: int | None = None  # of the last true states
        self._origin_ns = 0
        self._awaited = 0  # commands, for what was delivered
        self._held: Mapping[str, float] = {}  # the command that the actuators stand at
        # what the controller is expected to put together
        self._assembler = SampleSynchronizer(on.states)
        wiring, self._parts = on.wiring, list(by_topic(on.wiring.measured))
        if between:
            self._to_controller = Sender(node, wiring.measured)
            self._to_plant = Sender(node, wiring.commands, _BEHIND)
            for kind, places in (('disturbances', wiring.measured_disturbances),
                                 ('late', wiring.late)):
                self._listen(places, partial(self._pass_on, kind, Sender(node, places)),
                             before=_BEHIND)
        for kind, topic, callback, qos in (
                (DiagnosticArray, topics.DIAGNOSTICS, self._on_diagnostics, topics.LOOP_QOS),
                (String, topics.EVENT_LOG, self._on_record,
                 topics.profile(MOST_RECORDS, reliable=True))):
            node.create_subscription(kind, topic, callback, qos)
        self._listen(wiring.applied, self._on_applied, topics.LATCHED_QOS)
        self.hear_commands()

    def hear_commands(self) -> None:
        """Trace the commands."""
        on = self.trace.on
        self._of_commands = self._listen(
            on.wiring.commands, _whole(on.inputs, self._on_command))

    def leave_commands(self) -> None:
        """Subscribe to no command any more."""
        for subscription in self._of_commands:
            self._node.destroy_subscription(subscription)

    def open(self) -> None:
        """Trace the plant from now on."""
        on = self.trace.on
        self._listen(on.wiring.measured, _whole(on.states, self._on_states),
                     before=_BEHIND if self._between else '')

    def _listen(self, places: Mapping[str, MessageField], hear: Callable[[Packet], None],
                qos: QoSProfile = topics.LOOP_QOS, before: str = '') -> list[Subscription]:
        def read(names: list[str], message: Any) -> None:
            hear(Packet(stamp_nanoseconds(message.header.stamp),
                        {name: places[name].get(message) for name in names}))

        return [self._node.create_subscription(
            kind, f'{before}{topic}', partial(read, names), qos)
            for topic, kind, names in by_topic(places)]

    def _on_states(self, packet: Packet) -> None:
        stamp_ns, on = packet.stamp_ns, self.trace.on
        if self._stamp_ns is None:
            self._origin_ns = stamp_ns
        elif stamp_ns <= self._stamp_ns:
            # another plant: its time goes on from here
            self._origin_ns += stamp_ns - self._stamp_ns - round(on.period * NANOSECONDS)
        self._stamp_ns = stamp_ns
        self.now = (stamp_ns - self._origin_ns) / NANOSECONDS
        self.trace.samples.append((self.now, tuple(packet.values[name] for name in on.states)))
        if not self._between:
            self.trace.delivered.append(stamp_ns)
            return
        arriving = self.measurements(packet)
        expected = [whole for arrived in arriving if (whole := self._expected(arrived))]
        self._awaited = len(expected)
        self.trace.delivered += expected
        for arrived in arriving:
            self._to_controller(arrived)
        if not expected:
            self._actuate([])

    def _pass_on(self, kind: str, publish: Callable[[Packet], None], packet: Packet) -> None:
        alter: Alteration = getattr(self, kind)
        for arrived in alter(packet):
            publish(arrived)

    def _expected(self, packet: Packet) -> int | None:
        """Return the stamp of the sample that a packet makes whole, or None."""
        found = [whole for _, _, names in self._parts
                 if (own := {name: packet.values[name] for name in names
                             if name in packet.values})
                 and (whole := self._assembler.take(packet.stamp_ns, own))]
        return found[-1][0] if found else None

    def _on_applied(self, packet: Packet) -> None:
        self.trace.applied.setdefault(packet.stamp_ns, {}).update(packet.values)

    def _on_command(self, packet: Packet) -> None:
        self.trace.commands.append(Command(
            self.now, tuple(packet.values[name] for name in self.trace.on.inputs),
            packet.stamp_ns))
        if not self._between:
            return
        self._awaited -= 1
        arriving = self.commands(packet)
        if arriving:
            self._held = arriving[-1].values
        if self._awaited <= 0:
            self._actuate(arriving)

    def _actuate(self, arriving: list[Packet]) -> None:
        """Give the plant the last command that arrived, under the open stamp."""
        if not self._held or self._stamp_ns is None:
            return
        for packet in (Packet(self._stamp_ns, self._held), *arriving[:-1]):
            self._to_plant(packet)

    def _on_record(self, message: String) -> None:
        self.trace.records.append((self.now, message.data))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self.trace.statuses += [
            SeenStatus(self.now, status.name, status.level[0], status.message,
                       {item.key: item.value for item in status.values})
                       for status in message.status]


def _whole(names: tuple[str, ...], hear: Callable[[Packet], None]) -> Callable[[Packet], None]:
    """Put parts together that have one stamp, in the order in which they came."""
    waiting: dict[int, dict[str, deque[float]]] = {}

    def take(packet: Packet) -> None:
        parts = waiting.setdefault(packet.stamp_ns, {name: deque() for name in names})
        for name, number in packet.values.items():
            parts[name].append(number)
        if all(parts.values()):
            values = {name: numbers.popleft() for name, numbers in parts.items()}
            if not any(parts.values()):
                del waiting[packet.stamp_ns]
            hear(Packet(packet.stamp_ns, values))

    return take


def message_of(kind: Any, places: Mapping[str, MessageField], values: Mapping[str, float],
               stamp_ns: int = 0) -> Any:
    """Build a message from values in its units."""
    message = kind()
    for name, number in values.items():
        places[name].put(message, number)
    # a stamp cannot show a time before zero
    message.header.stamp = stamp_message(max(stamp_ns, 0))
    return message
