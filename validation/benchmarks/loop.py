# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The control step, and the loop across processes: latency, rate, start, memory, lock-step."""

from collections.abc import Iterator, Mapping
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
from std_srvs.srv import Trigger

from koopman_ros.demo import reactor
from koopman_ros.reports import table
from koopman_ros.ros import topics
from koopman_ros.ros.codec import stamp_message, stamp_nanoseconds
from koopman_ros.testing import Harness, NodeProcess
from koopman_ros.units import NANOSECONDS
from validation.benchmarks import planning, process, step

PACKAGES = ('numpy', 'scipy', 'torch', 'control', 'daqp', 'casadi', 'do-mpc')
MEANING = {
    'step_us': 'median time of a control step, by n_z; step has the 99th percentiles, too',
    'step_ratio_to_naive': 'how many times as long the same law takes by torch jacrev and '
                           'control.dlqr, by n_z; medians of processor time, since a busy machine '
                           'interrupts the longer one more often',
    'plan_us': 'median and 99th percentile of processor time of the law mpc with 30 intervals, '
               'targets given, by lift; plan has those of the whole control step, too',
    'plan_ratio_to_do_mpc': 'how many times as long do-mpc takes (IPOPT, targets given, the '
                            'true equations), by lift; medians and 99th percentiles of '
                            'processor time',
    'plan_ratio_to_sqp': "the same of casadi's SQP, as generated C where there is a compiler",
    'latency_ratio_median': 'measurement published to command received, over that of a bare echo',
    'latency_ratio_p99': 'the same for 99th percentiles',
    'pid_latency_ratio_median': 'the same of a PID controller, a plain node of rclpy',
    'pid_latency_ratio_p99': 'the same for 99th percentiles',
    'compiled_latency_ratio_median': 'the same with a compiled control step (numba)',
    'compiled_latency_ratio_p99': 'the same for 99th percentiles',
    'max_rate_hz': 'highest rate of measurements at which every one was answered and the median '
                   'answer in the last tenth of the run took less than 20 ms',
    'compiled_max_rate_hz': 'the same with a compiled control step',
    'pid_max_rate_hz': 'the same of the PID controller',
    'echo_max_rate_hz': 'the same of a bare echo, which is what rclpy and this sender leave room '
                        'for',
    'startup_seconds': "from the start of the controller's process to its first command, median",
    'rss_megabytes': 'resident memory: plant and controller after the lock-step run, trainer and '
                     'echo idle',
    'speedup_over_real_time': 'seconds of the plant per second, in lock-step at one sample a '
                              'second of the plant',
    'compiled_speedup_over_real_time': 'the same with a compiled control step',
    'pid_speedup_over_real_time': 'the same with the PID controller, which is what the plant and '
                                  'rclpy leave room for',
}
_ROUND = 50  # measurements of one side, then of the other
_PACE = 0.005  # s between measurements whose latency is taken
_BEHIND = 0.02  # s; a run whose answers come this late at its end has fallen behind
_PATIENCE = 2.0  # s for the answers that are still missing at the end of a run
_GROWTH, _TRIES = 1.2, 2  # twice, since another program may have come in between
_ON_SCHEDULE = 0.98
_CELSIUS = 51.0  # about the nominal point of the shipped lifts
_NAMESPACE = '/answers'
_NOISE = 0.01  # K, standard deviation
_RETRY = 0.01  # s between measurements that nobody may hear yet


@dataclass(frozen=True)
class Plan:
    """One extent of the measurements."""

    coordinates: tuple[int, ...]  #: the n_z of the lifts
    steps: int  #: timed control steps with each lift
    rounds: int  #: of latency, fifty measurements of each side in one
    rate_seconds: float  #: length of a run at one rate
    lowest_rate: float  #: of measurements, Hz
    starts: int  #: of the controller
    plant_seconds: float  #: length of the lock-step loop
    plans: int  #: timed plans with each lift
    compiled: bool  #: whether those who are compared with are compiled


PLANS = {'quick': Plan((2, 3, 4, 5, 6), 200, 4, 0.4, 500.0, 2, 600.0, 80, False),
         'default': Plan((2, 3, 4, 5, 6), 1500, 30, 2.0, 500.0, 5, 3600.0, 800, True)}


