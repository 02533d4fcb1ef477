# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Plans of the law `mpc`, and the loop across processes, each beside its like."""

from collections.abc import Iterator
import contextlib
from dataclasses import dataclass
from functools import partial
from pathlib import Path
import sys
import tempfile
import time
from typing import Any

import numpy as np
import psutil
from sensor_msgs.msg import Temperature

from benchmarks import planning, process
from koopman_ros.core.plots import table
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.demo import reactor
from koopman_ros.ros import topics
from koopman_ros.ros.time_conversion import stamp_message, stamp_nanoseconds
from koopman_ros.testing import Harness, NodeProcess

PACKAGES = ('numpy', 'scipy', 'daqp', 'casadi', 'do-mpc')
MEANING = {
    'plan_us': 'median and 99th percentile of processor time of the law mpc with 30 intervals, '
               'targets given, by lift; plan has those of the whole control step, too',
    'plan_ratio_to_do_mpc': 'how many times as long do-mpc takes (IPOPT, targets given, the '
                            'true equations), by lift',
    'plan_ratio_to_sqp': "the same of casadi's SQP, as generated C where there is a compiler",
    'latency_ratio': 'measurement published to command received, over that of a bare echo, by '
                     'who answers: medians and 99th percentiles',
    'speedup_over_real_time': 'seconds of the plant per second, in lock-step at one sample a '
                              'second of the plant, by who answers',
    'startup_seconds': "from the start of the controller's process to its first command, median",
    'rss_megabytes': 'resident memory after the lock-step run',
}
_ROUND = 50  # measurements of one side, then of the other
_PACE = 0.005  # s between measurements whose latency is taken
_CELSIUS = 51.0  # about the nominal point of the shipped lifts
_NAMESPACE = '/answers'
_NOISE = 0.01  # K, standard deviation
_RETRY = 0.01  # s between measurements before the first answer


@dataclass(frozen=True)
class LoopPlan:
    """One extent of the measurements."""

    rounds: int  #: of latency, fifty measurements of each side in one
    starts: int  #: of the controller
    plant_seconds: float  #: length of the lock-step loop
    plans: int  #: timed plans with each lift
    compiled: bool  #: whether the other solvers are compiled


PLANS = {'quick': LoopPlan(4, 2, 600.0, 80, False),
         'default': LoopPlan(30, 5, 3600.0, 800, True)}


def measure(plan: LoopPlan, figures: dict[str, Any], folder: Path) -> Iterator[str]:
    """Measure plans and the loop, each beside its like."""
    figures['meaning'] = MEANING
    with tempfile.TemporaryDirectory() as name:
        yield _plans(figures, plan, Path(name))
        with Harness(Path(name), name='probe') as harness:
            with _answering(harness) as (nodes, probes):
                yield _latency(figures, probes, plan.rounds)
                yield _lockstep(figures, harness, nodes, plan.plant_seconds)
            yield _start_up(figures, harness, plan.starts)


def _found(job: Any, *arguments: Any, folder: Path) -> dict[str, Any]:
    """Return what a job finds in a process with nothing else."""
    outcome = process.run(job, *arguments, folder=folder, megabytes=8e3)
    if outcome.failure:
        raise RuntimeError(f'{job.__module__} failed: {outcome.failure}')
    return {name: one for event in outcome.events for name, one in event.items()}


def _plans(figures: dict[str, Any], plan: LoopPlan, folder: Path) -> str:
    found = _found(planning.compare_all, tuple(planning.SETPOINTS), plan.plans, plan.compiled,
                   folder=folder)
    quantiles = ('median', 'p99')
    figures.update(plan=found, plan_us={
        plant: {quantile: one[f'law_cpu_{quantile}_us'] for quantile in quantiles}
        for plant, one in found.items()})
    for side in ('do_mpc', 'sqp'):
        figures[f'plan_ratio_to_{side}'] = {plant: {
            quantile: one[f'{side}_cpu_{quantile}_us'] / one[f'law_cpu_{quantile}_us']
            for quantile in quantiles} for plant, one in found.items()}
    return table(
        ('plan of 30 intervals', 'by', 'median [ms]', 'p99 [ms]', 'median / law',
         'commands apart [range]'),
        [(f'{plant}, {one["states"]} states', label, *(
            f'{1e-3 * one[f"{side}_cpu_{quantile}_us"]:.2f}' for quantile in quantiles),
          f'{one[f"{side}_cpu_median_us"] / one["law_cpu_median_us"]:.2g}',
          f'{one["agreement"].get(side, 0.0):.1e}')
         for plant, one in found.items()
         for side, label in (('step', 'control step with `mpc`'), ('law', 'the law alone'),
                             ('do_mpc', 'do-mpc'), ('sqp', 'SQP of casadi'))])


