# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The report on the general law: a table for each plant, one over all, and a picture."""

from collections.abc import Mapping
from pathlib import Path
import statistics
from typing import Any, TypeAlias

from koopman_ros.core.plots import drawing, legend, Picture, table
from studies import report
from studies.general.coordinates import BEYOND, FEW, NOISE, PLACE
from studies.general.loops import HELD_TO, OPTIMA, STARTS
from studies.general.systems import CASES
from studies.report import Cell, of, present, share, spread, total, Values

Models: TypeAlias = Mapping[str, Mapping[str, Values]]  # figures by model
_HIGHEST = 3.0  # cost ratio drawn; above it, or where a start did not arrive, at the upper edge
_LOWEST = 1e-10  # rx drawn; rounding is below
_COLUMNS: dict[str, tuple[str, Cell]] = {
    'rx': ('rx', spread), 'roll-out': ('rollout', spread), 'learning [s]': ('seconds', spread),
    'accepted': ('accepted', share), 'no gain': ('no_gain', total),
    'not arrived': ('not_arrived', total), 'missed': ('missed', total),
    'cost': ('ratio', of(statistics.median)), 'cost, worst': ('ratio_worst', of(max)),
    'over the least, worst': ('least_ratio', of(max))}
_COORDINATES: dict[str, tuple[str, Cell]] = {
    heading: (figure, of(statistics.median)) for heading, figure in (
        ('rx', 'rx'), ('noise', 'rx_noisy'), ('few', 'rx_few'), ('beyond', 'rx_beyond'),
        ('roll-out', 'rollout'), ('roll-out in z', 'rollout_z'))} | {
    'averaged': ('averaged', of(max)), 'missed': ('averaged_missed', total),
    're-centred': ('recentred', of(max)), 'missed ': ('recentred_missed', total)}


def write_report(summary: Mapping[str, Any], folder: Path) -> None:
    """Write the page on the content of ``summary.json``, with its picture."""
    cases = {name: summary[name] for name in CASES if name in summary}
    labels = dict.fromkeys(label for models in cases.values() for label in models)
    sections = [
        f'{report.opening(summary)} From each seed a model of every class; from the same {STARTS} '
        'starts in the box of each plant, its law regulates the true plant to the nominal state. '
        'Errors weigh 1 in half-ranges of the box and of the exciting steps. `rx`, roll-out and '
        'processor time are medians over the seeds with [smallest, largest]; `accepted` counts '
        'seeds. Of all starts and seeds: no gain, not arrived, and either not arrived or cost '
        f'more than {HELD_TO} times the better of two laws that know the plant; that cost ratio '
        f'at the median and the worst, and the worst over the least cost from {OPTIMA} starts.',
        '## The bound for every law',
        f'Seeds in which the law had a gain everywhere, arrived, and cost at most {HELD_TO} times '
        'the better law that knows the plant, from every start:',
        table(('model', *(CASES[name].system.name for name in cases)), [
            (label, *(share(_held(models.get(label, {}))) for models in cases.values()))
            for label in labels]),
        '## Acceptance and performance', _acceptance(cases)]
    if parts := summary.get(PLACE):
        sections += [
            '## Linear coordinates, and harder data',
            'Median `rx` on exact held-out data after learning from exact data, from rates with '
            f'noise of {100.0 * NOISE:g} %, from the first {100.0 * FEW:g} % of the episodes, and '
            f'beyond the upper ends of the box by up to {100.0 * BEYOND:g} %; median roll-out by '
            'the drift and by z alone; largest cost of the law by the averaged Jacobian and by '
            'the linear coordinates, over the better law that knows the plant, with the starts '
            'missed. Two rows predict in discrete time by monomials of degree 3, without and with '
            'a delay.',
            *(f'{CASES[name].system.name}\n\n' + report.rows_table('model', models, _COORDINATES)
              for name, models in parts.items())]
    report.write(folder, 'The law on plants that it was not made for', [*sections, *(
        f'## {CASES[name].system.name}\n\n' + report.rows_table('model', models, _COLUMNS)
        for name, models in cases.items())], [_draw(cases, folder / 'general.png')])


def _held(model: Mapping[str, Values]) -> Values | None:
    missed = model.get('missed')
    if missed is None:
        return None
    return [None if n is None else not (n or gone)
            for n, gone in zip(missed, model['no_gain'], strict=True)]


def _acceptance(cases: Mapping[str, Models]) -> str:
    """Compare the acceptance of each model with the performance of its law."""
    rows = []
    for name, models in cases.items():
        pairs = [(accepted, held) for model in models.values()
                 for accepted, held in zip(model.get('accepted', ()), _held(model) or (),
                                           strict=False) if accepted is not None]
        rows.append((CASES[name].system.name, *(
            pairs.count(pair) for pair in ((True, True), (True, False),
                                           (False, True), (False, False)))))
    return table(('trained models', 'accepted, law held', 'accepted, law missed',
                  'rejected, law held', 'rejected, law missed'), rows)


def _draw(cases: Mapping[str, Models], path: Path) -> Picture:
    columns = min(4, len(cases))
    rows = -(-len(cases) // columns)
    labels = columns + 1  # beside each other in the legend
    with drawing(path, rows, columns, size=(3.2 * columns + 0.6, 3.0 * rows + 3.0 / labels),
                 sharey=True) as (figure, axes):
        for axis, (name, models) in zip(axes, cases.items(), strict=False):
            trained = [label for label, m in models.items() if 'rx' in m]
            for number, label in enumerate(label for label in trained
                                           if 'missed' in models[label]):
                m, color = models[label], f'C{number}'
                axis.plot([], [], 's', color=color, label=label)
                for rx, worst, gone, accepted in zip(
                        m['rx'], m['ratio_worst'], m['not_arrived'], m['accepted'], strict=True):
                    if rx is not None:
                        ratio = _HIGHEST if gone or worst is None else min(worst, _HIGHEST)
                        axis.plot(max(rx, _LOWEST), ratio, 'X' if gone else 'o', color=color,
                                  alpha=0.8,
                                  markerfacecolor='none' if accepted is False else color)
            for number, known in enumerate(label for label in models if label not in trained):
                highest = max(present(models[known]['ratio_worst']), default=_HIGHEST)
                axis.axhline(min(highest, _HIGHEST), color='0.3',
                             linestyle=(':', '--')[number % 2], label=known)
            axis.axhline(HELD_TO, color='tab:red', linewidth=0.8, label=f'bound: {HELD_TO}')
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
        f'{STARTS} starts, by the error of the learned drift; a point a model and seed. Crosses: '
        'the plant did not arrive from every start. Hollow: training rejected the model.'))
