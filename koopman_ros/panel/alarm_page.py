# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The page with all alarms, those that are shelved, and the list of the day."""

from __future__ import annotations

from typing import Any

from koopman_ros.panel.frame import alarm_rows, clock, div, Frame, shelved_rows, words
from koopman_ros.panel.plant import Snapshot

_LISTED = 200  # entries of the day that are shown
_DAY = 86400.0  # s


def alarm_page(frame: Frame) -> None:
    """Build the page."""
    with frame.body:
        words('h2', 'Standing')
        standing = alarm_rows(frame, 'Standing alarms', shelving=True)
        words('h2', 'Shelved')
        shelved = shelved_rows(frame, 'Shelved alarms')
        words('h2', 'Of the day')
        day = div('card journal').props('role=list aria-label="Alarms of the day"')
    shown: list[Any] = [None]

    def show(now: Snapshot) -> None:
        standing.show(now.standing)
        shelved.show(now.shelved)
        entries = frame.source.view.alarms.journal(now.wall - _DAY)[:_LISTED]
        if shown[0] == entries:
            return
        shown[0] = entries
        day.clear()
        with day:
            for entry in entries:
                who = f' by {entry.who}' if entry.who else ''
                words('div', f'{clock(entry.time)}  {entry.priority.word}  {entry.what}{who}: '
                      f'{entry.text}').props('role=listitem')
            if not entries:
                words('div', 'none', 'quiet')

    frame.follow(show)
