# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What the campaign leaves behind: a page and a picture for people, figures for programs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import math
from pathlib import Path
from typing import Any, TYPE_CHECKING

from koopman_ros import reports
from koopman_ros.parameters.controller import ControllerParameters
from validation.faults.case import BAND, Trace
from validation.faults.endurance import Endurance
from validation.faults.harness import Outcome
from validation.faults.judge import RUNAWAY

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FIGURE = 'cases.png'
# Drawn, because they tell most.
TELLING = ('nan-long', 'bias', 'feed-warm', 'controller-killed-in-a-step', 'plant-reset',
           'actuator-saturated')
_BEFORE, _AFTER = 30.0, 300.0  # s around the fault


def write(folder: Path, outcomes: Sequence[Outcome], run: Endurance | None, pictured: bool = False
          ) -> None:
    """Write both files for what has been run so far."""
    counts = {'cases': len(outcomes),
              'survived': sum(outcome.survived for outcome in outcomes),
              'skipped': sum(bool(outcome.skipped) for outcome in outcomes)}
    figures = {'machine': reports.machine(), **counts,
               'results': {outcome.case.name: _figures(outcome) for outcome in outcomes}}
    if run is not None:
        figures['soak'] = _endurance_figures(run)
    reports.write_figures(folder / 'summary.json', figures)
    reports.write_page(folder / 'report.md', 'Fault campaign',
               _sections(outcomes, run, pictured, **counts))


def survived(outcomes: Sequence[Outcome], run: Endurance | None) -> bool:
    """Tell whether nothing is held against any case that could be tried, nor the run."""
    return all(outcome.survived or outcome.skipped for outcome in outcomes) and (
        run is None or not run.reasons)


def line(outcome: Outcome) -> str:
    """Write a case as one line of the terminal."""
    verdict = outcome.verdict
    if verdict is None:
        return f'skipped: {outcome.skipped}'
    figures = (f'{"survived" if outcome.survived else "FAILED":8s} '
               f'worst error {verdict.worst_error:6.2f} K, step {verdict.worst_step:5.2f} K, '
               f'back after {_seconds(verdict.recovery):>5s}')
    return '; '.join([figures, *verdict.reasons])


def _figures(outcome: Outcome) -> dict[str, Any]:
    figures: dict[str, Any] = {
        'group': outcome.case.group, 'does': outcome.case.does, 'survived': outcome.survived,
        'wall_seconds': round(outcome.wall, 2), 'notes': outcome.trace.notes}
    verdict = outcome.verdict
    if verdict is None:
        return {**figures, 'skipped': outcome.skipped}
    return {**figures, 'reasons': list(verdict.reasons),
            'worst_temperature_error_K': round(verdict.worst_error, 6),
            'worst_coolant_step_K': round(verdict.worst_step, 6),
            'time_to_recover_s': round(verdict.recovery, 6),
            'offset_at_the_end_K': round(verdict.offset, 6)}


def _endurance_figures(run: Endurance) -> dict[str, Any]:
    return {'survived': not run.reasons, 'reasons': list(run.reasons), 'hours': run.hours,
            'wall_seconds': round(run.wall, 1), 'answers': vars(run.answers),
            'events': run.events, 'recorded': run.recorded,
            'hottest_degC': round(run.hottest, 6), 'mean_error_K': round(run.mean_error, 6),
            'memory_MB': {name: {
                'first': round(float(seen.megabytes[0]), 2),
                'last': round(float(seen.megabytes[-1]), 2),
                'growth_when_warm': round(seen.growth, 3)} for name, seen in run.memory.items()}}


def _seconds(value: float) -> str:
    return f'{value:.0f} s' if math.isfinite(value) else 'never'


def _sections(outcomes: Sequence[Outcome], run: Endurance | None, pictured: bool, *, cases: int,
              survived: int, skipped: int) -> Iterator[str]:
    yield (f'{survived} of {cases} cases survived{f", {skipped} skipped" if skipped else ""}. '
           'Plant and controller are real processes; times are plant time.')
    yield ('A case is survived when every command was finite, within its range and without a '
           f'bump, the reactor stayed below {RUNAWAY:g} °C and came back to within {BAND:g} K of '
           'its set-point in time (unless the case says otherwise), diagnostics said what they '
           'should, and no process failed. The worst error is that of the true temperature from '
           'the set-point, steps of the set-point included; the worst step is that between two '
           'commands, of which the rate limit allows 1 K a second.')
    for group in dict.fromkeys(outcome.case.group for outcome in outcomes):
        yield f'## {group.capitalize()}'
        yield reports.table(
            ('case', 'what is done', 'worst error [K]', 'worst step [K]', 'back after [s]',
             'left [K]', ''),
            (_row(outcome) for outcome in outcomes if outcome.case.group == group), (2, 3, 4, 5))
    if pictured:
        yield f'![Some of the cases]({FIGURE})'
    failed = [f'**{outcome.case.name}**: {"; ".join(outcome.verdict.reasons)}'
              for outcome in outcomes if outcome.verdict is not None and outcome.verdict.reasons]
    if failed:
        yield '## What failed'
        yield reports.bullets(failed)
    if run is not None:
        yield from _endurance_sections(run)


