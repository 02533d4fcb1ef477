# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The report on the experiments: the bounds for every seed, and tables."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from koopman_ros.core.plots import Picture, table
from studies import report
from studies.report import at, figures_table, rows_table, share, spread


@dataclass(frozen=True)
class Criterion:
    """A bound for every seed."""

    path: str  #: place of the list in the summary
    bound: float  #: largest value allowed
    offset: float = 0.0  #: subtracted first, 1 for ratios

    def met(self, summary: dict[str, Any]) -> tuple[int, int]:
        """Return how many seeds meet it, and of how many."""
        values = at(summary, self.path)
        return (sum(value is not None and value - self.offset <= self.bound for value in values),
                len(values))


TARGETS = (
    Criterion('two_state/rw', 1e-8),
    Criterion('two_state/eigenvalue_error', 1e-4),
    *(Criterion(f'two_state/cost_ratio_to_exact/R={R}', 1e-6, 1.0) for R in ('1', '0.1', '0.001')),
    *(Criterion(f'reactor/nz={n}/{name}', bounds[n - 2]) for name, bounds in (
        ('rw', (1e-4, 1e-6, 1e-7, 1e-7)), ('cond', (10.0, 10.0, 10.0, 10.0)),
        ('rollout_rmse_in_kelvin', (0.1, 0.005, 0.002, 0.002))) for n in (2, 3, 4, 5)),
    *(Criterion(f'reactor/nz={n}/tracking_offset_kelvin', 1e-3) for n in (3, 4, 5)),
    Criterion('sensors/noisy/rollout_kelvin', 0.05),
    Criterion('sensors/noisy/input_gain_error', 0.01),
    Criterion('sensors/noise_free/rollout_kelvin', 0.01),
    Criterion('sensors/drifted/offset_ratio', 0.05),
)
_REACTOR = {name: (name, spread) for name in (
    'rw', 'cond', 'rollout_rmse_in_kelvin', 'rollout_rmse_out_kelvin', 'tracking_offset_kelvin',
    'feed_forward_offset_kelvin', 'cost_ratio_to_optimum')}
_NARROW = {'rw_in': ('rw_in', spread), 'cost_ratio_to_exact': ('cost_ratio_to_exact', spread),
           'left_box': ('left_box', share), 'final_distance': ('final_distance', spread)}
_EXACT = {'rw': 'rw', 'cond': 'cond', 'eigenvalue error': 'eigenvalue_error', **{
    f'cost ratio to exact, {R}': f'cost_ratio_to_exact/{R}' for R in ('R=1', 'R=0.1', 'R=0.001')}}


def write_report(summary: dict[str, Any], pictures: Sequence[Picture], folder: Path) -> None:
    """Write the report on the content of ``summary.json``."""
    sections = {'scalar': _scalar, 'two_state': _two_state, 'reactor': _reactor,
                'narrow': _narrow, 'paper_algorithm': _paper, 'sensors': _sensors}
    title = 'Learning from a sensor' if 'sensors' in summary else 'The experiments of the paper'
    report.write(folder, title, [_bounds(summary), *(
        write(summary[name]) for name, write in sections.items() if name in summary)], pictures)


def _bounds(summary: dict[str, Any]) -> str:
    rows = []
    for target in TARGETS:
        if target.path.split('/')[0] in summary:
            met, count = target.met(summary)
            values = [v - target.offset for v in report.present(at(summary, target.path))]
            rows.append((f'`{target.path + " - 1" * bool(target.offset)}`', f'{target.bound:g}',
                         f'{max(values):.2g}' if values else '-', f'{met} of {count}'))
    return (
        f'{report.opening(summary)} Figures in tables are medians over the seeds with [smallest, '
        'largest], on fresh simulations. `rw` is the relative residual of the lifted dynamics in '
        "the lift's own metric, `cond` the condition number of E[z z'].\n\n"
        "## The bounds for every seed\n\n"
        + table(('figure', 'at most', 'worst seed', 'met'), rows))


def _scalar(part: dict[str, Any]) -> str:
    return '## Motivating example, dx/dt = x^2\n\n' + figures_table({
        'rw in [0, 5]': 'rw_in', 'rw in [5, 6]': 'rw_5_6', 'rw in [6, 8]': 'rw_6_8',
        'eigenvalue': 'eigenvalue'}, {'learned on [0, 5]': part}) + (
        '\n\nexp(-a/x) is an exact lift for every a > 0, with eigenvalue a.')


def _two_state(part: dict[str, Any]) -> str:
    labels = {**_EXACT, **{f'cost ratio of the linearised law, {R}': f'linear_cost_ratio/{R}'
                           for R in part['linear_cost_ratio']},
              'cost ratio of EDMD (degree 2), averaged law, R=1': 'edmd_cost_ratio/R=1'}
    return (f'## Two-state example\n\n{figures_table(labels, {"learned": part})}\n\n'
            f'The path left the training box in {share(part["left_box"])} seeds.')


def _reactor(part: Mapping[str, Any]) -> str:
    return f'## One-state reactor\n\n{rows_table("", part, _REACTOR)}'


def _narrow(part: Mapping[str, Any]) -> str:
    counts = ', '.join(
        f'{share([v is None or v > 1.01 for v in box["cost_ratio_to_exact"]])} on {name}'
        for name, box in part.items())
    return (f'## Narrow data\n\n{rows_table("box", part, _NARROW)}\n\n'
            f'Control failed or cost over 1 % more than the optimum in: {counts}.')


def _paper(part: dict[str, Any]) -> str:
    return '\n\n'.join([
        '## Algorithm 1 as printed',
        'One standard-normal start for each seed, lambda from 10 down, both termination criteria, '
        '100 steps of Levenberg-Marquardt in place of IPOPT.',
        *([rows_table('reactor', part['reactor'], _REACTOR)] if 'reactor' in part else []),
        *([figures_table(_EXACT, {'two-state example': part['two_state']})]
          if 'two_state' in part else [])])


def _sensors(part: dict[str, Any]) -> str:
    drifted, two = part['drifted'], part['two_state']
    return '\n\n'.join([
        '## An hour at 1 s, B unknown',
        figures_table({
            'roll-out over fresh random steps [K]': 'rollout_kelvin',
            'relative error of B': 'input_gain_error', 'rw': 'rw', 'cond': 'cond',
            'degree of the drift': 'degree', 'noise as estimated [K]': 'noise_kelvin'},
            {'noise of 0.1 K': part['noisy'], 'no noise': part['noise_free']}),
        '## A fouled cooling jacket',
        figures_table({
            'offset with the present lift [K]': 'offset_before_kelvin',
            'offset with the new lift [K]': 'offset_after_kelvin',
            'new over present': 'offset_ratio', 'roll-out [K]': 'rollout_kelvin',
            'relative error of B': 'input_gain_error'}, {'UA -20 %': drifted}),
        f'The gate accepted {share(drifted["accepted"])} new lifts.',
        '## One temperature of a reactor with two states',
        figures_table({
            'error on held-out measurements [K]': 'heldout_kelvin',
            'noise as estimated [K]': 'noise_kelvin',
            'error of the best linear model [K]': 'linear_kelvin',
            'roll-out over fresh random steps [K]': 'rollout_kelvin'}, {'temperature alone': two}),
        'The report said that a state is not measured in '
        f'{share(two["warned"])} seeds.'])
