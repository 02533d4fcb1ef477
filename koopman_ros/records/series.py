# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Recorded signals: a number in each message of a topic."""

from collections.abc import Iterable
from dataclasses import dataclass
import os

import numpy as np
from numpy.typing import NDArray

from koopman_ros.core.message_fields import MessageField
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.records.decoding import BagMessage
from koopman_ros.records.mcap_file import BagReadError, reason
from koopman_ros.records.reader import BagSummary, read_messages, summary

_MOST_NS = 2**63


@dataclass(frozen=True)
class Series:
    """A signal as arrays of one length n, in the order of recording."""

    stamp_ns: NDArray[np.int64]  #: (n,) the header's stamp [ns], of receipt where there is none
    values: NDArray[np.float64]  #: (n,) the numbers
    unit: str  #: of the numbers


def read_series(path: str | os.PathLike[str], place: MessageField, *, recover: bool = False
                ) -> Series:
    """
    Return a signal of a bag as arrays; `recover` is that of `read_messages`.

    Messages without the number are left out.

    :raises BagReadError: as `read_messages` does, and for a topic that the bag does not hold or
        that is of another type.
    """
    # before the summary, which tolerates damage
    messages = read_messages(path, [place.topic], recover=recover)
    check_places(path, summary(path), [place])
    found = [(entry, stamped_number(path, entry, place)) for entry in messages]
    numbers = [(entry.log_time_ns if stamp is None else stamp, value)
               for entry, (stamp, value) in found if value is not None]
    return Series(np.array([stamp for stamp, _ in numbers], dtype=np.int64),
                  np.array([value for _, value in numbers], dtype=np.float64), place.unit)


def check_places(path: str | os.PathLike[str], content: BagSummary, places: Iterable[MessageField]
                 ) -> None:
    """Raise BagReadError for a topic that a bag does not hold, or that is of another type."""
    for place in places:
        if place.topic not in content.types:
            known = ', '.join(sorted(content.types)) or 'no topics'
            raise BagReadError(f'bag {os.fspath(path)!r} has no topic {place.topic!r}, its topics '
                               f'are {known}: correct the topic names, or record them')
        if content.types[place.topic] != place.type:
            raise _other_type(path, place.topic, content.types[place.topic], place.type)


def stamped_number(path: str | os.PathLike[str], entry: BagMessage, place: MessageField
                   ) -> tuple[int | None, float | None]:
    """
    Return stamp [ns] and number of a message: None where its type has none, or an array lacks it.

    :raises BagReadError: for a message of another type, or one that is laid out differently.
    """
    if entry.type_name != place.type:
        raise _other_type(path, entry.topic, entry.type_name, place.type)
    try:
        header = getattr(entry.message, 'header', None)
        stamp_ns = None if header is None else (
            NANOSECONDS * header.stamp.sec + header.stamp.nanosec)
        if stamp_ns is not None and not -_MOST_NS < stamp_ns < _MOST_NS:
            raise OverflowError(f'a stamp of {stamp_ns} ns')
        try:
            return stamp_ns, place.get(entry.message)
        except LookupError:
            # an array may be shorter at times, or name other elements
            if '[' not in place.field:
                raise
            return stamp_ns, None
    except (AttributeError, LookupError, TypeError, ValueError, OverflowError) as error:
        raise BagReadError(
            f'topic {entry.topic!r} of bag {os.fspath(path)!r} has type {entry.type_name} with a '
            f'different definition ({reason(error)}): read it with read_messages') from error


def _other_type(path: str | os.PathLike[str], topic: str, found: str, wanted: str) -> BagReadError:
    return BagReadError(f'topic {topic!r} of bag {os.fspath(path)!r} is {found}, not {wanted}: '
                        'name another topic, or its type')
