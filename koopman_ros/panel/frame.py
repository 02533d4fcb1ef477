# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What all pages have: head, tabs, banner, alarms, questions and answers. All text is text."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
import time
from typing import Any, Protocol, TypeVar

from nicegui import ui
from nicegui.element import Element

from koopman_ros.panel.alarms import Alarm, AlarmState, Priority
from koopman_ros.panel.learning import Learning
from koopman_ros.panel.plant import PlantView, Snapshot
from koopman_ros.panel.requests import Action, Answer
from koopman_ros.panel.style import CSS, WATCH

PERIOD = 0.25  # s between two looks at the snapshot
_PATIENCE = 40.0  # s for an answer
_SYMBOLS = {Priority.HIGH: '■', Priority.MEDIUM: '▲', Priority.LOW: '●'}
_TABS = {'/': 'Overview', '/trends': 'Trends', '/alarms': 'Alarms', '/model': 'Model',
         '/tuning': 'Tuning'}
_TEXTS = ('alt', 'aria-label', 'data-beat', 'data-parameter', 'data-signal')
_ADDRESSES = ('href', 'src')
_Kind = TypeVar('_Kind', bound=Element)
NOT_ALLOWED = Answer(False, 'you may look, not act: log in as an operator')


class Source(Protocol):
    """What the pages need of the node."""

    view: PlantView  #: of which trends and alarms may be used by any thread
    snapshot: Snapshot  #: of now

    @property
    def learning(self) -> Learning:
        """The last training and comparison."""

    @property
    def title(self) -> str:
        """What is written above each page."""

    def ask(self, action: Action) -> Future[Answer]:
        """Do what an operator asks for."""


@dataclass(frozen=True)
class Visitor:
    """Who looks at a page."""

    name: str
    #: whether the visitor may act at this moment; asked again before each action
    may_act: Callable[[], bool]
    #: whether the visitor may still look
    may_look: Callable[[], bool] = lambda: True
    named: bool = False  #: whether there is somebody to log out


def clock(seconds: float) -> str:
    """Return a time of the wall clock, of the day."""
    return time.strftime('%H:%M:%S', time.localtime(seconds))


