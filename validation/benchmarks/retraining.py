# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What retraining from long records costs: processor time and memory by their samples."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
import os
from pathlib import Path
import sys
import tempfile
import time
from typing import Any

from matplotlib.axes import Axes
import numpy as np

from koopman_ros.bags import RecordedInput, RecordedState
from koopman_ros.execution import backend_of
from koopman_ros.learning import TrainingTask
from koopman_ros.learning.identification import Drift
from koopman_ros.learning.pipeline import retrain_by
from koopman_ros.plants.library.reactor import OneStateReactor
from koopman_ros.plants.library.two_tanks import TwoTanks
from koopman_ros.reports import drawing, legend, table
from koopman_ros.units import SECONDS_PER_TIME_UNIT
from koopman_ros.wire import Place
from validation.benchmarks import process
from validation.benchmarks.long_records import Design, FIELD, simulated, TYPE, write

PACKAGES = ('torch', 'numpy', 'scipy', 'mcap')
_DAY = 86_400  # s
_STAGES = {'reading': 'reading the bags, twice', 'estimating': 'estimating the drift',
           'learning': 'learning the lift', 'judging': 'judging'}
_COLOURS = {'reading': '#c8553d', 'estimating': '#3d5a98', 'learning': '#0b6e4f',
            'judging': '#8d7aae'}
_MEGABYTES = 8e3  # that a process may take
_TESTED = 2000  # states at which the drift is held against the plant's


@dataclass(frozen=True)
class Case:
    """A kind of record."""

    name: str
    design: Design
    bag: int  #: samples in a bag at most


@dataclass(frozen=True)
class Plan:
    """One extent of the measurements."""

    samples: dict[str, tuple[int, ...]]  #: of the records, by case
    #: days of the reactor at 1 Hz that are read by two processes, a bag a day
    days: int


PLANS = {
    'quick': Plan({'reactor at 1 Hz': (10_000, 100_000), 'reactor at 100 Hz': (100_000,)}, 2),
    'default': Plan({
        'reactor at 1 Hz': (10_000, 100_000, 1_000_000, 10_000_000),
        'reactor at 100 Hz': (100_000, 1_000_000),
        'two tanks at 10 Hz': (10_000, 100_000, 1_000_000)}, 365),
}


def cases() -> dict[str, Case]:
    """Return the kinds of records by name."""
    reactor, tanks = OneStateReactor().system(), TwoTanks().system()
    slow = Design(reactor, np.array([281.3]), np.array([300.5]), (30.0, 120.0), 1.0,
                  np.array([0.1]))
    levels = Design(tanks, 0.6 * tanks.nominal_input, 1.4 * tanks.nominal_input, (10.0, 60.0),
                    0.1, np.full(2, 2e-4))
    found = (Case('reactor at 1 Hz', slow, _DAY),
             Case('reactor at 100 Hz', replace(slow, period=0.01), 1_000_000),
             Case('two tanks at 10 Hz', levels, 1_000_000))
    return {case.name: case for case in found}


def measure(plan: Plan, figures: dict[str, Any], folder: Path) -> Iterator[str]:
    """Retrain from records of growing length, and from many days by two processes."""
    figures['machine']['threads'] = 1
    figures['clock'] = 'processor time, in all processes'
    known = cases()
    with tempfile.TemporaryDirectory() as name:
        for case, sizes in plan.samples.items():
            rows = figures.setdefault('by_samples', {})[case] = []
            for samples in sizes:
                _tell(f'{case}, {samples} samples')
                bags = write_bags(known[case], samples, Path(name))
                rows.append({'samples': samples, **_measured(known[case], bags, Path(name), 1)})
                _remove(bags)
        yield _table(figures['by_samples'])
        _tell(f'{plan.days} days at 1 Hz, two processes')
        slow = known['reactor at 1 Hz']
        bags = write_bags(slow, plan.days * _DAY, Path(name))
        days = figures['days'] = {'days': plan.days, 'samples': plan.days * _DAY,
                                  **_measured(slow, bags, Path(name), 2)}
        yield (f'{plan.days} days at 1 Hz, {days["samples"]} samples: '
               f'{days["wall_seconds"]:.0f} s, {days["cpu_seconds"]:.0f} s of processor time, '
               f'{days["peak_megabytes"]:.0f} MB and {days["peak_megabytes_of_workers"]:.0f} MB '
               f'in each of two workers; {"accepted" if days["accepted"] else "refused"}')
    _draw(folder / 'retraining.png', figures)


