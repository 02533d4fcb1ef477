# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0


"""What a retraining leaves beside the model: figures, a page in words, a picture."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from koopman_ros.identification import Identified, longest_step, Stretches
from koopman_ros.identification.stretches import fitted_starts, Rate
from koopman_ros.retraining.coverage import CELLS, visited_cells
from koopman_ros.retraining.gate import lifted_rate
from koopman_ros.retraining.task import Outcome, ZERO_CELSIUS


def write_report(outcome: Outcome) -> list[Path]:
    """
    Write ``<output>.json``, ``<output>.md`` and, with matplotlib, ``<output>.png``.

    :param outcome: what to report.
    :return: what was written.
    """
    base = Path(outcome.task.output)
    written = [base.with_suffix('.json'), base.with_suffix('.md')]
    written[0].parent.mkdir(parents=True, exist_ok=True)
    written[0].write_text(
        json.dumps(outcome.summary(), indent=2, allow_nan=False) + '\n', encoding='utf-8')
    picture = base.with_suffix('.png')
    drawn = _draw(picture, outcome)
    written[1].write_text(_page(outcome, picture.name if drawn else ''), encoding='utf-8')
    return [*written, *([picture] if drawn else [])]


def _page(outcome: Outcome, picture: str) -> str:
    found, verdict, trained = outcome.found, outcome.verdict, outcome.trained
    lines = ['# Retraining', '',
             f'**The new lift is {"accepted" if outcome.accepted else "refused"}.**']
    lines += [f'- {reason}' for reason in outcome.reasons]
    if verdict is not None:
        lines += [f'- Beware: {warning}.' for warning in verdict.warnings]
    if outcome.model_file:
        lines += ['', f'Model file: `{outcome.model_file}`']
    lines += ['', '## Data', '', *(f'- {bag}' for bag in outcome.task.bags), '',
              *(f'- {line}' for line in outcome.account.lines()),
              f'- {100.0 * outcome.coverage:.0f} % of the cells of the state-input box visited '
              f'({CELLS} along each)',
              f'- noise from sample to sample: {found.noise[0]:.3g} K',
              f'- {len(found.fitted)} stretches to estimate and learn from, '
              f'{len(found.held_out)} held out to judge by']
    lines += ['', '## Estimates of the drift', '',
              f'Taken: {found.method}, degree {found.drift.degree}; '
              f'B = {found.drift.input_matrix[0, 0]:.5g} K per K and time unit.', '',
              '| degree | method | error on the stretches to choose by [K] |', '|---|---|---|']
    lines += [f'| {score.degree} | {score.method} | {score.rmse[0]:.5f} |'
              for score in found.scores]
    if verdict is not None and trained is not None:
        lines += ['', '## On held-out stretches', '',
                  '| prediction of the measurements by | root mean square error [K] |',
                  '|---|---|',
                  f'| the new lift | {verdict.rmse[0]:.5f} |',
                  f'| the drift that it was learned from | {verdict.drift_rmse[0]:.5f} |',
                  f'| the present lift | {verdict.current_rmse[0]:.5f} |',
                  f'| the best linear model | {verdict.linear_rmse[0]:.5f} |', '',
                  'The noise of the measurements is part of each.', '',
                  f'Lift: n_z = {trained.model.n_z}, rw = {trained.report.fit.rw:.2g}, '
                  f'condition number {trained.report.fit.cond:.3g}, eigenvalues '
                  + ', '.join(f'{value:.3g}' for value in trained.model.eigenvalues)
                  + f' 1/{trained.model.time_unit}.',
                  f'Closed loops on the estimated drift: {verdict.arrived} of {verdict.loops} '
                  'reach their set-point.']
    if picture:
        lines += ['', f'![Data, drift and prediction]({picture})']
    return '\n'.join(lines) + '\n'


def _draw(path: Path, outcome: Outcome) -> bool:
    """Draw where the data lie, what was learned, and how it predicts; False without matplotlib."""
    try:
        import matplotlib
        matplotlib.use('Agg')
        from matplotlib import pyplot
    except ImportError:
        return False
    found = outcome.found
    figure, (left, middle, right) = pyplot.subplots(1, 3, figsize=(15.0, 4.6),
                                                    layout='constrained')
    _draw_coverage(left, found)
    _draw_drift(middle, outcome)
    _draw_prediction(right, outcome)
    word = 'accepted' if outcome.accepted else 'refused'
    figure.suptitle(f'Retraining: the new lift is {word}')
    figure.savefig(path, dpi=120)
    pyplot.close(figure)
    return True


def _draw_coverage(axes: Any, found: Identified) -> None:
    box = found.drift.box
    records = [*found.fitted, *found.held_out]
    low = np.append(box.state_lower, box.input_lower) - ZERO_CELSIUS
    size = 2.0 * np.append(box.state_scale, box.input_scale) / CELLS
    visited = np.full((CELLS, CELLS), np.nan)
    for i, j in visited_cells(records, box):
        visited[j, i] = 1.0
    edges = [low[k] + size[k] * np.arange(CELLS + 1) for k in (0, 1)]
    axes.pcolormesh(*edges, visited, cmap='Greens', vmin=0.0, vmax=3.0)
    for record in records:
        axes.plot(record.x[:, 0] - ZERO_CELSIUS,
                  record.inputs_at(record.time)[:, 0] - ZERO_CELSIUS, '.', markersize=1.0,
                  color='tab:blue')
    axes.set(xlabel='temperature [°C]', ylabel='coolant [°C]',
             title='where the measurements lie (visited cells in green)')


def _draw_drift(axes: Any, outcome: Outcome) -> None:
    found, current = outcome.found, outcome.present
    box = found.drift.box
    x = np.linspace(box.state_lower, box.state_upper, 200)
    u = np.broadcast_to(0.5 * (box.input_lower + box.input_upper), (len(x), 1))
    unit = current.seconds_per_time_unit
    rates: list[tuple[str, Rate, str]] = [
        ('present lift', lifted_rate(current, unit), 'tab:red'),
        ('best linear model', found.linear.rate, '0.5')]
    if outcome.trained is not None:
        rates.append(('new lift', lifted_rate(outcome.trained.model, unit), 'tab:green'))
    estimated = found.drift.rate(x, u)[:, 0]
    for name, rate, color in rates:
        axes.plot(x[:, 0] - ZERO_CELSIUS, rate(x, u)[:, 0] - estimated,
                  color=color, label=name)
    axes.axhline(0.0, color='k', linestyle='--', linewidth=1.0,
                 label='estimated from the data')
    axes.set(xlabel='temperature [°C]',
             ylabel=f'difference of dT/dt [K/{current.time_unit}]',
             title=f'dT/dt at {u[0, 0] - ZERO_CELSIUS:.1f} °C of coolant, '
             'less the estimate')
    axes.legend()
    axes.grid(alpha=0.3)


def _draw_prediction(axes: Any, outcome: Outcome) -> None:
    found, current = outcome.found, outcome.present
    record = found.held_out[0]
    stretches = Stretches.of([record], longest_step([record]))
    minutes = np.concatenate(([0.0], np.cumsum(stretches.steps[:, 0])))
    measured = stretches.measured[:, 0]
    axes.plot(minutes[measured], stretches.x[measured, 0, 0] - ZERO_CELSIUS,
              '.', color='0.6', markersize=3.0, label='measured')
    unit = current.seconds_per_time_unit
    models = [('present lift', lifted_rate(current, unit), 'tab:red')]
    if outcome.trained is not None:
        models.append(('new lift', lifted_rate(outcome.trained.model, unit), 'tab:green'))
    for name, rate, color in models:
        x0, _ = fitted_starts(rate, stretches, found.drift.box.state_scale)
        path = stretches.path(rate, x0)[:, 0, 0]
        axes.plot(minutes, path - ZERO_CELSIUS, color=color, label=name)
    axes.set(xlabel=f'time [{current.time_unit}]', ylabel='temperature [°C]',
             title='prediction of a held-out stretch')
    axes.legend()
    axes.grid(alpha=0.3)
