# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Training over shards on real processes: speed-up, lost workers, and a large cluster on paper."""

from collections.abc import Callable, Iterator, Mapping
import contextlib
from dataclasses import dataclass
import hashlib
from pathlib import Path
import pickle
import signal
import statistics
import tempfile
import time
from typing import Any

import numpy as np
import psutil
import torch

from koopman_ros.jobs.backends import (
    Backend,
    backend_of,
    Found,
    Here,
    Item,
    Kept,
    SchedulerLost,
    WorkerLost,
)
from koopman_ros.jobs.cluster import Cluster
from koopman_ros.learning import Growth, read_samples, Shard, train, write_samples
from koopman_ros.learning.lift.multistart import Progress
from koopman_ros.plant_data import Plant, Samples
from koopman_ros.plants import describe, two_state_example
from koopman_ros.reports import table
from koopman_ros.testing.cluster import DaskProcesses
from validation.benchmarks.process import processor_seconds

PACKAGES = ('torch', 'numpy', 'distributed', 'joblib')
_SHARDS = 4
_SILENCE = 3.0  # s until a frozen worker is given up, here
_SENDING = 125e6  # bytes/s of a network of 1 Gbit/s
_LARGE = 1e10  # samples
_WORKERS = 100


@dataclass(frozen=True)
class Plan:
    """One extent of the measurements."""

    samples: int  #: in all shards
    iterations: int  #: Levenberg-Marquardt steps for each coordinate
    runs: int  #: of each place, of which the median counts
    rounds: int  #: of a task that does nothing, by which messages are measured


PLANS = {'quick': Plan(40_000, 6, 1, 10), 'default': Plan(200_000, 8, 3, 40)}


def measure(plan: Plan, figures: dict[str, Any], _: Path) -> Iterator[str]:
    """Train in each place, lose workers and the scheduler in mid-training, and extrapolate."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as name:
        work = _Work(plan, Path(name))
        figures.update(samples=plan.samples, shards=_SHARDS, iterations=plan.iterations,
                       places=[], losses=[])
        with _places(Path(name)) as places:
            for place, backend in places:
                _train_in(place, backend, work, plan.runs, figures)
        yield _table_of_places(figures)
        _lose(work, Path(name), figures)
        yield 'lost in mid-training\n\n' + table(('what', 'outcome', 'wall [s]'), [
            (one['what'], one['outcome'], f'{one["wall_seconds"]:.1f}')
            for one in figures['losses']])
        _measure_messages(work, plan.rounds, Path(name), figures)
        yield _estimate(figures)


class _Work:
    """A training over shards in files, of which each place does the same."""

    def __init__(self, plan: Plan, folder: Path) -> None:
        self.plant, system = _plant()
        self.recipe = Growth(4, hidden_first=16, max_iterations=plan.iterations, tolerance=0.0)
        self.some = _samples(system, 600, 0)
        self.shards = []
        for number in range(_SHARDS):
            path = folder / f'shard_{number}.npz'
            write_samples(path, _samples(system, plan.samples // _SHARDS, 1 + number))
            self.shards.append(Shard(f'shard {number}', read_samples, (path,)))

    def done(self, backend: Backend, watch: Callable[[Progress], bool] | None = None) -> str:
        """Return the digest of the model."""
        model = train(self.plant, self.some, self.recipe, starts=1, refuse=False,
                      backend=backend, shards=self.shards, watch=watch).model
        lifted = model.observables.lift(model.states.to_deviation(self.some.x))
        return hashlib.sha256(model.A.tobytes() + lifted.tobytes()).hexdigest()[:16]


def _plant() -> tuple[Plant, Any]:
    system = two_state_example()
    return describe(system), system


def _samples(system: Any, count: int, seed: int) -> Samples:
    rng = np.random.default_rng(seed)
    x = np.stack([rng.uniform(-6.0, 6.0, count), rng.uniform(-6.0, 8.0, count)], 1)
    u = rng.uniform(-5.0, 5.0, (count, 1))
    return Samples(x, system.derivative(x, u), u, np.arange(count) // max(1, count // 10))


@contextlib.contextmanager
def _places(folder: Path) -> Iterator[Iterator[tuple[str, Backend]]]:
    """Yield each place as it is needed, so that none of them is in another one's way."""
    def each() -> Iterator[tuple[str, Backend]]:
        for text, label in (('', 'this process'), ('process', 'a process of its own'),
                            ('joblib:2', 'joblib, 2 processes')):
            with backend_of(text) as backend:
                yield label, backend
        for count in (1, 2):
            with DaskProcesses(_made(folder / f'dask_{count}')) as dask:
                for _ in range(count):
                    dask.start_worker()
                with Cluster(dask.address) as cluster:
                    cluster.wait_for_workers(count)
                    yield f'Dask, {count} worker{"s" * (count > 1)}', cluster

    yield each()


