# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The page with the faceplates of all signals."""

from __future__ import annotations

from collections.abc import Callable
import math
from typing import Any

from nicegui import ui
from nicegui.element import Element

from koopman_ros.panel.frame import alarm_rows, attribute, div, Frame, say, show_if, words
from koopman_ros.panel.plant import Face, InputFace, number, Snapshot, StateFace
from koopman_ros.panel.requests import Answer
from koopman_ros.panel.trend_page import TrendChart

_STRIP = 3  # alarms that are shown here


def overview(frame: Frame) -> None:
    """Build the page."""
    now = frame.source.snapshot
    with frame.body:
        _strip(frame)
        with div('cards'):
            for at, state in enumerate(now.states):
                _state_card(frame, at, state)
            for at, own in enumerate(now.inputs):
                _input_card(frame, at, own)
            _controller_card(frame)
        chart = TrendChart(frame, 180, zoom=False)
        frame.follow(lambda _: chart.renew())


def _strip(frame: Frame) -> None:
    rows = alarm_rows(frame, 'Alarms', none='No alarms')
    others = words('div', '', 'quiet hidden')

    def show(now: Snapshot) -> None:
        rows.show(now.standing[:_STRIP])
        others.set_text(f'and {len(now.standing) - _STRIP} more')
        show_if(others, len(now.standing) > _STRIP)

    frame.follow(show)


class _Bar:
    """A number between the ends of its scale, with ranges and marks."""

    def __init__(self, frame: Frame) -> None:
        self._frame = frame
        with div('bar').props('aria-hidden=true'):
            self._training = div('train')
            self._fill = div('fill')
            self._limits = [div('limit'), div('limit')]
            self._tick = div('tick')
        with div('scale'):
            self._low, self._between, self._high = (words('span', '') for _ in range(3))

    def show(self, face: Face, value: float, mark: float) -> None:
        def show_at(element: Element, number: float | None) -> None:
            known = number is not None and math.isfinite(number)
            place(element, **({'left': face.share(number)} if known else {}))

        place = self._frame.place
        training, limits = face.training, face.limits
        place(self._training, **({} if training is None else {
            'left': face.share(training[0]), 'right': 1.0 - face.share(training[1])}))
        place(self._fill, width=face.share(value))
        show_at(self._tick, mark)
        for at, limit in enumerate(self._limits):
            show_at(limit, None if limits is None else limits[at])
        low, high = (face.text(end) for end in face.span)
        self._low.set_text(low)
        self._high.set_text(high)
        self._between.set_text('' if training is None else (
            f'trained {face.text(training[0])} to {face.text(training[1])}'))


def _card(face: Face) -> Any:
    return attribute(attribute(div('card', tag='section'), 'aria-label', face.label),
                     'data-signal', face.name)


class _Plate:
    """Name of a signal, what is out of order, its number with unit, and its bar."""

    def __init__(self, frame: Frame, face: Face, unit: str) -> None:
        with div('row1 between'):
            words('h2', face.label)
            self._abnormal = words('span', '', 'abnormal hidden')
        with div('row1'):
            self._number = words('span', '', 'big')
            words('span', unit, 'unit')
        self._bar = _Bar(frame)
        self._active = words('div', '', 'quiet')

    def show(self, face: Face, value: float, mark: float) -> None:
        self._abnormal.set_text(f'▲ {face.abnormal}')
        show_if(self._abnormal, bool(face.abnormal))
        self._number.set_text(face.text(value))
        self._bar.show(face, value, mark)
        self._active.set_text(f'planned: {face.active}' if face.active else '')


class _Entry:
    """A number that is asked for: typed, stepped by the arrow keys, or by a slider."""

    def __init__(self, frame: Frame, title: str, face: Face,
                 send: Callable[[float], Any], present: Callable[[], float]) -> None:
        self._send, self._present = send, present
        step = 10.0 ** -face.decimals
        low, high = face.span
        self._low, self._high = round(low, face.decimals), round(high, face.decimals)
        with div('ask'):
            self.field = frame.control(ui.number(
                title, step=step, format=f'%.{face.decimals}f', on_change=self._typed).props(
                    'outlined dense'))
            self.button = frame.control(ui.button('Set', on_click=self.submit).props('unelevated'))
        self.slider = frame.control(attribute(ui.slider(
            min=self._low, max=self._high, step=step, on_change=self._slid).props('color=grey-8'),
            'aria-label', f'{title}, slider'))
        self.said = frame.answer()
        self.field.on('keydown.enter', self.submit)
        self.field.on('keydown.escape', self.reset)
        self._started = False

    def start(self, value: float) -> None:
        """Show the present value, once it is known."""
        if not self._started and math.isfinite(value):
            self._started = True
            self.reset()

    def reset(self) -> None:
        """Take back what was typed."""
        value = self._present()
        if math.isfinite(value):
            self.field.set_value(value)
            self.slider.set_value(value)
        self.said.set_text('')

    def _slid(self, event: Any) -> None:
        # the slider keeps within its ends what was typed beyond them
        typed = self.field.value
        beyond = typed is not None and not self._low <= typed <= self._high
        if self._started and event.value != typed and not beyond:
            self.field.set_value(event.value)

    def _typed(self, event: Any) -> None:
        if self._started and event.value is not None and event.value != self.slider.value:
            self.slider.set_value(event.value)

    async def submit(self) -> None:
        """Send what is in the field."""
        value = self.field.value
        if value is None:
            say(self.said, Answer(False, 'write a number'))
            return
        self.said.set_text('sent …')
        say(self.said, await self._send(float(value)))


