# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Requests of operators, and the controller's answers from its event log."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import Enum
import json
import math
from typing import Any

TIMEOUT = 3.0  # s for the answer of a controller
_SENTENCE = 1.5  # s until its status has the reason of a rejection
UNKNOWN = 'unknown: '  #: prefix of an answer where a request may still be carried out
REJECTED = 'request rejected: '  #: prefix of that status

SETPOINT, MANUAL = 'setpoint', 'manual_command'  #: events of records


class Role(Enum):
    """Permissions of a user; the value is the word in the file."""

    VIEWER = 'viewer'  #: sees all pages
    OPERATOR = 'operator'  #: also operates the loop
    ENGINEER = 'engineer'  #: also changes limits, laws, safe values and models

    def includes(self, other: Role) -> bool:
        """Return whether it has the permissions of another role."""
        roles = list(Role)
        return roles.index(self) >= roles.index(other)


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


def required_role(what: str) -> Role:
    """Return the role that an action needs."""
    return Role.ENGINEER if what in ('parameters', 'reload') else Role.OPERATOR


@dataclass(frozen=True)
class Answer:
    """Answer to an action."""

    accepted: bool
    text: str

    def __str__(self) -> str:
        """Write the answer as the pages show it."""
        return self.text if self.accepted or self.text.startswith(('rejected', UNKNOWN)) else (
            f'rejected: {self.text}')


@dataclass(frozen=True)
class AuditEntry:
    """An action with its answer, in the audit log."""

    stamp: float  #: wall time
    who: str
    what: str
    old: Any
    new: Any
    unit: str  #: of the values, or empty
    accepted: bool
    answer: str

    @classmethod
    def of(cls, action: Action, answer: Answer, stamp: float, unit: str = '') -> AuditEntry:
        """Return the entry of an action; `unit` is that of its values."""
        return cls(round(stamp, 3), action.who, ' '.join(filter(None, (action.what, action.name))),
                   _plain(action.old), _plain(action.value), unit, answer.accepted, answer.text)

    def text(self) -> str:
        """Return the entry as a line of JSON."""
        found = asdict(self)
        return json.dumps({key: value for key, value in found.items() if key != 'unit' or value},
                          allow_nan=False)


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
    who: str
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
        self._expected: dict[str, tuple[str, float]] = {}  # person and deadline, by event

    def add(self, event: str, name: str, value: float, now: float,
            reply: Callable[[Answer], None], accepted: str = 'accepted', who: str = '') -> None:
        """Wait for the answer to a value that was published."""
        self._open.append(_Open(event, name, value, now + TIMEOUT, reply, accepted, who))

    def expect(self, event: str, who: str, now: float) -> None:
        """Expect a record of another kind, which a service of the controller causes."""
        self._expected[event] = who, now + TIMEOUT

    def take_record(self, event: str, fields: Mapping[str, Any], now: float) -> str:
        """Take a record, which may answer a request; return who made it, or ''."""
        if event not in (SETPOINT, MANUAL):
            who, until = self._expected.pop(event, ('', 0.0))
            return who if now <= until else ''
        try:
            names = fields.get('signals') or self._signals[event]
            values = dict(zip(names, map(float, fields['value']), strict=True))
            accepted, codes = bool(fields['accepted']), tuple(map(str, fields['reason']))
        except (KeyError, TypeError, ValueError):
            return ''
        request = next((one for one in self._open if one.event == event and not one.rejected
                        and math.isclose(values.get(one.name, math.nan), one.value,
                                         rel_tol=1e-9, abs_tol=1e-12)), None)
        if request is None:
            return ''
        if accepted:
            self._answer(request, Answer(True, request.accepted))
        elif words := self._words(codes, request.name, request.value):
            self._answer(request, Answer(False, words))
        else:
            # the sentence follows with the next status
            request.rejected = ', '.join(code.replace('_', ' ') for code in codes) or 'rejected'
            request.deadline = now + _SENTENCE
        return request.who

    def take_status(self, message: str) -> None:
        """Take the message of the controller's status, perhaps with the reason of a rejection."""
        if message.startswith(REJECTED):
            for request in [one for one in self._open if one.rejected]:
                self._answer(request, Answer(False, message.removeprefix(REJECTED)))

    def advance(self, now: float) -> None:
        """Answer the requests for which the controller has no answer in time."""
        for request in [one for one in self._open if now > one.deadline]:
            self._answer(request, Answer(False, request.rejected or (
                f'{UNKNOWN}the controller did not answer within {TIMEOUT:g} s: check the value '
                'shown, and its log')))

    def _answer(self, request: _Open, answer: Answer) -> None:
        self._open.remove(request)
        request.reply(answer)