class _Probe:
    """A sensor and an actuator in one, on the topics of a node under a namespace."""

    def __init__(self, harness: Harness, namespace: str) -> None:
        self._harness = harness
        self._rng = np.random.default_rng(0)
        self._answers: dict[int, int] = {}  # stamp -> arrival
        self._measurements = harness.node.create_publisher(
            Temperature, f'{namespace}/{reactor.TEMPERATURE}', topics.LOOP_QOS)
        harness.node.create_subscription(
            Temperature, f'{namespace}/{reactor.COOLANT_SETPOINT}', self._on_command,
            topics.LOOP_QOS)

    def _on_command(self, message: Temperature) -> None:
        self._answers[stamp_nanoseconds(message.header.stamp)] = time.time_ns()

    def publish(self) -> int:
        """Publish a measurement of now; return its stamp."""
        message = Temperature(temperature=_CELSIUS + _NOISE * self._rng.normal())
        stamp = time.time_ns()
        message.header.stamp = stamp_message(stamp)
        self._measurements.publish(message)
        return stamp

    def first_answer(self) -> int:
        """Publish until a command comes; return when it came [ns of time.time_ns]."""
        begun = time.time_ns()

        def answered() -> list[int]:
            self.publish()
            self._harness.spin_once(_RETRY)
            # answers of a node that has ended meanwhile may still come in
            return [came for stamp, came in self._answers.items() if stamp >= begun]

        return self._harness.wait_until(answered, 'an answer')[0]

    def paced(self) -> list[float]:
        """Measure, with time between so that answers do not queue; return the latencies in s."""
        taken = []
        for _ in range(_ROUND):
            due = time.monotonic() + _PACE
            stamp = self.publish()
            came = self._harness.wait_until(partial(self._answers.get, stamp), 'the answer')
            assert came is not None
            taken.append((came - stamp) / NANOSECONDS)
            time.sleep(max(0.0, due - time.monotonic()))
        return taken


def _start(harness: Harness, name: str, namespace: str, command: tuple[str, ...] | None = None,
           **parameters: object) -> NodeProcess:
    return harness.start(name, parameters, ('-r', f'__ns:={namespace}'), command)


@contextlib.contextmanager
def _answering(harness: Harness) -> Iterator[tuple[dict[str, NodeProcess], dict[str, _Probe]]]:
    """Yield the nodes that answer, and their probes, after all have answered for a while."""
    with contextlib.ExitStack() as stack:
        nodes = {name: stack.enter_context(_start(
            harness, name, f'{_NAMESPACE}/{name}', None if name == 'controller' else (
                sys.executable, '-m', 'benchmarks.answering', name)))
            for name in ('controller', 'pid', 'echo')}
        probes = {name: _Probe(harness, f'{_NAMESPACE}/{name}') for name in nodes}
        for probe in probes.values():
            probe.first_answer()
            probe.paced()
        yield nodes, probes


def _latency(figures: dict[str, Any], probes: dict[str, _Probe], rounds: int) -> str:
    """Time measurement to command of each side, round by round in turns."""
    taken: dict[str, list[float]] = {name: [] for name in probes}
    for _ in range(rounds):
        for name, probe in probes.items():
            taken[name] += probe.paced()
    found = figures['latency_us'] = {name: dict(zip(
        ('median', 'p99'), (1e6 * np.percentile(seconds, (50, 99))).tolist(), strict=True))
        for name, seconds in taken.items()}
    ratios = figures['latency_ratio'] = {name: {
        quantile: value / found['echo'][quantile] for quantile, value in of.items()}
        for name, of in found.items()}
    return table(('latency [us] (times echo)', *probes), [
        (quantile, *(f'{found[name][quantile]:.0f} ({ratios[name][quantile]:.2f})'
                     for name in probes)) for quantile in ('median', 'p99')])


def _start_up(figures: dict[str, Any], harness: Harness, runs: int) -> str:
    """Time the controller from the start of its process to its first command."""
    probe = _Probe(harness, '/start')
    taken = []
    for _ in range(runs):
        begun = time.time_ns()
        with _start(harness, 'controller', '/start'):
            taken.append((probe.first_answer() - begun) / NANOSECONDS)
    figures['startup_seconds'] = float(np.median(taken))
    return f'first command {figures["startup_seconds"]:.2f} s after the start'


def _lockstep(figures: dict[str, Any], harness: Harness, nodes: dict[str, NodeProcess],
              seconds: float) -> str:
    """Let the plant and each controller run in lock-step as fast as they can."""
    found = figures['speedup_over_real_time'] = {
        name: seconds / _run_in_lockstep(harness, name, seconds)
        # the echo would heat the plant until that leaves its bounds
        for name in nodes if name != 'echo'}
    memory = figures['rss_megabytes'] = {
        name: float(psutil.Process(node.process.pid).memory_info().rss) / 1e6
        for name, node in nodes.items()}
    return table(('in lock-step with the plant', 'times as fast as the plant', 'memory [MB]'), [
        (name, f'{found[name]:.0f}' if name in found else '', f'{memory[name]:.0f}')
        for name in nodes])


def _run_in_lockstep(harness: Harness, name: str, seconds: float) -> float:
    """Return the wall time of so many seconds of the plant beside a controller."""
    arrivals: list[float] = []
    harness.node.create_subscription(
        Temperature, f'{_NAMESPACE}/{name}/{reactor.TEMPERATURE}',
        lambda _: arrivals.append(time.monotonic()), topics.LOOP_QOS, raw=True)
    # without noise, a measurement at rest repeats itself as that of a frozen sensor
    noise: dict[str, Any] = {f'{reactor.TEMPERATURE}.measurement_noise': _NOISE}
    with _start(harness, 'plant', f'{_NAMESPACE}/{name}', speed=0.0, lockstep=True,
                duration=seconds, sample_period=1.0, lockstep_subscribers=2, **noise):
        harness.wait_until(lambda: len(arrivals) > round(seconds),
                           'the end of the lock-step loop')
        return arrivals[-1] - arrivals[0]
