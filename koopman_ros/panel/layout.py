# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Common page layout: head, tabs, banner, confirmations and answers. All content is escaped."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from importlib.resources import files
import operator
import time
from typing import Any, Protocol, Self, TypeVar

from nicegui import ui
from nicegui.element import Element

from koopman_ros.core.units import printed
from koopman_ros.panel.alarms import Alarm, AlarmState, Priority
from koopman_ros.panel.requests import Action, Answer, required_role, Role, UNKNOWN
from koopman_ros.panel.snapshot import Snapshot
from koopman_ros.panel.training_report import Learning
from koopman_ros.panel.view_model import LoopViewModel

PERIOD = 0.1  # s between two looks for a new snapshot
_TIMEOUT = 40.0  # s for an answer
TABS = {'/': 'Overview', '/trends': 'Trends', '/alarms': 'Alarms', '/model': 'Model',
        '/tuning': 'Tuning', '/audit': 'Audit'}
LOOPS = 'Loops'  #: name of the page of all loops
_CSS, _WATCH = ((files(__package__) / name).read_text() for name in ('style.css', 'watch.js'))
_TEXTS = ('alt', 'aria-label', 'data-answered', 'data-beat', 'data-loop', 'data-parameter',
          'data-present', 'data-signal', 'data-sound', 'data-title')
_SETTLED = 2.0  # s after which an answer no longer holds if the loop changes
#: frequency of the sound in Hz, and symbol, of each priority
SOUNDS = {Priority.HIGH: '880', Priority.MEDIUM: '660', Priority.LOW: '440'}
SYMBOLS = {Priority.HIGH: '■', Priority.MEDIUM: '▲', Priority.LOW: '●'}
_ADDRESSES = ('href', 'src')
_Kind = TypeVar('_Kind', bound=Element)
NOT_ALLOWED = {role: Answer(False, f'for {role.value}s only: log in as {role.value}')
               for role in Role}


class Source(Protocol):
    """Interface of a loop for the pages."""

    view: LoopViewModel  #: its trends and alarms may be used by any thread
    snapshot: Snapshot  #: of now

    @property
    def learning(self) -> Learning:
        """The last training and comparison."""

    @property
    def title(self) -> str:
        """Title of its pages."""

    def request(self, action: Action) -> Future[Answer]:
        """Carry out an action of an operator; called from any thread."""


@dataclass(frozen=True)
class Visitor:
    """User of a page."""

    name: str
    role: Callable[[], Role]  #: its permissions; called before each action
    may_look: Callable[[], bool] = lambda: True  #: whether it is still logged in
    named: bool = False  #: whether it can log out

    def may(self, role: Role) -> bool:
        """Return whether the user has the permissions of a role."""
        return self.role().includes(role)


def clock(seconds: float) -> str:
    """Return the time of day of a wall time."""
    return time.strftime('%H:%M:%S', time.localtime(seconds))


def prefix_of(loop: str) -> str:
    """Return the path before those of the pages of a loop; '' for the only one of a panel."""
    return f'/loop{loop}' if loop else ''


