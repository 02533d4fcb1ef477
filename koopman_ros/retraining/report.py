# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What a retraining leaves beside the model: figures, a page in words, a picture."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from koopman_ros.identification import Identified, longest_step, Stretches
from koopman_ros.identification.stretches import fitted_starts, Rate
from koopman_ros.reports import bullets, drawing, table, write_figures, write_page
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
    picture = base.with_suffix('.png')
    drawn = _draw(picture, outcome)
    written = [write_figures(base.with_suffix('.json'), outcome.summary()),
               write_page(base.with_suffix('.md'), 'Retraining',
                          [*_sections(outcome),
                           f'![Data, drift and prediction]({picture.name})' if drawn else ''],
                          ('numpy', 'scipy', 'torch'))]
    return [*written, *([picture] if drawn else [])]


def _sections(outcome: Outcome) -> Iterator[str]:
    found, verdict, trained = outcome.found, outcome.verdict, outcome.trained
    yield f'**The new lift is {"accepted" if outcome.accepted else "refused"}.**'
    warnings = () if verdict is None else verdict.warnings
    yield bullets([*outcome.reasons, *(f'Beware: {warning}.' for warning in warnings)])
    if outcome.model_file:
        yield f'Model file: `{outcome.model_file}`'
    yield '## Data'
    yield bullets(map(str, outcome.task.bags))
    yield bullets([
        *outcome.account.lines(),
        f'{100.0 * outcome.coverage:.0f} % of the cells of the state-input box visited '
        f'({CELLS} along each)',
        f'noise from sample to sample: {found.noise[0]:.3g} K',
        f'{len(found.fitted)} stretches to estimate and learn from, '
        f'{len(found.held_out)} held out to judge by'])
    yield '## Estimates of the drift'
    yield (f'Taken: {found.method}, degree {found.drift.degree}; '
           f'B = {found.drift.input_matrix[0, 0]:.5g} K per K and time unit.')
    yield table(('degree', 'method', 'error on the stretches to choose by [K]'),
                ((score.degree, score.method, f'{score.rmse[0]:.5f}') for score in found.scores),
                (2,))
    if verdict is None or trained is None:
        return
    yield '## On held-out stretches'
    yield table(('prediction of the measurements by', 'root mean square error [K]'),
                ((name, f'{rmse[0]:.5f}') for name, rmse in (
                    ('the new lift', verdict.rmse),
                    ('the drift that it was learned from', verdict.drift_rmse),
                    ('the present lift', verdict.current_rmse),
                    ('the best linear model', verdict.linear_rmse))), (1,))
    yield 'The noise of the measurements is part of each.'
    eigenvalues = ', '.join(f'{value:.3g}' for value in trained.model.eigenvalues)
    yield (f'Lift: n_z = {trained.model.n_z}, rw = {trained.report.fit.rw:.2g}, condition number '
           f'{trained.report.fit.cond:.3g}, eigenvalues {eigenvalues} '
           f'1/{trained.model.time_unit}. Closed loops on the estimated drift: {verdict.arrived} '
           f'of {verdict.loops} reach their set-point.')


def _draw(path: Path, outcome: Outcome) -> bool:
    """Draw where the data lie, what was learned, and how it predicts; False without matplotlib."""
    try:
        with drawing(path, 1, 3, size=(15.0, 4.6)) as (figure, (left, middle, right)):
            _draw_coverage(left, outcome.found)
            _draw_drift(middle, outcome)
            _draw_prediction(right, outcome)
            word = 'accepted' if outcome.accepted else 'refused'
            figure.suptitle(f'Retraining: the new lift is {word}')
    except ImportError:
        return False
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
    axes.grid(False)  # the cells are one
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
