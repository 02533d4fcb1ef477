# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Page of the parameters of controller and trainer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
import json
import re
from typing import Any

from nicegui import ui

from koopman_ros.core.units import printed, ZERO_CELSIUS
from koopman_ros.panel.faceplates import readable
from koopman_ros.panel.files import sanitize_text
from koopman_ros.panel.layout import AnswerLine, attribute, box, label, PageLayout
from koopman_ros.panel.requests import Answer
from koopman_ros.panel.snapshot import CONTROLLER, PANEL, Snapshot, TRAINER
from koopman_ros.parameters.description import ParameterDescription
from koopman_ros.parameters.table import as_yaml, UNBOUNDED

_GENERAL = 'general'
_NAME = re.compile(r'[A-Za-z_][\w.]*', re.ASCII)
_MAX_UNIT = 60  # characters


def tuning_page(page: PageLayout) -> None:
    """Build the page."""
    with page.body:
        for node in (CONTROLLER, TRAINER, PANEL):
            _node(page, node)


def _node(page: PageLayout, node: str) -> None:
    with page.card(node, f'Parameters of the {node}', node):
        with box('row1'):
            export = ui.button('Export YAML', on_click=lambda: ui.download.content(
                exported(node, page.source.snapshot.parameters.get(node, {})),
                f'{node}.yaml')).props('outline')
        rows = box('')
    shown: dict[str, _Row] = {}

    def show(now: Snapshot) -> None:
        found = now.parameters.get(node, {})
        if export.enabled is not bool(found):
            export.set_enabled(bool(found))
        if set(found) != set(shown) or not rows.default_slot.children:
            shown.clear()
            rows.clear()
            with rows:
                shown.update(_groups(page, node, found))
        for name, row in shown.items():
            row.show(found[name])

    page.follow(show)


def _groups(page: PageLayout, node: str, found: Mapping[str, ParameterDescription]
            ) -> dict[str, _Row]:
    """Build a group of rows for each signal, and one for all others."""
    if not found:
        label('div', f'{node.capitalize()} not running: no parameters available', 'quiet')
    groups: dict[str, list[ParameterDescription]] = {}
    for name, one in found.items():
        groups.setdefault(name.rpartition('.')[0] or _GENERAL, []).append(one)
    rows = {}
    for group, members in sorted(groups.items(), key=lambda item: item[0] != _GENERAL):
        with ui.expansion(readable(group)).props('dense switch-toggle-side'):
            for one in sorted(members, key=lambda one: one.read_only):
                rows[one.name] = _Row(page, node, one)
    return rows


class _Row:
    """A parameter with its entry."""

    def __init__(self, page: PageLayout, node: str, parameter: ParameterDescription) -> None:
        self._page, self._node, self._parameter = page, node, parameter
        self._text = ''
        unit = f' [{parameter.unit}]' if parameter.unit else ''
        notes = [parameter.meaning.rstrip('.'), _range(parameter),
                 'fixed at start' if parameter.read_only else '']
        with attribute(box('parameter'), 'data-parameter', parameter.name):
            with box(''):
                label('div', f'{parameter.name.rpartition(".")[2]}{unit}')
                label('div', '; '.join(filter(None, notes)), 'quiet')
            title = f'{parameter.name}{unit}'
            if parameter.read_only:
                self._field: Any = attribute(label('div', ''), 'aria-label', title)
                return
            with box(''):
                with box('ask'):
                    choices = {bool: ('false', 'true'), str: parameter.choices}.get(
                        type(parameter.value))
                    self._field = page.control(attribute(
                        (ui.select(list(choices)) if choices else ui.input()).props(
                            'outlined dense'), 'aria-label', title), 'parameters')
                    attribute(page.button('Set', self._submit, 'parameters'), 'aria-label',
                              f'Set {parameter.name}')
                self._answer = AnswerLine(page, lambda now: now.parameter(node, parameter.name))
                self._field.on('keydown.enter', self._submit)
                self._field.on('keydown.escape', self._reset)

    def show(self, parameter: ParameterDescription) -> None:
        """Show a changed value."""
        if self._text and parameter == self._parameter:
            return
        self._parameter = parameter
        if parameter.read_only:
            self._field.set_text(parameter.text)
        elif self._field.value in ('', self._text, None):
            # a text that a user is typing stays
            self._field.set_value(parameter.text)
        self._text = parameter.text

    def _reset(self) -> None:
        self._field.set_value(self._parameter.text)
        self._answer.set_text('')

    async def _submit(self) -> None:
        name = self._parameter.name
        try:
            value = self._parameter.parse(str(self._field.value))
        except ValueError as error:
            self._answer.show(Answer(False, str(error)))
            return
        now = replace(self._parameter, value=value)
        unit = f' {printed(now.unit)}' if now.unit else ''
        if not await self._page.confirm(
                f'Change {name}?', 'Change', [now.meaning, _range(now)],
                [('', 'now', 'new'),
                 (name, f'{self._parameter.text}{unit}', f'{now.text}{unit}')]):
            self._answer.set_text('not changed')
            return
        self._answer.set_text('sent …')
        answer = await self._page.act('parameters', self._node, {name: value},
                                      {name: self._parameter.value})
        if answer.accepted:
            # the new value stays in the field until the node publishes it
            self._text = now.text
        self._answer.show(answer)


def _range(parameter: ParameterDescription) -> str:
    """Return the range in words, without the ends that stand for no bound."""
    if parameter.upper < UNBOUNDED:
        return parameter.range
    if parameter.lower <= -ZERO_CELSIUS:
        return ''
    word = 'above' if parameter.range.startswith('(') else 'at least'
    return f'{word} {parameter.lower:g} {parameter.unit}'.rstrip()


def exported(node: str, found: Mapping[str, ParameterDescription]) -> str:
    """Return the parameter file of a node."""
    lines = [f'/**/{node}:', '  ros__parameters:']
    for name, one in found.items():
        unit = f'  # [{sanitize_text(one.unit, _MAX_UNIT)}]' if one.unit else ''
        key = name if _NAME.fullmatch(name) else json.dumps(name)
        lines.append(f'    {key}: {as_yaml(one.value)}{unit}')
    return '\n'.join(lines) + '\n'
