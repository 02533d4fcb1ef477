# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The most urgent alarm, on each page; and the page of all: active, shelved, the last 24 hours."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
import time
from typing import Any

from nicegui import ui
from nicegui.element import Element

from koopman_ros.core.units import printed
from koopman_ros.panel.alarms import Alarm, AlarmState, Priority
from koopman_ros.panel.conditions import grouped
from koopman_ros.panel.layout import (
    alarm_counts,
    attribute,
    box,
    clock,
    label,
    Lines,
    link,
    PageLayout,
    show_if,
    SYMBOLS,
    unacknowledged,
)
from koopman_ros.panel.requests import Action, Role
from koopman_ros.panel.snapshot import Snapshot

_SHELVING = {'Shelve 10 min': 600.0, '1 h': 3600.0, '8 h': 28800.0}  # s
_LISTED = 200  # entries of the journal that are shown
_DAY = 86400.0  # s
_URGENCY, _NEWEST, _FIRST = 'by urgency and cause', 'newest first', 'oldest first (first-out)'
_ALL = 'all'


def alarm_strip(page: PageLayout) -> None:
    """Show the most urgent unacknowledged alarm of each page, and the numbers of all."""
    with page.strip:
        rows = _AlarmRows('Most urgent alarm', lambda alarm: _row(page, alarm, ()))
        counts = link('', f'{page.prefix}/alarms').classes('counts')
        attribute(ui.element('button').props('id=sound type=button'), 'aria-label', 'Sound')

    def show(now: Snapshot) -> None:
        waiting = unacknowledged(now.standing)
        rows.show([(alarm, '') for alarm in waiting[:1]], now)
        counts.set_text(alarm_counts(now))

    page.follow(show)


class _Choice:
    """Which of the alarms are shown, and in which order."""

    def __init__(self) -> None:
        with box('row1 middle view'):
            self._text = ui.input('Filter').props('outlined dense clearable')
            self._priority = self._select('Priority', [_ALL, *(
                one.word for one in reversed(Priority))])
            self._source = self._select('Source', [_ALL])
            self._order = self._select('Order', [_URGENCY, _NEWEST, _FIRST])

    @staticmethod
    def _select(name: str, options: list[str]) -> ui.select:
        return ui.select(options, value=options[0], label=name).props('outlined dense')

    @property
    def source(self) -> str:
        """The chosen source; empty for all."""
        return '' if self._source.value == _ALL else str(self._source.value)

    def rows(self, alarms: Sequence[Alarm]) -> list[tuple[Alarm, str]]:
        """Return the alarms in their order, each with a note."""
        sources = [_ALL, *sorted({alarm.source for alarm in alarms})]
        if self._source.options != sources:
            self._source.set_options(sources, value=self._source.value if (
                self._source.value in sources) else _ALL)
        wanted = str(self._text.value or '').casefold()
        found = [alarm for alarm in alarms if wanted in alarm.text.casefold()
                 and self._priority.value in (_ALL, alarm.priority.word)
                 and self._source.value in (_ALL, alarm.source)]
        if self._order.value != _URGENCY:
            found.sort(key=lambda one: one.since, reverse=self._order.value == _NEWEST)
            first = min(found, key=lambda one: one.since, default=None)
            return [(one, 'first-out' if one is first and len(found) > 1 else '')
                    for one in found]
        return [row for cause, consequences in grouped(found) for row in (
            (cause, f'cause of {len(consequences)} more' if consequences else ''),
            *((one, 'consequence') for one in consequences))]


def alarm_page(page: PageLayout) -> None:
    """Build the page."""
    chosen: set[str] = set()

    def acknowledge(wanted: Callable[[Alarm], bool]) -> None:
        for alarm in unacknowledged(page.source.view.alarms.standing):
            if wanted(alarm):
                _act(page, 'acknowledge', alarm.key)
        chosen.clear()

    with page.body:
        label('h2', 'Active alarms')
        choice = _Choice()
        with box('row1 middle'):
            selected = page.button('', lambda: acknowledge(lambda one: one.key in chosen))
            of_source = page.button('', lambda: acknowledge(
                lambda one: one.source == choice.source))
        standing = _AlarmRows('Active alarms', lambda alarm: _row(page, alarm, _SHELVING, chosen))
        label('h2', 'Shelved alarms')
        shelved = _AlarmRows('Shelved alarms', lambda alarm: _shelved_row(page, alarm))
        label('h2', 'Last 24 hours')
        day = Lines('Last 24 hours')

    def show(now: Snapshot) -> None:
        standing.show(choice.rows(now.standing), now)
        shelved.show([(alarm, '') for alarm in now.shelved], now)
        chosen.intersection_update(alarm.key for alarm in now.standing)
        selected.set_text(f'Acknowledge selected ({len(chosen)})')
        page.allow(selected, bool(chosen), 'select alarms by their boxes')
        of_source.set_text(f'Acknowledge all of {choice.source or "a source"}')
        page.allow(of_source, bool(choice.source), 'choose a source')
        day.show([
            f'{clock(entry.time)}  {entry.priority.word}  {entry.what}'
            f'{f" by {entry.who}" if entry.who else ""}: {entry.text}'
            for entry in page.source.view.alarms.journal(now.wall - _DAY)[:_LISTED]])

    page.follow(show)