def _made(folder: Path) -> Path:
    folder.mkdir()
    return folder


def _train_in(place: str, backend: Backend, work: _Work, runs: int, figures: dict[str, Any]
              ) -> None:
    # one step first: workers import what they need, and the files come into the cache
    train(work.plant, work.some, Growth(3, max_iterations=1), starts=1, refuse=False,
          backend=backend, shards=work.shards)
    digests: set[str] = set()
    walls, own, theirs, most = [], [], [], []
    for _ in range(runs):
        begin, mine, before = time.perf_counter(), time.process_time(), _processor_times()
        digests.add(work.done(backend))
        walls.append(time.perf_counter() - begin)
        own.append(time.process_time() - mine)
        spent = [seconds - before.get(pid, 0.0) for pid, seconds in _processor_times().items()]
        theirs.append(sum(spent))
        # the wall shows it only where each worker has a core to itself
        most.append(max([own[-1], *spent]))
    figures['places'].append({
        'place': place, 'wall_seconds': statistics.median(walls), 'all_wall_seconds': walls,
        'processor_seconds_here': statistics.median(own),
        'processor_seconds_of_workers': statistics.median(theirs),
        'processor_seconds_of_the_busiest': statistics.median(most), 'models': sorted(digests)})


def _processor_times() -> dict[int, float]:
    """Return those of all processes below this one, in seconds."""
    found = {}
    for child in psutil.Process().children(recursive=True):
        with contextlib.suppress(OSError):
            found[child.pid] = processor_seconds(child.pid)
    return found


def _table_of_places(figures: dict[str, Any]) -> str:
    first = figures['places'][0]
    rows = [(one['place'], f'{one["wall_seconds"]:.1f}',
             f'{min(one["all_wall_seconds"]):.1f} to {max(one["all_wall_seconds"]):.1f}',
             f'{first["wall_seconds"] / one["wall_seconds"]:.2f}',
             f'{one["processor_seconds_here"]:.1f}', f'{one["processor_seconds_of_workers"]:.1f}',
             f'{one["processor_seconds_of_the_busiest"]:.1f}',
             'yes' if one['models'] == first['models'] and len(one['models']) == 1 else 'no')
            for one in figures['places']]
    return (f'{figures["samples"]} samples in {figures["shards"]} shards\n\n' + table(
        ('place', 'wall [s]', 'from to', 'speed-up', 'processor here [s]', 'of workers [s]',
         'of the busiest [s]', 'same model'), rows))


def _lose(work: _Work, folder: Path, figures: dict[str, Any]) -> None:
    """Kill a worker, freeze one, and end the scheduler, each in mid-training."""
    expected = figures['places'][0]['models']
    with DaskProcesses(_made(folder / 'losses')) as dask:
        for _ in range(3):
            dask.start_worker()
        killed, frozen, _ = dask.workers
        with Cluster(dask.address, _SILENCE) as cluster:
            cluster.wait_for_workers(3)
            for what, act in (
                    ('nothing', lambda: None),
                    ('a worker, by kill -9', killed.process.kill),
                    (f'a worker, frozen; {_SILENCE:g} s are waited',
                     lambda: frozen.process.send_signal(signal.SIGSTOP)),
                    ('the scheduler, by kill -9', dask.scheduler.process.kill)):
                begin = time.perf_counter()
                try:
                    found = work.done(cluster, _once(act))
                    outcome = 'the same model' if [found] == expected else 'another model'
                except (WorkerLost, SchedulerLost) as error:
                    outcome = f'{type(error).__name__}: {error}'.replace(dask.address, 'tcp://...')
                figures['losses'].append({'what': what, 'outcome': outcome,
                                          'wall_seconds': time.perf_counter() - begin})


def _once(act: Callable[[], object]) -> Callable[[Progress], bool]:
    done = False

    def watch(now: Progress) -> bool:
        nonlocal done
        if not done and now.n_z == 4 and now.iteration == 3:
            done = True
            act()
        return False

    return watch


