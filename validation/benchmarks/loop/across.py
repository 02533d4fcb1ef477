# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The loop across processes: its latency and rate, the nodes' start and memory, lock-step."""

import sys
import time
from typing import Any

import numpy as np
import psutil
from sensor_msgs.msg import Temperature
from std_srvs.srv import Trigger

from koopman_ros.ros import topics
from koopman_ros.testing import Harness, NodeProcess
from koopman_ros.units import NANOSECONDS
from validation.benchmarks.loop.probe import Loop

_ROUND = 50  # measurements of one side, then of the other
_PACE = 0.005  # s between measurements whose latency is taken
# A run whose answers come this late at its end has fallen behind.
_BEHIND = 0.02  # s
_PATIENCE = 2.0  # s for the answers that are still missing at the end of a run
_GROWTH, _TRIES = 1.2, 2
_ON_SCHEDULE = 0.98


def _start(harness: Harness, name: str, namespace: str, command: tuple[str, ...] | None = None,
           **parameters: object) -> NodeProcess:
    """Start a node under a namespace."""
    return harness.start(name, parameters, ('-r', f'__ns:={namespace}'), command)


def latency(harness: Harness, rounds: int) -> dict[str, Any]:
    """Time measurement to command of the controller and of the echo, round by round in turns."""
    echo = (sys.executable, '-m', 'validation.benchmarks.loop.echo')
    taken: dict[str, list[float]] = {'controller': [], 'echo': []}
    with _start(harness, 'controller', '/latency/controller'), \
            _start(harness, 'echo', '/latency/echo', echo) as echoing:
        loops = {name: Loop(harness, f'/latency/{name}') for name in taken}
        for loop in loops.values():
            loop.wait_for_first_answer()
            loop.settle()
            _paced(loop, _ROUND)
        for _ in range(rounds):
            for name, loop in loops.items():
                taken[name] += _paced(loop, _ROUND)
        memory = megabytes(echoing)
    found: dict[str, Any] = {'measurements': rounds * _ROUND, 'echo_rss_megabytes': memory}
    for name, seconds in taken.items():
        median, p99 = np.percentile(seconds, (50, 99))
        found[name] = {'median_us': 1e6 * float(median), 'p99_us': 1e6 * float(p99)}
    return found


def _paced(loop: Loop, count: int) -> list[float]:
    """Ask so many times, with time between that nothing left over from one meets the next."""
    taken = []
    for _ in range(count):
        due = time.monotonic() + _PACE
        taken.append(loop.ask())
        time.sleep(max(0.0, due - time.monotonic()))
    return taken


def highest_rate(harness: Harness, seconds: float, lowest: float
                 ) -> dict[str, Any]:
    """
    Raise the rate of measurements until the controller does not keep up.

    It keeps up with a rate when every measurement of a run is answered and the answers are not
    late at the end; a rate is tried twice, since another program may have come in between.

    :param seconds: length of a run.
    :param lowest: rate to start from, Hz.
    """
    steps: list[dict[str, Any]] = []
    highest, ended = None, ''
    with _start(harness, 'controller', '/rate'):
        loop = Loop(harness, '/rate')
        loop.wait_for_first_answer()
        loop.settle()
        while not ended:
            rate = lowest * _GROWTH ** sum(step['kept_up'] for step in steps)
            for _ in range(_TRIES):
                steps.append(step := _run(loop, harness, rate, seconds))
                if step['kept_up']:
                    highest = step['sent_hz']
                    break
            else:
                ended = 'a measurement has no answer' if step['unanswered'] else (
                    'the answers come late')
            if not ended and not step['on_schedule']:
                ended = 'the sender does not keep up'
    return {'max_rate_hz': highest, 'ended_by': ended, 'steps': steps}


def _run(loop: Loop, harness: Harness, rate: float, seconds: float) -> dict[str, Any]:
    """Publish on schedule while the answers come in."""
    stamps: list[int] = []
    count = round(rate * seconds)
    begun = time.monotonic()
    for k in range(count):
        due = begun + k / rate
        while (left := due - time.monotonic()) > 0.0:
            harness.spin_once(left)
        stamps.append(loop.publish())
        harness.spin_once(0.0)
    took = time.monotonic() - begun
    end = time.monotonic() + _PATIENCE
    while np.isinf(loop.seconds(stamps[-1])) and time.monotonic() < end:
        harness.spin_once(0.05)
    delays = np.array([loop.seconds(stamp) for stamp in stamps])
    at_end = float(np.median(delays[-max(1, count // 10):]))
    unanswered = int(np.sum(np.isinf(delays)))
    return {'rate_hz': rate, 'sent_hz': (count - 1) / took, 'sent': count,
            'unanswered': unanswered, 'delay_at_end_us': 1e6 * at_end if at_end < np.inf else None,
            'on_schedule': (count - 1) / took > _ON_SCHEDULE * rate,
            'kept_up': not unanswered and at_end < _BEHIND}


def start_up(harness: Harness, runs: int) -> dict[str, Any]:
    """Time the controller from the start of its process to its first command."""
    loop = Loop(harness, '/start')
    taken = []
    for _ in range(runs):
        begun = time.time_ns()
        with _start(harness, 'controller', '/start'):
            taken.append((loop.wait_for_first_answer() - begun) / NANOSECONDS)
    return {'seconds': float(np.median(taken)), 'runs': taken}


def lockstep(harness: Harness, seconds: float) -> dict[str, Any]:
    """
    Let plant and controller run in lock-step as fast as they can, and weigh all nodes.

    :param seconds: of the plant.
    """
    arrivals: list[float] = []
    harness.node.create_subscription(
        Temperature, f'/lockstep/{topics.TEMPERATURE}',
        lambda _: arrivals.append(time.monotonic()), topics.LOOP_QOS, raw=True)
    count = round(seconds) + 1
    with _start(harness, 'trainer', '/idle', record_at_start=False) as trainer, \
            _start(harness, 'plant', '/lockstep', speed=0.0, lockstep=True, duration=seconds,
                       sample_period=1.0, lockstep_subscribers=2) as plant, \
            _start(harness, 'controller', '/lockstep') as controller:
        harness.wait_until(lambda: len(arrivals) >= count,
                         f'the lock-step loop of {seconds:g} s of the plant')
        ready = harness.node.create_client(Trigger, '/idle/trainer/train').service_is_ready
        harness.wait_until(ready, 'the trainer')
        memory = {'plant': megabytes(plant), 'controller': megabytes(controller),
                  'trainer': megabytes(trainer)}
    return {'plant_seconds': seconds, 'seconds': arrivals[-1] - arrivals[0],
            'speed_over_real_time': seconds / (arrivals[-1] - arrivals[0]),
            'rss_megabytes': memory}


def megabytes(node: NodeProcess) -> float:
    """Return the resident memory of a process in MB."""
    return float(psutil.Process(node.process.pid).memory_info().rss) / 1e6
