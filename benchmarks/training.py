# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Training beside other solvers: seconds to a given accuracy, and how the cost grows."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
import itertools
import math
from pathlib import Path
import sys
import tempfile
from typing import Any

from matplotlib.axes import Axes
import numpy as np

from benchmarks import process, solvers
from benchmarks.problems import build, Case, SYSTEMS
from koopman_ros.plants import describe
from koopman_ros.reports import drawing, legend, table
from studies.general.learners import LEARNERS
from studies.general.study import predicted
from studies.general.systems import CASES

PACKAGES = ('torch', 'casadi', 'numpy', 'pysindy')
TARGETS = {'1e-4': 1e-4, '1e-6': 1e-6, '1e-8': 1e-8}
# Three coordinates, the first of them the state, do not represent the reactor below 1e-8 or so.
NOT_ASKED = {'two-state example': (), 'one-state reactor': ('1e-8',)}
SOLVERS = {
    'ours': 'ours',
    'ipopt': 'IPOPT, expanded graph',
    'ipopt_compiled': 'IPOPT, compiled graph',
    'lbfgs': 'L-BFGS',
    'adam': 'Adam',
}
_COLOURS = {'ours': '#0b6e4f', 'ipopt': '#c8553d', 'ipopt_compiled': '#e8a33d',
            'lbfgs': '#3d5a98', 'adam': '#8d7aae'}
_DRAWN = (2000, 16)  # the case that is drawn
_FIRST = 1e-3  # s, the left end of the time axis
_REPEATED = 4.0  # s
_COST_LIMIT = 240.0  # s
# torch imports the latter for L-BFGS and Adam.
_NEEDED = ('benchmarks.ipopt', 'torch._dynamo')
_SEED = 0
_HELD_OUT = 40  # episodes that no training has seen


@dataclass(frozen=True)
class Plan:
    """One extent of the comparison."""

    cases: tuple[tuple[int, int], ...]  #: (samples, hidden units), each for all systems
    limit: float  #: of a solver in a case, s
    build_limit: float  #: of building what a solver solves, beside imports, s
    megabytes: float  #: limit of the memory
    #: of a solver that takes no longer than four seconds, of which the middle one counts: a busy
    #: moment is long beside a short run
    runs: int
    samples: tuple[int, ...]  #: N of the growth of the cost
    n_z: tuple[int, ...]  #: likewise
    n_x: tuple[int, ...]  #: likewise
    systems: tuple[str, ...] = tuple(SYSTEMS)
    #: by their names in the study of other plants: those that whole models are learned of
    learned: tuple[str, ...] = ()


PLANS = {
    'quick': Plan(((300, 8),), 1.0, 10.0, 4e3, 1, (1000, 10_000), (2, 3), (1, 2),
                  learned=('two_tanks',)),
    'default': Plan(((300, 8), (2000, 8), (2000, 16), (2000, 32)), 20.0, 60.0, 8e3, 3,
                    (1000, 10_000, 100_000, 1_000_000), (2, 3, 4, 5, 6, 7, 8), (1, 2, 3, 4),
                    learned=('two_tanks', 'van_der_pol', 'pendulum', 'reactor_saddle')),
}


