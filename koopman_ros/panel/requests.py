# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Requests of operators, and the controller's answers from its event log."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
import json
import math
from typing import Any

TIMEOUT = 3.0  # s for the answer of a controller
_SENTENCE = 1.5  # s until its status has the reason of a rejection
REJECTED = 'request rejected: '  #: prefix of that status

SETPOINT, MANUAL = 'setpoint', 'manual_command'  #: events of records


@dataclass(frozen=True)
class Action:
    """Action of an operator."""

    who: str
    #: setpoint, manual, automatic, clear safe state, reset, reload, record, experiment, train,
    #: cancel, compare, end comparison or parameters
    what: str
    name: str = ''  #: of the signal or the node
    value: Any = None  #: in the unit in which people read it
    old: Any = None


@dataclass(frozen=True)
class Answer:
    """Answer to an action."""

    accepted: bool
    text: str

    def __str__(self) -> str:
        """Write the answer as the pages show it."""
        return self.text if self.accepted or self.text.startswith('rejected') else (
            f'rejected: {self.text}')


def action_text(action: Action, answer: Answer, stamp: float, unit: str = '') -> str:
    """Return the line of JSON of an action; `unit` is that of its values."""
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
    accepted: str  # text of the answer if the request is accepted
    rejected: str = ''  # words of the code


class Requests:
    """
    Requests on topics that the controller has not answered yet.

    :param signals: signals in the records of each event, in their order.
    :param words: writes the codes of a rejection of a value of a signal; '' if it cannot.
    """

    def __init__(self, signals: Mapping[str, Sequence[str]],
                 words: Callable[[Sequence[str], str, float], str] = lambda *_: '') -> None:
        self._signals, self._words = signals, words
        self._open: list[_Open] = []

    def add(self, event: str, name: str, value: float, now: float,
            reply: Callable[[Answer], None], accepted: str = 'accepted') -> None:
        """Wait for the answer to a value that was published."""
        self._open.append(_Open(event, name, value, now + TIMEOUT, reply, accepted))

    def take_record(self, event: str, fields: Mapping[str, Any], now: float) -> None:
        """Take a record, which may answer a request."""
        if event not in (SETPOINT, MANUAL):
            return
        try:
            names = fields.get('signals') or self._signals[event]
            values = dict(zip(names, map(float, fields['value']), strict=True))
            accepted, codes = bool(fields['accepted']), tuple(map(str, fields['reason']))
        except (KeyError, TypeError, ValueError):
            return
        request = next((one for one in self._open if one.event == event and not one.rejected
                        and math.isclose(values.get(one.name, math.nan), one.value,
                                         rel_tol=1e-9, abs_tol=1e-12)), None)
        if request is None:
            return
        if accepted:
            self._answer(request, Answer(True, request.accepted))
        elif words := self._words(codes, request.name, request.value):
            self._answer(request, Answer(False, words))
        else:
            # the sentence follows with the next status
            request.rejected = ', '.join(code.replace('_', ' ') for code in codes) or 'rejected'
            request.deadline = now + _SENTENCE

    def take_status(self, message: str) -> None:
        """Take the message of the controller's status, perhaps with the reason of a rejection."""
        if message.startswith(REJECTED):
            for request in [one for one in self._open if one.rejected]:
                self._answer(request, Answer(False, message.removeprefix(REJECTED)))

    def advance(self, now: float) -> None:
        """Answer the requests for which the controller has no answer in time."""
        for request in [one for one in self._open if now > one.deadline]:
            self._answer(request, Answer(False, request.rejected or (
                f'the controller did not answer within {TIMEOUT:g} s: check its log')))

    def _answer(self, request: _Open, answer: Answer) -> None:
        self._open.remove(request)
        request.reply(answer)
