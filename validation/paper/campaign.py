# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""All experiments over a number of seeds, side by side on the cores of the machine."""

from collections.abc import Callable, Iterator, Mapping
import contextlib
from dataclasses import dataclass, field
import math
from pathlib import Path
import sys
import time
from typing import Any, TypeAlias

from tqdm import tqdm

from koopman_ros import __version__
from koopman_ros.control import ClosedLoop
from koopman_ros.execution import backend_of, SchedulerLost, Tell, WorkerLost
from koopman_ros.lifting import LiftedModel
from koopman_ros.reports import write_figures
from validation.paper import reactor, scalar, sensors, two_state
from validation.paper.datasets import Metrics, Models

# What is run for a seed.
Experiment: TypeAlias = Callable[[int], tuple[Metrics, Models]]
# Each experiment with the place of its figures in the summary; the slow ones first.
EXPERIMENTS: dict[str, Experiment] = {
    'reactor': reactor.run,
    'two_state': two_state.run,
    'narrow': two_state.run_narrow,
    'paper_algorithm/reactor': reactor.run_paper,
    'paper_algorithm/two_state': two_state.run_paper,
    'scalar': scalar.run,
}
# The same for what the paper leaves open: data from a sensor.
SENSOR_EXPERIMENTS: dict[str, Experiment] = {
    'sensors/drifted': sensors.run_drifted,
    'sensors/noisy': sensors.run_noisy,
    'sensors/noise_free': sensors.run_noise_free,
    'sensors/two_state': sensors.run_two_state,
}


@dataclass
class Campaign:
    """What has been computed so far."""

    #: figures by experiment and seed
    metrics: dict[str, dict[int, Metrics]] = field(default_factory=dict)
    #: learned models by experiment and seed, for the figures
    models: dict[str, dict[int, Mapping[str, LiftedModel]]] = field(default_factory=dict)
    errors: list[str] = field(default_factory=list)  #: one line for each run that failed
    complete: bool = False  #: whether every run was made
    #: closed loops of models, by the identity of the model
    loops: dict[int, ClosedLoop] = field(default_factory=dict)

    def add(self, other: 'Campaign') -> None:
        """Take in what other experiments found."""
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
            names = dict.fromkeys(name for seed in seeds for name in flat[seed])
            for name in names:
                *path, last = f'{experiment}/{name}'.split('/')
                place = nested
                for part in path:
                    place = place.setdefault(part, {})
                place[last] = [flat[seed].get(name) for seed in seeds]
        return nested


def run_campaign(seeds: int, experiments: Mapping[str, Experiment] | None = None,
                 scheduler: str = 'joblib') -> Campaign:
    """
    Run every experiment for the seeds 0 ... `seeds` - 1; an interrupt keeps what is done.

    :param experiments: by the place of their figures in the summary; the paper's by default.
    :param scheduler: where the runs go, see :func:`~koopman_ros.execution.backend_of`.
    """
    experiments = EXPERIMENTS if experiments is None else experiments
    campaign = Campaign()
    # seed by seed, so that an interrupted campaign is whole for the first ones
    runs = {f'{name}, seed {seed}': (name, seed, experiments[name])
            for seed in range(seeds) for name in experiments}
    bar = tqdm(total=len(runs), unit='run', disable=not sys.stderr.isatty())
    try:
        with backend_of(scheduler) as backend, contextlib.closing(
                backend.run(_run, runs)) as finished:
            for number, (run, outcome) in enumerate(finished, 1):
                text = _noted(campaign, *runs[run][:2], outcome)
                bar.set_postfix_str(run + text, refresh=False)
                bar.update()
                if bar.disable:
                    print(f'{number}/{len(runs)}: {run}{text}', file=sys.stderr, flush=True)
        campaign.complete = True
    except KeyboardInterrupt:
        print('interrupted: reporting on what is done', file=sys.stderr)
    except (WorkerLost, SchedulerLost) as error:
        campaign.errors.append(str(error))
    finally:
        bar.close()
    campaign.errors.sort()
    return campaign


def conclude(campaign: Campaign, seeds: int, begin: float, folder: Path,
             report: Callable[[dict[str, Any]], str]) -> int:
    """
    Write what a campaign of so many seeds found, tell what failed, and return the exit status.

    :param begin: when it began, by ``time.monotonic()``.
    :param report: writes ``report.md`` and figures of a summary; returns how many these are.
    """
    summary = {
        'package_version': __version__, 'seeds': seeds, 'complete': campaign.complete,
        'errors': campaign.errors, 'wall_seconds': round(time.monotonic() - begin, 1),
        **campaign.summary()}
    write_figures(folder / 'summary.json', summary)
    figures = report(summary)
    for line in campaign.errors:
        print(f'failed: {line}', file=sys.stderr)
    print(f'wrote {folder}/report.md, summary.json and {figures} in '
          f'{time.monotonic() - begin:.0f} s')
    return 0 if campaign.complete and not campaign.errors else 1


def _noted(campaign: Campaign, name: str, seed: int, outcome: tuple[Metrics, Models] | str
           ) -> str:
    """Note what a run has found, and return what is told of it."""
    if isinstance(outcome, str):
        campaign.errors.append(f'{name}, seed {seed}: {outcome}')
        return ' failed'
    metrics, models = outcome
    campaign.metrics.setdefault(name, {})[seed] = metrics
    campaign.models.setdefault(name, {})[seed] = models
    rw = [value for figure, value in metrics.items()
          if figure.split('/')[-1] in ('rw', 'rw_in') and isinstance(value, float)]
    return f', rw {min(rw):.1e}' if rw else ''


def _run(_: None, item: tuple[str, int, Experiment], __: Tell) -> tuple[Metrics, Models] | str:
    _name, seed, experiment = item
    try:
        return experiment(seed)
    except (ValueError, RuntimeError, ArithmeticError) as error:
        # one run that fails must not take the others with it
        return f'{type(error).__name__}: {error}'


def _flattened(metrics: Metrics) -> Iterator[tuple[str, float | bool | None]]:
    """Yield the figures with their paths; None for what JSON cannot hold."""
    for name, value in metrics.items():
        for key, entry in (value.items() if isinstance(value, dict) else (('', value),)):
            yield (f'{name}/{key}' if key else name,
                   entry if entry is None or math.isfinite(entry) else None)
