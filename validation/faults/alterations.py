# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
What may happen to a message on its way: each alteration turns one message into none or more.

Those with a memory are made anew for each case.
"""

from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from koopman_ros.units import NANOSECONDS


class Packet(NamedTuple):
    """A stamped temperature on its way, in degrees Celsius."""

    stamp_ns: int
    celsius: float


Alteration = Callable[[Packet], list[Packet]]


def unchanged(packet: Packet) -> list[Packet]:
    """Pass a message on."""
    return [packet]


def changed(change: Callable[[Packet, Packet], Packet]) -> Alteration:
    """
    Replace each message.

    :param change: takes the first message and this one, returns the new one.
    """
    first: list[Packet] = []

    def alter(packet: Packet) -> list[Packet]:
        first.append(packet)
        del first[1:]
        return [change(first[0], packet)]

    return alter


def value(change: Callable[[float, float], float]) -> Alteration:
    """
    Replace the value.

    :param change: takes the seconds since the first message and its value, returns the new one.
    """
    return changed(lambda first, packet: packet._replace(celsius=change(
        (packet.stamp_ns - first.stamp_ns) / NANOSECONDS, packet.celsius)))


def frozen() -> Alteration:
    """Repeat the first value for ever."""
    return changed(lambda first, packet: packet._replace(celsius=first.celsius))


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


def stamped(change: Callable[[int], int]) -> Alteration:
    """Replace the stamp in nanoseconds."""
    return lambda packet: [packet._replace(stamp_ns=change(packet.stamp_ns))]


def stamps_frozen() -> Alteration:
    """Give every message the stamp of the first."""
    return changed(lambda first, packet: packet._replace(stamp_ns=first.stamp_ns))