class Frame:
    """
    A page, to be filled below `body`.

    :param path: of the page.
    """

    def __init__(self, source: Source, visitor: Visitor, path: str) -> None:
        self.source, self.visitor = source, visitor
        #: whether there are controls that can be used
        self.enabled = visitor.may_act()
        self._shown: Snapshot | None = None
        self._updates: list[Callable[[Snapshot], None]] = []
        self._places: dict[int, tuple[tuple[str, float], ...]] = {}
        ui.add_css(CSS)
        ui.add_head_html(WATCH)
        ui.page_title(f'{_TABS[path]} – {source.title}')
        ui.colors(primary='#4a4a47', secondary='#6b6b67', accent='#4a4a47', positive='#4a4a47')
        self._head(path)
        self.body = div('page')
        self._beat_at = 0.0

    def _head(self, path: str) -> None:
        with div('head', tag='header'):
            title = words('h1', self.source.title)
            mode, level = words('div', ''), words('div', '', 'quiet')
            beat = words('div', '', 'right quiet').props('id=beat')
            who = self.visitor.name + ('' if self.enabled else ' (viewer)')
            words('div', who, 'quiet')
            if self.visitor.named:
                link('Log out', '/logout')
        with div('tabs', tag='nav').props('aria-label=Pages'):
            tabs = {target: link(name, target) for target, name in _TABS.items()}
        tabs[path].classes('here').props('aria-current=page')
        banner = words('div', '', 'banner hidden').props('role=alert')

        def show(now: Snapshot) -> None:
            title.set_text(self.source.title)
            mode.set_text(now.mode.upper() or 'MODE NOT KNOWN')
            level.set_text(now.level)
            unacknowledged = sum(alarm.state is not AlarmState.ACKNOWLEDGED
                                 for alarm in now.standing)
            tabs['/alarms'].set_text(
                f'Alarms ({unacknowledged})' if unacknowledged else 'Alarms')
            if now.wall - self._beat_at >= 1.0:
                self._beat_at = now.wall
                beat.set_text(clock(now.wall))
                attribute(beat, 'data-beat', f'{now.wall:.1f}')
            silent = [
                f'nothing from the {one.source} since {clock(one.since)}' + (
                    '' if one.ever else ', when the panel started') for one in now.silences]
            banner.set_text(f'⚠ Connection lost: {"; ".join(silent)}')
            show_if(banner, bool(silent))

        self.follow(show)

    def follow(self, update: Callable[[Snapshot], None]) -> None:
        """Call a function with each new snapshot."""
        self._updates.append(update)

    def run(self) -> None:
        """Begin to follow what happens."""
        self._look()
        self._timer = ui.timer(PERIOD, self._look)

    def _look(self) -> None:
        now = self.source.snapshot
        if now is self._shown:
            return
        self._shown = now
        if not self.visitor.may_look():
            # logged out elsewhere, or idle for too long
            self._timer.cancel()
            ui.navigate.to('/login')
            return
        for update in self._updates:
            update(now)

    def place(self, element: Element, **sides: float) -> None:
        """Place an element by shares of its parent, or hide it where none is given."""
        found = tuple(sides.items())
        if self._places.get(element.id) != found:
            self._places[element.id] = found
            element.style(replace='; '.join(
                f'{side}: {100.0 * share:.1f}%' for side, share in found) or 'display: none')

    # Questions and answers.

    async def act(self, what: str, name: str = '', value: Any = None, old: Any = None) -> Answer:
        """Ask for something as the visitor, who has to be an operator; return what came of it."""
        if not self.visitor.may_act():
            return NOT_ALLOWED
        future = self.source.ask(Action(self.visitor.name, what, name, value, old))
        try:
            return await asyncio.wait_for(asyncio.wrap_future(future), _PATIENCE)
        except TimeoutError:
            return Answer(False, f'no answer within {_PATIENCE:g} s')

    def control(self, element: Any) -> Any:
        """Return a control, which a viewer cannot use."""
        if not self.enabled:
            element.disable()
        return element

    def answer(self) -> ui.label:
        """Return where answers are shown."""
        return words('div', '', 'answer').props('role=status aria-live=polite')

    async def confirm(self, question: str, yes: str, details: list[str] | None = None) -> bool:
        """Ask once; Escape is no."""
        with ui.dialog() as dialog, div('card'):
            words('div', question, 'value')
            for line in details or ():
                words('div', line)
            with div('row1'):
                ui.button('Cancel', on_click=lambda: dialog.submit(False)).props(
                    'outline autofocus')
                ui.button(yes, on_click=lambda: dialog.submit(True)).props('unelevated')
        found = await dialog
        dialog.delete()
        return bool(found)


def say(where: ui.label, answer: Answer) -> None:
    """Show an answer where it was asked for."""
    where.set_text(str(answer) if answer.accepted else f'✖ {answer}')
    where.classes(remove='refused')
    if not answer.accepted:
        where.classes('refused')


def show_if(element: Element, shown: bool) -> None:
    """Show or hide an element."""
    if shown is ('hidden' in element.classes):
        element.classes(**{'remove' if shown else 'add': 'hidden'})


def attribute(element: _Kind, name: str, text: str) -> _Kind:
    """
    Set an attribute of an element to a text, which may come from outside.

    NiceGUI reads a string of props for several, and evaluates those whose names begin with ':' as
    JavaScript: no text from outside may be part of such a string, or of a name.

    :param text: a path of the panel itself where the attribute is an address.
    :raises ValueError: for any other attribute, or another address.
    """
    own = name in _ADDRESSES and text.startswith('/') and not text.startswith('//')
    if name not in _TEXTS and not own:
        raise ValueError(f'{name} = {text!r} cannot be set: give a text to one of '
                         f'{", ".join(_TEXTS)}, or a path to one of {", ".join(_ADDRESSES)}')
    element.props[name] = text
    return element


def div(classes: str = '', tag: str = 'div') -> Element:
    """Return an element to be filled."""
    return ui.element(tag).classes(classes)


class _Words(ui.label):
    """Text in an element of any tag, never more than text."""

    def __init__(self, tag: str, text: str) -> None:
        super().__init__(text)
        self.tag = tag


def words(tag: str, text: str, classes: str = '') -> ui.label:
    """Return text in an element."""
    return _Words(tag, text).classes(classes)


