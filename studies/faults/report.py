# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The report of the campaign: a page and a picture for people, figures for programs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
import math
from pathlib import Path
from typing import Any, TYPE_CHECKING

from koopman_ros.core import plots
from studies.faults.case import LoopTrace
from studies.faults.plants import PLANTS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Drawn, because they tell most.
TELLING = ('nan-long', 'bias', 'feed-warm', 'controller-killed-in-a-step', 'plant-reset',
           'actuator-saturated', 'two_tanks-silent-one', 'quadruple_tank-frozen-one')
_BEFORE, _AFTER = 30.0, 300.0  # s around the fault
_HEAD = ('case', 'fault', 'worst error', 'worst step', 'back after [s]', 'left', '')


def write(folder: Path, results: Mapping[str, dict[str, Any]],
          runs: Mapping[str, dict[str, Any]] | None = None,
          traces: Mapping[str, LoopTrace] | None = None) -> bool:
    """
    Write a page, figures and, where traces are given, a picture of all cases so far.

    :return: whether every case that could be tried was survived, and every endurance run.
    """
    figures: dict[str, Any] = {
        'machine': plots.machine(), 'cases': len(results),
        'survived': sum(result['survived'] for result in results.values()),
        'skipped': sum('skipped' in result for result in results.values()),
        'results': results, **(runs or {})}
    plots.write_figures(folder / 'summary.json', figures)
    drawn = _draw(traces or {}, folder / 'cases.png')
    plots.write_page(folder / 'report.md', 'Fault campaign', [
        *_sections(figures), *(['![Some of the cases](cases.png)'] if drawn else [])])
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


def _draw(traces: Mapping[str, LoopTrace], path: Path) -> bool:
    """Draw the first controlled state and the first input of telling cases, if there are any."""
    shown = {name: trace for name in TELLING if (trace := traces.get(name)) is not None
             and trace.commands and math.isfinite(trace.end)}
    if shown:
        with plots.drawing(path, 2, len(shown), size=(3.2 * len(shown), 5.2),
                           sharex='col') as (_, panels):
            for upper, lower, name in zip(panels, panels[len(shown):], shown, strict=False):
                _draw_case(upper, lower, shown[name])
                upper.set_title(name, fontsize='medium')
            for panel in (panels[0], panels[len(shown)]):
                panel.legend(fontsize='small')
    return bool(shown)


def _draw_case(upper: Axes, lower: Axes, trace: LoopTrace) -> None:
    on = trace.on
    state = on.controlled[0]
    times = [seconds for seconds, _ in trace.samples]
    true = [states[on.states.index(state)] for _, states in trace.samples]
    since, wanted = zip(*((seconds, values[0]) for seconds, values in trace.setpoints),
                        strict=True)
    upper.plot(times, true, label='true')
    upper.step([*since, times[-1]], [*wanted, wanted[-1]], where='post', linestyle='--',
               color='black', linewidth=1.0, label='set-point')
    lower.plot([command.seconds for command in trace.commands],
               [command.values[0] for command in trace.commands], label='command')
    plots.draw_limits(lower, on.range(on.inputs[0]), 'limits')
    for axes, name, unit in zip((upper, lower), (state, on.inputs[0]), on.shown_units,
                                strict=True):
        axes.set_ylabel(f'{name} [{unit}]')
        axes.axvspan(trace.begin, max(trace.end, trace.begin + 2.0), alpha=0.2,
                     color='tab:red', linewidth=0.0, label='fault')
    near = [*wanted, *(value for seconds, value in zip(times, true, strict=True)
                       if seconds > trace.begin - _BEFORE)]
    upper.set(xlim=(trace.begin - _BEFORE, min(trace.end + _AFTER, times[-1])),
              ylim=(min(near) - 2.0 * on.band, max(near) + 2.0 * on.band))
    lower.set_xlabel('plant time [s]')
