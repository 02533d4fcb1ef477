# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Page with the faceplates of all signals."""

from __future__ import annotations

from collections.abc import Callable
import math
from typing import Any

from nicegui import ui
from nicegui.element import Element

from koopman_ros.panel.alarm_page import alarm_rows
from koopman_ros.panel.faceplates import Faceplate, InputFaceplate, number, Range, StateFaceplate
from koopman_ros.panel.layout import AnswerLine, attribute, box, label, PageLayout, place, show_if
from koopman_ros.panel.requests import Answer
from koopman_ros.panel.snapshot import CONTROL, CONTROLLER, PLANT, Snapshot
from koopman_ros.panel.trend_chart import TrendChart

_STRIP = 3  # alarms that are shown here


def overview(page: PageLayout) -> None:
    """Build the page."""
    now = page.source.snapshot
    with page.body:
        _alarm_strip(page)
        with box('cards'):
            for at, state in enumerate(now.states):
                _state_card(page, at, state)
            for at, own in enumerate(now.inputs):
                _input_card(page, at, own)
            _controller_card(page)
        _simulation(page)
        chart = TrendChart(page, 220, zoom=False)
        page.follow(lambda _: chart.update())


def _alarm_strip(page: PageLayout) -> None:
    rows = alarm_rows(page, 'Alarms', none='No alarms')
    others = label('div', '', 'quiet hidden')

    def show(now: Snapshot) -> None:
        rows.show(now.standing[:_STRIP])
        others.set_text(f'and {len(now.standing) - _STRIP} more')
        show_if(others, len(now.standing) > _STRIP)

    page.follow(show)


class _Bar:
    """A number on its scale, with ranges and a mark."""

    def __init__(self) -> None:
        with box('bar').props('aria-hidden=true'):
            self._training, self._fill = box('train'), box('fill')
            self._limits = [box('limit'), box('limit')]
            self._tick = box('tick')
        with box('scale'):
            self._low, self._between, self._high = (label('span', '') for _ in range(3))

    def show(self, face: Faceplate, value: float, mark: float) -> None:
        def show_at(element: Element, value: float) -> None:
            place(element, **({'left': face.share(value)} if math.isfinite(value) else {}))

        place(self._training, **({} if face.training is None else {
            'left': face.share(face.training[0]), 'right': 1.0 - face.share(face.training[1])}))
        place(self._fill, width=face.share(value))
        show_at(self._tick, mark)
        for element, limit in zip(self._limits, face.limits or (math.nan, math.nan), strict=True):
            show_at(element, limit)
        low, high = map(face.text, face.span)
        self._low.set_text(low)
        self._high.set_text(high)
        self._between.set_text('' if face.training is None else (
            f'trained {face.span_text(face.training)}'))


class _Faceplate:
    """Name of a signal, its abnormal condition, its number with unit, and its bar."""

    def __init__(self, face: Faceplate, unit: str) -> None:
        with box('row1 between'):
            label('h2', face.label)
            self._abnormal = label('span', '', 'abnormal hidden')
        with box('row1'):
            self._number = label('span', '', 'big')
            label('span', unit, 'unit')
        self._bar = _Bar()
        self._active = label('div', '', 'quiet')

    def show(self, face: Faceplate, value: float, mark: float) -> None:
        self._abnormal.set_text(f'▲ {face.abnormal}')
        show_if(self._abnormal, bool(face.abnormal))
        self._number.set_text(face.text(value))
        self._bar.show(face, value, mark)
        self._active.set_text(f'planned: {face.active}' if face.active else '')


class _Entry:
    """Entry of a number: typed, stepped by the arrow keys, or by a slider."""

    def __init__(self, page: PageLayout, title: str, send: Callable[[float], Any]) -> None:
        self._send = send
        self._shown: float | None = None  # present value in the field until a user types
        self._ends: Range = (0.0, 1.0)
        with box('ask'):
            self._field = page.control(ui.number(title, on_change=self._typed).props(
                'outlined dense'))
            page.control(ui.button('Set', on_click=self._submit).props('unelevated'))
        self._slider = page.control(attribute(ui.slider(
            min=0.0, max=1.0, on_change=self._slid).props('color=grey-8'),
            'aria-label', f'{title}, slider'))
        self._answer = AnswerLine()
        self._field.on('keydown.enter', self._submit)
        self._field.on('keydown.escape', self._reset)

    def show(self, face: Faceplate, present: float) -> None:
        """Follow the present value until a user types another one."""
        low, high = (round(end, face.decimals) for end in face.span)
        if (low, high) != self._ends:
            self._ends, step = (low, high), 10.0 ** -face.decimals
            self._field.format = f'%.{face.decimals}f'
            self._field.props['step'] = step
            self._slider.props.update({'min': low, 'max': high, 'step': step})
        if math.isfinite(present) and self._field.value == self._shown:
            self._shown = round(present, face.decimals)
            self._field.set_value(self._shown)
            self._slider.set_value(self._shown)

    def _reset(self) -> None:
        self._field.set_value(self._shown)
        self._answer.set_text('')

    def _slid(self, event: Any) -> None:
        # the slider keeps within its ends a value that was typed beyond them
        typed, (low, high) = self._field.value, self._ends
        if self._shown is not None and event.value != typed and (
                typed is None or low <= typed <= high):
            self._field.set_value(event.value)

    def _typed(self, event: Any) -> None:
        if event.value is not None and event.value != self._slider.value:
            self._slider.set_value(event.value)

    async def _submit(self) -> None:
        value = self._field.value
        if value is None:
            self._answer.show(Answer(False, 'enter a number'))
            return
        self._answer.set_text('sent …')
        self._answer.show(await self._send(float(value)))
        # whatever the answer is, the field shows the present value again
        self._shown = value


