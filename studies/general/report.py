# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The report on the general law: a table for each plant, and one over all."""

from collections.abc import Mapping
from pathlib import Path
import statistics
from typing import Any, TypeAlias

from koopman_ros.core.plots import table
from studies import report
from studies.general.loops import HELD_TO, STARTS
from studies.general.study import NOISE, PARTS_SEEDS
from studies.general.systems import CASES
from studies.report import Cell, of, share, spread, total, Values

Models: TypeAlias = Mapping[str, Mapping[str, Values]]  # figures by model
_COLUMNS: dict[str, tuple[str, Cell]] = {
    'rx': ('rx', spread), 'roll-out': ('rollout', spread), 'learning [s]': ('seconds', spread),
    'accepted': ('accepted', share), 'no gain': ('no_gain', total),
    'not arrived': ('not_arrived', total), 'missed': ('missed', total),
    'cost': ('ratio', of(statistics.median)), 'cost, worst': ('ratio_worst', of(max))}
_COORDINATES: dict[str, tuple[str, Cell]] = {
    heading: (figure, of(statistics.median)) for heading, figure in (
        ('rx', 'rx'), ('noise', 'rx_noisy'), ('roll-out', 'rollout'),
        ('roll-out in z', 'rollout_z'))} | {
    'averaged': ('averaged', of(max)), 'missed': ('averaged_missed', total),
    're-centred': ('recentred', of(max)), 'missed ': ('recentred_missed', total)}


def write_report(summary: Mapping[str, Any], folder: Path) -> None:
    """Write the page on the content of ``summary.json``."""
    cases = {name: summary[name] for name in CASES if name in summary}
    labels = dict.fromkeys(label for models in cases.values() for label in models)
    sections = [
        f'{report.opening(summary)} From each seed a model of every class; from the same {STARTS} '
        'starts in the box of each plant, its law regulates the true plant to the nominal state. '
        'Errors weigh 1 in half-ranges of the box and of the exciting steps. `rx`, roll-out and '
        'processor time are medians over the seeds with [smallest, largest]; `accepted` counts '
        'seeds. Of all starts and seeds: no gain, not arrived, and either not arrived or cost '
        f'more than {HELD_TO} times the better of two laws that know the plant; that cost ratio '
        'at the median and the worst.',
        '## The bound for every law',
        f'Seeds in which the law had a gain everywhere, arrived, and cost at most {HELD_TO} times '
        'the better law that knows the plant, from every start:',
        table(('model', *(CASES[name].system.name for name in cases)), [
            (label, *(share(_held(models.get(label, {}))) for models in cases.values()))
            for label in labels]),
        '## Acceptance and performance', _acceptance(cases),
        '## Linear coordinates, and noise',
        'Median `rx` on exact held-out data after learning from exact data, and from rates with '
        f'noise of {100.0 * NOISE:g} %; median roll-out by the drift and by z alone; largest cost '
        'of the law by the averaged Jacobian and by the linear coordinates, over the better law '
        f'that knows the plant, with the starts missed. All but the exact data: {PARTS_SEEDS} '
        'seeds.',
        *(f'{CASES[name].system.name}\n\n' + report.rows_table('model', {
            label: model for label, model in models.items() if 'rx_noisy' in model}, _COORDINATES)
          for name, models in cases.items())]
    report.write(folder, 'The law on plants that it was not made for', [*sections, *(
        f'## {CASES[name].system.name}\n\n' + report.rows_table('model', models, _COLUMNS)
        for name, models in cases.items())])


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