def measure(plan: Plan, figures: dict[str, Any], folder: Path) -> Iterator[str]:
    """Measure the control step and the loop, each beside its like."""
    figures['meaning'] = MEANING
    with tempfile.TemporaryDirectory() as name:
        yield _steps(figures, plan, Path(name))
        yield _plans(figures, plan, Path(name))
        with Harness(Path(name), name='probe') as harness:
            with _answering(harness) as (nodes, probes):
                yield _latency(figures, probes, plan.rounds)
                yield _highest_rate(figures, probes, plan.rate_seconds, plan.lowest_rate)
                yield _lockstep(figures, harness, nodes, plan.plant_seconds)
            yield _start_up(figures, harness, plan.starts)


def _prefix(name: str) -> str:
    """Return what the figures of a side begin with, nothing for the controller in numpy."""
    return '' if name == 'controller' else f'{name}_'


def _tell(label: str) -> None:
    print(f'loop: {label}', file=sys.stderr, flush=True)


def _steps(figures: dict[str, Any], plan: Plan, folder: Path) -> str:
    _tell(f'{plan.steps} control steps with each lift')
    outcome = process.run(step.compare_all, plan.coordinates, plan.steps, folder=folder,
                          megabytes=8e3)
    if outcome.failure:
        raise RuntimeError(f'the control step could not be timed: {outcome.failure}')
    found = {n_z: one for event in outcome.events for n_z, one in event.items()}
    ratio = {n_z: one['naive_cpu_median_us'] / one['cpu_median_us'] for n_z, one in found.items()}
    figures.update(step=found, step_ratio_to_naive=ratio,
                   step_us={n_z: one['median_us'] for n_z, one in found.items()})
    columns = ('median_us', 'p99_us', 'compiled_median_us', 'compiled_p99_us', 'naive_median_us',
               'naive_p99_us')
    return table(('control step', 'ratio', *columns), [
        (f'n_z = {n_z}', f'{ratio[n_z]:.1f}', *(
            f'{one[column]:.0f}' if column in one else '-' for column in columns))
        for n_z, one in found.items()])


def _plans(figures: dict[str, Any], plan: Plan, folder: Path) -> str:
    _tell(f'{plan.plans} plans with each lift')
    outcome = process.run(planning.compare_all, tuple(planning.SETPOINTS), plan.plans,
                          plan.compiled, folder=folder, megabytes=8e3)
    if outcome.failure:
        raise RuntimeError(f'the plans could not be timed: {outcome.failure}')
    found = {plant: one for event in outcome.events for plant, one in event.items()}
    figures.update(plan=found, plan_us={
        plant: {quantile: one[f'law_cpu_{quantile}_us'] for quantile in ('median', 'p99')}
        for plant, one in found.items()})
    rows = []
    for side in ('do_mpc', 'sqp'):
        figures[f'plan_ratio_to_{side}'] = {plant: {
            quantile: one[f'{side}_cpu_{quantile}_us'] / one[f'law_cpu_{quantile}_us']
            for quantile in ('median', 'p99')} for plant, one in found.items()}
    for plant, one in found.items():
        for side, label in (('step', 'control step with `mpc`'), ('law', 'the law alone'),
                            ('do_mpc', 'do-mpc'), ('sqp', 'SQP of casadi')):
            rows.append((f'{plant}, {one["states"]} states', label, *(
                f'{1e-3 * one[f"{side}_cpu_{quantile}_us"]:.2f}' for quantile in ('median', 'p99')
            ), f'{one[f"{side}_cpu_median_us"] / one["law_cpu_median_us"]:.2g}',
                f'{one["agreement"].get(side, 0.0):.1e}'))
    return table(('plan of 30 intervals', 'by', 'median [ms]', 'p99 [ms]', 'median / law',
                  'commands apart [range]'), rows)