def _signal_card(face: Faceplate) -> Element:
    return attribute(attribute(box('card', tag='section'), 'aria-label', face.label),
                     'data-signal', face.name)


def _state_card(page: PageLayout, at: int, face: StateFaceplate) -> None:
    def present() -> float:
        return page.source.snapshot.states[at].target

    async def send(value: float) -> Answer:
        return await page.act('setpoint', face.name, value, present())

    with _signal_card(face):
        plate = _Faceplate(face, face.unit)
        if face.controlled:
            with box('row1 between'):
                label('span', 'set-point')
                setpoint = label('span', '', 'value')
            target = label('div', '', 'quiet')
            entry = _Entry(page, f'Set-point of {face.label}, {face.unit}', send)
        predicted = label('div', '', 'quiet')

    def show(now: Snapshot) -> None:
        own = now.states[at]
        plate.show(own, own.measured, own.setpoint)
        if face.controlled:
            setpoint.set_text(f'{own.text(own.setpoint)} {own.unit}')
            ramps = math.isfinite(own.target) and own.text(own.target) != own.text(own.setpoint)
            target.set_text(f'target {own.text(own.target)} {own.unit} (ramping)' if ramps else '')
            entry.show(own, own.target)
        predicted.set_text(f'model prediction {number(own.predicted, own.decimals + 1)} {own.unit}'
                           if math.isfinite(own.predicted) else
                           'measured disturbance' if own.disturbance else '')

    page.follow(show)


def _input_card(page: PageLayout, at: int, face: InputFaceplate) -> None:
    def present() -> float:
        return page.source.snapshot.inputs[at].manual

    async def send(value: float) -> Answer:
        return await page.act('manual', face.name, value, present())

    with _signal_card(face):
        plate = _Faceplate(face, f'{face.unit} command')
        with box('row1 between'):
            label('span', 'applied')
            applied = label('span', '', 'value')
        details = label('div', '', 'quiet')
        with box('') as manual:
            entry = _Entry(page, f'Manual command: {face.label}, {face.unit}', send)

    def show(now: Snapshot) -> None:
        own = now.inputs[at]
        plate.show(own, own.command, own.applied)
        applied.set_text(f'{own.text(own.applied)} {own.unit}')
        limits = f'limits {own.span_text(own.limits)} {own.unit}' if own.limits else (
            'limits not known')
        change = own.disturbance
        disturbance = f' · disturbance {change:+z.{own.decimals + 1}f} {own.own_unit}' if (
            math.isfinite(change)) else ''
        details.set_text(limits + disturbance)
        show_if(manual, now.mode == 'manual')
        entry.show(own, own.manual)

    page.follow(show)


def _simulation(page: PageLayout) -> None:
    async def reset() -> None:
        if await page.confirm('Reset the simulated plant?', 'Reset the simulated plant',
                              ['It jumps to the state in which it was started.']):
            answer.show(await page.act('reset', PLANT))

    with box('row1 hidden') as row:
        page.button('Reset the simulated plant …', reset)
        answer = AnswerLine()
    # the driver of a real plant is no node of ours
    page.follow(lambda now: show_if(row, f'{PLANT}: simulation' in now.statuses))


def _controller_card(page: PageLayout) -> None:
    with page.card('controller', 'Controller', CONTROLLER):
        mode, level = label('div', '', 'mode'), label('div', '', 'value')
        fallback = label('div', '▲ FALLBACK CONTROL ACTIVE', 'abnormal hidden')
        reason, message = label('div', ''), label('div', '', 'quiet')
        estimates = label('div', '')

        async def switch() -> None:
            manual = page.source.snapshot.mode == 'manual'
            if manual or await page.confirm(
                    'Switch to manual mode?', 'Switch to manual mode',
                    ['The controller holds its last command until you enter another one. '
                     'In manual mode the set-point is not controlled.']):
                answer.show(await page.act('automatic', CONTROLLER, manual, not manual))

        async def clear() -> None:
            if await page.confirm(
                    'Clear the latched safe state?', 'Clear the safe state',
                    ['The control laws command the inputs again at once.']):
                answer.show(await page.act('clear safe state', CONTROLLER))

        button = page.button('', switch)
        with box('row1 hidden') as latched:
            page.button('Clear the safe state …', clear)
        answer = AnswerLine()

    def show(now: Snapshot) -> None:
        mode.set_text(now.mode or '–')
        level.set_text(now.level if now.level != now.mode else '')
        show_if(fallback, now.fallback and bool(now.level))
        reason.set_text(now.reason)
        found = now.status(CONTROL).message
        message.set_text('' if found == now.mode else found)
        estimates.set_text(' · '.join(f'{name} {text} (estimated)' for name, text
                                      in now.estimates))
        button.set_text('Switch to automatic mode' if now.mode == 'manual'
                        else 'Switch to manual mode …')
        show_if(latched, now.status(CONTROL).values.get('safe state') == 'latched')

    page.follow(show)
