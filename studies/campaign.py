# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Programs of the studies: their options, experiments from several seeds, and the summary."""

import argparse
from collections.abc import Callable, Iterable, Iterator, Mapping
import contextlib
from dataclasses import dataclass, field
import math
from pathlib import Path
import signal
import sys
import time
from typing import Any, TypeAlias, TypeVar

from tqdm import tqdm

from koopman_ros import __version__
from koopman_ros.core.plots import write_figures
from koopman_ros.execution import Backend, backend_of, Notify, SchedulerLost, Serial, WorkerLost
from koopman_ros.model import LiftedModel

Key = TypeVar('Key')
Found = TypeVar('Found')
# Figures by name; None where there is none, e.g. after a divergence.
Metrics: TypeAlias = dict[str, float | bool | dict[str, 'float | bool | None'] | None]
Models: TypeAlias = Mapping[str, LiftedModel]  # by name, for the figures
Experiment: TypeAlias = Callable[[int], tuple[Metrics, Models]]  # from a seed


def read_options(args: list[str] | None, module: str, description: str, output: str = '',
                 seeds: int = 0, scheduler: str | None = None, plants: Iterable[str] = (),
                 flags: Mapping[str, str] | None = None, records: str = ''
                 ) -> argparse.Namespace:
    """
    Read the options of a study or benchmark.

    :param output: default folder of the report; '' for no such option.
    :param seeds: default number of seeds, 0 for no such option.
    :param scheduler: default place of the runs, None for no such option.
    :param plants: plants to choose from.
    :param flags: further switches, with their help.
    :param records: default folder of measured records; '' for no such option.
    """
    parser = argparse.ArgumentParser(prog=f'python -m {module}', description=description)
    if plants:
        parser.add_argument('plants', nargs='*', metavar='plant',
                            help=f'which: {", ".join(plants)} (default: all)')
    if seeds:
        parser.add_argument('--seeds', type=int, default=seeds,
                            help='number of seeds, at least 1 (default: %(default)s)')
    if output:
        parser.add_argument('--output', type=Path, default=Path(output),
                            help='folder for the results (default: %(default)s)')
    if scheduler is not None:
        parser.add_argument(
            '--scheduler', default=scheduler, metavar='PLACE', help='place of the runs: joblib '
            'for a process on each core, joblib:N for N of them, tcp://... for the workers of a '
            'Dask scheduler, an empty text for this process (default: '
            f'{"%(default)s" if scheduler else "this process"})')
    if records:
        parser.add_argument('--records', type=Path, default=Path(records),
                            help='folder of the measured records (default: %(default)s)')
    for flag, text in (flags or {}).items():
        parser.add_argument(f'--{flag}', action='store_true', help=text)
    options = parser.parse_args(args)
    if getattr(options, 'seeds', 1) < 1:
        parser.error(f'--seeds is {options.seeds}, must be at least 1')
    if unknown := set(getattr(options, 'plants', ())) - set(plants):
        parser.error(f'there is no plant {", ".join(sorted(unknown))}: choose of '
                     f'{", ".join(plants)}')
    return options


def over(backend: Backend | None, function: Callable[[Key], Found], keys: Iterable[Key]
         ) -> dict[Key, Found]:
    """Return the results of a function by key; `backend` is this process by default."""
    by_name = {str(key): key for key in keys}
    return {by_name[name]: found for name, found in (backend or Serial()).run(
        _called, by_name, shared=function)}


def _called(function: Callable[[Key], Found], key: Key, _: Notify) -> Found:
    return function(key)