class Frame:
    """
    Common part of all pages: style, head, heartbeat, and the most urgent alarm in the title.

    :param sources: loops of the panel by namespace; the only one has the name ''.
    :param path: of the page, to which the visitor returns after a new log-in.
    :param name: of the page.
    :param shown: loops on the page.
    """

    def __init__(self, sources: Mapping[str, Source], visitor: Visitor, path: str, name: str,
                 shown: Sequence[Source]) -> None:
        self.sources, self.visitor, self._path = sources, visitor, path
        self._name, self._of = name, shown
        # without a look at the session, which would be a use of it
        self._role = visitor.role()
        self.snapshots: list[Snapshot] = []  #: of the loops on the page
        self._updates: list[Callable[[Snapshot], None]] = []
        self._beat_at = 0.0
        ui.add_css(_CSS)
        ui.add_head_html(f'<script>{_WATCH}</script>')
        ui.page_title(self._title)
        ui.colors(primary='#4a4a47', secondary='#6b6b67', accent='#4a4a47', positive='#4a4a47')
        with box('head', tag='header') as self._header:
            self._heading = label('h1', '')
            self._details = box('details')  # of the loop
            self._beat = label('div', '', 'right quiet').props('id=beat')
            label('div', f'{visitor.name} ({self._role.value})' if visitor.named else (
                visitor.name), 'quiet')
            if visitor.named:
                link('Log out', '/logout')
        self.follow(self._show)

    @property
    def _title(self) -> str:
        return self._name if len(self._of) != 1 else f'{self._name} – {self._of[0].title}'

    def _show(self, now: Snapshot) -> None:
        self._heading.set_text(self._of[0].title if len(self._of) == 1 else self._name)
        count, worst = urgency(self.snapshots if len(self._of) == len(self.sources) else [
            source.snapshot for source in self.sources.values()])
        attribute(self._header, 'data-title', f'{SYMBOLS[worst]} {worst.word.upper()} '
                  f'({count}) {self._title}' if worst else self._title)
        attribute(self._header, 'data-sound', SOUNDS[worst] if worst else '')
        # the panel's clock that a page has seen last tells the age of what is pressed there
        if (beat_at := time.monotonic()) - self._beat_at >= 1.0:
            self._beat_at = beat_at
            self._beat.set_text(f'wall time {clock(now.wall)}')
            attribute(self._beat, 'data-beat', f'{beat_at:.1f}')

    def follow(self, update: Callable[[Snapshot], None]) -> None:
        """Call a function with each new snapshot of the first loop on the page."""
        self._updates.append(update)

    def run(self) -> None:
        """Start the updates."""
        self.update()
        self._timer = ui.timer(PERIOD, self.update)

    def update(self) -> None:
        """Show new snapshots."""
        now = [source.snapshot for source in self._of]
        if self.snapshots and all(map(operator.is_, now, self.snapshots)):
            return
        self.snapshots = now
        if not self.visitor.may_look():
            # logged out on another page, or idle for too long
            self._timer.cancel()
            ui.navigate.to(f'/login?page={self._path}')
            return
        for update in self._updates:
            update(now[0])


