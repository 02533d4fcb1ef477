# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The page of the acting model, of recording, experiments and training."""

from __future__ import annotations

from collections.abc import Callable, Mapping
import hashlib
import math
import time

from nicegui import ui

from koopman_ros.panel.frame import attribute, clock, div, Frame, say, show_if, words
from koopman_ros.panel.learning import Comparison, Report
from koopman_ros.panel.plant import (
    CONTROLLER,
    ERROR,
    OK,
    ParameterView,
    Snapshot,
    TaskStatus,
    TRAINER,
)

_WORDS = {OK: '', ERROR: '■ ERROR'}
_DONE = 'done [%]'
_CONTROL, _TRAINING = 'controller: control', 'trainer: training'


def model_page(frame: Frame) -> None:
    """Build the page."""
    with frame.body, div('cards loose'):
        _acting(frame)
        _recording(frame)
        _experiment(frame)
        _training(frame)
        _report(frame)
        _comparison(frame)


class _Figures:
    """Figures of a status, a line for each."""

    def __init__(self, choose: Callable[[str], bool] = lambda _: True) -> None:
        self._choose = choose
        self._head = words('div', '')
        self._mark = words('span', '', 'abnormal hidden')
        self._lines = div('pairs')
        self._shown: dict[str, tuple[ui.label, ui.label]] = {}

    def show(self, status: TaskStatus) -> None:
        """Show a status."""
        self._head.set_text(status.message or 'nothing heard of it')
        self._mark.set_text(_WORDS.get(status.level, '▲ WARNING'))
        show_if(self._mark, status.level > OK)
        self.figures({key: value for key, value in status.values.items() if self._choose(key)})

    def figures(self, found: Mapping[str, str]) -> None:
        """Show figures alone, but for those that are none."""
        values = {key: value for key, value in found.items() if value not in ('none', '')}
        if set(values) != set(self._shown):
            self._lines.clear()
            with self._lines:
                self._shown = {key: (words('div', key, 'quiet'), words('div', ''))
                               for key in values}
        for key, value in values.items():
            self._shown[key][1].set_text(_brief(value))


def _brief(value: str) -> str:
    """Write a number with as many digits as are read."""
    try:
        return f'{float(value):.4g}' if '.' in value else value
    except ValueError:
        return value


def _acting(frame: Frame) -> None:
    with div('card', tag='section').props('aria-label=Model'):
        words('h2', 'acting model')
        name = words('div', '', 'value')
        figures = _Figures(lambda key: key.startswith('model') or 'outside' in key
                           or key in ('law', 'gain norm', 'predicted growth per sample'))
        trained = words('div', '', 'quiet')
        card = _Figures()

        async def reload() -> None:
            said.set_text('asked …')
            say(said, await frame.act('reload', CONTROLLER))

        async def take_over(name: str) -> None:
            now = frame.source.snapshot
            if await frame.confirm(
                    f'Let {name} act?', 'Take over', [
                        f'It replaces {now.status(_CONTROL).values.get("model", "the model")}, '
                        'if it predicts what was measured lately as well.',
                        now.status(_TRAINING).message]):
                said.set_text('asked …')
                old = now.parameters.get(CONTROLLER, {}).get('model')
                say(said, await (frame.act('reload', CONTROLLER) if old and old.value == name
                                 else frame.act('parameters', CONTROLLER, {'model': name}, {
                                     'model': old.value if old else None})))

        def trained_model() -> str:
            values = frame.source.snapshot.status(_TRAINING).values
            return values.get('model_file', '') if values.get('accepted') == 'True' else ''

        with div('row1'):
            new = frame.control(ui.button('Take over the new one …', on_click=lambda: take_over(
                trained_model())).props('outline'))
            back = frame.control(ui.button('', on_click=lambda: take_over(
                frame.source.snapshot.previous_model)).props('outline'))
            frame.control(ui.button('Read the file again', on_click=reload).props('outline'))
        said = frame.answer()

    def show(now: Snapshot) -> None:
        status = now.status(_CONTROL)
        card.figures(now.model)
        show_if(new, bool(trained_model()))
        show_if(back, bool(now.previous_model))
        back.set_text(f'Back to {now.previous_model} …')
        name.set_text(status.values.get('model', '–'))
        figures.show(status)
        trained.set_text('trained: ' + (', '.join(
            f'{face.label} {face.text(face.training[0])} to {face.text(face.training[1])} '
            f'{face.unit}' for face in (*now.states, *now.inputs) if face.training)
            or 'not known here'))

    frame.follow(show)