class _AlarmRows:
    """
    List of alarms with a row for each, which stays while its alarm is active.

    A control that is drawn again would vanish under a finger.

    :param build: draws the row of an alarm, and returns the function that updates it.
    """

    def __init__(self, name: str, build: Callable[[Alarm], Callable[[Alarm, str, Snapshot], None]]
                 ) -> None:
        self._build = build
        self._rows: dict[str, tuple[Element, Callable[[Alarm, str, Snapshot], None]]] = {}
        self._list = attribute(box('strip').props('role=list'), 'aria-label', name)
        with self._list:
            self._none = label('div', 'none', 'quiet')

    def show(self, alarms: Sequence[tuple[Alarm, str]], now: Snapshot) -> None:
        """Show these alarms in this order, each with a note."""
        for removed in set(self._rows) - {alarm.key for alarm, _ in alarms}:
            self._rows.pop(removed)[0].delete()
        for at, (alarm, note) in enumerate(alarms):
            if alarm.key not in self._rows:
                # the page makes a row that appears or moves inert for a moment
                with self._list, box('alarm').props('role=listitem inert') as row:
                    self._rows[alarm.key] = row, self._build(alarm)
            row, update = self._rows[alarm.key]
            update(alarm, note, now)
            indented = note == 'consequence'
            if indented is not ('consequence' in row.classes):
                row.classes(**{'add' if indented else 'remove': 'consequence'})
            if self._list.default_slot.children.index(row) != at:
                row.move(target_index=at)
        show_if(self._none, not alarms)


def _row(page: PageLayout, first: Alarm, shelving: Iterable[str], chosen: set[str] | None = None
         ) -> Callable[[Alarm, str, Snapshot], None]:
    def choose(event: Any) -> None:
        if chosen is not None:
            (chosen.add if event.value else chosen.discard)(first.key)

    def named(control: Element, what: str) -> Any:
        return attribute(page.control(control), 'aria-label', f'{what}: {printed(first.text)}')

    if chosen is not None:
        select = named(ui.checkbox(on_change=choose).props('dense'), 'Select')
    priority, what, state = label('span', ''), label('span', '', 'what'), label(
        'span', '', 'quiet')
    button = named(ui.button('Acknowledge', on_click=lambda: _act(
        page, 'acknowledge', first.key)).props('outline dense'), 'Acknowledge')
    for text in shelving:
        named(ui.button(text, on_click=lambda _, s=_SHELVING[text]: _act(
            page, 'shelve', first.key, s)).props('flat dense'),
            f'Shelve {text.removeprefix("Shelve ")}')

    def update(alarm: Alarm, note: str, now: Snapshot) -> None:
        word = alarm.priority.word
        priority.set_text(f'{SYMBOLS[alarm.priority]} {word.upper()}')
        priority.classes(replace=word)
        what.set_text(alarm.text)
        by = f' by {alarm.acknowledged_by}' if alarm.acknowledged_by else ''
        stale = 'stale: its node is silent' * (alarm.key in now.stale)
        state.set_text(', '.join(filter(None, (
            clock(alarm.since), '' if chosen is None else f'{alarm.state.value}{by}', note,
            stale))))
        acknowledged = alarm.state is AlarmState.ACKNOWLEDGED
        # the row keeps its shape
        button.style(replace='visibility: hidden' if acknowledged else '')
        if chosen is not None and select.value is not (alarm.key in chosen):
            select.set_value(alarm.key in chosen)

    return update


def _shelved_row(page: PageLayout, first: Alarm) -> Callable[[Alarm, str, Snapshot], None]:
    what, until = label('span', '', 'what'), label('span', '', 'quiet')
    attribute(page.button('Unshelve', lambda: _act(page, 'unshelve', first.key)).props('dense'),
              'aria-label', f'Unshelve: {printed(first.text)}')

    def update(alarm: Alarm, _: str, now: Snapshot) -> None:
        what.set_text(alarm.text)
        until.set_text(f'until {clock(alarm.shelved_until or 0.0)}')

    return update


def _act(page: PageLayout, what: str, key: str, seconds: float | None = None) -> None:
    """Change an alarm for an operator, and publish the action if it was possible."""
    if not page.visitor.may(Role.OPERATOR):
        return
    alarms, who, now = page.source.view.alarms, page.visitor.name, time.time()
    if (alarms.acknowledge(key, who, now) if what == 'acknowledge' else
            alarms.unshelve(key, who, now) if seconds is None else
            alarms.shelve(key, seconds, who, now)):
        page.source.request(Action(who, what, key, seconds))
