# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
What the controller said of itself in a bag: its mode, its model, and when it was started.

A status tells how many measurements the controller had answered when it was published, which
places a change of mode exactly, whatever the times at which the topics were recorded.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

from koopman_ros.bags import BagMessage
from koopman_ros.control import Mode
from koopman_ros.nodes.diagnostics import as_text

# Of one controller there are a few; each is compared with every status.
_MOST_OFFSETS = 200


@dataclass(frozen=True)
class Status:
    """
    What the controller said of itself, as far as a replay needs it.

    :param time_ns: when it was recorded.
    :param mode: who commanded.
    :param measurements: how many it had answered since its start.
    :param recorded: how many measurements of the bag had been recorded before this.
    :param last: the last measurement and its command, as written in the message.
    :param model: the model in force.
    """

    time_ns: int
    mode: Mode
    measurements: int
    recorded: int
    last: tuple[str, str]
    model: str


def statuses_in(entry: BagMessage, prefix: str, recorded: int) -> Iterator[Status]:
    """Yield what the controller says in a message of diagnostics."""
    listed = getattr(entry.message, 'status', None)
    for status in listed if isinstance(listed, list) else ():
        try:
            node, _, task = status.name.partition(': ')
            values = {item.key: item.value for item in status.values}
            if task == 'control' and node.rpartition('/')[0] == prefix:
                last = values['temperature [degC]'], values['coolant [degC]']
                yield Status(entry.log_time_ns, Mode(values['mode']),
                             int(values['measurements']), recorded, last, values['model'])
        except (AttributeError, KeyError, TypeError, ValueError):
            # of another program, or another version of ours
            continue


@dataclass(frozen=True)
class Life:
    """
    What the controller said between two starts.

    :param statuses: in the order in which they were recorded.
    :param earlier: how many measurements it had answered before the first one of the bag;
        negative when it was started later.
    """

    statuses: list[Status]
    earlier: int


def lives_of(statuses: list[Status], answered: list[tuple[float, float]]) -> Iterator[Life]:
    """
    Yield the statuses between starts, which set the count of measurements back.

    :param statuses: in the order in which they were recorded.
    :param answered: the measurements in the bag with their commands, in degrees Celsius.
    """
    written = [(as_text(measured), as_text(command)) for measured, command in answered]
    life: list[Status] = []
    for status in statuses:
        if life and status.measurements < life[-1].measurements:
            yield Life(life, _earlier(life, written))
            life = []
        life.append(status)
    if life:
        yield Life(life, _earlier(life, written))


def _earlier(life: list[Status], written: list[tuple[str, str]]) -> int:
    """Find the measurements answered before the bag by what the statuses say of the last ones."""
    # topics pass each other on their way, by some measurements in a fast loop
    offsets = Counter(status.measurements - status.recorded for status in life)

    def confirmed(offset: int) -> tuple[int, int]:
        places = [(status.measurements - offset - 1, status) for status in life]
        return sum(0 <= place < len(written) and written[place] == status.last
                   for place, status in places), offsets[offset]

    return max((offset for offset, _ in offsets.most_common(_MOST_OFFSETS)), key=confirmed)


@dataclass(frozen=True)
class Change:
    """
    A change of mode, or a new start of the controller.

    :param place: number of measurements in the bag before it.
    :param time_ns: when it was recorded.
    :param mode: the new one, or None for a start.
    """

    place: int
    time_ns: int
    mode: Mode | None


def changes_of(lives: list[Life]) -> Iterator[Change]:
    """Yield what changed, in order."""
    mode = lives[0].statuses[0].mode if lives else Mode.AUTOMATIC
    for k, life in enumerate(lives):
        if k > 0:
            mode = Mode.AUTOMATIC
            yield Change(-life.earlier, life.statuses[0].time_ns, None)
        for status in life.statuses:
            if status.mode is not mode:
                mode = status.mode
                yield Change(status.measurements - life.earlier, status.time_ns, mode)
