# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Report of a retraining, written next to the model: figures as JSON, a page, a plot."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from koopman_ros.core.plots import (
    axis_label,
    bullets,
    drawing,
    table,
    time_axis,
    write_figures,
    write_page,
    zoom,
)
from koopman_ros.core.units import printed, SECONDS_PER_TIME_UNIT, shown
from koopman_ros.evaluation.closed_loop_plots import draw_loops
from koopman_ros.learning.acceptance import PlantAcceptance
from koopman_ros.learning.downsampling import CELLS, visited_cells
from koopman_ros.learning.identification import fitted_starts, Identified, longest_step, Segments
from koopman_ros.learning.identification.drift import Rate
from koopman_ros.learning.lift.metrics import lifted_rate
from koopman_ros.learning.training_result import TrainingResult
from koopman_ros.model import Coordinates, RateBand
from koopman_ros.model_classes import BEST


def write_report(retrained: TrainingResult, *, pictures: bool = True) -> list[Path]:
    """
    Write ``<output>.json``, ``.md`` and, with matplotlib, pictures; return the files.

    The pictures are ``.png``, and ``.free_run.png`` and ``.test.png`` of free runs.
    """
    base = Path(retrained.task.output)
    files = {'Data, drift and prediction': base.with_suffix('.png')}
    drawn = pictures and _draw(files['Data, drift and prediction'], retrained)
    for name, run in retrained.free_runs.items() if drawn else ():
        path = base.with_suffix('.free_run.png' if name == 'record' else f'.{name}.png')
        title = f'Free run on the {name} {run.plant.name}'.replace('test', 'test record', 1)
        run.draw(path, f'{title}: the new model is {retrained.verdict}')
        files[title] = path
    written = [write_figures(base.with_suffix('.json'), retrained.summary()),
               write_page(base.with_suffix('.md'), _title(retrained),
                          [*_sections(retrained),
                           *(f'![{title}]({path.name})' for title, path in files.items()
                             if drawn)],
                          ('numpy', 'scipy', 'torch'))]
    return [*written, *(files.values() if drawn else [])]


