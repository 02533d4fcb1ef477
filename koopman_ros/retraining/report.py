# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Report of a retraining beside the model: figures as JSON, a page, a picture."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from koopman_ros.identification import fitted_starts, Identified, longest_step, Segments
from koopman_ros.identification.drift import Rate
from koopman_ros.lifting import Coordinates
from koopman_ros.reports import bullets, drawing, table, write_figures, write_page
from koopman_ros.retraining.lift import lifted_rate
from koopman_ros.retraining.task import CELLS, Retrained, visited_cells
from koopman_ros.units import shown, unit_label


def write_report(retrained: Retrained) -> list[Path]:
    """Write ``<output>.json``, ``.md`` and, with matplotlib, ``.png``; return what was written."""
    base = Path(retrained.task.output)
    picture = base.with_suffix('.png')
    drawn = _draw(picture, retrained)
    written = [write_figures(base.with_suffix('.json'), retrained.summary()),
               write_page(base.with_suffix('.md'), 'Retraining',
                          [*_sections(retrained),
                           f'![Data, drift and prediction]({picture.name})' if drawn else ''],
                          ('numpy', 'scipy', 'torch'))]
    return [*written, *([picture] if drawn else [])]


def _sections(retrained: Retrained) -> Iterator[str]:
    found, decision, trained = retrained.found, retrained.decision, retrained.trained
    unit, input_unit = retrained.present.states.units[0], retrained.present.inputs.units[0]
    yield f'**The new lift is {"accepted" if retrained.accepted else "refused"}.**'
    warnings = () if decision is None else decision.warnings
    yield bullets([*retrained.reasons, *(f'Beware: {warning}.' for warning in warnings)])
    if retrained.model_file:
        yield f'Model file: `{retrained.model_file}`'
    yield '## Data'
    yield bullets(map(str, retrained.task.bags))
    yield bullets([
        *retrained.account.lines(),
        f'{100.0 * retrained.coverage:.0f} % of the cells of the state-input box visited '
        f'({CELLS} along each)',
        f'noise from sample to sample: {found.noise[0]:.3g} {unit}',
        f'{len(found.fitted)} segments to estimate and learn from, '
        f'{len(found.held_out)} held out to judge by'])
    yield '## Estimates of the drift'
    yield (f'Taken: {found.method}, degree {found.drift.degree}; '
           f'B = {found.drift.input_matrix[0, 0]:.5g} {unit} per {input_unit} and time unit.')
    yield table(('degree', 'method', f'error on the segments to choose by [{unit}]'),
                ((score.degree, score.method, f'{score.rmse[0]:.5f}') for score in found.scores),
                (2,))
    if decision is None or trained is None:
        return
    yield '## On held-out segments'
    yield table(('prediction of the measurements by', f'root mean square error [{unit}]'),
                ((name, f'{rmse[0]:.5f}') for name, rmse in (
                    ('the new lift', decision.rmse),
                    ('the drift that it was learned from', decision.drift_rmse),
                    ('the present lift', decision.current_rmse),
                    ('the best linear model', decision.linear_rmse))), (1,))
    yield 'The noise of the measurements is part of each.'
    eigenvalues = ', '.join(f'{value:.3g}' for value in trained.model.eigenvalues)
    yield (f'Lift: n_z = {trained.model.n_z}, rw = {trained.figures.fit.rw:.2g}, condition number '
           f'{trained.figures.fit.cond:.3g}, eigenvalues {eigenvalues} '
           f'1/{trained.model.time_unit}. Closed loops on the estimated drift: {decision.arrived} '
           f'of {decision.loops} reach their set-point.')


def _label(signals: Coordinates) -> str:
    return f'{signals.names[0].replace("_", " ")} [{unit_label(signals.units[0])}]'


def _draw(path: Path, retrained: Retrained) -> bool:
    """Draw where the data lie, what was learned, and how it predicts; False without matplotlib."""
    try:
        with drawing(path, 1, 3, size=(15.0, 4.6)) as (figure, (left, middle, right)):
            _draw_coverage(left, retrained.found)
            _draw_drift(middle, retrained)
            _draw_prediction(right, retrained)
            word = 'accepted' if retrained.accepted else 'refused'
            figure.suptitle(f'Retraining: the new lift is {word}')
    except ImportError:
        return False
    return True


def _draw_coverage(axes: Any, found: Identified) -> None:
    box = found.drift.box
    episodes = [*found.fitted, *found.held_out]
    visited = np.full((CELLS, CELLS), np.nan)
    for i, j in visited_cells(episodes, box):
        visited[j, i] = 1.0
    edges = [shown(np.linspace(a.lower[0], a.upper[0], CELLS + 1), a.units[0])
             for a in (box.states, box.inputs)]
    axes.pcolormesh(*edges, visited, cmap='Greens', vmin=0.0, vmax=3.0)
    for episode in episodes:
        axes.plot(shown(episode.x[:, 0], box.states.units[0]),
                  shown(episode.inputs_at(episode.time)[:, 0], box.inputs.units[0]), '.',
                  markersize=1.0, color='tab:blue')
    axes.grid(False)  # the cells are one
    axes.set(xlabel=_label(box.states), ylabel=_label(box.inputs),
             title='where the measurements lie (visited cells in green)')


def _lifts(retrained: Retrained) -> list[tuple[str, Rate, str]]:
    """Return label, rate and colour of the present lift and of the new one, where there is one."""
    unit = retrained.present.seconds_per_time_unit
    new = [] if retrained.trained is None else [
        ('new lift', lifted_rate(retrained.trained.model, unit), 'tab:green')]
    return [('present lift', lifted_rate(retrained.present, unit), 'tab:red'), *new]


def _draw_drift(axes: Any, retrained: Retrained) -> None:
    found, current = retrained.found, retrained.present
    box = found.drift.box
    x = np.linspace(box.states.lower, box.states.upper, 200)
    u = np.broadcast_to(box.inputs.center, (len(x), 1))
    estimated = found.drift.rate(x, u)[:, 0]
    for name, rate, color in [*_lifts(retrained), ('best linear model', found.linear.rate, '0.5')]:
        axes.plot(shown(x[:, 0], box.states.units[0]), rate(x, u)[:, 0] - estimated,
                  color=color, label=name)
    axes.axhline(0.0, color='k', linestyle='--', linewidth=1.0,
                 label='estimated from the data')
    held = shown(float(u[0, 0]), box.inputs.units[0])
    axes.set(xlabel=_label(box.states),
             ylabel=f'difference of the rate [{box.states.units[0]}/{current.time_unit}]',
             title=f'rate at {held:.1f} {_label(box.inputs)}, less the estimate')
    axes.legend()


def _draw_prediction(axes: Any, retrained: Retrained) -> None:
    found, current, states = retrained.found, retrained.present, retrained.present.states
    episode = found.held_out[0]
    segments = Segments.of([episode], longest_step([episode]))
    minutes = np.concatenate(([0.0], np.cumsum(segments.steps[:, 0])))
    measured = segments.measured[:, 0]
    axes.plot(minutes[measured], shown(segments.x[measured, 0, 0], states.units[0]),
              '.', color='0.6', markersize=3.0, label='measured')
    for name, rate, color in _lifts(retrained):
        x0, _ = fitted_starts(rate, segments, found.drift.box.states.scale)
        path = segments.path(rate, x0)[:, 0, 0]
        axes.plot(minutes, shown(path, states.units[0]), color=color, label=name)
    axes.set(xlabel=f'time [{current.time_unit}]', ylabel=_label(states),
             title='prediction of a held-out segment')
    axes.legend()
