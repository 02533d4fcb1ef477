# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Page with the faceplates of all signals."""

from __future__ import annotations

from collections.abc import Callable
import math
from typing import Any

from nicegui import ui
from nicegui.element import Element

from koopman_ros.panel.faceplates import Faceplate, InputFaceplate, number, StateFaceplate
from koopman_ros.panel.layout import (
    AnswerLine,
    attribute,
    box,
    label,
    PageLayout,
    place,
    show_if,
    show_value,
)
from koopman_ros.panel.requests import Answer
from koopman_ros.panel.snapshot import CONTROL, CONTROLLER, PLANT, Snapshot, TRAINER
from koopman_ros.panel.trend_chart import TrendChart
from koopman_ros.parameters.description import parsed_number


def overview(page: PageLayout) -> None:
    """Build the page."""
    now = page.source.snapshot
    with page.body:
        with box('cards'):
            for at, state in enumerate(now.states):
                _state_card(page, at, state)
            for at, own in enumerate(now.inputs):
                _input_card(page, at, own)
            _controller_card(page)
        _simulation(page)
        chart = TrendChart(page, 220, zoom=False)
        page.follow(lambda _: chart.update())


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

    def show(self, face: Faceplate, value: float, mark: float, old: bool) -> None:
        self._abnormal.set_text(f'▲ {face.abnormal}')
        show_if(self._abnormal, bool(face.abnormal))
        show_value(self._number, face.text(value), old)
        self._bar.show(face, value, mark)
        self._active.set_text(f'planned: {face.active}' if face.active else '')


class _Entry:
    """
    Entry of a number: typed, stepped by the arrow keys, or moved by a slider.

    The page itself fills in the field (watch.js), from two attributes of the box: the present
    value, and the text that was answered last. A text sent by the panel could arrive while a
    person types.

    :param present: the requested value at present.
    """

    def __init__(self, page: PageLayout, title: str, send: Callable[[float], Any],
                 present: Callable[[Snapshot], float]) -> None:
        self._send = send
        self._answered = ''
        # disabled, it disables all that it holds
        with box('ask', tag='fieldset').props('disabled') as self._box:
            self._field = page.control(ui.input(title).props(
                'outlined dense inputmode=decimal autocomplete=off'))
            page.control(attribute(
                ui.button('Set', on_click=self._submit).props('unelevated'), 'aria-label',
                f'Set {title}'))
            self._slider = attribute(
                ui.element('input').props('type=range'), 'aria-label', f'{title}, slider')
        self._answer = AnswerLine(page, lambda now: (
            now.mode, present(now), now.silent(PLANT), now.silent(CONTROLLER)))
        self._field.on('keydown.enter', self._submit)
        self._field.on('keydown.escape', lambda: self._answer.set_text(''))

    def show(self, face: Faceplate, present: float, obstacle: str) -> None:
        """
        Let the field follow the present value until a user types another one.

        :param obstacle: why nothing can be sent, or empty.
        """
        low, high = (round(end, face.decimals) for end in face.span)
        _update(self._slider, min=low, max=high, step=round(10.0 ** -face.decimals, 9))
        _update(self._box, disabled=bool(obstacle) or not self._field.enabled, title=obstacle)
        attribute(self._box, 'data-present', face.exact(present) if math.isfinite(present) else '')
        attribute(self._box, 'data-answered', self._answered)

    async def _submit(self) -> None:
        typed, self._answered = str(self._field.value), ''
        try:
            value = parsed_number(typed)
        except ValueError as error:
            self._answer.show(Answer(False, str(error)))
            return
        self._answer.set_text('sent …')
        self._answer.show(await self._send(value))
        self._answered = typed


def _update(element: Element, **props: object) -> None:
    """Change attributes of an element, and send it to the page where one is new."""
    if any(element.props.get(name) != value for name, value in props.items()):
        element.props.update(props)
        element.update()


