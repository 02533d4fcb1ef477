# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The page with the parameters of controller and trainer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
import json
import re
from typing import Any

from nicegui import ui

from koopman_ros.panel.frame import attribute, div, Frame, say, words
from koopman_ros.panel.plant import CONTROLLER, ParameterView, Snapshot, TRAINER
from koopman_ros.panel.requests import Answer
from koopman_ros.panel.texts import plain
from koopman_ros.parameters.table import as_yaml, UNBOUNDED
from koopman_ros.units import ZERO_CELSIUS

_GENERAL = 'general'
_NAME = re.compile(r'[A-Za-z_][\w.]*', re.ASCII)
_MAX_UNIT = 60  # characters


def tuning_page(frame: Frame) -> None:
    """Build the page."""
    with frame.body:
        for node in (CONTROLLER, TRAINER):
            _node(frame, node)


def _node(frame: Frame, node: str) -> None:
    with attribute(div('card', tag='section'), 'aria-label', f'Parameters of the {node}'):
        with div('row1 between'):
            words('h2', node)
            ui.button('Export YAML', on_click=lambda: ui.download.content(
                exported(node, frame.source.snapshot.parameters.get(node, {})),
                f'{node}.yaml')).props('outline')
        place = div('')
    fields: dict[str, _Row] = {}

    def show(now: Snapshot) -> None:
        found = now.parameters.get(node, {})
        if set(found) != set(fields) or (not found and not place.default_slot.children):
            fields.clear()
            place.clear()
            with place:
                _groups(frame, node, found, fields)
        for name, row in fields.items():
            row.show(found[name])

    frame.follow(show)


def _groups(frame: Frame, node: str, found: Mapping[str, ParameterView],
            fields: dict[str, _Row]) -> None:
    if not found:
        words('div', f'the {node} is not there: nothing is known of its parameters', 'quiet')
    groups: dict[str, list[ParameterView]] = {}
    for name, view in found.items():
        groups.setdefault(name.rpartition('.')[0] or _GENERAL, []).append(view)
    for group, views in sorted(groups.items(), key=lambda item: item[0] != _GENERAL):
        with ui.expansion(group.replace('_', ' ')).props('dense switch-toggle-side'):
            # what is fixed comes last
            for view in sorted(views, key=lambda view: view.read_only):
                fields[view.name] = _Row(frame, node, view)


class _Row:
    """A parameter."""

    def __init__(self, frame: Frame, node: str, view: ParameterView) -> None:
        self._frame, self._node, self._view = frame, node, view
        self._text = ''
        short = view.name.rpartition('.')[2]
        unit = f' [{view.unit}]' if view.unit else ''
        with attribute(div('parameter'), 'data-parameter', view.name):
            with div(''):
                words('div', f'{short}{unit}', '')
                notes = [view.meaning, _range(view), 'fixed at start' if view.read_only else '']
                words('div', '; '.join(filter(None, notes)), 'quiet')
            with div(''):
                title = f'{view.name}{unit}'
                if view.read_only:
                    self._field: Any = attribute(words('div', ''), 'aria-label', title)
                    return
                with div('ask'):
                    self._field = frame.control(attribute(
                        ui.input().props('outlined dense'), 'aria-label', title))
                    frame.control(attribute(
                        ui.button('Set', on_click=self._submit).props('outline'),
                        'aria-label', f'Set {view.name}'))
                self._said = frame.answer()
                self._field.on('keydown.enter', self._submit)
                self._field.on('keydown.escape', partial(self._reset))

    def show(self, view: ParameterView) -> None:
        """Show a value that is another one."""
        if self._text and view == self._view:
            return
        self._view = view
        if view.read_only:
            self._field.set_text(view.text)
        elif self._field.value in ('', self._text, None):
            # what is being typed stays
            self._field.set_value(view.text)
        self._text = view.text

    def _reset(self) -> None:
        self._field.set_value(self._view.text)
        self._said.set_text('')

    async def _submit(self) -> None:
        try:
            value = self._view.read(str(self._field.value))
        except ValueError as error:
            say(self._said, Answer(False, str(error)))
            return
        self._said.set_text('sent …')
        answer = await self._frame.act(
            'parameters', self._node, {self._view.name: value}, {
                self._view.name: self._view.value})
        if answer.accepted:
            # the node tells of it later: what is typed until then stays, the value of before, too
            self._text = replace(self._view, value=value).text
        say(self._said, answer)


def _range(view: ParameterView) -> str:
    """Return the range in words, but for ends that stand for none."""
    if view.upper < UNBOUNDED:
        return view.range
    if view.lower <= -ZERO_CELSIUS:
        return ''
    word = 'above' if view.range.startswith('(') else 'at least'
    return f'{word} {view.lower:g} {view.unit}'.rstrip()


def exported(node: str, found: Mapping[str, ParameterView]) -> str:
    """Return parameters as a file that a node can be started with."""
    lines = [f'{node}:', '  ros__parameters:']
    for name, view in found.items():
        unit = f'  # [{plain(view.unit, _MAX_UNIT)}]' if view.unit else ''
        # a node may have any names
        key = name if _NAME.fullmatch(name) else json.dumps(name)
        lines.append(f'    {key}: {as_yaml(view.value)}{unit}')
    return '\n'.join(lines) + '\n'