class PageLayout(Frame):
    """
    A page of a loop; its content goes into `body`.

    :param loop: its name in `sources`.
    :param path: of the page, without the prefix of the loop.
    """

    def __init__(self, sources: Mapping[str, Source], loop: str, visitor: Visitor, path: str
                 ) -> None:
        self.source, self.prefix = sources[loop], prefix_of(loop)
        super().__init__(sources, visitor, self.prefix + path, TABS[path], [self.source])
        self._head(path)
        self.body = box('page')

    def _head(self, path: str) -> None:
        with self._details:
            mode, level = label('div', ''), label('div', '', 'quiet')
            experiment = label('div', '', 'abnormal hidden')
        self.strip = box('row1 strip-head')  #: place of the most urgent alarm
        others = [one for one in self.sources.values() if one is not self.source]
        with box('tabs', tag='nav').props('aria-label=Pages'):
            loops = link('', '/') if others else None
            tabs = {target: link(name, self.prefix + target) for target, name in TABS.items()}
        tabs[path].classes('here').props('aria-current=page')
        banner = label('div', '', 'banner hidden').props('role=alert')

        def show(now: Snapshot) -> None:
            mode.set_text(now.mode.upper() or 'MODE NOT KNOWN')
            level.set_text(now.level if now.level != now.mode else '')
            experiment.set_text(f'EXPERIMENT, {now.experiment} s left')
            show_if(experiment, bool(now.experiment))
            waiting = unacknowledged(now.standing)
            tabs['/alarms'].set_text(f'Alarms ({len(waiting)})' if waiting else 'Alarms')
            if loops is not None:
                count, worst = urgency(one.snapshot for one in others)
                loops.set_text(f'{LOOPS}: {SYMBOLS[worst]} {worst.word.upper()} ({count})'
                               if worst else LOOPS)
                loops.classes(replace=f'urgent {worst.word}' if worst else '')
            silent = [f'no message from the {one.role} since {clock(one.since)}' + (
                '' if one.seen else ', the start of the panel') for one in now.silences]
            known = any(one.seen for one in now.silences)
            banner.set_text(f'⚠ {"Connection lost" if known else "Waiting"}: {"; ".join(silent)}')
            show_if(banner, bool(silent))

        self.follow(show)

    def card(self, title: str, name: str, role: str) -> Element:
        """Return a card that is grey, with controls that do nothing, while a node is silent."""
        found = card(title, name)

        def show(now: Snapshot) -> None:
            silent = any(one.role == role for one in now.silences)
            if silent and 'inert' not in found.props:
                found.props('inert')
            elif not silent and 'inert' in found.props:
                found.props(remove='inert')

        self.follow(show)
        return found

    # Actions.

    async def act(self, what: str, name: str = '', value: Any = None, old: Any = None) -> Answer:
        """Carry out an action of the visitor if it has the role; return the answer."""
        if not self.visitor.may(role := required_role(what)):
            return NOT_ALLOWED[role]
        future = self.source.request(Action(self.visitor.name, what, name, value, old))
        try:
            answer: Answer = await asyncio.wait_for(asyncio.wrap_future(future), _TIMEOUT)
        except TimeoutError:
            answer = Answer(False, f'{UNKNOWN}no answer within {_TIMEOUT:g} s')
        self._end_if_closed()
        return answer

    def _end_if_closed(self) -> None:
        """End the present task if its page was closed."""
        if self.body.is_deleted:
            raise asyncio.CancelledError

    def control(self, element: Any, what: str = '') -> Any:
        """Return a control, disabled for a user without the role of its action."""
        if not self._role.includes(role := required_role(what)):
            element.props['title'] = NOT_ALLOWED[role].text
            element.disable()
        return element

    def button(self, text: str, act: Callable[[], Any], what: str = '') -> ui.button:
        """Return a button of an action."""
        found: ui.button = self.control(ui.button(text, on_click=act).props('outline'), what)
        return found

    def allow(self, control: Any, possible: bool, obstacle: str, what: str = '') -> None:
        """Enable a control while it can act; otherwise it shows the obstacle."""
        title = '' if possible else obstacle
        if self._role.includes(required_role(what)) and (
                control.enabled, control.props.get('title', '')) != (possible, title):
            control.props['title'] = title
            control.set_enabled(possible)
            control.update()

    async def confirm(self, question: str, yes: str, details: Sequence[str] = (),
                      changes: Sequence[Sequence[str]] = ()) -> bool:
        """
        Return whether the visitor confirms; Escape cancels.

        :param changes: rows of three cells: a title, and the values before and after.
        """
        with ui.dialog() as dialog, box('card'):
            label('div', question, 'value')
            for line in details:
                label('div', line)
            with box('changes'):
                for cell in (cell for row in changes for cell in row):
                    label('div', cell)
            with box('row1'):
                ui.button('Cancel', on_click=lambda: dialog.submit(False)).props(
                    'outline autofocus')
                ui.button(yes, on_click=lambda: dialog.submit(True)).props('unelevated')
        found = await dialog
        self._end_if_closed()
        dialog.delete()
        return bool(found)


class AnswerLine:
    """
    Line with the answer to an action, next to its control, as long as the answer holds.

    :param basis: state of the loop to which the answer refers; the answer ends when it changes.
    """

    def __init__(self, page: PageLayout,
                 basis: Callable[[Snapshot], object] = lambda now: (now.mode, now.silences)
                 ) -> None:
        self._label = label('div', '', 'answer').props('role=status aria-live=polite')
        self._basis, self._held, self._since = basis, object(), 0.0
        page.follow(self._expire)

    def set_text(self, text: str) -> None:
        """Show a text other than a rejection."""
        self._label.set_text(text)
        self._label.classes(remove='rejected')
        self._since = time.monotonic()

    def show(self, answer: Answer) -> None:
        """Show an answer."""
        self.set_text(str(answer) if answer.accepted else f'✖ {answer}')
        if not answer.accepted:
            self._label.classes('rejected')

    def _expire(self, now: Snapshot) -> None:
        if not self._label.text:
            return
        # the request takes effect first
        if time.monotonic() - self._since < _SETTLED:
            self._held = self._basis(now)
        elif self._basis(now) != self._held:
            self.set_text('')