def _measure_messages(work: _Work, rounds: int, folder: Path, figures: dict[str, Any]) -> None:
    """Measure what goes and comes with an evaluation, and how long a round of messages takes."""
    counting = _Counting()
    work.done(counting)
    figures['bytes_to_a_worker'] = max(counting.sent)
    figures['bytes_from_a_shard'] = max(counting.received) / _SHARDS
    figures['evaluations'] = len(counting.sent)
    figures['seconds_per_sample'] = counting.seconds / (counting.evaluated * figures['samples'])
    seconds = {}
    with DaskProcesses(_made(folder / 'messages')) as dask:
        for _ in range(2):
            dask.start_worker()
        with Cluster(dask.address) as cluster:
            cluster.wait_for_workers(2)
            load = np.zeros(int(figures['bytes_from_a_shard']) // 8)
            for count in (2, 20):
                with contextlib.closing(cluster.keep(
                        _nothing, {str(n): load for n in range(count)})) as kept:
                    kept.run(_same, None)
                    begin = time.perf_counter()
                    for _ in range(rounds):
                        kept.run(_same, None)
                    seconds[count] = (time.perf_counter() - begin) / rounds
    figures['seconds_per_shard_and_round'] = (seconds[20] - seconds[2]) / 18.0
    figures['seconds_per_round'] = max(
        0.0, seconds[2] - 2.0 * figures['seconds_per_shard_and_round'])


class _Counting(Here):
    """This process as a place, with a count of what would have been sent elsewhere."""

    def __init__(self) -> None:
        self.sent: list[int] = []
        self.received: list[int] = []
        self.seconds, self.evaluated = 0.0, 0

    def keep(self, load: Callable[[Item], Any], items: Mapping[str, Item]) -> Kept:
        """Load here."""
        return _CountingKept(self, super().keep(load, items))


class _CountingKept:
    def __init__(self, counting: _Counting, kept: Kept) -> None:
        self._of, self._kept = counting, kept

    def run(self, function: Callable[[Any, Any], Found], argument: Any) -> list[Found]:
        of, begin = self._of, time.process_time()
        found = self._kept.run(function, argument)
        seconds = time.process_time() - begin
        of.sent.append(len(pickle.dumps((function, argument))))
        of.received.append(len(pickle.dumps(found)))
        # what most comes back from: the last coordinate with all derivatives
        if of.received[-1] > max(of.received[:-1], default=0):
            of.seconds, of.evaluated = 0.0, 0
        if of.received[-1] == max(of.received):
            of.seconds, of.evaluated = of.seconds + seconds, of.evaluated + 1
        return found

    def close(self) -> None:
        self._kept.close()


def _nothing(value: Any) -> Any:
    return value


def _same(value: Any, _: None) -> Any:
    return value


def _estimate(figures: dict[str, Any]) -> str:
    """Extrapolate to a large cluster, one shard a worker, from what was measured."""
    work = _LARGE * figures['seconds_per_sample']
    each = figures['seconds_per_shard_and_round'] + figures['bytes_from_a_shard'] / _SENDING
    saturated = (work / each) ** 0.5
    rows = []
    for workers in (1, 10, _WORKERS, round(saturated), 10 * round(saturated)):
        seconds = work / workers + figures['seconds_per_round'] + workers * each
        rows.append((workers, f'{work / workers:.3g}', f'{workers * each:.3g}', f'{seconds:.3g}',
                     f'{work / seconds / workers:.0%}'))
    figures['estimate'] = {
        'samples': _LARGE, 'seconds_of_one_core': work, 'seconds_of_each_worker': each,
        'workers_at_the_least_time': round(saturated)}
    return (f'{_LARGE:.0e} samples on paper: an evaluation sums for '
            f'{1e9 * figures["seconds_per_sample"]:.0f} ns a sample, sends '
            f'{figures["bytes_to_a_worker"]} bytes to each worker and gets '
            f'{figures["bytes_from_a_shard"]:.0f} bytes from each; a round takes '
            f'{1e3 * figures["seconds_per_round"]:.1f} ms and '
            f'{1e3 * figures["seconds_per_shard_and_round"]:.2f} ms for each worker, a network of '
            '1 Gbit/s the rest\n\n'
            + table(('workers', 'sums [s]', 'messages [s]', 'an evaluation [s]', 'used'), rows))