def reported(retrained: TrainingResult) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Write the report; return the summary, with a warning where that failed, and the files."""
    warnings = list(retrained.warnings)
    files: tuple[str, ...] = ()
    try:
        files = tuple(map(str, write_report(retrained)))
    except OSError as error:
        # the lift is written already
        warnings.append(f'the report could not be written: {error}')
    return {**retrained.summary(), 'warnings': warnings}, files


def _title(retrained: TrainingResult) -> str:
    """Name the training by its plant and record."""
    kind = 'Training' if retrained.present is None else 'Retraining'
    names = [Path(one).name for one in map(str, retrained.task.bags)]
    return f'{kind} of {retrained.task.plant or "the plant"}' + (
        f' from {names[0]}' if len(names) == 1 else f' from {len(names)} records' if names else '')


def _sections(retrained: TrainingResult) -> Iterator[str]:
    found, decision, learned = retrained.found, retrained.decision, retrained.learned
    states, inputs = found.drift.box.states, found.drift.box.inputs
    errors = tuple(f'error of {name} [{unit}]'
                   for name, unit in zip(states.names, states.units, strict=True))
    kind = '' if learned is None else f' ({learned.model.kind})'
    yield f'**The new model{kind} is {retrained.verdict}.**'
    yield bullets([*retrained.reasons, *(f'Warning: {one}.' for one in retrained.warnings)])
    if retrained.model_file:
        yield f'Model file: `{retrained.model_file}`'
    if retrained.alternative_files:
        yield 'Models of other drifts that explain the record equally well: ' + ', '.join(
            f'`{file}`' for file in retrained.alternative_files)
    yield '## Data'
    yield bullets(map(str, retrained.task.bags))
    yield bullets([
        *retrained.account.lines(),
        *([] if retrained.reduction is None else [retrained.reduction.text()]),
        *(f'{100.0 * share:.0f} % of the cells of {first} and {second} visited ({CELLS} along '
          'each)' for (first, second), share in retrained.coverage.items()),
        *(f'noise of {name} from sample to sample: {noise:.3g} {unit}' for name, noise, unit in
          zip(states.names, found.noise, states.units, strict=True)),
        *(f'{what} of {name}: {seconds:.4g} s' for what, values in (
            ('dead time', retrained.dead_time), ('lag', retrained.lag))
          for name, seconds in zip(inputs.names, values.tolist(), strict=True)),
        *(f'characteristic of {name}: {one}' for name, one in
          found.drift.characteristics.items()),
        f'{len(found.fitted)} segments for training, {len(found.held_out)} held out for testing'])
    yield '## Estimates of the drift'
    yield (f'Selected: {found.method}, {found.drift.form}, with the input matrix B'
           + ', which depends on the states, in the middle of the range'
           * found.drift.varying_input_matrix)
    yield table(('per second by', *(f'{name} [1/({unit})]' for name, unit in
                                    zip(inputs.names, inputs.units, strict=True))),
                ((f'{name} [{unit}]', *(f'{gain:.5g}' for gain in row)) for name, unit, row in zip(
                    states.names, states.units,
                    found.drift.input_matrix / SECONDS_PER_TIME_UNIT[retrained.plant.time_unit],
                    strict=True)), range(1, 1 + len(inputs)))
    if found.constants:
        yield 'Constants, with the standard errors of their estimates:'
        yield table(('constant', 'unit', 'estimate', 'standard error', 'searched in', ''),
                    ((one.name, one.unit, f'{one.value:.6g}', f'{one.standard_error:.2g}',
                      f'{one.lower:.6g} to {one.upper:.6g}', one.standing.value)
                     for one in found.constants), (2, 3))
    yield ('Errors on the selection segments, of the predicted next measurement:'
           if found.constants else 'Errors of simulations, at samples left out of the fit:'
           if len(found.free_run) else 'Errors on the selection segments:')
    yield table(('degree', 'method', *errors),
                (('' if score.degree is None else score.degree, score.method,
                  *(f'{error:.5g}' for error in score.rmse),
                  *[''] * (len(states) - len(score.rmse)))
                 for score in found.scores), range(2, 2 + len(states)))
    yield bullets(found.steps)
    if learned is None:
        return
    yield '## Classes of models'
    by_rule = retrained.task.model_class == BEST
    yield ('Selected: the simplest accepted class whose error beyond the noise is at most twice '
           'the smallest; differences within chance count as equal.' if by_rule
           else 'The class given by model_class.')
    yield str(learned)
    yield ('rx is the relative mean-square difference from the estimated drift; roll-outs are '
           'simulations of the held-out measurements, including their noise; errors beyond the '
           'noise are mean squares relative to the range.')
    if decision is None:
        return
    yield '## On held-out segments'
    yield 'Root mean square errors of predictions of the measurements:'
    yield table(('prediction by', *errors),
                ((name, *(f'{error:.5g}' for error in rmse)) for name, rmse in (
                    ('the new model', decision.rmse),
                    ('the drift that it was trained on', decision.drift_rmse),
                    ('the current model', decision.current_rmse),
                    ('the best linear model', decision.linear_rmse)) if rmse is not None),
                range(1, 1 + len(states)))
    yield 'Each includes the measurement noise.'
    yield '## Free run'
    yield ('Simulations by the inputs alone, from starts fitted to the first samples of each '
           'episode. The fit is the explained share of the motion.')
    yield table(('record', 'state', 'simulation by', 'error', 'fit [%]'), (
        (name, state, model, f'{rmse:.5g} {unit}', f'{fit:.1f}')
        for model, runs in {'the new model': retrained.free_runs,
                            **retrained.compared_runs}.items()
        for name, run in runs.items() for state, unit, rmse, fit in zip(
            run.names, run.units, run.rmse, run.fit, strict=True)), (3, 4))
    eigenvalues = ', '.join(f'{value:.3g}' for value in learned.model.eigenvalues)
    own = learned.model.states
    yield 'Set-points are accepted within ' + ', '.join(
        f'{low:.5g} to {high:.5g} {unit} of {name}'
        for name, unit, low, high in zip(own.names, own.units, own.lower, own.upper, strict=True))
    yield (f'Lift: n_z = {learned.model.n_z}, rw = {learned.figures.fit.rw:.2g}, condition number '
           f'{learned.figures.fit.cond:.3g}, eigenvalues {eigenvalues} '
           f'1/{learned.model.time_unit}. On the estimated drift {decision.law_check}.')
    yield f'Eigenvalues of the model at operating points [1/{learned.model.time_unit}]:'
    yield table(('operating point', 'eigenvalues'), (
        (own.text(point.x, '.4g'), ', '.join(f'{value:.3g}' for value in np.real_if_close(
            point.eigenvalues)))
        for point in decision.operating_points))
    if decision.plant is not None:
        yield from _plant_sections(decision.plant, own)


def _plant_sections(about: PlantAcceptance, states: Coordinates) -> Iterator[str]:
    yield '## The plant'
    yield f'{about.statement}.'
    yield ('Not covered: unmeasured disturbances, and conditions that the record does not have.')
    held = about.held
    yield table(('state', 'recorded range that can be held [%]',
                 'steady states that can be held [%]', 'requested set-points [%]'),
                ((name, f'{100.0 * share:.0f}', *(f'{100.0 * one[i]:.0f}' if len(one) else ''
                                                  for one in (held.steady,)),
                  f'{100.0 * held.requested[name]:.0f}' if name in held.requested else '')
                 for i, (name, share) in enumerate(zip(held.names, held.recorded, strict=True))),
                (1, 2, 3))
    yield 'Corrections of the drift that the record demands, as shares of the motion:'
    yield bullets(f'{name.replace("_", " ")}: {100.0 * share:.2g} %'
                  for name, share in about.causes.items())


def _label(signals: Coordinates, k: int) -> str:
    return axis_label(signals.names[k], signals.units[k])


def _draw(path: Path, retrained: TrainingResult) -> bool:
    """Draw range of the data, learned model and predictions; False without matplotlib."""
    n_x = len(retrained.found.drift.box.states)
    try:
        decision = retrained.decision
        columns = 3 if decision is None else 4 if decision.plant is None else 5
        with drawing(path, n_x, columns, size=(5.0 * columns, 4.6 * n_x)) as (figure, panels):
            for i in range(n_x):
                row = panels[columns * i:columns * (i + 1)]
                _draw_coverage(row[0], retrained.found, i)
                _draw_drift(row[1], retrained, i)
                _draw_prediction(row[2], retrained, i)
                if decision is not None and decision.plant is not None:
                    _draw_band(row[4], retrained, decision.plant.band, i)
                if decision is not None:
                    draw_loops(row[3], decision.law_check, i)
                    row[3].set_title('closed loops on the estimated drift')
                    low, high = row[3].get_ylim()
                    row[3].set_ylim(low, high + 0.2 * (high - low))  # room for the legend
                    row[3].legend(fontsize=8, loc='upper left')
            figure.suptitle(f'{_title(retrained)}: the new model is {retrained.verdict}')
    except ImportError:
        return False
    return True


def _draw_coverage(axes: Any, found: Identified, i: int) -> None:
    """Draw where a state was, over the input that moves it most."""
    box = found.drift.box
    j = int(np.argmax(np.abs(found.drift.input_matrix[i] * box.inputs.scale)))
    episodes = found.episodes
    visited = np.full((CELLS, CELLS), np.nan)
    cells = visited_cells(episodes, box)
    visited[cells[:, len(box.states) + j], cells[:, i]] = 1.0
    edges = [shown(np.linspace(a.lower[k], a.upper[k], CELLS + 1), a.units[k])
             for a, k in ((box.states, i), (box.inputs, j))]
    axes.pcolormesh(*edges, visited, cmap='Greens', vmin=0.0, vmax=3.0)
    for episode in episodes:
        axes.plot(shown(episode.x[:, i], box.states.units[i]),
                  shown(episode.inputs_at(episode.time)[:, j], box.inputs.units[j]), '.',
                  markersize=1.0, color='tab:blue')
    axes.grid(False)  # the cells are one
    axes.set(xlabel=_label(box.states, i), ylabel=_label(box.inputs, j),
             title='measurements (visited cells in green)')


def _lifts(retrained: TrainingResult) -> list[tuple[str, Rate, str]]:
    """Return label, rate and colour of the current model and of the new one, where they are."""
    new = None if retrained.learned is None else retrained.learned.model
    seconds = SECONDS_PER_TIME_UNIT[retrained.plant.time_unit]
    return [(name, lifted_rate(model.joined, seconds), color)
            for name, model, color in (('current model', retrained.present, 'tab:red'),
                                       ('new model', new, 'tab:green')) if model is not None]


def _draw_drift(axes: Any, retrained: TrainingResult, i: int) -> None:
    """Draw a state's rate over the state, the others and the inputs in the middle."""
    found = retrained.found
    box = found.drift.box
    x = np.tile(box.states.center, (200, 1))
    x[:, i] = np.linspace(box.states.lower[i], box.states.upper[i], 200)
    u = np.broadcast_to(box.inputs.center, (len(x), len(box.inputs)))
    estimated = found.drift.rate(x, u)[:, i]
    for name, rate, color in [*_lifts(retrained), ('best linear model', found.linear.rate, '0.5')]:
        axes.plot(shown(x[:, i], box.states.units[i]), rate(x, u)[:, i] - estimated,
                  color=color, label=name)
    axes.axhline(0.0, color='k', linestyle='--', linewidth=1.0,
                 label='estimated from the data')
    # differences below a thousandth of the rates are none: rounding would fill the panel
    low, high = axes.get_ylim()
    width = box.inputs.upper - box.inputs.lower
    least = 1e-3 * float(np.ptp(estimated) + np.abs(found.drift.input_matrix[i]) @ width)
    axes.set_ylim(min(low, -least), max(high, least))
    axes.set(xlabel=_label(box.states, i),
             ylabel='difference of the rate '
                    f'[{printed(box.states.units[i])}/{retrained.plant.time_unit}]',
             title='difference of the rate, the others in the middle')
    axes.legend()