def link(text: str, target: str) -> Any:
    """Return a link to a page of the panel."""
    return attribute(_Words('a', text), 'href', target)


class Rows:
    """
    Alarms in a list, a row for each, which stays as it is while its alarm stands.

    A control that was drawn anew would be gone under the finger that is on its way to it.

    :param build: draws the row of an alarm, and returns what shows another state of it.
    """

    def __init__(self, name: str, build: Callable[[Alarm], Callable[[Alarm], None]],
                 none: str = 'none') -> None:
        self._build = build
        self._rows: dict[str, tuple[Element, Callable[[Alarm], None]]] = {}
        self._place = attribute(div('strip').props('role=list'), 'aria-label', name)
        with self._place:
            self._none = words('div', none, 'quiet')

    def show(self, alarms: Sequence[Alarm]) -> None:
        """Show these, in this order."""
        for gone in set(self._rows) - {alarm.key for alarm in alarms}:
            self._rows.pop(gone)[0].delete()
        for at, alarm in enumerate(alarms):
            if alarm.key not in self._rows:
                with self._place, div('alarm').props('role=listitem') as row:
                    self._rows[alarm.key] = row, self._build(alarm)
            row, update = self._rows[alarm.key]
            update(alarm)
            if self._place.default_slot.children.index(row) != at:
                row.move(target_index=at)
        show_if(self._none, not alarms)


def alarm_rows(frame: Frame, name: str, *, shelving: bool = False, none: str = 'none') -> Rows:
    """Return a list of standing alarms, with what can be done about them."""
    def build(first: Alarm) -> Callable[[Alarm], None]:
        key = first.key
        priority, what, state = words('span', ''), words('span', '', 'what'), words(
            'span', '', 'quiet')

        def acknowledge() -> None:
            if frame.visitor.may_act():
                frame.source.view.alarms.acknowledge(key, frame.visitor.name, time.time())
                _tell(frame, 'acknowledge', key)

        button = frame.control(ui.button('Acknowledge', on_click=acknowledge).props(
            'outline dense'))
        if shelving:
            shelve_control(frame, key)

        def update(alarm: Alarm) -> None:
            word = alarm.priority.word
            priority.set_text(f'{_SYMBOLS[alarm.priority]} {word.upper()}')
            priority.classes(replace=word)
            what.set_text(alarm.text)
            by = f' by {alarm.acknowledged_by}' if alarm.acknowledged_by else ''
            state.set_text(f'{clock(alarm.since)}, {alarm.state.word}{by}')
            show_if(button, alarm.state is not AlarmState.ACKNOWLEDGED)

        return update

    return Rows(name, build, none)


def shelved_rows(frame: Frame, name: str) -> Rows:
    """Return a list of shelved alarms, which can be shown again."""
    def build(first: Alarm) -> Callable[[Alarm], None]:
        what, until = words('span', '', 'what'), words('span', '', 'quiet')
        frame.control(ui.button('Show again', on_click=lambda: _unshelve(frame, first.key)).props(
            'outline dense'))

        def update(alarm: Alarm) -> None:
            what.set_text(alarm.text)
            until.set_text(f'until {clock(alarm.shelved_until or 0.0)}')

        return update

    return Rows(name, build)


def shelve_control(frame: Frame, key: str) -> None:
    """Show what takes an alarm out of sight for a while."""
    def shelve(seconds: float) -> None:
        if frame.visitor.may_act():
            frame.source.view.alarms.shelve(key, seconds, frame.visitor.name, time.time())
            _tell(frame, 'shelve', key, seconds)

    for text, seconds in (('Shelve 10 min', 600.0), ('1 h', 3600.0), ('8 h', 28800.0)):
        frame.control(ui.button(text, on_click=lambda _, s=seconds: shelve(s)).props(
            'flat dense'))


def _unshelve(frame: Frame, key: str) -> None:
    if frame.visitor.may_act():
        frame.source.view.alarms.unshelve(key, frame.visitor.name, time.time())
        _tell(frame, 'unshelve', key)


def _tell(frame: Frame, what: str, key: str, value: Any = None) -> None:
    frame.source.ask(Action(frame.visitor.name, what, key, value))
