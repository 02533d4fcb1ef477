# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The table of all controllers on all plants, and a picture of the first seed."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from koopman_ros.core.plots import draw_limits, drawing, legend, Picture, table
from studies.partly_measured.cases import PartialCase
from studies.partly_measured.study import ComparedFigures, ComparedRun

# By plant and controller, one for each seed.
Found = Mapping[str, Mapping[str, Sequence[tuple[ComparedRun, ComparedFigures]]]]
_HEAD = ('plant', 'controller', 'cost / least', 'worst', 'offset', 'offset under load',
         'farthest under load', 'above the limit', 'not held', 'step, median [ms]', '99 % [ms]')
# The others lie upon one of these.
DRAWN = ('do-mpc with its MHE', 'LQG at the set-point', '`sdre`, lift', '`mpc`, lift')


def figures_of(runs: Sequence[tuple[ComparedRun, ComparedFigures]]) -> dict[str, Any]:
    """Return the figures of a controller on a plant, all and in short."""
    judged = [one for _, one in runs]
    steps = np.concatenate([run.step_us for run, _ in runs])
    median, p99 = np.percentile(steps, (50, 99))
    return {
        'cost': [one.cost for one in judged], 'cost_mean': float(np.mean(
            [one.cost for one in judged])),
        'cost_worst': max(one.cost for one in judged),
        'offset': max(one.offsets[0] for one in judged),
        'offset_under_load': max(one.offsets[1] for one in judged),
        'farthest_under_load': max(one.farthest for one in judged),
        'violation': max(one.violation for one in judged),
        'lost': sum(one.lost for one in judged), 'runs': len(judged),
        'step_median_ms': 1e-3 * float(median), 'step_p99_ms': 1e-3 * float(p99)}


def table_of(summary: Mapping[str, Mapping[str, Mapping[str, Any]]],
             cases: Mapping[str, PartialCase]) -> str:
    """Return the table of :func:`figures_of` by plant and controller."""
    rows = []
    for plant, contenders in summary.items():
        case = cases[plant]
        factor, shown = (1e3, 'mm') if case.unit == 'm' else (1.0, case.unit)
        for name, found in contenders.items():
            rows.append([
                plant, name, f'{found["cost_mean"]:.3f}', f'{found["cost_worst"]:.3f}',
                *(f'{factor * found[figure]:.2g} {shown}'
                  for figure in ('offset', 'offset_under_load', 'farthest_under_load')),
                f'{found["violation"]:.2g} {case.unit}' if len(case.state_upper) else '',
                f'{found["lost"]} of {found["runs"]}',
                f'{found["step_median_ms"]:.2f}', f'{found["step_p99_ms"]:.2f}'])
    return table(_HEAD, rows, range(2, len(_HEAD)))


def draw(found: Found, cases: Mapping[str, PartialCase], path: Path) -> Picture:
    """Draw some of the first seed: a state with a set-point above, an input below, by plant."""
    with drawing(path, 2, len(found), size=(4.2 * len(found), 6.4), sharex='col') as (
            figure, axes):
        for column, (plant, contenders) in enumerate(found.items()):
            case, (above, below) = cases[plant], (axes[column], axes[column + len(found)])
            system, name = case.system, case.shown
            i, j = system.state_names.index(name), int(np.argmax(np.abs(case.load)))
            for number, contender in enumerate(DRAWN):
                run, color = contenders[contender][0][0], f'C{number}'
                label = contender.replace('`', '')
                above.plot(run.times, run.states[:, i], label=label, color=color, linewidth=1.1)
                below.step(run.times, run.commands[:, j], where='post', label=label, color=color,
                           linewidth=1.1)
            above.plot([0.0, case.stepped_at, case.stepped_at, case.duration],
                       [case.begin[name]] * 2 + [case.setpoint[name]] * 2, '--', color='0.3',
                       linewidth=0.8, label='set-point')
            if len(case.state_upper) and np.isfinite(case.state_upper[i]):
                draw_limits(above, [case.state_upper[i]], 'limit')
            draw_limits(below, [case.lower[j], case.upper[j]], 'limit')
            for axis in (above, below):
                axis.axvline(case.loaded_at, color='0.6', linewidth=0.8, label='load begins')
            above.set(title=plant, ylabel=f'{name} [{system.state_units[i]}]')
            below.set(xlabel='time [s]',
                      ylabel=f'{system.input_names[j]} [{system.input_units[j]}]')
        legend(figure, axes, 5)
    return Picture(path.name, 'Controllers on plants measured in part. The first seed; the load '
                   'is added to the input that is shown. The others lie upon one of these, '
                   'or near it, and are left out.')