def measure(plan: Plan, figures: dict[str, Any], folder: Path) -> Iterator[str]:
    """Compare the solvers, measure how our cost grows, and draw both."""
    figures['machine']['threads'] = 1
    figures.update(limit_seconds=plan.limit, cases=[],
                   clock='processor time of one thread; wall_seconds are those on the wall')
    outcomes: list[dict[str, process.Outcome]] = []  # by solver, for each case
    unbuilt: dict[str, tuple[int, int, str]] = {}  # samples, hidden units, reason, by solver
    with tempfile.TemporaryDirectory() as name:
        within = partial(process.run, folder=Path(name), megabytes=plan.megabytes, needed=_NEEDED)
        try:
            for system, (samples, hidden) in itertools.product(plan.systems, plan.cases):
                case = build(system, samples, hidden)
                outcomes.append({})
                for solver, label in SOLVERS.items():
                    _tell(f'{system}, N = {samples}, {hidden} hidden units: {label}')
                    fewer, narrower, reason = unbuilt.get(solver, (math.inf, math.inf, ''))
                    if fewer <= samples and narrower <= hidden:
                        found = process.Outcome((), f'left out, as N = {fewer}, {narrower} hidden '
                                                    f'units {reason}')
                    else:
                        found = _solve(within, plan, solver, case, [
                            TARGETS[name] for name in TARGETS if name not in NOT_ASKED[system]])
                        if found.find('built') is None:
                            unbuilt[solver] = samples, hidden, found.failure
                    outcomes[-1][solver] = found
                figures['cases'].append({
                    'system': system, 'samples': samples, 'hidden': hidden,
                    'parameters': case.layout.size, **_figures(system, outcomes[-1])})
                yield _table_of(figures['cases'][-1])
            # memory is measured in a fresh process each
            for n in plan.samples:
                _add_cost(figures, 'samples', {n: (n, 2, 3, 16)}, within)
            _add_cost(figures, 'n_z', {n: (2000, 1, n, 17) for n in plan.n_z}, within)
            _add_cost(figures, 'n_x', {n: (2000, n, n + 2, 16) for n in plan.n_x}, within)
            yield '\n\n'.join(_tables_of_cost(figures))
            for name in plan.learned:
                yield _models(figures, name, within)
        finally:
            _draw(folder / 'training.png', outcomes, figures)


