# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What a bag tells of a controller: its inputs in the order they came, and what it answered."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
import math
import os

from koopman_ros.bags import BagMessage, BagReadError, in_log_order, read_messages, summary
from koopman_ros.control import Mode
from koopman_ros.nodes.messages import NANOSECONDS, stamp_nanoseconds
from koopman_ros.nodes.replaying.answers import Answers
from koopman_ros.nodes.replaying.inputs import Input, Silence
from koopman_ros.nodes.replaying.status import (
    Change,
    changes_of,
    lives_of,
    Status,
    statuses_in,
)

TEMPERATURE_TYPE = 'sensor_msgs/msg/Temperature'
# By so much a message may be recorded too early beside one of another topic.
_OVERTAKING_NS = NANOSECONDS // 5


@dataclass(frozen=True)
class Names:
    """
    The topics of a controller in a bag, as absolute names.

    :param namespace: of the controller, by which its diagnostics are known, e.g. ``unit_1``.
    """

    temperature: str = '/temperature'
    setpoint: str = '/setpoint'
    manual: str = '/manual_coolant_setpoint'
    command: str = '/coolant_setpoint'
    active: str = '/active_setpoint'
    coolant: str = '/coolant_temperature'
    internals: str = '/controller_state'
    diagnostics: str = '/diagnostics'
    namespace: str = ''


@dataclass(frozen=True)
class ControlRecord:
    """
    A controller's run as recorded.

    :param names: of its topics.
    :param inputs: in the order in which they came.
    :param active_before: the set-point that was tracked before the first measurement of the bag,
        (stamp in ns, degrees Celsius), or None.
    :param mode: at the beginning.
    :param began_before: whether the controller had answered measurements before the first.
    :param tells_active: whether changes of the tracked set-point were recorded.
    :param models: those in force, in the order of their use.
    :param silences: number of commands that the controller gave because no measurement came.
    :param unmatched_commands: number of others that answer no recorded measurement.
    :param complete: whether the recorder closed the bag.
    """

    names: Names
    inputs: tuple[Input, ...]
    active_before: tuple[int, float] | None
    mode: Mode
    began_before: bool
    tells_active: bool
    models: tuple[str, ...]
    silences: int
    unmatched_commands: int
    complete: bool


def read_record(path: str | os.PathLike[str], names: Names, *, recover: bool = False
                ) -> ControlRecord:
    """
    Read what a replay needs from a bag.

    :param path: a .mcap file or a bag directory.
    :param names: of the controller's topics.
    :param recover: read a bag that was not closed or is damaged as far as it is whole.
    :raises BagReadError: for a bag that cannot be read, or lacks measurements or commands.
    """
    wanted = (names.temperature, names.setpoint, names.manual, names.command, names.active,
              names.coolant)
    inputs: list[Input] = []
    commands, actives, coolants, tracked = Answers(), Answers(), Answers(), Answers()
    statuses: list[Status] = []
    measured = 0
    for entry in in_log_order(read_messages(
            path, (*wanted, names.internals, names.diagnostics), recover=recover)):
        if entry.topic == names.diagnostics:
            statuses += statuses_in(entry, names.namespace, measured)
            continue
        if entry.topic == names.internals:
            tracked.add_tracked(entry)
            continue
        _check(path, entry)
        if entry.topic == names.command:
            commands.add(entry)
        elif entry.topic == names.active:
            actives.add(entry)
        elif entry.topic == names.coolant:
            coolants.add(entry)
        else:
            inputs.append(Input(entry.topic, entry.log_time_ns, entry.message))
            measured += entry.topic == names.temperature
    content = summary(path)
    for topic, count in ((names.temperature, measured), (names.command, len(commands.in_order))):
        if not count:
            known = ', '.join(name for name, count in sorted(content.counts.items()) if count)
            raise BagReadError(
                f'bag {os.fspath(path)!r} has no message on {topic!r}, it has {known or "none"}: '
                f'name the topic that stands for it, e.g. -r {topic[1:]}:=NAME')
    return _assembled(names, inputs, commands, actives, coolants, tracked, statuses,
                      content.complete)


