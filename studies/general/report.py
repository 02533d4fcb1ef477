# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The report on the general law: a table for each plant, one over all, and a picture."""

from collections.abc import Mapping, Sequence
import math
from pathlib import Path
import statistics
from typing import Any

from koopman_ros.reports import drawing, legend, Picture, table, write_page
from studies.general.coordinates import BEYOND, FEW, NOISE, PLACE
from studies.general.loops import HELD_TO, OPTIMA, STARTS
from studies.general.systems import CASES

Values = Sequence[float | bool | None]
_HIGHEST = 3.0  # cost ratio drawn; above it, or where a start did not arrive, at the upper edge
_LOWEST = 1e-10  # rx drawn; rounding is below
_COLUMNS = ('model', 'rx', 'roll-out', 'learning [s]', 'accepted', 'no gain', 'not arrived',
            'missed', 'cost', 'cost, worst', 'over the least, worst')


def write_report(summary: Mapping[str, Any], folder: Path) -> None:
    """Write the page on what ``summary.json`` holds, with its picture."""
    cases = {name: summary[name] for name in CASES if name in summary}
    state = '' if summary['complete'] else ' **Interrupted before the end.**'
    picture = _draw(cases, folder / 'general.png')
    write_page(folder / 'report.md', 'The law on plants that it was not made for', [
        f'Seeds 0 to {summary["seeds"] - 1}, {summary["wall_seconds"]:.0f} s.{state} From each '
        f'seed a model of every class; from {STARTS} starts in the box of each plant, the same '
        'ones always, its law regulates the true plant to the nominal state, in continuous time. '
        'Errors weigh 1 in half widths of the box and of the steps that excited the plant. '
        '`rx`, roll-out (root mean square over an episode, of the worst state, in half widths of '
        'the box) and processor time of learning are medians over the seeds with [smallest, '
        'largest]; `accepted` counts seeds. Of all starts and seeds: where the law had no gain, '
        f'where the plant did not arrive, and where it either did not or cost more than {HELD_TO} '
        'times the better of two laws that know the plant; that cost ratio where it arrived, at '
        f'the median and the worst, and the worst over the least cost from {OPTIMA} of the '
        'starts. The least is found with inputs held, so that ratios a little below 1 mean 1.',
        '## What every law is held to', _overall(cases),
        '## Does acceptance tell?', _acceptance(cases), _coordinates(summary),
        '## Figure', str(picture), *(
            f'## {CASES[name].system.name}\n\n{_table(models)}'
            for name, models in cases.items())],
        ('torch', 'numpy', 'scipy'))


def _table(models: Mapping[str, Mapping[str, Values]]) -> str:
    return table(_COLUMNS, [(
        label, _spread(m.get('rx')), _spread(m.get('rollout')), _spread(m.get('seconds')),
        _share(m.get('accepted')), *(_total(m.get(name)) for name in (
            'no_gain', 'not_arrived', 'missed')),
        _figure(m.get('ratio'), statistics.median), _figure(m.get('ratio_worst'), max),
        _figure(m.get('least_ratio'), max)) for label, m in models.items()])


def _overall(cases: Mapping[str, Mapping[str, Mapping[str, Values]]]) -> str:
    """Count the seeds of each plant in which a law met its bound from every start."""
    labels = dict.fromkeys(label for models in cases.values() for label in models)
    return ('Seeds in which the law had a gain everywhere, arrived, and cost at most '
            f'{HELD_TO} times the better law that knows the plant, from every start:\n\n'
            + table(('model', *(CASES[name].system.name for name in cases)), [
                (label, *(_share(_held(models.get(label, {}))) for models in cases.values()))
                for label in labels]))


def _held(model: Mapping[str, Values]) -> Values | None:
    missed = model.get('missed')
    if missed is None:
        return None
    return [None if n is None else not (n or gone)
            for n, gone in zip(missed, model['no_gain'], strict=True)]


def _acceptance(cases: Mapping[str, Mapping[str, Mapping[str, Values]]]) -> str:
    """Set what training said of each model beside what its law then did."""
    rows = []
    for name, models in cases.items():
        said = [(accepted, held) for model in models.values()
                for accepted, held in zip(model.get('accepted', ()), _held(model) or (),
                                          strict=False) if accepted is not None]
        rows.append((CASES[name].system.name, *(
            said.count(pair) for pair in ((True, True), (True, False),
                                          (False, True), (False, False)))))
    return table(('trained models', 'accepted, law held', 'accepted, law missed',
                  'refused, law held', 'refused, law missed'), rows)


