# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What happened before the panel was started, from the bag that is being recorded."""

from collections.abc import Callable, Mapping
import math
import time
from typing import Any

from koopman_ros.bags import BagReadError, read_messages
from koopman_ros.bags.series import stamped_number
from koopman_ros.panel.plant import pen, PlantView
from koopman_ros.parameters.wire import CONTROLLER_EVENTS, Wiring
from koopman_ros.replay.records import parse, RecordError
from koopman_ros.units import conversion, NANOSECONDS
from koopman_ros.wire import Place

_KINDS = ('measured', 'active_setpoints', 'predicted', 'applied', 'commands')
_BUCKETS = 10_000  # in which what was read is handed over, with their extremes
_BATCH = 200  # messages, after which others have their turn for
_PAUSE = 0.001  # s


def read_past(path: str, wiring: Wiring, read: Mapping[str, str],
              resolve: Callable[[str], str], span: float,
              ended: Callable[[], bool] = lambda: False) -> PlantView:
    """
    Return the view of a loop that its bag gives, as far as it is whole.

    It may take a minute for hours of records, and leaves room for other threads meanwhile.

    :param read: units in which people read the signals, by name.
    :param resolve: makes names of topics those in the bag.
    :param span: s of the past that is kept.
    :param ended: tells that it is not wanted any more.
    :raises BagReadError: for what is no bag.
    """
    signals = wiring.signals
    places: dict[str, list[tuple[str, str, Place, Any]]] = {}
    for kind in _KINDS:
        for name, place in getattr(wiring, kind).items():
            unit = signals.units[name]
            places.setdefault(resolve(place.topic), []).append(
                (kind, name, place, conversion(place.unit, unit)))
    events = resolve(CONTROLLER_EVENTS)
    past = PlantView(signals, read, span, 0.0)
    for number, entry in enumerate(read_messages(path, (*places, events), recover=True)):
        if number % _BATCH == 0:
            time.sleep(_PAUSE)
            if ended():
                break
        if entry.topic == events:
            try:
                record = parse(entry.message.data)
            except (AttributeError, RecordError):
                continue
            past.record(record.event, record.fields, 0.0)
            continue
        for kind, name, place, own in places[entry.topic]:
            try:
                stamp, value = stamped_number(path, entry, place)
            except BagReadError:
                continue
            if value is not None:
                past.hear(kind, {name: own(value)}, (
                    entry.log_time_ns if stamp is None else stamp) / NANOSECONDS, 0.0)
    return past


def fill_in(view: PlantView, past: PlantView, first: float) -> None:
    """Give a view the trends of the past, and what happened before its first measurement."""
    signals = view.signals
    for kind in _KINDS:
        names = signals.inputs if kind in ('applied', 'commands') else (
            signals.controlled if kind == 'active_setpoints' else signals.states)
        for name in names:
            own = pen(kind, name)
            view.trends.extend(own, *past.trends.window(
                [own], -math.inf, math.inf, _BUCKETS)[own])
    for mark in past.trends.marks(-math.inf, math.nextafter(first, -math.inf)):
        view.trends.mark(mark.time, mark.kind, mark.text)