def _assembled(names: Names, inputs: list[Input], commands: Answers, actives: Answers,
               coolants: Answers, tracked: Answers, statuses: list[Status], complete: bool
               ) -> ControlRecord:
    first = next(entry for entry in inputs if entry.topic == names.temperature)
    answers: dict[int, int] = {}  # place of the command by that of the measurement
    for k, entry in enumerate(inputs):
        if entry.topic == names.temperature:
            place = commands.take(entry)
            if place is not None:
                answers[k] = place
            changed, every = actives.taken(entry), tracked.taken(entry)
            inputs[k] = replace(
                entry, command=None if place is None else commands.in_order[place][2],
                active=changed if every is None else every, coolant=coolants.last(entry))
    answered = list(_with_silences(inputs, answers, commands, names))
    silences = len(answered) - len(inputs)
    pairs = [(entry.message.temperature, math.nan if entry.command is None else entry.command)
             for entry in answered if entry.topic == names.temperature]
    lives = list(lives_of(statuses, pairs))
    active_before = actives.before(first)
    return ControlRecord(
        names=names,
        inputs=tuple(_with_changes(names, answered, deque(changes_of(lives)))),
        active_before=active_before,
        mode=statuses[0].mode if statuses else Mode.AUTOMATIC,
        began_before=(active_before is not None or commands.before(first) is not None
                      or (bool(lives) and lives[0].earlier > 0)),
        tells_active=bool(actives.in_order),
        models=tuple(dict.fromkeys(status.model for status in statuses)),
        silences=silences,
        unmatched_commands=len(commands.in_order) - len(answers) - silences,
        complete=complete,
    )


def _with_silences(inputs: list[Input], answers: dict[int, int], commands: Answers, names: Names
                   ) -> Iterator[Input]:
    """
    Yield the inputs with what the controller commanded by itself among them.

    Its commands went out in the order of what they answer, whenever that was recorded.
    """
    taken = set(answers.values())
    waiting = deque(place for place in range(len(commands.in_order)) if place not in taken)
    measured_ns: int | None = None
    for k, entry in enumerate([*inputs, None]):
        while waiting and (waiting[0] < answers[k] if k in answers else
                           entry is None or commands.in_order[waiting[0]][1] < entry.time_ns):
            stamp_ns, time_ns, _ = commands.in_order[waiting.popleft()]
            if measured_ns is not None and stamp_ns > measured_ns:
                yield Input('', time_ns, Silence(stamp_ns))
        if entry is not None:
            yield entry
            if entry.topic == names.temperature:
                measured_ns = stamp_nanoseconds(entry.message.header.stamp)


def _with_changes(names: Names, inputs: list[Input], changes: deque[Change]) -> Iterator[Input]:
    """Yield the inputs with the changes among them."""
    count = 0
    for entry in inputs:
        measured = entry.topic == names.temperature
        while changes and _comes_before(changes[0], entry, count, measured):
            change = changes.popleft()
            yield Input('', change.time_ns, change.mode)
        count += measured
        yield entry


def _comes_before(change: Change, entry: Input, count: int, measured: bool) -> bool:
    """Tell whether a change comes before the input that follows `count` measurements."""
    if change.place == count:
        # a request follows the change that it needs, also when it overtook word of it
        return measured or change.time_ns < entry.time_ns + _OVERTAKING_NS
    return change.place < count


def _check(path: str | os.PathLike[str], entry: BagMessage) -> None:
    """Refuse another type of message, also one that only bears the name."""
    message = entry.message
    try:
        float(message.temperature)
        stamp_nanoseconds(message.header.stamp)
    except (AttributeError, TypeError, ValueError):
        fits = False
    else:
        fits = entry.type_name == TEMPERATURE_TYPE
    if not fits:
        raise BagReadError(
            f'topic {entry.topic!r} of bag {os.fspath(path)!r} is {entry.type_name} and not laid '
            f'out as {TEMPERATURE_TYPE}: choose another topic by a remap, e.g. '
            f'-r {entry.topic[1:]}:=NAME')