def _coordinates(summary: Mapping[str, Any]) -> str:
    """Set what lifts do by their linear coordinates beside what they do by their drift."""
    parts = summary.get(PLACE, {})
    if not parts:
        return ''
    rows = [(CASES[name].system.name, label, *(_figure(m.get(figure), statistics.median)
                                               for figure in _RX),
             *(_figure(m.get(figure), statistics.median) for figure in ('rollout', 'rollout_z')),
             *(f'{_figure(m[law], max)} ({_total(m[f"{law}_missed"])})' if law in m else '-'
               for law in ('averaged', 'recentred')))
            for name, models in parts.items() for label, m in models.items()]
    seeds = max(len(values) for _, models in parts.items() for m in models.values()
                for values in m.values())
    return (
        '## What linear coordinates add, and harder data\n\n'
        f'From {seeds} seeds: median `rx` of the drift on exact held-out data after learning from '
        f'exact data, from derivatives with noise of {100.0 * NOISE:g} %, from the first '
        f'{100.0 * FEW:g} % of the episodes, and, after the first, beyond the upper ends of the '
        f'box by up to {100.0 * BEYOND:g} % of it; median roll-out by the drift and by z alone, dz'
        '/dt = A z + J(x) B u with x taken from z; and the largest cost of the law by the '
        'averaged Jacobian and of that by the linear coordinates, over the better law that knows '
        'the plant (in brackets the starts that missed). Two rows predict in discrete time by '
        'monomials of degree 3, linear in these, without and with a delay of states and inputs.'
        '\n\n'
        + table(('plant', 'model', 'rx', 'noise', 'few', 'beyond', 'roll-out', 'roll-out in z',
                 'averaged', 're-centred'), rows))


_RX = ('rx', 'rx_noisy', 'rx_few', 'rx_beyond')


def _draw(cases: Mapping[str, Mapping[str, Mapping[str, Values]]], path: Path) -> Picture:
    columns = min(4, len(cases))
    rows = -(-len(cases) // columns)
    labels = columns + 1  # beside each other in the legend
    with drawing(path, rows, columns, size=(3.2 * columns + 0.6, 3.0 * rows + 3.0 / labels),
                 sharey=True) as (figure, axes):
        for axis, (name, models) in zip(axes, cases.items(), strict=False):
            trained = [label for label, m in models.items() if 'rx' in m]
            for number, label in enumerate(trained):
                m, color = models[label], f'C{number}'
                if 'missed' not in m:
                    continue
                axis.plot([], [], 's', color=color, label=label)
                for i, rx in enumerate(m['rx']):
                    if rx is None:
                        continue
                    worst = m['ratio_worst'][i]
                    lost = bool(m['not_arrived'][i]) or worst is None
                    refused = m['accepted'][i] is False
                    axis.plot(max(rx, _LOWEST),
                              _HIGHEST if lost or worst is None else min(worst, _HIGHEST),
                              'X' if lost else 'o', color=color, alpha=0.8,
                              markerfacecolor='none' if refused else color)
            for number, known in enumerate(label for label in models if label not in trained):
                highest = max(_present(models[known]['ratio_worst']), default=_HIGHEST)
                axis.axhline(min(highest, _HIGHEST), color='0.3',
                             linestyle=(':', '--')[number % 2], label=known)
            axis.axhline(HELD_TO, color='tab:red', linewidth=0.8, label=f'held to: {HELD_TO}')
            axis.set(title=CASES[name].system.name, xlabel='rx [1]', xscale='log', yscale='log',
                     xlim=(0.5 * _LOWEST, 100.0), ylim=(0.97, 1.05 * _HIGHEST))
            axis.set_xticks([1e-10, 1e-7, 1e-4, 1e-1])
            axis.set_yticks([1.0, 1.1, 1.3, 2.0, 3.0], ['1', '1.1', '1.3', '2', '≥ 3'])
            axis.minorticks_off()
        for axis in axes[len(cases):]:
            axis.set_axis_off()
        for axis in axes[::columns]:
            axis.set_ylabel('cost, worst start [1]')
        legend(figure, axes[:len(cases)], labels)
    return Picture(path.name, (
        'Cost on the true plant over that of the better law that knows it, at the worst of '
        f'{STARTS} starts, by the error of the learned drift (at the left edge: exact to '
        'rounding); a point a model and seed. Crosses: the plant did not arrive from every '
        'start. Hollow: training refused the model.'))


def _present(values: Values | None) -> list[float]:
    return [float(v) for v in values or () if v is not None and math.isfinite(v)]


def _figure(values: Values | None, of: Any) -> str:
    numbers = _present(values)
    return f'{of(numbers):.4g}' if numbers else '-'


def _spread(values: Values | None) -> str:
    numbers = _present(values)
    if not numbers:
        return '-'
    lost = len(values or ()) - len(numbers)
    return (f'{statistics.median(numbers):.2g} [{min(numbers):.2g}, {max(numbers):.2g}]'
            + (f', none in {lost}' if lost else ''))


def _total(values: Values | None) -> str:
    return f'{sum(_present(values)):.0f}' if values else '-'


def _share(values: Values | None) -> str:
    known = [v for v in values or () if v is not None]
    return f'{sum(map(bool, known))} of {len(known)}' if known else '-'