async def _experiment_goes_on(page: PageLayout, signal: str) -> bool:
    """Ask before an action that ends an experiment; return whether the action is dropped."""
    now = page.source.snapshot
    on = now.parameter(TRAINER, 'experiment_signal')
    return bool(now.experiment and on == signal) and not await page.confirm(
        'Abort the experiment?', 'Abort the experiment',
        [f'An experiment is running, {now.experiment} s are left. It steps the {signal} itself, '
         'and ends with this entry.'])


def _signal_card(face: Faceplate) -> Element:
    return attribute(attribute(box('card', tag='section'), 'aria-label', face.label),
                     'data-signal', face.name)


def _state_card(page: PageLayout, at: int, face: StateFaceplate) -> None:
    async def send(value: float) -> Answer:
        if await _experiment_goes_on(page, 'setpoint'):
            return Answer(False, 'not sent: the experiment goes on')
        return await page.act('setpoint', face.name, value, page.source.snapshot.states[at].target)

    with _signal_card(face):
        plate = _Faceplate(face, face.unit)
        if face.controlled:
            with box('row1 between'):
                label('span', 'set-point')
                setpoint = label('span', '', 'value')
            target = label('div', '', 'quiet')
            entry = _Entry(page, f'Set-point of {face.label}, {face.unit}', send,
                           lambda now: now.states[at].target)
        predicted = label('div', '', 'quiet')

    def show(now: Snapshot) -> None:
        own = now.states[at]
        plate.show(own, own.measured, own.setpoint, 'measured' in own.old)
        if face.controlled:
            show_value(setpoint, f'{own.exact(own.setpoint)} {own.unit}', 'setpoint' in own.old)
            ramps = math.isfinite(own.target) and own.text(own.target) != own.text(own.setpoint)
            target.set_text(
                f'target {own.exact(own.target)} {own.unit} (ramping)' if ramps else '')
            entry.show(own, own.target, now.obstacle)
        show_value(predicted, f'model prediction {number(own.predicted, own.decimals + 1)} '
                    f'{own.unit}' if math.isfinite(own.predicted) else
                    'measured disturbance' if own.disturbance else '', 'predicted' in own.old)

    page.follow(show)


def _input_card(page: PageLayout, at: int, face: InputFaceplate) -> None:
    async def send(value: float) -> Answer:
        if await _experiment_goes_on(page, 'manual'):
            return Answer(False, 'not sent: the experiment goes on')
        return await page.act('manual', face.name, value, page.source.snapshot.inputs[at].manual)

    with _signal_card(face):
        plate = _Faceplate(face, f'{face.unit} command')
        with box('row1 between'):
            label('span', 'applied')
            applied = label('span', '', 'value')
        details = label('div', '', 'quiet')
        with box('') as manual:
            entry = _Entry(page, f'Manual command: {face.label}, {face.unit}', send,
                           lambda now: now.inputs[at].manual)

    def show(now: Snapshot) -> None:
        own = now.inputs[at]
        plate.show(own, own.command, own.applied, 'command' in own.old)
        show_value(applied, f'{own.text(own.applied)} {own.unit}', 'applied' in own.old)
        limits = f'limits {own.span_text(own.limits)} {own.unit}' if own.limits else (
            'limits not known')
        change = own.disturbance
        disturbance = f' · disturbance {change:+z.{own.decimals + 1}f} {own.own_unit}' if (
            math.isfinite(change)) else ''
        late = f' · dead time {own.dead_time:.3g} s' if own.dead_time > 0.0 else ''
        details.set_text(limits + disturbance + late)
        show_if(manual, now.mode == 'manual')
        entry.show(own, own.manual, now.obstacle)

    page.follow(show)


def _simulation(page: PageLayout) -> None:
    async def reset() -> None:
        if await page.confirm('Reset the simulated plant?', 'Reset the simulated plant',
                              ['It jumps to the state in which it was started.']):
            answer.show(await page.act('reset', PLANT))

    with box('row1 hidden') as row:
        page.button('Reset the simulated plant …', reset)
        answer = AnswerLine(page)
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
            if page.source.snapshot.experiment and not await page.confirm(
                    'Abort the experiment?', 'Abort the experiment',
                    ['An experiment is running, and ends with another mode.']):
                return
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
        answer = AnswerLine(page)

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
