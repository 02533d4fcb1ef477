# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Page of the alarms: active ones, shelved ones, and the last 24 hours."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import time
from typing import Any

from nicegui import ui
from nicegui.element import Element

from koopman_ros.panel.alarms import Alarm, AlarmState, Priority
from koopman_ros.panel.layout import attribute, box, clock, label, PageLayout, show_if
from koopman_ros.panel.requests import Action
from koopman_ros.panel.snapshot import Snapshot

_SYMBOLS = {Priority.HIGH: '■', Priority.MEDIUM: '▲', Priority.LOW: '●'}
_SHELVING = {'Shelve 10 min': 600.0, '1 h': 3600.0, '8 h': 28800.0}  # s
_LISTED = 200  # entries of the journal that are shown
_DAY = 86400.0  # s


def alarm_page(page: PageLayout) -> None:
    """Build the page."""
    with page.body:
        label('h2', 'Active alarms')
        standing = alarm_rows(page, 'Active alarms', shelving=True)
        label('h2', 'Shelved alarms')
        shelved = _AlarmRows('Shelved alarms', lambda alarm: _shelved_row(page, alarm))
        label('h2', 'Last 24 hours')
        day = box('card journal').props('role=list aria-label="Last 24 hours"')
    shown: list[Any] = [None]

    def show(now: Snapshot) -> None:
        standing.show(now.standing)
        shelved.show(now.shelved)
        entries = page.source.view.alarms.journal(now.wall - _DAY)[:_LISTED]
        if shown[0] == entries:
            return
        shown[0] = entries
        day.clear()
        with day:
            for entry in entries:
                who = f' by {entry.who}' if entry.who else ''
                label('div', f'{clock(entry.time)}  {entry.priority.word}  {entry.what}{who}: '
                      f'{entry.text}').props('role=listitem')
            if not entries:
                label('div', 'none', 'quiet')

    page.follow(show)


class _AlarmRows:
    """
    List of alarms with a row for each, which stays while its alarm is active.

    A control that is drawn again would vanish under a finger.

    :param build: draws the row of an alarm, and returns the function that updates it.
    """

    def __init__(self, name: str, build: Callable[[Alarm], Callable[[Alarm], None]],
                 none: str = 'none') -> None:
        self._build = build
        self._rows: dict[str, tuple[Element, Callable[[Alarm], None]]] = {}
        self._list = attribute(box('strip').props('role=list'), 'aria-label', name)
        with self._list:
            self._none = label('div', none, 'quiet')

    def show(self, alarms: Sequence[Alarm]) -> None:
        """Show these alarms in this order."""
        for removed in set(self._rows) - {alarm.key for alarm in alarms}:
            self._rows.pop(removed)[0].delete()
        for at, alarm in enumerate(alarms):
            if alarm.key not in self._rows:
                with self._list, box('alarm').props('role=listitem') as row:
                    self._rows[alarm.key] = row, self._build(alarm)
            row, update = self._rows[alarm.key]
            update(alarm)
            if self._list.default_slot.children.index(row) != at:
                row.move(target_index=at)
        show_if(self._none, not alarms)


def alarm_rows(page: PageLayout, name: str, *, shelving: bool = False, none: str = 'none'
               ) -> _AlarmRows:
    """Return a list of active alarms with their controls."""
    def build(first: Alarm) -> Callable[[Alarm], None]:
        priority, what, state = label('span', ''), label('span', '', 'what'), label(
            'span', '', 'quiet')
        button = page.button('Acknowledge', lambda: _act(page, 'acknowledge', first.key)).props(
            'dense')
        for text, seconds in _SHELVING.items() if shelving else ():
            attribute(page.control(ui.button(text, on_click=lambda _, s=seconds: _act(
                page, 'shelve', first.key, s)).props('flat dense')),
                'aria-label', f'Shelve {text.removeprefix("Shelve ")}')

        def update(alarm: Alarm) -> None:
            word = alarm.priority.word
            priority.set_text(f'{_SYMBOLS[alarm.priority]} {word.upper()}')
            priority.classes(replace=word)
            what.set_text(alarm.text)
            by = f' by {alarm.acknowledged_by}' if alarm.acknowledged_by else ''
            state.set_text(f'{clock(alarm.since)}, {alarm.state.value}{by}')
            show_if(button, alarm.state is not AlarmState.ACKNOWLEDGED)

        return update

    return _AlarmRows(name, build, none)


def _shelved_row(page: PageLayout, first: Alarm) -> Callable[[Alarm], None]:
    what, until = label('span', '', 'what'), label('span', '', 'quiet')
    page.button('Unshelve', lambda: _act(page, 'unshelve', first.key)).props('dense')

    def update(alarm: Alarm) -> None:
        what.set_text(alarm.text)
        until.set_text(f'until {clock(alarm.shelved_until or 0.0)}')

    return update


def _act(page: PageLayout, what: str, key: str, seconds: float | None = None) -> None:
    """Change an alarm for an operator, and publish the action if it was possible."""
    if not page.visitor.may_act():
        return
    alarms, who, now = page.source.view.alarms, page.visitor.name, time.time()
    if (alarms.acknowledge(key, who, now) if what == 'acknowledge' else
            alarms.unshelve(key, who, now) if seconds is None else
            alarms.shelve(key, seconds, who, now)):
        page.source.request(Action(who, what, key, seconds))
