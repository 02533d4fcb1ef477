# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The report of the campaign: a page for people, figures for programs."""

from collections import Counter
from collections.abc import Iterator, Mapping
import math
from pathlib import Path
from typing import Any

from koopman_ros.core import plots
from studies.faults.plants import PLANTS

_HEAD = ('case', 'fault', 'worst error', 'worst step', 'back after [s]', 'left', '')


def write(folder: Path, results: Mapping[str, dict[str, Any]],
          runs: Mapping[str, dict[str, Any]] | None = None) -> bool:
    """
    Write a page and figures of all cases so far.

    :return: whether every case that could be tried was survived, and every endurance run.
    """
    figures: dict[str, Any] = {
        'machine': plots.machine(), 'cases': len(results),
        'survived': sum(result['survived'] for result in results.values()),
        'skipped': sum('skipped' in result for result in results.values()),
        'results': results, **(runs or {})}
    plots.write_figures(folder / 'summary.json', figures)
    plots.write_page(folder / 'report.md', 'Fault campaign', _sections(figures))
    return figures['survived'] + figures['skipped'] == len(results) and all(
        run['survived'] for run in (runs or {}).values())


def line(result: dict[str, Any]) -> str:
    """Write a case as one line of the terminal."""
    *_, error, step, back, _, verdict = _row('', result)
    figures = f'worst error {error}, step {step}, back after {back} s'
    return '; '.join([f'{verdict:12} {figures}' if error else verdict,
                      *result.get('reasons', ())])


def by_plant(results: Mapping[str, dict[str, Any]]) -> str:
    """Say of each plant how many of its cases were survived."""
    counts = Counter(result['plant'] for result in results.values())
    survived = Counter(result['plant'] for result in results.values() if result['survived'])
    return ', '.join(f'{name} {survived[name]} of {count}' for name, count in counts.items())


def _sections(figures: dict[str, Any]) -> Iterator[str]:
    results = figures['results']
    skipped = f', {figures["skipped"]} skipped' if figures['skipped'] else ''
    yield (f'{figures["survived"]} of {figures["cases"]} cases survived{skipped}: '
           f'{by_plant(results)}. Plant and controller are real processes; times are plant time.')
    yield ('A case is survived if every command was finite, within its range and without a bump, '
           'the plant was not lost and came back to its set-points in time, diagnostics reported '
           'the fault, the commands are reproduced from the records bit-identically, and no '
           'process failed.')
    on = [plant for plant in PLANTS.values()
          if plant.name in {result['plant'] for result in results.values()}]
    yield plots.table(
        ('plant', 'back within', 'in at most [s]', 'lost from', 'fastest command'),
        ((plant.name, f'{plant.band:g} {plant.unit}', f'{plant.recovery:g}',
          f'{plant.highest:g} {plant.shown_units[0]}', f'{plant.rate:g} {plant.input_unit}/s')
         for plant in on), (2,))
    for plant in on:
        own = {name: result for name, result in results.items() if result['plant'] == plant.name}
        for group in dict.fromkeys(result['group'] for result in own.values()):
            yield f'## {plant.name}: {group}'
            yield plots.table(_HEAD, (_row(name, result) for name, result in own.items()
                                      if result['group'] == group), (2, 3, 4, 5))
    failed = [f'**{name}**: {"; ".join(result["reasons"])}' for name, result in results.items()
              if result.get('reasons')]
    if failed:
        yield '## Failures'
        yield plots.bullets(failed)
    for name, run in figures.items():
        if name.startswith('soak'):
            yield from _endurance_sections(name, run)


def _row(name: str, result: dict[str, Any]) -> tuple[str, ...]:
    does = '; '.join([result['does'], *result['notes']])
    if 'skipped' in result:
        return name, does, '', '', '', '', f'skipped: {result["skipped"]}'
    back, unit = result['time_to_recover_s'], result.get('unit', '')
    return (name, does, f'{result["worst_error"]:.3g} {unit}',
            f'{result["worst_step"]:.2f} {result.get("input_unit", "")}',
            f'{back:.0f}' if math.isfinite(back) else 'never',
            f'{result["offset_at_the_end"]:.2g} {unit}',
            'survived' if result['survived'] else '**failed**')


def _endurance_sections(name: str, run: dict[str, Any]) -> Iterator[str]:
    yield f'## Endurance: {name}'
    yield (f'{"Survived" if run["survived"] else "**Failed**"}: {run["hours"]:g} h of plant time '
           f'in {run["wall_seconds"]:.0f} s with {sum(run["events"].values())} events. The mean '
           f'error was {run["mean_error_K"]:.2f} K, the highest temperature '
           f'{run["hottest_degC"]:.1f} °C.')
    yield plots.bullets(run['reasons'])
    for title, counts in (('messages', run['answers']), ('recorded', run['recorded']),
                          ('event', dict(sorted(run['events'].items())))):
        yield plots.table((title, 'times'), counts.items(), (1,))
    yield plots.table(
        ('process', 'memory at first [MB]', 'at last [MB]', 'growth when warm [MB]'),
        ((name, *seen.values()) for name, seen in run['memory_MB'].items()), (1, 2, 3))