def _recording(frame: Frame) -> None:
    with div('card', tag='section').props('aria-label=Recording'):
        words('h2', 'recording')
        figures = _Figures(lambda key: not key.startswith('messages on'))

        async def record(on: bool) -> None:
            say(said, await frame.act('record', 'trainer', on))

        with div('row1'):
            frame.control(ui.button('Record', on_click=lambda: record(True)).props('outline'))
            frame.control(ui.button('Stop', on_click=lambda: record(False)).props('outline'))
        said = frame.answer()
    frame.follow(lambda now: figures.show(now.status('trainer: recording')))


def _experiment(frame: Frame) -> None:
    with div('card', tag='section').props('aria-label=Experiment'):
        words('h2', 'experiment')
        figures = _Figures()
        plan = div('')

        async def start() -> None:
            lines = bounds(frame.source.snapshot.parameters.get(TRAINER, {}))
            if await frame.confirm(
                    'Start the experiment?', 'Start the experiment',
                    ['It steps the plant at random, between these bounds:', *lines]):
                say(said, await frame.act('experiment', 'trainer', True))

        async def stop() -> None:
            say(said, await frame.act('experiment', 'trainer', False))

        with div('row1'):
            frame.control(ui.button('Start …', on_click=start).props('outline'))
            frame.control(ui.button('End', on_click=stop).props('outline'))
        said = frame.answer()
    shown: list[list[str]] = [[]]

    def show(now: Snapshot) -> None:
        figures.show(now.status('trainer: experiment'))
        lines = bounds(now.parameters.get(TRAINER, {}))
        if lines != shown[0]:
            shown[0] = lines
            plan.clear()
            with plan:
                for line in lines:
                    words('div', line, 'quiet')

    frame.follow(show)


def bounds(parameters: Mapping[str, ParameterView]) -> list[str]:
    """Return what an experiment does and does not do, in lines."""
    if 'experiment_on' not in parameters:
        return ['the bounds are not known: the trainer is not there']

    def text(name: str) -> str:
        return f'{parameters[name].text} {parameters[name].unit}'.rstrip()

    on = parameters['experiment_on'].text
    lines = [f'steps: {on}, for {text("experiment_length")}, each '
             f'{text("experiment_shortest_hold")} to {text("experiment_longest_hold")}']
    signals = dict.fromkeys(name.rpartition('.')[0] for name in parameters
                            if name.endswith('.experiment_min'))
    for signal in signals:
        what = 'steps within' if f'{signal}.safe' in parameters else 'is ended outside'
        if on == 'setpoint' and f'{signal}.setpoint_min' in parameters:
            lines.append(f'{signal}: set-points {text(f"{signal}.setpoint_min")} to '
                         f'{text(f"{signal}.setpoint_max")}')
        lines.append(f'{signal}: {what} {text(f"{signal}.experiment_min")} to '
                     f'{text(f"{signal}.experiment_max")}')
    return lines


def _training(frame: Frame) -> None:
    with div('card', tag='section').props('aria-label=Training'):
        words('h2', 'training')
        progress = ui.linear_progress(0.0, show_value=False, size='14px').props(
            'aria-label="Progress of the training" color=grey-8')
        share = words('div', '', 'value')
        figures = _Figures(lambda key: key != _DONE)

        async def train() -> None:
            say(said, await frame.act('train', 'trainer'))

        async def cancel() -> None:
            say(said, await frame.act('cancel', 'trainer'))

        with div('row1'):
            frame.control(ui.button('Train', on_click=train).props('outline'))
            frame.control(ui.button('Cancel', on_click=cancel).props('outline'))
        said = frame.answer()

    def show(now: Snapshot) -> None:
        status = now.status(_TRAINING)
        try:
            done = float(status.values.get(_DONE, 'nan'))
        except ValueError:
            done = math.nan
        progress.set_value(0.0 if math.isnan(done) else round(done) / 100.0)
        share.set_text('' if math.isnan(done) else f'{done:.0f} %')
        figures.show(status)

    frame.follow(show)


