# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The page with all alarms, those that are shelved, and the list of the day."""

from __future__ import annotations

from typing import Any

from nicegui import ui

from koopman_ros.panel.frame import alarm_row, clock, div, Frame, unshelve, words
from koopman_ros.panel.plant import Snapshot

_LISTED = 200  # entries of the day that are shown
_DAY = 86400.0  # s


def alarm_page(frame: Frame) -> None:
    """Build the page."""
    with frame.body:
        words('h2', 'Standing')
        standing = div('strip').props('role=list aria-label="Standing alarms"')
        words('h2', 'Shelved')
        shelved = div('strip').props('role=list aria-label="Shelved alarms"')
        words('h2', 'Of the day')
        day = div('card journal').props('role=list aria-label="Alarms of the day"')
    shown: list[Any] = [None, None, None]

    def show(now: Snapshot) -> None:
        alarms = frame.source.view.alarms
        entries = alarms.journal(now.wall - _DAY)[:_LISTED]
        if shown[0] != now.standing:
            standing.clear()
            with standing:
                for alarm in now.standing:
                    alarm_row(frame, alarm, shelving=True)
                if not now.standing:
                    words('div', 'none', 'quiet')
        if shown[1] != now.shelved:
            shelved.clear()
            with shelved:
                for alarm in now.shelved:
                    with div('alarm').props('role=listitem'):
                        words('span', alarm.text, 'what')
                        words('span', f'until {clock(alarm.shelved_until or 0.0)}', 'quiet')
                        frame.control(ui.button(
                            'Show again', on_click=lambda _, a=alarm: unshelve(frame, a)).props(
                                'outline dense'))
                if not now.shelved:
                    words('div', 'none', 'quiet')
        if shown[2] != entries:
            day.clear()
            with day:
                for entry in entries:
                    who = f' by {entry.who}' if entry.who else ''
                    words('div', f'{clock(entry.time)}  {entry.priority.word}  {entry.what}{who}: '
                          f'{entry.text}').props('role=listitem')
                if not entries:
                    words('div', 'none', 'quiet')
        shown[:] = [now.standing, now.shelved, entries]

    frame.follow(show)
