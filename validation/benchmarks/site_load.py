# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Sensors and actuators of many loops in one light process, for the part `site`.

Messages are passed on as bytes. It says `ready` on standard output when every loop has answered,
then measures for a while and writes what it found as JSON.
"""

import argparse
from functools import partial
import json
import struct
import sys
import time

import numpy as np
import rclpy
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Temperature

from koopman_ros.demo import reactor
from koopman_ros.ros import topics
from koopman_ros.units import NANOSECONDS

_CELSIUS = 51.0  # about the nominal point of the shipped lifts
_STAMP = struct.Struct('<iI')
_AT = 4  # where the stamp stands in a serialized message, after four bytes about its encoding


class Load:
    """Measurements of each loop once a period, all loops spread over it, and their answers."""

    def __init__(self, namespaces: list[str], period: float) -> None:
        self._node = Node('site_load', enable_rosout=False, start_parameter_services=False)
        self._executor = EventsExecutor()
        self._count, self._period_ns = len(namespaces), round(period * NANOSECONDS)
        self._message = bytearray(serialize_message(Temperature(temperature=_CELSIUS)))
        self._publishers = [self._node.create_publisher(
            Temperature, f'{namespace}/{reactor.TEMPERATURE}', topics.LOOP_QOS)
            for namespace in namespaces]
        self._sent: dict[tuple[int, int], int] = {}  # by loop and stamp: when, by the steady clock
        self.answered: set[int] = set()
        self.latencies: list[float] = []
        for k, namespace in enumerate(namespaces):
            self._node.create_subscription(
                Temperature, f'{namespace}/{reactor.COOLANT_SETPOINT}',
                partial(self._on_command, k), topics.LOOP_QOS, raw=True)
        self._executor.add_node(self._node)
        self._turn, self._begun = 0, time.monotonic_ns()

    def _on_command(self, loop: int, message: bytes) -> None:
        now = time.monotonic_ns()
        sec, nanosec = _STAMP.unpack_from(message, _AT)
        sent = self._sent.pop((loop, sec * NANOSECONDS + nanosec), None)
        if sent is not None:
            self.answered.add(loop)
            self.latencies.append((now - sent) / NANOSECONDS)

    @property
    def open(self) -> int:
        """How many measurements have no answer."""
        return len(self._sent)

    def forget(self) -> None:
        """Count what is answered from now on."""
        self._sent.clear()
        self.latencies.clear()

    def run(self, seconds: float) -> int:
        """Measure on schedule for a while; return how many measurements were sent."""
        end, before = time.monotonic_ns() + round(seconds * NANOSECONDS), self._turn
        while (now := time.monotonic_ns()) < end:
            due = self._begun + self._turn * self._period_ns // self._count
            if now >= due:
                self._publish(self._turn % self._count)
                # what could not be sent in time is left out
                late = (now - due) * self._count // self._period_ns
                self._turn += 1 + late // self._count * self._count
            self._executor.spin_once(timeout_sec=max(0.0, (due - now) / NANOSECONDS))
        return self._turn - before

    def _publish(self, loop: int) -> None:
        stamp = time.time_ns()
        _STAMP.pack_into(self._message, _AT, *divmod(stamp, NANOSECONDS))
        self._sent[loop, stamp] = time.monotonic_ns()
        self._publishers[loop].publish(bytes(self._message))


def main() -> int:
    """Load the loops of a file, and print what was found."""
    parser = argparse.ArgumentParser()
    parser.add_argument('loops')
    parser.add_argument('--period', type=float, default=1.0)
    parser.add_argument('--settle', type=float, default=5.0)
    parser.add_argument('--seconds', type=float, default=20.0)
    parser.add_argument('--patience', type=float, default=300.0)
    given = parser.parse_args()
    with open(given.loops) as file:
        namespaces = [f'/{line.strip()}' for line in file]
    rclpy.init()
    load = Load(namespaces, given.period)
    begun = time.monotonic()
    while len(load.answered) < len(namespaces) and time.monotonic() - begun < given.patience:
        load.run(0.1)
    found = {'answering': len(load.answered), 'discovery_seconds': time.monotonic() - begun}
    load.run(given.settle)
    load.forget()
    print('ready', flush=True)
    sent = load.run(given.seconds)
    latencies = np.array(load.latencies or [np.inf])
    print(json.dumps(found | {
        'sent': sent, 'received': len(load.latencies), 'open': load.open,
        'p50_ms': 1e3 * float(np.percentile(latencies, 50)),
        'p99_ms': 1e3 * float(np.percentile(latencies, 99)),
        'worst_ms': 1e3 * float(latencies.max())}), flush=True)
    rclpy.try_shutdown()
    return 0


if __name__ == '__main__':
    sys.exit(main())