def _solve(within: Callable[..., process.Outcome], plan: Plan, solver: str, case: Case,
           targets: list[float]) -> process.Outcome:
    """Run a solver on a case; where it is quick, as often as planned, and take the middle run."""
    outcomes: list[process.Outcome] = []
    while len(outcomes) < plan.runs:
        outcomes.append(within(solvers.solve, solver, case, targets, plan.limit, plan.build_limit))
        if _ended(outcomes[0]) + (outcomes[0].find('built') or 0.0) > _REPEATED:
            return outcomes[0]
    return sorted(outcomes, key=_ended)[plan.runs // 2]


def _tell(label: str) -> None:
    print(f'training: {label}', file=sys.stderr, flush=True)


def _ended(outcome: process.Outcome) -> float:
    ended = outcome.find('ended')
    return math.inf if ended is None else float(ended)


def _trace(outcome: process.Outcome) -> list[dict[str, float]]:
    return [event for event in outcome.events if 'rw' in event]


def _figures(system: str, outcomes: dict[str, process.Outcome]) -> dict[str, Any]:
    """Turn what the solvers have told into times by target."""
    def when(clock: str) -> dict[str, dict[str, float | None]]:
        return {name: {solver: next((event[clock] for event in _trace(outcome)
                                     if event['rw'] <= target), None)
                       for solver, outcome in outcomes.items()}
                for name, target in TARGETS.items()}

    seconds = when('seconds')
    built = {solver: outcome.find('built') for solver, outcome in outcomes.items()}
    with_build = {name: {solver: None if t is None else t + built[solver]
                         for solver, t in times.items()} for name, times in seconds.items()}
    return {
        'seconds': seconds,
        'ratio_to_ours': _ratios(seconds),
        'seconds_with_build': with_build,
        'ratio_to_ours_with_build': _ratios(with_build),
        'ipopt_build_seconds': built['ipopt'],
        'ipopt_compiled_build_seconds': built['ipopt_compiled'],
        'best_rw': {solver: min((event['rw'] for event in _trace(outcome)), default=None)
                    for solver, outcome in outcomes.items()},
        # where it is well above `seconds`, the machine was busy with something else
        'wall_seconds': when('wall'),
        'not_asked': list(NOT_ASKED[system]),
        'notes': {solver: note for solver, outcome in outcomes.items()
                  if (note := outcome.failure or outcome.find('end'))},
    }


def _ratios(seconds: dict[str, dict[str, float | None]]) -> dict[str, dict[str, float | None]]:
    return {name: {solver: None if t is None or not times['ours'] else t / times['ours']
                   for solver, t in times.items() if solver != 'ours'}
            for name, times in seconds.items()}


def _add_cost(figures: dict[str, Any], name: str, sizes: dict[int, tuple[int, int, int, int]],
              within: Callable[..., process.Outcome]) -> None:
    _tell(f'cost of an iteration by {name}')
    outcome = within(solvers.measure_cost, list(sizes.values()), _COST_LIMIT)
    found = [event for event in outcome.events if 'size' in event]
    if outcome.failure or len(found) < len(sizes):
        raise RuntimeError(f'the cost by {name} could not be measured: {outcome.failure}')
    for n, event in zip(sizes, found, strict=True):
        figures.setdefault(f'seconds_per_iteration_by_{name}', {})[str(n)] = event['seconds']
        if name == 'samples':
            figures.setdefault('peak_memory_by_samples', {})[str(n)] = event['megabytes']


def _models(figures: dict[str, Any], name: str, within: Callable[..., process.Outcome]) -> str:
    """Learn whole models of a plant by each class, SINDy of pysindy among them."""
    _tell(f'{name}: models of {len(LEARNERS)} classes')
    outcome = within(_learn, name)
    if outcome.failure:
        raise RuntimeError(f'the models of {name} could not be learned: {outcome.failure}')
    found = {label: one for event in outcome.events for label, one in event.items()}
    figures.setdefault('models', {})[name] = found
    return table((f'{name}: models', 'learned in [s]', 'relative error of the drift',
                  'roll-out, worst state [half ranges]'), [
        (label, f'{one["seconds"]:.3g}', f'{one["rx"]:.1e}',
         '-' if one['rollout'] is None else f'{one["rollout"]:.1e}')
        for label, one in found.items()])


def _learn(tell: process.Tell, name: str) -> None:
    case = CASES[name]
    plant, samples = describe(case.system), case.samples(_SEED)
    held_out = case.samples(_SEED + 1000, _HELD_OUT)
    # what is imported at the first use is not learning
    LEARNERS['SINDy-5'](plant, samples, _SEED)
    for label, learn in LEARNERS.items():
        tell({label: predicted(case, learn(plant, samples, _SEED), held_out)})


def _table_of(case: dict[str, Any]) -> str:
    """Write one case: seconds to each rw, and in brackets how many times ours that is."""
    def cell(name: str, solver: str) -> str:
        seconds, ratio = case['seconds'][name][solver], case['ratio_to_ours'][name].get(solver)
        return '-' if seconds is None else f'{seconds:.3g}' + (f' ({ratio:.1f})' if ratio else '')

    rows = [(label, *(cell(name, solver) for name in TARGETS),
             f'{case.get(f"{solver}_build_seconds") or 0.0:.1f}', case['notes'].get(solver, ''))
            for solver, label in SOLVERS.items()]
    return (f'{case["system"]}, N = {case["samples"]}, {case["hidden"]} hidden units, '
            f'{case["parameters"]} parameters: seconds to rw (times ours)\n\n'
            + table(('', *TARGETS, 'build [s]', ''), rows))


def _tables_of_cost(figures: dict[str, Any]) -> Iterator[str]:
    memory = figures['peak_memory_by_samples']
    for title, name in (('N (n_x = 2, n_z = 3, 16 hidden units)', 'samples'),
                        ('n_z (n_x = 1, 17 hidden units, N = 2000)', 'n_z'),
                        ('n_x (n_z = n_x + 2, 16 hidden units, N = 2000)', 'n_x')):
        peaks = memory if name == 'samples' else {}
        yield f'cost of an iteration by {title}\n\n' + table((name, 'ms', 'peak memory [MB]'), [
            (size, f'{1e3 * seconds:.3f}', f'{peaks[size]:.1f}' if peaks.get(size) else '-')
            for size, seconds in figures[f'seconds_per_iteration_by_{name}'].items()])


def _draw(path: Path, outcomes: list[dict[str, process.Outcome]], figures: dict[str, Any]
          ) -> None:
    """Draw rw over time for all solvers and the cost of an iteration, as far as there is any."""
    with drawing(path, 1, 3, size=(14.0, 5.0), width_ratios=(1.0, 1.0, 0.8)) as (figure, axes):
        for ax, system in zip(axes, SYSTEMS, strict=False):
            of_system = [pair for pair in zip(figures['cases'], outcomes, strict=False)
                         if pair[0]['system'] == system]
            for case, found in sorted(of_system, key=lambda pair: (
                    pair[0]['samples'], pair[0]['hidden']) == _DRAWN)[-1:]:
                _draw_traces(ax, found, case)
        if 'seconds_per_iteration_by_samples' in figures:
            _draw_cost(axes[2], figures)
        for solver, label in SOLVERS.items():
            axes[0].plot([], [], color=_COLOURS[solver], lw=_width(solver), label=label)
        legend(figure, axes[:1], len(SOLVERS))
        machine = figures['machine']
        figure.suptitle(
            f'Training: accuracy over time from the same start ({machine["processor"]}, one '
            f'thread, torch {machine["torch"]}, casadi {machine["casadi"]})', fontsize=11)


def _width(solver: str) -> float:
    return 2.6 if solver == 'ours' else 1.6


def _draw_traces(ax: Axes, outcomes: dict[str, process.Outcome], case: dict[str, Any]) -> None:
    last, built = _FIRST, 0
    for solver, outcome in outcomes.items():
        if not (trace := _trace(outcome)):
            continue
        # up to the end, where the solver may not have improved for a while
        seconds = [event['seconds'] for event in trace] + [
            outcome.find('ended') or trace[-1]['seconds']]
        rw = [event['rw'] for event in trace] + [trace[-1]['rw']]
        ax.plot(np.maximum(seconds, _FIRST), rw, color=_COLOURS[solver], lw=_width(solver),
                drawstyle='steps-post')
        last = max(last, seconds[-1])
        if build := case.get(f'{solver}_build_seconds'):
            # each above the one before, lest they end at the same place
            ax.annotate(f'+{build:.0f} s to build', (seconds[-1], rw[-1]),
                        xytext=(5, 10 * built - 3), textcoords='offset points', fontsize=8,
                        color=_COLOURS[solver])
            built += 1
    for name, target in TARGETS.items():
        if name not in case['not_asked']:
            ax.axhline(target, color='0.5', lw=0.9, ls=':', zorder=1)
    ax.set(xscale='log', yscale='log', xlim=(_FIRST, 25.0 * last), xlabel='time of one thread [s]',
           ylabel='relative residual rw on the training samples')
    ax.set_title(f'{case["system"]}: N = {case["samples"]}, n$_z$ = 3, {case["hidden"]} hidden '
                 'units', fontsize=10)


def _draw_cost(ax: Axes, figures: dict[str, Any]) -> None:
    by_samples = figures['seconds_per_iteration_by_samples']
    samples, seconds = np.array([int(n) for n in by_samples]), np.array(list(by_samples.values()))
    ax.plot(samples, seconds, 'o-', color=_COLOURS['ours'], lw=2.0,
            label='ours, with its peak memory beyond the data')
    ax.plot(samples, seconds[-1] * samples / samples[-1], color='0.5', lw=1.0, ls='--',
            label='proportional to N')
    for n, s in zip(samples, seconds, strict=True):
        if peak := figures['peak_memory_by_samples'][str(n)]:
            ax.annotate(f'{peak:.0f} MB', (n, s), xytext=(-8, 6), fontsize=8, ha='right',
                        textcoords='offset points', color='0.3')
    ax.legend(fontsize=8, loc='lower right')
    ax.set(xscale='log', yscale='log', xlim=(samples[0] / 8, samples[-1] * 3),
           ylim=(seconds[-1] * samples[0] / samples[-1] / 5, 3 * seconds[-1]),
           xlabel='samples N', ylabel='time of an iteration [s]')
    ax.set_title('a step of ours: n$_x$ = 2, n$_z$ = 3, 16 units', fontsize=10)
