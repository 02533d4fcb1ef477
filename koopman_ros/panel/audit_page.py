# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Page of the actions of operators, with their answers; and their export."""

from __future__ import annotations

from collections.abc import Mapping
import csv
from dataclasses import asdict
import io
import time
from typing import Any

from nicegui import ui

from koopman_ros.panel.faceplates import readable
from koopman_ros.panel.layout import box, label, Lines, PageLayout
from koopman_ros.panel.requests import AuditEntry
from koopman_ros.panel.snapshot import Snapshot

_LISTED = 200  # entries that are shown


def audit_page(page: PageLayout) -> None:
    """Build the page."""
    with page.body:
        label('h2', 'Actions')
        with box('row1 middle view'):
            ui.button('Export CSV', on_click=lambda: ui.download.content(
                exported(page.source.view.audit), 'audit.csv')).props('outline')
            wanted = ui.input('Filter').props('outlined dense clearable')
        rows = Lines('Actions')

    def show(_: Snapshot) -> None:
        text = str(wanted.value or '').casefold()
        rows.show([line for entry in reversed(page.source.view.audit)
                   if text in (line := line_of(entry)).casefold()][:_LISTED])

    page.follow(show)


def line_of(entry: AuditEntry) -> str:
    """Write an action for people."""
    change = ' → '.join(('off', 'on')[value] if isinstance(value, bool) else value_text(value)
                        for value in (entry.old, entry.new) if value not in (None, ''))
    when = time.strftime('%Y-%m-%d %H:%M:%S', time.localtime(entry.stamp))
    answer = entry.answer if entry.accepted else f'✖ {entry.answer}'
    what = readable(entry.what).replace('setpoint', 'set-point')
    return f'{when}  {entry.who}: {what} {change} {entry.unit}'.rstrip() + f': {answer}'


def value_text(value: Any) -> str:
    """Write a value of an action."""
    if isinstance(value, Mapping):
        return ', '.join(f'{name} = {value_text(item)}' for name, item in value.items())
    return f'{value:.6g}' if isinstance(value, float) else str(value)


def exported(entries: tuple[AuditEntry, ...]) -> str:
    """Return actions as CSV, the oldest first; no cell is a formula of a spreadsheet."""
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(['time', *asdict(entries[0])] if entries else ['time'])
    for entry in entries:
        when = time.strftime('%Y-%m-%dT%H:%M:%S%z', time.localtime(entry.stamp))
        writer.writerow([when, *(
            f"'{cell}" if cell[:1] in ('=', '+', '@') else cell
            for cell in map(value_text, asdict(entry).values()))])
    return text.getvalue()