def _state_card(frame: Frame, at: int, face: StateFace) -> None:
    def present() -> float:
        return frame.source.snapshot.states[at].setpoint

    async def send(value: float) -> Answer:
        return await frame.act('setpoint', face.name, value, present())

    with _card(face):
        plate = _Plate(frame, face, face.unit)
        if face.controlled:
            with div('row1 between'):
                words('span', 'set-point')
                setpoint = words('span', '', 'value')
            asked = words('div', '', 'quiet')
            entry = _Entry(frame, f'Set-point of {face.label}, {face.unit}', face, send, present)
        predicted = words('div', '', 'quiet')

    def show(now: Snapshot) -> None:
        own = now.states[at]
        plate.show(own, own.measured, own.setpoint)
        if face.controlled:
            setpoint.set_text(f'{own.text(own.setpoint)} {own.unit}')
            ramps = math.isfinite(own.asked) and own.text(own.asked) != own.text(own.setpoint)
            asked.set_text(f'asked for {own.text(own.asked)} {own.unit}' if ramps else '')
            entry.start(own.setpoint)
        expected = f'{number(own.predicted, own.decimals + 1)} {own.unit}'
        predicted.set_text(
            f'the model expected {expected}' if math.isfinite(own.predicted) else '')

    frame.follow(show)


def _input_card(frame: Frame, at: int, face: InputFace) -> None:
    def present() -> float:
        return frame.source.snapshot.inputs[at].command

    async def send(value: float) -> Answer:
        return await frame.act('manual', face.name, value, present())

    with _card(face):
        plate = _Plate(frame, face, f'{face.unit} command')
        with div('row1 between'):
            words('span', 'acting')
            applied = words('span', '', 'value')
        beside = words('div', '', 'quiet')
        by_hand = div('')
        with by_hand:
            entry = _Entry(frame, f'{face.label} by hand, {face.unit}', face, send, present)

    def show(now: Snapshot) -> None:
        own = now.inputs[at]
        plate.show(own, own.command, own.applied)
        applied.set_text(f'{own.text(own.applied)} {own.unit}')
        limits = f'limits {own.text(own.limits[0])} to {own.text(own.limits[1])} {own.unit}' if (
            own.limits) else 'limits not known'
        # no minus zero
        change = round(own.disturbance, own.decimals + 1) + 0.0
        disturbance = f' · disturbance {change:+.{own.decimals + 1}f} {own.own_unit}' if (
            math.isfinite(change)) else ''
        beside.set_text(limits + disturbance)
        show_if(by_hand, now.mode == 'manual')
        entry.start(own.command)

    frame.follow(show)


def _controller_card(frame: Frame) -> None:
    with div('card', tag='section').props('aria-label=Controller'):
        words('h2', 'controller')
        mode = words('div', '', 'big')
        level = words('div', '', 'value')
        fallback = words('div', '▲ not the best law', 'abnormal hidden')
        reason, sentence = words('div', ''), words('div', '', 'quiet')
        estimates = words('div', '')
        said: ui.label

        async def switch() -> None:
            manual = frame.source.snapshot.mode == 'manual'
            if not manual and not await frame.confirm(
                    'Switch to manual mode?', 'Switch to manual mode',
                    ['The controller then holds its last command until you give another one. '
                     'Nothing brings the plant to its set-point meanwhile.']):
                return
            say(said, await frame.act('automatic', 'controller', manual, not manual))

        button = frame.control(ui.button('', on_click=switch).props('outline'))
        said = frame.answer()

    def show(now: Snapshot) -> None:
        mode.set_text(now.mode or '–')
        level.set_text(now.level)
        show_if(fallback, now.fallback and bool(now.level))
        reason.set_text(now.reason)
        said_of_it = now.status('controller: control').message
        sentence.set_text('' if said_of_it == now.mode else said_of_it)
        estimates.set_text(' · '.join(f'{name} {text} (estimated)' for name, text
                                      in now.estimates))
        button.set_text('Switch to automatic mode' if now.mode == 'manual'
                        else 'Switch to manual mode …')

    frame.follow(show)