def _row(outcome: Outcome) -> tuple[str, ...]:
    does = '; '.join([outcome.case.does, *outcome.trace.notes])
    verdict = outcome.verdict
    if verdict is None:
        return outcome.case.name, does, '', '', '', '', f'skipped: {outcome.skipped}'
    return (outcome.case.name, does, f'{verdict.worst_error:.2f}', f'{verdict.worst_step:.2f}',
            _seconds(verdict.recovery).removesuffix(' s'), f'{verdict.offset:.3f}',
            'survived' if outcome.survived else '**failed**')


def _endurance_sections(run: Endurance) -> Iterator[str]:
    yield '## Endurance'
    yield (f'{"Survived" if not run.reasons else "**Failed**"}: {run.hours:g} h of plant time '
           f'in {run.wall:.0f} s with {sum(run.events.values())} events. The reactor was '
           f'{run.mean_error:.2f} K from its set-point on average and never above '
           f'{run.hottest:.1f} °C.')
    yield reports.bullets(run.reasons)
    answers = run.answers
    yield (f'{answers.measurements} measurements reached the controller, {answers.answered} were '
           f'answered as often as they came; {answers.unanswered} answers are missing, '
           f'{answers.repeated} repeated, {answers.unasked} unasked, {answers.out_of_order} out '
           'of order. Recorded: '
           f'{", ".join(f"{count} on {topic}" for topic, count in run.recorded.items())}.')
    yield reports.table(
        ('process', 'memory at first [MB]', 'at last [MB]', 'growth when warm [MB]'),
        ((name, f'{seen.megabytes[0]:.1f}', f'{seen.megabytes[-1]:.1f}', f'{seen.growth:.2f}')
         for name, seen in run.memory.items()), (1, 2, 3))
    yield reports.table(('event', 'times'), sorted(run.events.items()), (1,))


def draw(outcomes: Sequence[Outcome], path: Path) -> bool:
    """Draw temperature and coolant of the telling cases; return whether there was one."""
    shown = [outcome for name in TELLING for outcome in outcomes
             if outcome.case.name == name and outcome.trace.commands
             and math.isfinite(outcome.trace.end)]
    if not shown:
        return False
    size = (3.2 * len(shown), 5.2)
    with reports.drawing(path, 2, len(shown), size=size, sharex='col') as (_, panels):
        for upper, lower, outcome in zip(panels, panels[len(shown):], shown, strict=False):
            _draw_case(upper, lower, outcome.trace)
            upper.set_title(outcome.case.name, fontsize='medium')
        for panel, quantity in ((panels[0], 'temperature'), (panels[len(shown)], 'coolant')):
            panel.set_ylabel(f'{quantity} [°C]')
            panel.legend(fontsize='small')
    return True


def _draw_case(upper: Axes, lower: Axes, trace: Trace) -> None:
    times, temperatures = zip(*trace.samples, strict=True)
    upper.plot(times, temperatures, label='reactor, true')
    since, wanted = zip(*trace.setpoints, strict=True)
    upper.step([*since, times[-1]], [*wanted, wanted[-1]], where='post', linestyle='--',
               color='black', linewidth=1.0, label='set-point')
    lower.plot([command.seconds for command in trace.commands],
               [command.celsius for command in trace.commands], label='command')
    limits = ControllerParameters()
    reports.draw_limits(lower, (limits.coolant_min, limits.coolant_max), 'limits')
    for axes in (upper, lower):
        axes.axvspan(trace.begin, max(trace.end, trace.begin + 2.0), alpha=0.2,
                     color='tab:red', linewidth=0.0, label='fault')
    upper.set_xlim(trace.begin - _BEFORE, min(trace.end + _AFTER, times[-1]))
    near = [celsius for seconds, celsius in trace.samples if seconds > trace.begin - _BEFORE]
    upper.set_ylim(min(*near, *wanted) - 0.5, max(*near, *wanted) + 0.5)
    lower.set_xlabel('plant time [s]')
