# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Cards of the last training and of a comparison: verdict, picture and text."""

from __future__ import annotations

from collections.abc import Callable
import hashlib
import time

from nicegui import ui

from koopman_ros.panel.layout import (
    AnswerLine,
    attribute,
    box,
    card,
    clock,
    label,
    PageLayout,
    show_if,
)
from koopman_ros.panel.snapshot import Snapshot, TRAINING
from koopman_ros.panel.training_report import Findings, ReplayComparison, TrainingReport


def _findings(address: str, about: str) -> Callable[[Findings], None]:
    """Add lines, picture and text of a report; return the function that shows them."""
    lines = label('div', '', 'lines')
    with box('pictures'):
        picture = attribute(ui.element('img').classes('picture hidden'), 'alt', about)
    with ui.expansion('the whole report').classes('hidden').props('dense') as whole:
        text = label('div', '', 'report')

    def show(found: Findings) -> None:
        lines.set_text('\n'.join(found.lines))
        if found.picture:
            # another address for another picture
            version = hashlib.sha256(found.picture).hexdigest()[:16]
            attribute(picture, 'src', f'{address}?{version}')
        show_if(picture, bool(found.picture))
        text.set_text(found.text)
        show_if(whole, bool(found.text))

    return show


def report_card(page: PageLayout) -> None:
    """Show the report of the last training."""
    with card('report of the last training', 'Report').classes('hidden') as own:
        verdict, when = label('div', '', 'value'), label('div', '', 'quiet')
        problem = label('div', '')
        show_findings = _findings(f'{page.prefix}/picture/training', 'Data, drift and prediction')
    shown: list[TrainingReport | None] = [None]

    def show(_: Snapshot) -> None:
        found = page.source.learning.report
        if found is shown[0] or found is None:
            return
        shown[0] = found
        show_if(own, True)
        problem.set_text(found.problem)
        verdict.set_text('' if found.problem else
                         f'The new model is {"accepted" if found.accepted else "rejected"}.')
        written = time.strftime('%Y-%m-%d %H:%M:%S', time.localtime(found.written))
        when.set_text('' if found.problem else f'{written}, {found.model_file}')
        show_findings(found)

    page.follow(show)


def comparison_card(page: PageLayout) -> None:
    """Show the comparison of the new model with the recorded commands."""
    with card('comparison on the last hour', 'Comparison').classes('hidden') as own:
        label('div', 'Commands of the new model for the recorded measurements, next to the '
              'commands that were sent. With the new model the plant would have moved '
              'differently.', 'quiet')

        async def compare() -> None:
            answer.show(await page.act('compare', '', model()))

        async def cancel() -> None:
            answer.show(await page.act('end comparison'))

        with box('row1'):
            begin = page.button('Compare on the last hour', compare)
            end = page.button('Cancel', cancel)
        answer = AnswerLine(page)
        state = label('div', '').props('role=status')
        show_findings = _findings(f'{page.prefix}/picture/comparison',
                                  'Recorded commands and those of the new model')
    shown = [ReplayComparison()]

    def model() -> str:
        return page.source.learning.new_model(page.source.snapshot.status(TRAINING).values)[0]

    def show(now: Snapshot) -> None:
        found = page.source.learning.comparison
        show_if(own, bool(model() or found.model))
        show_if(begin, not found.running)
        show_if(end, found.running)
        if found.running:
            state.set_text(f'running for {max(now.wall - found.since, 0.0):.0f} s')
        if found is shown[0]:
            return
        shown[0] = found
        if not found.running:
            answer.set_text('')
            state.set_text(f'✖ {found.problem}' if found.problem else
                           f'{found.model}, compared at {clock(found.since)}' if found.model
                           else '')
        show_findings(found)

    page.follow(show)
