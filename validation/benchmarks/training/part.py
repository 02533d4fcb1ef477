# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The part *training* of the benchmark: the loop over its measurements."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
import itertools
import math
import os
from pathlib import Path
import tempfile
from typing import Any

from koopman_ros.reports import machine
from validation.benchmarks.options import Options, say, tell
from validation.benchmarks.training import picture, process, table
from validation.benchmarks.training.plan import (
    Plan,
    PLANS,
    REPEATED,
    sizes_of_cost,
    SOLVERS,
    SYSTEMS,
    TARGETS,
)

# (seconds, rw) of each solver in each case (system, samples, hidden)
Traces = dict[tuple[str, int, int], dict[str, list[tuple[float, float]]]]


@dataclass
class _Comparison:
    """The state of a run."""

    plan: Plan  #: what is measured
    folder: Path  #: for the cases' files
    traces: Traces = field(default_factory=dict)  #: what each solver had reached when
    #: (samples, hidden, reason) of a solver whose graph could not be built
    unbuilt: dict[str, tuple[int, int, str]] = field(default_factory=dict)

    def case(self, system: str, samples: int, hidden: int, begin: Callable[[str], None]
             ) -> dict[str, Any]:
        """Run all solvers on one case."""
        path = self.folder / 'case.npz'
        prepared = process.run(
            {'do': 'prepare', 'system': system, 'samples': samples, 'hidden': hidden,
             'path': str(path)}, build_limit=60.0, limit=10.0, megabytes=self.plan.megabytes)
        if prepared.failure:
            raise RuntimeError(f'the start for {system} could not be built: {prepared.failure}')
        outcomes = {}
        for solver in SOLVERS:
            begin(f'{system}, N = {samples}, {hidden} hidden units: {SOLVERS[solver]}')
            outcomes[solver] = self._solve(solver, path, system, samples, hidden)
        self.traces[system, samples, hidden] = {
            solver: _drawn(outcome) for solver, outcome in outcomes.items()}
        return {'system': system, 'samples': samples, 'hidden': hidden,
                'parameters': prepared.find('parameters'), **_figures(system, outcomes)}

    def _solve(self, solver: str, path: Path, system: str, samples: int, hidden: int
               ) -> process.Outcome:
        if solver in self.unbuilt:
            fewer, narrower, reason = self.unbuilt[solver]
            if fewer <= samples and narrower <= hidden:
                return process.Outcome((), f'left out, as N = {fewer}, {narrower} hidden units '
                                           f'{reason}')
        plan = self.plan

        def once() -> process.Outcome:
            return process.run(
                {'do': 'solve', 'solver': solver, 'path': str(path), 'limit': plan.limit,
                 'targets': [TARGETS[name] for name in SYSTEMS[system]]},
                build_limit=plan.build_limit, limit=plan.limit, megabytes=plan.megabytes)

        outcome = once()
        if outcome.find('built') is None:
            self.unbuilt[solver] = samples, hidden, outcome.failure
            return outcome
        ended = outcome.find('ended')
        if ended is None or ended + outcome.find('built') > REPEATED:
            return outcome
        outcomes = [outcome, *(once() for _ in range(1, plan.runs))]
        return sorted(outcomes, key=lambda one: one.find('ended') or math.inf)[plan.runs // 2]


def run(options: Options) -> dict[str, Any]:
    """Compare the solvers, measure how our cost grows, and draw both."""
    plan = PLANS[options.extent]
    if options.limit is not None:
        plan = replace(plan, limit=options.limit)
    cases = [(system, *size) for system in SYSTEMS for size in plan.cases]
    costs = sizes_of_cost(plan)
    figures: dict[str, Any] = {
        'machine': {**machine('torch', 'casadi', 'numpy'), 'threads': 1},
        'extent': options.extent.value, 'limit_seconds': plan.limit,
        'clock': 'processor time of one thread; wall_seconds are those on the wall', 'cases': []}
    total = len(cases) * len(SOLVERS) + len(plan.samples) + 2
    steps = itertools.count(1)

    def begin(label: str) -> None:
        tell(f'training [{next(steps)}/{total}]: {label}')

    with tempfile.TemporaryDirectory() as folder:
        comparison = _Comparison(plan, Path(folder))
        try:
            for system, samples, hidden in cases:
                case = comparison.case(system, samples, hidden, begin)
                figures['cases'].append(case)
                options.save(figures)
                say(table.of_case(case))
            for name, sizes in costs.items():
                # memory is measured in a fresh process each
                for group in ([[size] for size in sizes] if name == 'samples' else [sizes]):
                    begin(f'cost of an iteration by {name}')
                    figures = _with_cost(figures, name, group, plan)
                    options.save(figures)
            say(table.of_cost(figures))
        finally:
            picture.draw(options.output / 'training.png', comparison.traces, figures)
    figures['machine']['load_at_end'] = os.getloadavg()[0]
    return figures


def _figures(system: str, outcomes: dict[str, process.Outcome]) -> dict[str, Any]:
    """Turn what the solvers have noted into times by target."""
    seconds, wall, with_build = {}, {}, {}
    built = {solver: outcome.find('built') for solver, outcome in outcomes.items()}
    for name, target in TARGETS.items():
        times = {solver: _when(outcome, target, 'seconds')
                 for solver, outcome in outcomes.items()}
        seconds[name] = times
        wall[name] = {solver: _when(outcome, target, 'wall')
                      for solver, outcome in outcomes.items()}
        with_build[name] = {solver: None if t is None else t + built[solver]
                            for solver, t in times.items()}
    notes = {solver: outcome.failure or outcome.find('end')
             for solver, outcome in outcomes.items()}
    return {
        'seconds': seconds,
        'ratio_to_ours': {name: _ratios(times) for name, times in seconds.items()},
        'seconds_with_build': with_build,
        'ratio_to_ours_with_build': {name: _ratios(times) for name, times in with_build.items()},
        'ipopt_build_seconds': built['ipopt'],
        'ipopt_compiled_build_seconds': built['ipopt_compiled'],
        'best_rw': {solver: min((rw for _, rw in _trace(outcome)), default=None)
                    for solver, outcome in outcomes.items()},
        # where it is well above `seconds`, the machine was busy with something else
        'wall_seconds': wall,
        'not_asked': [name for name in TARGETS if name not in SYSTEMS[system]],
        'notes': {solver: note for solver, note in notes.items() if note},
    }


def _when(outcome: process.Outcome, target: float, clock: str) -> float | None:
    return next((event[clock] for event in outcome.events
                 if 'rw' in event and event['rw'] <= target), None)


def _trace(outcome: process.Outcome) -> list[tuple[float, float]]:
    return [(event['seconds'], event['rw']) for event in outcome.events if 'rw' in event]


def _drawn(outcome: process.Outcome) -> list[tuple[float, float]]:
    """Return the trace up to the end, where the solver may not have improved for a while."""
    trace, ended = _trace(outcome), outcome.find('ended')
    return trace if not trace or ended is None else [*trace, (ended, trace[-1][1])]


def _ratios(times: dict[str, float | None]) -> dict[str, float | None]:
    ours = times['ours']
    return {solver: None if t is None or not ours else t / ours
            for solver, t in times.items() if solver != 'ours'}


def _with_cost(figures: dict[str, Any], name: str, sizes: list[dict[str, int]], plan: Plan
               ) -> dict[str, Any]:
    outcome = process.run({'do': 'measure', 'sizes': sizes}, build_limit=120.0, limit=120.0,
                          megabytes=plan.megabytes)
    if outcome.failure:
        raise RuntimeError(f'the cost by {name} could not be measured: {outcome.failure}')
    key = f'seconds_per_iteration_by_{name}'
    figures = {**figures, key: {**figures.get(key, {}), **{
        str(event[name]): event['seconds_per_iteration'] for event in outcome.events}}}
    if name == 'samples':
        key = 'peak_memory_by_samples'
        figures[key] = {**figures.get(key, {}), **{
            str(event[name]): event['peak_megabytes'] for event in outcome.events}}
    return figures
