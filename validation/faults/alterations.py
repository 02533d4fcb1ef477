# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
What may happen to a message on its way: each alteration turns one message into none or more.

Those with a memory are made anew for each case.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

NANOSECONDS = 1_000_000_000


class Packet(NamedTuple):
    """A stamped temperature on its way, in degrees Celsius."""

    stamp_ns: int
    celsius: float


Alteration = Callable[[Packet], list[Packet]]


def unchanged(packet: Packet) -> list[Packet]:
    """Pass a message on."""
    return [packet]


def value(change: Callable[[float, float], float]) -> Alteration:
    """
    Replace the value.

    :param change: takes the seconds since the first message and its value, returns the new one.
    """
    first: list[int] = []

    def alter(packet: Packet) -> list[Packet]:
        first.append(packet.stamp_ns)
        del first[1:]
        seconds = (packet.stamp_ns - first[0]) / NANOSECONDS
        return [packet._replace(celsius=change(seconds, packet.celsius))]

    return alter


def frozen() -> Alteration:
    """Repeat the first value for ever."""
    shown: list[float] = []

    def alter(packet: Packet) -> list[Packet]:
        shown.append(packet.celsius)
        del shown[1:]
        return [packet._replace(celsius=shown[0])]

    return alter


def noise(deviation: float, seed: int = 0) -> Alteration:
    """Add normal noise of a standard deviation in K."""
    random = np.random.default_rng(seed)
    return lambda packet: [
        packet._replace(celsius=packet.celsius + float(random.normal(0.0, deviation)))]


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
    shown: list[int] = []

    def alter(packet: Packet) -> list[Packet]:
        shown.append(packet.stamp_ns)
        del shown[1:]
        return [packet._replace(stamp_ns=shown[0])]

    return alter
