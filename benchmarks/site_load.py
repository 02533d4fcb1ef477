# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Sensors and actuators of many loops in one light process, for the part `site`.

Messages are passed on as bytes. When every loop has answered it says so in a line of JSON; after
a line on its standard input it measures for some windows, and prints what it found in another.
"""

import argparse
from functools import partial
import json
import math
from pathlib import Path
import select
import struct
import sys
import time

import numpy as np
import psutil
import rclpy
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Temperature

from benchmarks.process import processor_seconds
from koopman_ros.demo import reactor
from koopman_ros.ros import topics
from koopman_ros.units import NANOSECONDS

_CELSIUS = 51.0  # about the nominal point of the shipped lifts
_STAMP = struct.Struct('<iI')
_AT = 4  # where the stamp stands in a serialized message, after four bytes about its encoding


class Load:
    """
    Measurements of each loop once a period, all loops spread over it, and their answers.

    :param plants: whether plants measure instead, and answers alone are heard.
    """

    def __init__(self, namespaces: list[str], period: float, plants: bool) -> None:
        self._node = Node('site_load', enable_rosout=False, start_parameter_services=False)
        self._executor = EventsExecutor()
        self._count, self._period_ns = len(namespaces), round(period * NANOSECONDS)
        self._message = bytearray(serialize_message(Temperature(temperature=_CELSIUS)))
        self._publishers = [] if plants else [self._node.create_publisher(
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
        stamp = sec * NANOSECONDS + nanosec
        sent = self._sent.pop((loop, stamp), None) if self._publishers else (
            now - time.time_ns() + stamp)
        if sent is not None:
            self.answered.add(loop)
            self.latencies.append((now - sent) / NANOSECONDS)

    def forget(self) -> None:
        """Count what is answered from now on."""
        self._sent.clear()
        self.latencies.clear()

    def run(self, seconds: float) -> int:
        """Measure on schedule for a while; return how many measurements were due."""
        end, before = time.monotonic_ns() + round(seconds * NANOSECONDS), self._turn
        while (now := time.monotonic_ns()) < end:
            due = self._begun + self._turn * self._period_ns // self._count
            if now >= due:
                if self._publishers:
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


def _processor(processes: list[psutil.Process]) -> float:
    """Return the processor time that some processes have taken, in s."""
    return sum(processor_seconds(process.pid) for process in processes)


def _window(load: Load, seconds: float, processes: list[psutil.Process]) -> dict[str, float]:
    load.forget()
    begun, before, own = time.monotonic(), _processor(processes), time.process_time()
    sent = load.run(seconds)
    took = time.monotonic() - begun
    share = (_processor(processes) - before) / took
    latencies = 1e3 * np.array(load.latencies or [math.inf])
    p50, p99 = np.percentile(latencies, (50, 99), method='lower')
    return {'sent': sent, 'answered': len(load.latencies), 'cores': share,
            'load_cores': (time.process_time() - own) / took,
            'p50_ms': float(p50), 'p99_ms': float(p99), 'worst_ms': float(latencies.max())}


def main() -> int:
    """Load the loops of a file, and print what was found."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument('loops', type=Path, help='a namespace a line')
    parser.add_argument('--pids', type=int, nargs='+', help='of their processes')
    parser.add_argument('--plants', action='store_true', help='that measure are there')
    for name in ('period', 'settle', 'seconds', 'patience'):
        parser.add_argument(f'--{name}', type=float, help='in s')
    parser.add_argument('--windows', type=int)
    given = parser.parse_args()
    namespaces = [f'/{line}' for line in given.loops.read_text().splitlines()]
    processes = [psutil.Process(pid) for pid in given.pids]
    rclpy.init()
    load = Load(namespaces, given.period, given.plants)
    begun = time.monotonic()
    while len(load.answered) < len(namespaces) and time.monotonic() - begun < given.patience:
        load.run(0.1)
    print(json.dumps({
        'answering': len(load.answered), 'start_cpu_seconds': _processor(processes),
        'discovery_seconds': time.time() - min(one.create_time() for one in processes)}),
        flush=True)
    while not select.select([sys.stdin], [], [], 0.0)[0]:
        load.run(0.1)
    load.run(given.settle)
    windows = [_window(load, given.seconds, processes) for _ in range(given.windows)]
    memory = [one.memory_full_info() for one in processes]
    print(json.dumps({
        'windows': windows, 'pss_megabytes': sum(one.pss for one in memory) / 1e6,
        'rss_megabytes': sum(one.rss for one in memory) / 1e6}), flush=True)
    rclpy.try_shutdown()
    return 0


if __name__ == '__main__':
    sys.exit(main())