class _Leaflet:
    """Sentences, figures, a picture and a whole page of what was found, all of it as text."""

    def __init__(self, name: str, about: str) -> None:
        self._name = name
        self._lines = div('')
        self._figures = _Figures()
        self._picture = attribute(ui.element('img').classes('picture hidden'), 'alt', about)
        with ui.expansion('the whole report').classes('hidden').props('dense') as self._whole:
            self._text = words('div', '', 'report')

    def show(self, found: Report | Comparison) -> None:
        """Show what was found, in place of what was there."""
        self._lines.clear()
        with self._lines:
            for line in found.lines:
                words('div', line)
        self._figures.figures(found.figures)
        if found.picture:
            # another address for another picture
            version = hashlib.sha256(found.picture).hexdigest()[:16]
            attribute(self._picture, 'src', f'/picture/{self._name}?{version}')
        show_if(self._picture, bool(found.picture))
        self._text.set_text(found.text)
        show_if(self._whole, bool(found.text))


def _report(frame: Frame) -> None:
    with div('card wide hidden', tag='section').props('aria-label=Report') as card:
        words('h2', 'report of the last training')
        verdict, when = words('div', '', 'value'), words('div', '', 'quiet')
        problem = words('div', '')
        leaflet = _Leaflet('training', 'Data, drift and prediction')
    shown: list[Report | None] = [None]

    def show(_: Snapshot) -> None:
        found = frame.source.learning.report
        if found is shown[0] or found is None:
            return
        shown[0] = found
        show_if(card, True)
        problem.set_text(found.problem)
        verdict.set_text('' if found.problem else
                         f'the new model is {"accepted" if found.accepted else "refused"}')
        when.set_text('' if found.problem else f'{_day(found.written)}, {found.model_file}')
        leaflet.show(found)

    frame.follow(show)


def _day(seconds: float) -> str:
    return time.strftime('%Y-%m-%d %H:%M:%S', time.localtime(seconds))


def _comparison(frame: Frame) -> None:
    with div('card wide hidden', tag='section').props('aria-label=Comparison') as card:
        words('h2', 'comparison on the last hour')
        words('div', 'What the new model would have commanded at what was measured, beside what '
              'was commanded; the loop under it would have gone another way.', 'quiet')

        async def compare() -> None:
            say(said, await frame.act('compare', '', model()))

        async def cancel() -> None:
            say(said, await frame.act('end comparison'))

        with div('row1'):
            begin = frame.control(ui.button('Compare on the last hour', on_click=compare).props(
                'outline'))
            end = frame.control(ui.button('Cancel', on_click=cancel).props('outline'))
        said = frame.answer()
        state = words('div', '').props('role=status')
        leaflet = _Leaflet('comparison', 'Recorded commands and those of the new model')
    shown = [Comparison()]

    def model() -> str:
        report = frame.source.learning.report
        return (frame.source.snapshot.status(_TRAINING).values.get('model_file', '')
                or (report.model_file if report else ''))

    def show(now: Snapshot) -> None:
        found = frame.source.learning.comparison
        show_if(card, bool(model() or found.model))
        show_if(begin, not found.running)
        show_if(end, found.running)
        if found.running:
            state.set_text(f'running for {max(now.wall - found.since, 0.0):.0f} s')
        if found is shown[0]:
            return
        shown[0] = found
        if not found.running:
            said.set_text('')
            state.set_text(f'✖ {found.problem}' if found.problem else
                           f'{found.model}, compared at {clock(found.since)}')
        leaflet.show(found)

    frame.follow(show)
