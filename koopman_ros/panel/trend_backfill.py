# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Trends from before the start of the panel, from the bag that is being recorded."""

from collections.abc import Callable, Mapping
import math
import time
from typing import Any

from koopman_ros.core.message_fields import MessageField
from koopman_ros.core.units import conversion, NANOSECONDS
from koopman_ros.event_log.records import parse, RecordError
from koopman_ros.panel.faceplates import pen
from koopman_ros.panel.view_model import LoopViewModel
from koopman_ros.parameters.signal_topics import EVENT_LOG, SignalTopics
from koopman_ros.records import BagReadError, read_messages
from koopman_ros.records.series import stamped_number

_KINDS = ('measured', 'active_setpoints', 'predicted', 'applied', 'commands',
          'measured_disturbances')
_BUCKETS = 10_000
_BATCH = 200  # messages between two pauses for other threads
_PAUSE = 0.001  # s


def read_past(path: str, wiring: SignalTopics, read: Mapping[str, str],
              resolve: Callable[[str], str], span: float,
              ended: Callable[[], bool] = lambda: False) -> LoopViewModel:
    """
    Return the view model of a loop from the readable part of its bag.

    Hours of records take a minute.

    :param read: units in which people read the signals, by name.
    :param resolve: full name of a topic.
    :param span: s of the past that is kept.
    :param ended: whether to stop.
    :raises BagReadError: for a file that is not a bag.
    """
    signals = wiring.signals
    places: dict[str, list[tuple[str, str, MessageField, Any]]] = {}
    for kind in _KINDS:
        for name, place in getattr(wiring, kind).items():
            places.setdefault(resolve(place.topic), []).append(
                (kind, name, place, conversion(place.unit, signals.units[name])))
    events = resolve(EVENT_LOG)
    past = LoopViewModel(signals, read, span, 0.0)
    for number, entry in enumerate(read_messages(path, (*places, events), recover=True)):
        if number % _BATCH == 0:
            time.sleep(_PAUSE)
            if ended():
                break
        try:
            if entry.topic == events:
                record = parse(entry.message.data)
                past.take_record(record.event, record.fields, 0.0)
                continue
            for kind, name, place, own in places[entry.topic]:
                stamp, value = stamped_number(path, entry, place)
                if value is not None:
                    past.take_signals(kind, {name: own(value)}, (
                        entry.log_time_ns if stamp is None else stamp) / NANOSECONDS, 0.0)
        except (AttributeError, RecordError, BagReadError):
            continue
    return past


def backfill(view: LoopViewModel, past: LoopViewModel, first: float) -> None:
    """Add the trends of the past, and its events before the first measurement, to a view model."""
    for kind in _KINDS:
        for name in view.signals.units:
            own = pen(kind, name)
            times, values = past.trends.window([own], -math.inf, math.inf, _BUCKETS)[own]
            if len(times):
                view.trends.prepend(own, times, values)
    for mark in past.trends.marks(-math.inf, math.nextafter(first, -math.inf)):
        view.trends.mark(mark.time, mark.kind, mark.text)