def write_bags(case: Case, samples: int, folder: Path) -> list[Path]:
    """Write a record, a run of its own in each bag, with an hour between two."""
    runs = -(-samples // case.bag)
    states, inputs = simulated(case.design, -(-samples // runs), runs, 0)
    system, period = case.design.system, case.design.period
    topics = [f'/{name}' for name in (*system.state_names, *system.input_names)]
    return [write(folder / f'{run:04d}.mcap', topics,
                  np.hstack([states[:, run], inputs[:, run]]), period,
                  1.0 + run * (len(states) * period + 3600.0)) for run in range(runs)]


def task_of(case: Case, bags: Sequence[Path], output: Path) -> TrainingTask:
    """Return the task of a first lift from some bags."""
    system = case.design.system

    def place(name: str, unit: str) -> Place:
        return Place(f'/{name}', TYPE, FIELD, unit)

    return TrainingTask(tuple(map(str, bags)), str(output), '', tuple(
        RecordedState(name, unit, place(name, unit)) for name, unit in zip(
            system.state_names, system.state_units, strict=True)), tuple(
        RecordedInput(name, unit, place(name, unit)) for name, unit in zip(
            system.input_names, system.input_units, strict=True)), plant=case.name)


def drift_error(case: Case, drift: Drift) -> list[float]:
    """Return the error of each state's drift along fresh runs, relative to the drift's size."""
    system, states = case.design.system, drift.box.states
    x, u = (values.reshape(-1, values.shape[2])[::7][:_TESTED] for values in simulated(
        replace(case.design, noise=np.zeros(len(states))), 7 * _TESTED, 1, 99))
    seconds = SECONDS_PER_TIME_UNIT[system.time_unit]
    true = system.derivative(x, u) / seconds
    error = drift.rate(x, u) - true
    return np.sqrt(np.mean(error ** 2, axis=0) / np.mean(true ** 2, axis=0)).tolist()


def _measured(case: Case, bags: Sequence[Path], folder: Path, workers: int) -> dict[str, Any]:
    """Retrain in a process of its own; return its figures."""
    begun = time.perf_counter()
    outcome = process.run(_retrain, case.name, bags, folder / 'new.safetensors', workers,
                          folder=folder, megabytes=_MEGABYTES, children=workers > 1)
    figures = outcome.find('figures')
    if figures is None:
        raise RuntimeError(f'{case.name}: the retraining has failed: {outcome.failure}')
    return {**figures, 'wall_seconds': time.perf_counter() - begun,
            'bag_megabytes': sum(bag.stat().st_size for bag in bags) / 1e6}


def _retrain(tell: process.Tell, name: str, bags: Sequence[Path], output: Path, workers: int
             ) -> None:
    """Retrain, and tell what each stage took; in a process of its own."""
    import torch

    torch.set_num_threads(1)
    case, before = cases()[name], _peak()
    spent, by_workers, of_workers = {'reading': 0.0}, 0.0, 0.0
    stage, since = 'reading', time.process_time()

    def on_progress(_: float, text: str) -> bool:
        nonlocal stage, since
        now = {'reading bags': 'reading', 'writing': 'judging'}.get(text, text.partition(':')[0])
        if now != stage:
            spent[stage] = spent.get(stage, 0.0) + time.process_time() - since
            stage, since = now, time.process_time()
        return False

    task = task_of(case, bags, output)
    with backend_of(f'joblib:{workers}' if workers > 1 else '') as backend:
        found = retrain_by(backend, task, on_progress)
        if workers > 1:
            # each of them has ended what it does, and tells of itself
            used = {pid: figures for _, figures in backend.run(
                _used, {str(number): None for number in range(workers)}) for pid in [figures[0]]}
            by_workers = sum(seconds for _, seconds, _ in used.values())
            of_workers = max(peak for *_, peak in used.values())
    spent[stage] = spent.get(stage, 0.0) + time.process_time() - since
    reduction = found.reduction
    tell({'figures': {
        'stages': spent,
        'cpu_seconds': time.process_time() + by_workers, 'cpu_seconds_of_workers': by_workers,
        'start_megabytes': before, 'peak_megabytes': _peak(),
        'peak_megabytes_of_workers': of_workers,
        'accepted': found.accepted, 'reasons': list(found.reasons),
        'reduction': None if reduction is None else asdict(reduction),
        'coverage': min(found.coverage.values()),
        'heldout_error': None if found.decision is None else found.decision.rmse.tolist(),
        'drift_error': drift_error(case, found.found.drift)}})


def _peak() -> float:
    """Return the most memory that this process has had, in MB."""
    status = Path('/proc/self/status').read_text()
    return int(status.partition('VmHWM:')[2].split()[0]) * 1024 / 1e6


def _used(*_: object) -> tuple[int, float, float]:
    """Return the number of a worker, its processor time, and the most memory it has had."""
    # the other one is to be asked, too
    time.sleep(0.2)
    return os.getpid(), time.process_time(), _peak()


def _remove(bags: Sequence[Path]) -> None:
    for bag in bags:
        bag.unlink()


def _tell(label: str) -> None:
    print(f'retraining: {label}', file=sys.stderr, flush=True)


def _table(by_samples: dict[str, list[dict[str, Any]]]) -> str:
    rows = []
    for case, found in by_samples.items():
        for one in found:
            reduction = one['reduction'] or {}
            rows.append((
                case, f'{one["samples"]:.0e}', *(f'{one["stages"].get(name, 0.0):.1f}'
                                                 for name in _STAGES),
                f'{one["cpu_seconds"]:.0f}', f'{one["peak_megabytes"]:.0f}',
                reduction.get('group', 1), f'{100.0 * max(one["drift_error"]):.2g} %',
                'accepted' if one['accepted'] else 'refused'))
    return table(('record', 'samples', *(f'{name} [s]' for name in _STAGES), 'all [s]', 'MB',
                  'averaged', 'error of the drift', ''), rows, range(1, 5 + len(_STAGES)))


def _draw(path: Path, figures: dict[str, Any]) -> None:
    """Draw the time of each stage, and the memory, over the samples of a record."""
    found = figures['by_samples']
    with drawing(path, 1, len(found) + 1, size=(4.4 * (len(found) + 1), 4.6)) as (figure, panels):
        for axes, (case, rows) in zip(panels, found.items(), strict=False):
            _draw_times(axes, rows)
            axes.set_title(case, fontsize=10)
        axes = panels[-1]
        for case, rows in found.items():
            axes.plot([one['samples'] for one in rows], [one['peak_megabytes'] for one in rows],
                      'o-', label=case)
        first = next(iter(found.values()))[0]
        axes.axhline(first['start_megabytes'], color='0.5', ls='--', lw=1.0,
                     label='before it begins: Python with torch')
        highest = max(one['peak_megabytes'] for rows in found.values() for one in rows)
        axes.set(xscale='log', ylim=(0.0, 1.2 * highest), xlabel='samples of the record',
                 ylabel='peak memory [MB]')
        axes.set_title('memory', fontsize=10)
        axes.legend(fontsize=8, loc='lower right')
        legend(figure, panels[:1], len(_STAGES) + 1)
        machine = figures['machine']
        figure.suptitle(f'Retraining from long records ({machine["processor"]}, one thread)',
                        fontsize=11)


def _draw_times(axes: Axes, rows: Sequence[dict[str, Any]]) -> None:
    samples = np.array([one['samples'] for one in rows])
    for name, label in _STAGES.items():
        axes.plot(samples, [max(one['stages'].get(name, 0.0), 1e-2) for one in rows], 'o-',
                  color=_COLOURS[name], label=label)
    last = rows[-1]['stages']['reading']
    axes.plot(samples, last * samples / samples[-1], color='0.5', ls=':', lw=1.2,
              label='proportional to the samples')
    axes.set(xscale='log', yscale='log', xlabel='samples of the record',
             ylabel='processor time [s]')
