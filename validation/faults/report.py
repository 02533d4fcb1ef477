# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What the campaign leaves behind: ``report.md`` for people, ``summary.json`` for programs."""

from collections.abc import Iterator, Sequence
import math
from pathlib import Path
from typing import Any

from koopman_ros.reports import bullets, machine, table, write_figures, write_page
from validation.faults.case import Outcome
from validation.faults.endurance import Endurance
from validation.faults.judge import BAND, RUNAWAY

FIGURE = 'cases.png'


def write(folder: Path, outcomes: Sequence[Outcome], run: Endurance | None, pictured: bool = False
          ) -> None:
    """Write both files for what has been run so far."""
    figures = {'machine': machine(), **_counts(outcomes),
               'results': {outcome.case.name: _figures(outcome) for outcome in outcomes}}
    if run is not None:
        figures['soak'] = _endurance_figures(run)
    write_figures(folder / 'summary.json', figures)
    write_page(folder / 'report.md', 'Fault campaign', _sections(outcomes, run, pictured))


def survived(outcomes: Sequence[Outcome], run: Endurance | None) -> bool:
    """Tell whether nothing is held against any case that could be tried, nor the run run."""
    return all(outcome.survived or outcome.skipped for outcome in outcomes) and (
        run is None or not run.reasons)


def line(outcome: Outcome) -> str:
    """Write a case as one line of the terminal."""
    verdict = outcome.verdict
    if verdict is None:
        return f'skipped: {outcome.skipped}'
    figures = (f'{"survived" if verdict.survived else "FAILED":8s} '
               f'worst error {verdict.worst_error:6.2f} K, step {verdict.worst_step:5.2f} K, '
               f'back after {_seconds(verdict.recovery):>5s}')
    return '; '.join([figures, *verdict.reasons])


def _counts(outcomes: Sequence[Outcome]) -> dict[str, int]:
    return {'cases': len(outcomes),
            'survived': sum(outcome.survived for outcome in outcomes),
            'skipped': sum(bool(outcome.skipped) for outcome in outcomes)}


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


def _sections(outcomes: Sequence[Outcome], run: Endurance | None, pictured: bool) -> Iterator[str]:
    counts = _counts(outcomes)
    skipped = f', {counts["skipped"]} skipped' if counts['skipped'] else ''
    yield (f'{counts["survived"]} of {counts["cases"]} cases survived{skipped}. Plant and '
           'controller are real processes; times are plant time.')
    yield ('A case is survived when every command was finite, within its range and without a '
           f'bump, the reactor stayed below {RUNAWAY:g} °C and came back to within {BAND:g} K of '
           'its set-point in time (unless the case says otherwise), diagnostics said what they '
           'should, and no process failed. The worst error is that of the true temperature from '
           'the set-point, steps of the set-point included; the worst step is that between two '
           'commands, of which the rate limit allows 1 K a second.')
    for group in dict.fromkeys(outcome.case.group for outcome in outcomes):
        yield f'## {group.capitalize()}'
        yield table(('case', 'what is done', 'worst error [K]', 'worst step [K]',
                     'back after [s]', 'left [K]', ''),
                    (_row(outcome) for outcome in outcomes if outcome.case.group == group),
                    (2, 3, 4, 5))
    if pictured:
        yield f'![Some of the cases]({FIGURE})'
    failed = [(o.case.name, o.verdict.reasons) for o in outcomes if o.verdict is not None
              and o.verdict.reasons]
    if failed:
        yield '## What failed'
        yield bullets(f'**{name}**: {"; ".join(reasons)}' for name, reasons in failed)
    if run is not None:
        yield from _endurance_sections(run)


def _row(outcome: Outcome) -> tuple[str, ...]:
    does = '; '.join([outcome.case.does, *outcome.trace.notes])
    verdict = outcome.verdict
    if verdict is None:
        return outcome.case.name, does, '', '', '', '', f'skipped: {outcome.skipped}'
    return (outcome.case.name, does, f'{verdict.worst_error:.2f}', f'{verdict.worst_step:.2f}',
            _seconds(verdict.recovery).removesuffix(' s'), f'{verdict.offset:.3f}',
            'survived' if verdict.survived else '**failed**')


def _endurance_sections(run: Endurance) -> Iterator[str]:
    yield '## Endurance'
    yield (f'{"Survived" if not run.reasons else "**Failed**"}: {run.hours:g} h of plant time '
           f'in {run.wall:.0f} s with {sum(run.events.values())} events. The reactor was '
           f'{run.mean_error:.2f} K from its set-point on average and never above '
           f'{run.hottest:.1f} °C.')
    yield bullets(run.reasons)
    answers = run.answers
    yield (f'{answers.measurements} measurements reached the controller, {answers.answered} were '
           f'answered as often as they came; {answers.unanswered} answers are missing, '
           f'{answers.repeated} repeated, {answers.unasked} unasked, {answers.out_of_order} out '
           'of order. Recorded: '
           f'{", ".join(f"{count} on {topic}" for topic, count in run.recorded.items())}.')
    yield table(('process', 'memory at first [MB]', 'at last [MB]', 'growth when warm [MB]'),
                ((name, f'{seen.megabytes[0]:.1f}', f'{seen.megabytes[-1]:.1f}',
                  f'{seen.growth:.2f}') for name, seen in run.memory.items()), (1, 2, 3))
    yield table(('event', 'times'), sorted(run.events.items()), (1,))
