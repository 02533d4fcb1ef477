# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What operators ask for, and the controller's answers, which come as records."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
import json
import math
from typing import Any, Protocol

PATIENCE = 3.0  # s in which a controller answers
_SENTENCE = 1.5  # s in which its diagnostics say why it refused
REFUSED = 'request refused: '  #: what they begin with then

SETPOINT, MANUAL = 'setpoint', 'manual_command'  #: events of records


@dataclass(frozen=True)
class Action:
    """What an operator asks for."""

    who: str
    #: setpoint, manual, automatic, reload, record, experiment, train, cancel, compare,
    #: end comparison or parameters
    what: str
    name: str = ''  #: of the signal or the node
    value: Any = None  #: in the unit in which people read it
    old: Any = None


@dataclass(frozen=True)
class Answer:
    """What came of it."""

    accepted: bool
    text: str

    def __str__(self) -> str:
        """Write it as it is shown where the action was asked for."""
        return self.text if self.accepted or self.text.startswith('refused') else (
            f'refused: {self.text}')


class Desk(Protocol):
    """Where actions are handed in; answers come later."""

    def ask(self, action: Action) -> Future[Answer]:
        """Do what an operator asks for; called from any thread."""


def action_text(action: Action, answer: Answer, stamp: float, unit: str = '') -> str:
    """Return the line of JSON that says what an operator did; `unit` is that of the values."""
    return json.dumps({'stamp': round(stamp, 3), 'who': action.who, 'what': ' '.join(
        filter(None, (action.what, action.name))), 'old': _plain(action.old),
        'new': _plain(action.value), **({'unit': unit} if unit else {}),
        'accepted': answer.accepted, 'answer': answer.text}, allow_nan=False)


def _plain(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return repr(value)
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    return list(value) if isinstance(value, tuple) else value


@dataclass
class _Open:
    event: str
    name: str
    value: float  # in the unit of the signal
    deadline: float
    reply: Callable[[Answer], None]
    accepted: str  # the answer where it is
    refused: str = ''  # why, in the words of its code


class Requests:
    """
    Requests on topics that a controller has not answered yet.

    :param signals: those in the records of each event, in their order.
    :param words: writes the codes of a refusal of a value of a signal; '' where it cannot.
    """

    def __init__(self, signals: Mapping[str, Sequence[str]],
                 words: Callable[[Sequence[str], str, float], str] = lambda *_: '') -> None:
        self._signals, self._words = signals, words
        self._open: list[_Open] = []

    def add(self, event: str, name: str, value: float, now: float,
            reply: Callable[[Answer], None], accepted: str = 'accepted') -> None:
        """Wait for the answer to a value that was just published."""
        self._open.append(_Open(event, name, value, now + PATIENCE, reply, accepted))

    def record(self, event: str, fields: Mapping[str, Any], now: float) -> None:
        """Take a record, which may answer a request."""
        if event not in (SETPOINT, MANUAL):
            return
        try:
            names = fields.get('signals') or self._signals[event]
            values = dict(zip(names, map(float, fields['value']), strict=True))
            accepted, codes = bool(fields['accepted']), tuple(map(str, fields['reason']))
        except (KeyError, TypeError, ValueError):
            return
        for request in self._open:
            same = math.isclose(values.get(request.name, math.nan), request.value,
                                rel_tol=1e-9, abs_tol=1e-12)
            if same and request.event == event and not request.refused:
                break
        else:
            return
        if accepted:
            self._answer(request, Answer(True, request.accepted))
        elif said := self._words(codes, request.name, request.value):
            self._answer(request, Answer(False, said))
        else:
            # the codes come at once, their sentence with the next status
            request.refused = ', '.join(code.replace('_', ' ') for code in codes) or 'refused'
            request.deadline = now + _SENTENCE

    def status(self, message: str) -> None:
        """Take the sentence of the controller's status, which may say why it refused."""
        if not message.startswith(REFUSED):
            return
        for request in [one for one in self._open if one.refused]:
            self._answer(request, Answer(False, message.removeprefix(REFUSED)))

    def advance(self, now: float) -> None:
        """Give up what was not answered in time."""
        for request in [one for one in self._open if now > one.deadline]:
            self._answer(request, Answer(False, request.refused or (
                f'the controller did not answer within {PATIENCE:g} s: look at its log')))

    def _answer(self, request: _Open, answer: Answer) -> None:
        self._open.remove(request)
        request.reply(answer)