@dataclass
class Campaign:
    """The results of experiments so far."""

    #: figures by experiment and seed
    metrics: dict[str, dict[int, Metrics]] = field(default_factory=dict)
    #: learned models by experiment and seed, for the figures
    models: dict[str, dict[int, Models]] = field(default_factory=dict)
    errors: list[str] = field(default_factory=list)  #: one line for each run that failed
    complete: bool = False  #: whether every run was made

    def add(self, other: 'Campaign') -> None:
        """Add the results of other experiments."""
        self.metrics |= other.metrics
        self.models |= other.models
        self.errors = sorted(self.errors + other.errors)
        self.complete = self.complete and other.complete

    def summary(self) -> dict[str, Any]:
        """Nest the figures: experiment, its parts, then one list over the seeds."""
        nested: dict[str, Any] = {}
        for experiment, by_seed in self.metrics.items():
            seeds = sorted(by_seed)
            flat = {seed: dict(_flattened(by_seed[seed])) for seed in seeds}
            for name in dict.fromkeys(name for seed in seeds for name in flat[seed]):
                *path, last = f'{experiment}/{name}'.split('/')
                place = nested
                for part in path:
                    place = place.setdefault(part, {})
                place[last] = [flat[seed].get(name) for seed in seeds]
        return nested


def _flattened(metrics: Metrics) -> Iterator[tuple[str, float | bool | None]]:
    """Yield the figures with their paths; None for values that JSON cannot represent."""
    for name, value in metrics.items():
        for key, entry in (value.items() if isinstance(value, dict) else (('', value),)):
            yield (f'{name}/{key}' if key else name,
                   entry if entry is None or math.isfinite(entry) else None)


def run_campaign(seeds: int, experiments: Mapping[str, Experiment], scheduler: str = 'joblib'
                 ) -> Campaign:
    """
    Run every experiment for the seeds 0 ... `seeds` - 1; an interrupt keeps the finished runs.

    :param experiments: by the place of their figures in the summary.
    :param scheduler: place of the runs.
    """
    campaign = Campaign()
    # seed by seed, so that an interrupted campaign is whole for the first ones
    runs = {f'{name}, seed {seed}': (name, seed, experiments[name])
            for seed in range(seeds) for name in experiments}
    bar = tqdm(total=len(runs), unit='run', disable=not sys.stderr.isatty())
    try:
        with backend_of(scheduler) as backend, contextlib.closing(
                backend.run(_run, runs)) as finished:
            for number, (run, outcome) in enumerate(finished, 1):
                name, seed, _ = runs[run]
                if isinstance(outcome, str):
                    campaign.errors.append(f'{run}: {outcome}')
                else:
                    metrics, models = outcome
                    campaign.metrics.setdefault(name, {})[seed] = metrics
                    campaign.models.setdefault(name, {})[seed] = models
                bar.update()
                if bar.disable:
                    print(f'{number}/{len(runs)}: {run}' + ' failed' * isinstance(outcome, str),
                          file=sys.stderr, flush=True)
        campaign.complete = True
    except KeyboardInterrupt:
        print('interrupted: the finished runs are reported', file=sys.stderr)
    except (WorkerLost, SchedulerLost) as error:
        campaign.errors.append(str(error))
    finally:
        bar.close()
    campaign.errors.sort()
    return campaign


def _run(_: None, item: tuple[str, int, Experiment], __: Notify) -> tuple[Metrics, Models] | str:
    _name, seed, experiment = item
    try:
        return experiment(seed)
    except (ValueError, RuntimeError, ArithmeticError) as error:
        # a run that fails must not end the others
        return f'{type(error).__name__}: {error}'


def conclude(seeds: int, folder: Path, make: Callable[[], Campaign],
             report: Callable[[Campaign, dict[str, Any]], None]) -> int:
    """
    Run a campaign, write its summary and report, print its errors; return the exit status.

    :param make: runs the campaign.
    :param report: writes ``report.md`` and the figures of a summary.
    """
    # a request to end is an interrupt: the finished runs are reported
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    begin = time.monotonic()
    campaign = make()
    summary = {
        'package_version': __version__, 'seeds': seeds, 'complete': campaign.complete,
        'errors': campaign.errors, 'wall_seconds': round(time.monotonic() - begin, 1),
        **campaign.summary()}
    write_figures(folder / 'summary.json', summary)
    report(campaign, summary)
    for line in campaign.errors:
        print(f'failed: {line}', file=sys.stderr)
    print(f'wrote {folder}/report.md and summary.json in {time.monotonic() - begin:.0f} s')
    return 0 if campaign.complete and not campaign.errors else 1
