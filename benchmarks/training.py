# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Training compared with other solvers and model classes: seconds to a given accuracy."""

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
from benchmarks.problems import build, PlanningCase, SYSTEMS
from koopman_ros.core.plots import drawing, legend, table
from koopman_ros.plants import describe
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
# torch imports the latter for L-BFGS and Adam.
_NEEDED = ('benchmarks.ipopt', 'torch._dynamo')
_SEED = 0
_HELD_OUT = 40  # episodes that no training has seen


@dataclass(frozen=True)
class TrainingPlan:
    """One extent of the comparison."""

    cases: tuple[tuple[int, int], ...]  #: (samples, hidden units), each for all systems
    limit: float  #: of a solver in a case, s
    build_limit: float  #: of building the problem of a solver, without imports, s
    megabytes: float  #: limit of the memory
    #: of a solver that takes no longer than four seconds, of which the middle one counts: a busy
    #: moment is long beside a short run
    runs: int
    systems: tuple[str, ...] = tuple(SYSTEMS)
    #: by their names in the study of other plants: those that whole models are learned of
    learned: tuple[str, ...] = ()


PLANS = {
    'quick': TrainingPlan(((300, 8),), 1.0, 10.0, 4e3, 1, learned=('two_tanks',)),
    'default': TrainingPlan(((300, 8), (2000, 8), (2000, 16), (2000, 32)), 20.0, 60.0, 8e3, 3,
                            learned=('two_tanks', 'van_der_pol', 'pendulum', 'reactor_saddle')),
}


def measure(plan: TrainingPlan, figures: dict[str, Any], folder: Path) -> Iterator[str]:
    """Compare the solvers, and draw rw over time."""
    figures['machine']['threads'] = 1
    figures.update(limit_seconds=plan.limit, cases=[],
                   clock='processor time of one thread; wall_seconds are those on the wall')
    outcomes: list[dict[str, process.ProcessResult]] = []  # by solver, for each case
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
                        found = process.ProcessResult(
                            (), f'left out, as N = {fewer}, {narrower} hidden units {reason}')
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
            for name in plan.learned:
                yield _models(figures, name, within)
        finally:
            _draw(folder / 'training.png', outcomes, figures)


def _solve(within: Callable[..., process.ProcessResult], plan: TrainingPlan, solver: str,
           case: PlanningCase, targets: list[float]) -> process.ProcessResult:
    """Run a solver on a case; where it is quick, as often as planned, and take the middle run."""
    outcomes: list[process.ProcessResult] = []
    while len(outcomes) < plan.runs:
        outcomes.append(within(solvers.solve, solver, case, targets, plan.limit, plan.build_limit))
        if _ended(outcomes[0]) + (outcomes[0].find('built') or 0.0) > _REPEATED:
            return outcomes[0]
    return sorted(outcomes, key=_ended)[plan.runs // 2]


def _tell(label: str) -> None:
    print(f'training: {label}', file=sys.stderr, flush=True)


def _ended(outcome: process.ProcessResult) -> float:
    ended = outcome.find('ended')
    return math.inf if ended is None else float(ended)


def _trace(outcome: process.ProcessResult) -> list[dict[str, float]]:
    return [event for event in outcome.events if 'rw' in event]


def _figures(system: str, outcomes: dict[str, process.ProcessResult]) -> dict[str, Any]:
    """Turn the messages of the solvers into times by target."""
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
        **{f'{solver}_build_seconds': built[solver] for solver in built
           if solver.startswith('ipopt')},
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


def _models(figures: dict[str, Any], name: str,
            within: Callable[..., process.ProcessResult]) -> str:
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


def _draw(path: Path, outcomes: list[dict[str, process.ProcessResult]], figures: dict[str, Any]
          ) -> None:
    """Draw rw over time for all solvers."""
    with drawing(path, 1, 2, size=(10.0, 5.0)) as (figure, axes):
        for ax, system in zip(axes, SYSTEMS, strict=False):
            of_system = [pair for pair in zip(figures['cases'], outcomes, strict=False)
                         if pair[0]['system'] == system]
            for case, found in sorted(of_system, key=lambda pair: (
                    pair[0]['samples'], pair[0]['hidden']) == _DRAWN)[-1:]:
                _draw_traces(ax, found, case)
        for solver, label in SOLVERS.items():
            axes[0].plot([], [], color=_COLOURS[solver], lw=_width(solver), label=label)
        legend(figure, axes[:1], len(SOLVERS))
        machine = figures['machine']
        figure.suptitle(
            f'Training: accuracy over time from the same start ({machine["processor"]}, one '
            f'thread, torch {machine["torch"]}, casadi {machine["casadi"]})', fontsize=11)


def _width(solver: str) -> float:
    return 2.6 if solver == 'ours' else 1.6


def _draw_traces(ax: Axes, outcomes: dict[str, process.ProcessResult],
                 case: dict[str, Any]) -> None:
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