def _draw_band(axes: Any, retrained: TrainingResult, band: RateBand, i: int) -> None:
    """Draw a state's rate over the state where the data are, with its band and the data."""
    assert retrained.learned is not None
    states = retrained.learned.model.states
    x = shown(states.to_physical(band.values)[:, i], states.units[i])
    axes.fill_between(x, *(states.scale[i] * one[:, i] for one in (band.lower, band.upper)),
                      color='tab:orange', alpha=0.4, linewidth=0.0,
                      label='plants that the record allows')
    axes.plot(x, states.scale[i] * band.rates[:, i], color='k', label='estimated from the data')
    measured = np.concatenate([one.interpolated()[:, i] for one in retrained.found.episodes])
    axes.plot(shown(measured, states.units[i]), np.full(len(measured), 0.02), '|', alpha=0.1,
              color='tab:blue', transform=axes.get_xaxis_transform())
    axes.plot([], [], '|', color='tab:blue', label='measurements')
    axes.set(xlabel=_label(states, i),
             ylabel=f'rate [{printed(states.units[i])}/{retrained.plant.time_unit}]',
             title='rate where the data are, and its band')
    axes.legend()


def _draw_prediction(axes: Any, retrained: TrainingResult, i: int) -> None:
    found = retrained.found
    states = found.drift.box.states
    episode = found.held_out[0]
    segments = Segments.of([episode], longest_step([episode]))
    times = np.concatenate(([0.0], np.cumsum(segments.steps[:, 0])))
    measured = segments.measured[:, 0, min(i, segments.measured.shape[2] - 1)]
    seconds = SECONDS_PER_TIME_UNIT[retrained.plant.time_unit]
    time_unit, second = time_axis(seconds * times[-1])
    times = seconds / second * times
    values = shown(segments.x[measured, 0, i], states.units[i])
    axes.plot(times[measured], values, '.', color='0.6', markersize=3.0,
              label='measured' if i < len(states) - found.hidden else 'estimated')
    for name, rate, color in _lifts(retrained):
        x0, _ = fitted_starts(rate, segments, found.drift.box.states.scale)
        path = segments.path(rate, x0)[:, 0, i]
        axes.plot(times, shown(path, states.units[i]), color=color, label=name)
    zoom(axes, values)
    axes.set(xlabel=f'time [{time_unit}]', ylabel=_label(states, i),
             title='prediction of a held-out segment')
    axes.legend()
