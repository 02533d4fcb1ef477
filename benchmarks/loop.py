# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The computing time of the law `mpc`, compared with do-mpc and casadi's SQP."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
import tempfile
from typing import Any

from benchmarks import pending, planning, process
from koopman_ros.core.plots import table

PACKAGES = ('numpy', 'scipy', 'daqp', 'casadi', 'do-mpc')
MEANING = {
    'plan_us': 'median and 99th percentile of processor time of the law mpc with 30 intervals, '
               'targets given, by lift; plan has those of the whole control step, too',
    'plan_ratio_to_do_mpc': 'how many times as long do-mpc takes (IPOPT, targets given, the '
                            'true equations), by lift',
    'plan_ratio_to_sqp': "the same of casadi's SQP, as generated C where there is a compiler",
    'pending_us': f'median processor time of the control step of {pending.PLANT} with 0 and with '
                  f'{pending.PENDING} commands on their way, in turns, by law',
    'pending_ratio': 'the latter by the former',
}


@dataclass(frozen=True)
class LoopPlan:
    """One extent of the measurements."""

    plans: int  #: timed plans with each lift
    compiled: bool  #: whether the other solvers are compiled


PLANS = {'quick': LoopPlan(80, False), 'default': LoopPlan(800, True)}


def measure(plan: LoopPlan, figures: dict[str, Any], folder: Path) -> Iterator[str]:
    """Measure the plans of the law, of do-mpc and of the SQP in turns."""
    figures['meaning'] = MEANING
    with tempfile.TemporaryDirectory() as name:
        yield _plans(figures, plan, Path(name))
        yield _pending(figures, plan, Path(name))


def _found(job: Any, *arguments: Any, folder: Path) -> dict[str, Any]:
    """Return the result of a job in a process with nothing else."""
    outcome = process.run(job, *arguments, folder=folder, megabytes=8e3)
    if outcome.failure:
        raise RuntimeError(f'{job.__module__} failed: {outcome.failure}')
    return {name: one for event in outcome.events for name, one in event.items()}


def _pending(figures: dict[str, Any], plan: LoopPlan, folder: Path) -> str:
    found = _found(pending.measure_pending, plan.plans, folder=folder)
    none, some = '0', str(pending.PENDING)
    figures.update(pending_us=found, pending_ratio={
        law: one[some] / one[none] for law, one in found.items()})
    return table(('step with', f'0 and {some} commands on their way [ms]', 'ratio'), [
        (law, f'{1e-3 * one[none]:.2f}, {1e-3 * one[some]:.2f}', f'{one[some] / one[none]:.2g}')
        for law, one in found.items()])


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