def unacknowledged(alarms: Sequence[Alarm]) -> list[Alarm]:
    """Return the alarms that wait for an acknowledgement, in their order."""
    return [alarm for alarm in alarms if alarm.state is not AlarmState.ACKNOWLEDGED]


def alarm_counts(now: Snapshot) -> str:
    """Write the numbers of alarms of a loop."""
    numbers = {'unacknowledged': len(unacknowledged(now.standing)), 'active': len(now.standing),
               'shelved': len(now.shelved)}
    return ' · '.join(f'{count} {what}' for what, count in numbers.items() if count) or 'No alarms'


def urgency(snapshots: Iterable[Snapshot]) -> tuple[int, Priority | None]:
    """Return the number of unacknowledged alarms, and the highest priority of them."""
    waiting = [alarm.priority for now in snapshots for alarm in unacknowledged(now.standing)]
    return len(waiting), max(waiting, key=lambda one: one.value, default=None)


class Lines:
    """List of lines, which is drawn again when they change."""

    def __init__(self, name: str, none: str = 'none') -> None:
        self._none = none
        self._shown: Sequence[str] | None = None
        self._list = attribute(box('card journal').props('role=list'), 'aria-label', name)

    def show(self, lines: Sequence[str]) -> None:
        """Show these lines."""
        if lines == self._shown:
            return
        self._shown = lines
        self._list.clear()
        with self._list:
            for line in lines or [self._none]:
                label('div', line).props('role=listitem')


def show_if(element: Element, shown: bool) -> None:
    """Show or hide an element."""
    if shown is ('hidden' in element.classes):
        element.classes(**{'remove' if shown else 'add': 'hidden'})


def show_value(element: ui.label, text: str, old: bool) -> None:
    """Show a value, marked where the node that sends it is silent."""
    element.set_text(f'? {text}' if old and text else text)
    if old is not ('old' in element.classes):
        element.classes(**{'add' if old else 'remove': 'old'})


def place(element: Element, **sides: float) -> None:
    """Place an element by shares of its parent, or hide it if none is given."""
    style = '; '.join(f'{side}: {100.0 * share:.1f}%' for side, share in sides.items())
    element.style(replace=style or 'display: none')


def attribute(element: _Kind, name: str, text: str) -> _Kind:
    """
    Set an attribute of an element to a text, which may come from outside.

    NiceGUI parses a string of props, and evaluates props with a leading ':' as JavaScript: no text
    from outside may be part of such a string, or of a name.

    :param text: for an address a path of the panel itself.
    :raises ValueError: for any other attribute, or another address.
    """
    own = name in _ADDRESSES and text.startswith('/') and not text.startswith('//')
    if element.props.get(name) == text:
        return element
    if name not in _TEXTS and not own:
        raise ValueError(f'{name} = {text!r} cannot be set: give a text to one of '
                         f'{", ".join(_TEXTS)}, or a path to one of {", ".join(_ADDRESSES)}')
    element.props[name] = text
    return element


def box(classes: str = '', tag: str = 'div') -> Element:
    """Return an element for others."""
    return ui.element(tag).classes(classes)


def card(title: str, name: str) -> Element:
    """Return a card with a title, and its name for a screen reader."""
    found = attribute(box('card', tag='section'), 'aria-label', name)
    with found:
        label('h2', title)
    return found


class _Label(ui.label):
    """Text in an element of any tag, with the units of nodes and files as people write them."""

    def __init__(self, tag: str, text: str) -> None:
        super().__init__()
        self.tag = tag
        self.set_text(text)

    def set_text(self, text: str) -> Self:
        return super().set_text(printed(text))


def label(tag: str, text: str, classes: str = '') -> ui.label:
    """Return text in an element."""
    return _Label(tag, text).classes(classes)


def link(text: str, target: str) -> Any:
    """Return a link to a page of the panel."""
    return attribute(_Label('a', text), 'href', target)