class _Probe:
    """A sensor and an actuator in one, on the topics of whoever answers under a namespace."""

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

    def seconds(self, stamp: int) -> float:
        """Return the time from a measurement to its command; infinity where none came."""
        return (self._answers.get(stamp, np.inf) - stamp) / NANOSECONDS

    def first_answer(self) -> int:
        """Publish until somebody answers; return when the answer came [ns of time.time_ns]."""
        begun = time.time_ns()

        def answered() -> list[int]:
            self.publish()
            self._harness.spin_once(_RETRY)
            # answers of somebody who has ended meanwhile may still come in
            return [came for stamp, came in self._answers.items() if stamp >= begun]

        return self._harness.wait_until(answered, 'an answer')[0]

    def paced(self) -> list[float]:
        """Measure, with time between that nothing left over from one meets the next; return s."""
        taken = []
        for _ in range(_ROUND):
            due = time.monotonic() + _PACE
            stamp = self.publish()
            self._harness.wait_until(partial(self._answers.get, stamp), 'the answer')
            taken.append(self.seconds(stamp))
            time.sleep(max(0.0, due - time.monotonic()))
        return taken

    def run(self, rate: float, seconds: float) -> dict[str, Any]:
        """Publish on schedule while the answers come in."""
        stamps: list[int] = []
        count = round(rate * seconds)
        begun = time.monotonic()
        for k in range(count):
            due = begun + k / rate
            while (left := due - time.monotonic()) > 0.0:
                self._harness.spin_once(left)
            stamps.append(self.publish())
            self._harness.spin_once(0.0)
        sent_hz = (count - 1) / (time.monotonic() - begun)
        end = time.monotonic() + _PATIENCE
        while np.isinf(self.seconds(stamps[-1])) and time.monotonic() < end:
            self._harness.spin_once(0.05)
        delays = np.array([self.seconds(stamp) for stamp in stamps])
        at_end = float(np.median(delays[-max(1, count // 10):]))
        unanswered = int(np.sum(np.isinf(delays)))
        return {'rate_hz': rate, 'sent_hz': sent_hz, 'sent': count, 'unanswered': unanswered,
                'delay_at_end_us': 1e6 * at_end, 'on_schedule': sent_hz > _ON_SCHEDULE * rate,
                'kept_up': not unanswered and at_end < _BEHIND}


def _start(harness: Harness, name: str, namespace: str, command: tuple[str, ...] | None = None,
           **parameters: object) -> NodeProcess:
    return harness.start(name, parameters, ('-r', f'__ns:={namespace}'), command)


@contextlib.contextmanager
def _answering(harness: Harness) -> Iterator[tuple[dict[str, NodeProcess], dict[str, _Probe]]]:
    """Yield who answers, and their probes, after all have answered for a while."""
    _tell('controllers, a PID controller and an echo')
    echo, pid = ((sys.executable, '-m', f'validation.benchmarks.{name}')
                 for name in ('echo', 'pid'))
    # nothing is compiled: `compiled` is the first one again
    with contextlib.ExitStack() as stack:
        nodes = {name: stack.enter_context(
            _start(harness, program, f'{_NAMESPACE}/{name}', command, **parameters))
            for name, program, command, parameters in (
                ('controller', 'controller', None, {}),
                ('compiled', 'controller', None, {}),
                ('pid', 'pid', pid, {}), ('echo', 'echo', echo, {}))}
        probes = {name: _Probe(harness, f'{_NAMESPACE}/{name}') for name in nodes}
        for probe in probes.values():
            probe.first_answer()
            probe.paced()
        yield nodes, probes


def _latency(figures: dict[str, Any], probes: dict[str, _Probe], rounds: int) -> str:
    """Time measurement to command of each side, round by round in turns."""
    _tell('latency')
    taken: dict[str, list[float]] = {name: [] for name in probes}
    for _ in range(rounds):
        for name, probe in probes.items():
            taken[name] += probe.paced()
    figures['latency'] = {'measurements': rounds * _ROUND}
    rows = []
    for quantile, percent in (('median', 50), ('p99', 99)):
        found = {name: 1e6 * float(np.percentile(seconds, percent))
                 for name, seconds in taken.items()}
        for name, microseconds in found.items():
            figures['latency'].setdefault(name, {})[f'{quantile}_us'] = microseconds
            if name != 'echo':
                figures[f'{_prefix(name)}latency_ratio_{quantile}'] = microseconds / found['echo']
        rows.append((quantile, *(
            f'{us:.0f}' if name == 'echo' else f'{us:.0f} ({us / found["echo"]:.2f})'
            for name, us in found.items())))
    return table(('latency [us] (times echo)', *probes), rows)


def _highest_rate(figures: dict[str, Any], probes: dict[str, _Probe], seconds: float,
                  lowest: float) -> str:
    """Raise the rate of measurements, in Hz, until who answers does not keep up for a run."""
    _tell('highest rate')
    return table(('every measurement is answered', 'up to [Hz]', 'ended because'), [
        _raised(figures, _prefix(name), probe, seconds, lowest)
        for name, probe in probes.items()])


def _raised(figures: dict[str, Any], side: str, probe: _Probe, seconds: float, lowest: float
            ) -> tuple[str, str, str]:
    """Find the highest rate of a side, note it, and return its row."""
    steps: list[dict[str, Any]] = []
    highest, ended = None, ''
    while not ended:
        rate = lowest * _GROWTH ** sum(one['kept_up'] for one in steps)
        for _ in range(_TRIES):
            steps.append(one := probe.run(rate, seconds))
            if one['kept_up']:
                highest = one['sent_hz']
                break
        else:
            ended = 'a measurement has no answer' if one['unanswered'] else (
                'the answers come late')
        if not ended and not one['on_schedule']:
            ended = 'the sender does not keep up'
    figures.update({f'{side}rate': {'max_rate_hz': highest, 'ended_by': ended, 'steps': steps},
                    f'{side}max_rate_hz': highest})
    return (side.strip('_') or 'controller', '-' if highest is None else f'{highest:.0f}', ended)


def _start_up(figures: dict[str, Any], harness: Harness, runs: int) -> str:
    """Time the controller from the start of its process to its first command."""
    _tell('start-up')
    probe = _Probe(harness, '/start')
    taken = []
    for _ in range(runs):
        begun = time.time_ns()
        with _start(harness, 'controller', '/start'):
            taken.append((probe.first_answer() - begun) / NANOSECONDS)
    figures['startup'] = {'seconds': float(np.median(taken)), 'runs': taken}
    figures['startup_seconds'] = seconds = figures['startup']['seconds']
    return f'first command {seconds:.2f} s after the start'


def _lockstep(figures: dict[str, Any], harness: Harness, nodes: Mapping[str, NodeProcess],
              seconds: float) -> str:
    """Let the plant and each side run in lock-step as fast as they can, and weigh all nodes."""
    _tell('lock-step and memory')
    memory = {'echo': _rss(nodes['echo'])}
    rows = []
    for name, node in nodes.items():
        if name == 'echo':
            # it would heat the plant until that leaves its bounds
            continue
        side = _prefix(name)
        took, weight = _run_in_lockstep(harness, name, seconds)
        figures[f'{side}lockstep'] = {'plant_seconds': seconds, 'seconds': took}
        figures[f'{side}speedup_over_real_time'] = seconds / took
        rows.append((name, f'{seconds / took:.0f}'))
        if name == 'controller':
            memory.update(plant=weight, controller=_rss(node))
    with _start(harness, 'trainer', '/idle', record_at_start=False) as trainer:
        ready = harness.node.create_client(Trigger, '/idle/trainer/train').service_is_ready
        harness.wait_until(ready, 'the trainer')
        memory['trainer'] = _rss(trainer)
    figures['rss_megabytes'] = memory
    return '\n'.join((
        table(('in lock-step with the plant', 'times as fast as the plant'), rows),
        f'resident memory in MB: {", ".join(f"{k} {v:.0f}" for k, v in memory.items())}'))


def _run_in_lockstep(harness: Harness, name: str, seconds: float) -> tuple[float, float]:
    """Return what so many seconds of the plant take beside a side, and its memory in MB."""
    arrivals: list[float] = []
    harness.node.create_subscription(
        Temperature, f'{_NAMESPACE}/{name}/{reactor.TEMPERATURE}',
        lambda _: arrivals.append(time.monotonic()), topics.LOOP_QOS, raw=True)
    # that of the other measurements: without it, one at rest repeats itself to the last digit, as
    # that of a sensor which is frozen
    noise: dict[str, Any] = {f'{reactor.TEMPERATURE}.noise': _NOISE}
    with _start(harness, 'plant', f'{_NAMESPACE}/{name}', speed=0.0, lockstep=True,
                duration=seconds, sample_period=1.0, lockstep_subscribers=2,
                **noise) as plant:
        harness.wait_until(lambda: len(arrivals) > round(seconds),
                           'the end of the lock-step loop')
        return arrivals[-1] - arrivals[0], _rss(plant)


def _rss(node: NodeProcess) -> float:
    """Return the resident memory of a process in MB."""
    return float(psutil.Process(node.process.pid).memory_info().rss) / 1e6
