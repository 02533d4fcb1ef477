# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Page of the trends: the chart, the time that it shows, and the events in it."""

from __future__ import annotations

import time

from nicegui import ui

from koopman_ros.panel.layout import box, label, Lines, PageLayout, show_if
from koopman_ros.panel.snapshot import Snapshot
from koopman_ros.panel.trend_chart import EPOCH, SPANS, TrendChart

_DAY = 86400.0  # s


def trend_page(page: PageLayout) -> None:
    """Build the page."""
    with page.body:
        with box('row1 middle'):
            span = ui.toggle(list(SPANS), value='10 min').props(
                'aria-label="Time shown" unelevated color=grey-5 text-color=black '
                'toggle-color=grey-9')
            whole = ui.checkbox('whole range')
            until = ui.input('Until, h:mm:ss', placeholder='now', validation={
                'not h:mm:ss or h:mm': lambda text: not text or time_of_day(
                    str(text), page.source.view.trends.latest or 0.0) is not None}).props(
                        'outlined dense hide-bottom-space')
            earlier = ui.button('Earlier').props('outline')
            later = ui.button('Later').props('outline')
            present = ui.button('Now').props('outline')
            past = label('span', '▲ NOT LIVE', 'abnormal hidden')
            label('span', 'Click a name to hide its line; scroll or pinch to zoom, drag to pan, '
                  'hover to read values and events', 'quiet')
        chart = TrendChart(page, 290, zoom=True)
        label('h2', 'Events')
        events = Lines('Events', 'none in this period')

    def show(_: Snapshot) -> None:
        chart.update()
        show_if(past, not chart.live)
        events.show([f'{_clock(mark.time)}  {mark.kind}: {mark.text}'
                     for mark in reversed(chart.marks)])

    def end() -> float | None:
        return time_of_day(str(until.value), page.source.view.trends.latest or 0.0)

    def change() -> None:
        # a browser may send any value
        if span.value in SPANS:
            chart.show(str(span.value), bool(whole.value), end())

    def shift(sign: float) -> None:
        latest = page.source.view.trends.latest
        if span.value in SPANS and latest is not None:
            found = (latest if (now := end()) is None else now) + sign * SPANS[span.value][0] / 2.0
            # a time of day is one of the last 24 hours
            first = 0.0 if latest < EPOCH else latest - _DAY + 1.0
            until.set_value('' if found >= latest else _clock(max(found, first)))

    for control in (span, whole, until):
        control.on_value_change(change)

    def follow() -> None:
        until.set_value('')
        chart.reset()

    present.on_click(follow)
    earlier.on_click(lambda: shift(-1.0))
    later.on_click(lambda: shift(1.0))
    page.follow(show)


def _clock(seconds: float) -> str:
    """Write a time of day, or the hours, minutes and seconds of a simulation."""
    if seconds >= EPOCH:
        return time.strftime('%H:%M:%S', time.localtime(seconds))
    return f'{int(seconds // 3600.0):02}' + time.strftime(':%M:%S', time.gmtime(seconds))


def time_of_day(text: str, latest: float) -> float | None:
    """
    Return a time that is written as h:mm:ss or h:mm; None for another text.

    :param latest: time of the last value; a wall time is the last one before it.
    """
    try:
        hours, minutes, seconds = (*map(int, text.split(':')), 0)[:3]
    except ValueError:
        return None
    after = 3600.0 * hours + 60.0 * minutes + seconds
    if latest < EPOCH:
        return after
    found = time.mktime((*time.localtime(latest)[:3], 0, 0, 0, 0, 0, -1)) + after
    return found if found <= latest else found - _DAY
