# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Page of all loops of a panel, one in a row."""

from __future__ import annotations

from koopman_ros.panel.layout import (
    alarm_counts,
    attribute,
    box,
    Frame,
    label,
    link,
    prefix_of,
    show_if,
    show_value,
    Source,
    SYMBOLS,
)
from koopman_ros.panel.snapshot import Snapshot

_COLUMNS = ('Loop', 'Mode', 'Control level', 'Most urgent alarm', 'Value and set-point')


def loop_page(page: Frame) -> None:
    """Build the page."""
    with box('page'), box('loops', tag='table'):
        with box(tag='thead'), box(tag='tr'):
            for column in _COLUMNS:
                label('th', column).props('scope=col')
        with box(tag='tbody'):
            rows = [_LoopRow(source, prefix_of(name)) for name, source in page.sources.items()]

    def show(_: Snapshot) -> None:
        for row, now in zip(rows, page.snapshots, strict=True):
            row.show(now)

    page.follow(show)


class _LoopRow:
    """A loop: its mode, control level, most urgent alarm, and signals with a set-point."""

    def __init__(self, source: Source, prefix: str) -> None:
        self._source = source
        with attribute(box(tag='tr'), 'data-loop', prefix.removeprefix('/loop/')):
            with box(tag='th').props('scope=row'):
                self._name = link(source.title, f'{prefix}/')
            with box(tag='td'):
                self._mode = label('span', '')
                self._mark = label('span', '', 'abnormal hidden')
            with box(tag='td'):
                self._level = label('span', '')
            with box('alarm-cell', tag='td'):
                self._priority, self._alarm = label('span', ''), label('span', '')
                self._counts = link('', f'{prefix}/alarms')
            with box(tag='td'), box('signals'):
                self._signals = [
                    (at, label('span', face.label), label('span', '', 'number'),
                     label('span', '', 'number'), label('span', '', 'abnormal hidden'))
                    for at, face in enumerate(source.snapshot.states) if face.controlled]

    def show(self, now: Snapshot) -> None:
        """Show the state of the loop."""
        self._name.set_text(self._source.title)
        self._mode.set_text(now.mode.upper() or 'MODE NOT KNOWN')
        mark = f'⚠ {now.obstacle}' if now.obstacle else (
            f'EXPERIMENT, {now.experiment} s left' if now.experiment else '')
        self._mark.set_text(mark)
        show_if(self._mark, bool(mark))
        self._level.set_text(f'▲ {now.level}' if now.fallback and now.level else now.level)
        worst = now.standing[0] if now.standing else None
        self._priority.set_text(
            f'{SYMBOLS[worst.priority]} {worst.priority.word.upper()}' if worst else '')
        self._priority.classes(replace=worst.priority.word if worst else '')
        self._alarm.set_text(worst.text if worst else '')
        self._counts.set_text(alarm_counts(now))
        for at, _, value, setpoint, abnormal in self._signals:
            face = now.states[at]
            show_value(value, f'{face.text(face.measured)} {face.unit}', 'measured' in face.old)
            show_value(setpoint, f'set-point {face.exact(face.setpoint)} {face.unit}',
                       'setpoint' in face.old)
            abnormal.set_text(f'▲ {face.abnormal}')
            show_if(abnormal, bool(face.abnormal))
