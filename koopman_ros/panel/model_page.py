# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Page of the current model, and of recording, experiments and training."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping, Sequence
from functools import partial
import math

from nicegui import ui

from koopman_ros.core.paths import model_path
from koopman_ros.core.units import printed
from koopman_ros.model import load
from koopman_ros.panel.faceplates import readable
from koopman_ros.panel.layout import AnswerLine, box, label, PageLayout, show_if
from koopman_ros.panel.model_card import (
    brief,
    model_changes,
    status_card,
    training_card,
    training_ranges,
)
from koopman_ros.panel.report_cards import comparison_card, report_card
from koopman_ros.panel.requests import Action, Answer, Role
from koopman_ros.panel.snapshot import (
    CONTROL,
    CONTROLLER,
    EXPERIMENT,
    OK,
    RECORDING,
    Snapshot,
    TaskStatus,
    TRAINER,
    TRAINING,
    WARN,
)

_DONE = 'done [%]'
_FORCE = 'load_rejected_model'


def model_page(page: PageLayout) -> None:
    """Build the page."""
    with page.body:
        _model(page)
        with box('cards loose'):
            _recording(page)
            _experiment(page)
        _training(page)
        report_card(page)
        comparison_card(page)


class _Figures:
    """Figures, one in a line."""

    def __init__(self, *, columns: bool = False) -> None:
        self._lines = box('').classes('pairs columns' if columns else 'pairs')
        self._shown: dict[str, ui.label] = {}

    def show(self, found: Mapping[str, str]) -> None:
        """Show figures, without the unknown ones."""
        values = {key: brief(value) for key, value in found.items() if value not in ('none', '')}
        if list(values) != list(self._shown):
            self._lines.clear()
            self._shown = {}
            with self._lines:
                for key in values:
                    with box('pair'):
                        label('div', key, 'quiet')
                        self._shown[key] = label('div', '')
        for key, value in values.items():
            self._shown[key].set_text(value)


class _Task:
    """Status of a task: its message, a mark if it is a warning or an error, and its figures."""

    def __init__(self, *, columns: bool = False) -> None:
        self._message = label('div', '')
        self._mark = label('span', '', 'abnormal hidden')
        self._figures = _Figures(columns=columns)

    def show(self, status: TaskStatus, figures: Mapping[str, str]) -> None:
        """Show a status and its figures by their names."""
        self._message.set_text(status.message or 'no status received')
        self._mark.set_text({OK: '', WARN: '▲ WARNING'}.get(status.level, '■ ERROR'))
        show_if(self._mark, status.level > OK)
        self._figures.show({key[:1].upper() + key[1:]: value for key, value in figures.items()})


def _model(page: PageLayout) -> None:
    with page.card('current model', 'Model', CONTROLLER):
        name = label('div', '', 'value')
        task, origin = _Task(columns=True), _Figures(columns=True)
        training = label('div', '', 'quiet')

        async def reload() -> None:
            answer.set_text('sent …')
            answer.show(await page.act('reload', CONTROLLER))

        async def activate(name: str, rejected: bool = False) -> None:
            answer.set_text('')
            now, view = page.source.snapshot, page.source.view
            current = now.status(CONTROL).values.get('model', 'the current model')
            details = [
                name, f'It replaces {current} if it passes the check on recent measurements.']
            changes: list[Sequence[str]] = []
            reasons = now.status(TRAINING).message
            try:
                new = await asyncio.to_thread(load, model_path(name))
            except (OSError, ValueError) as error:
                details.append(f'The panel cannot show the changes: {error}')
            else:
                rejected = new.provenance.accepted is False
                reasons = '; '.join(new.provenance.reasons)
                changes = [('', 'current model', 'new model'), *model_changes(
                    now, name, new, view.shown_ranges(training_ranges(new)))]
            if rejected:
                details.append(f'✖ Training rejected this model: {reasons}.')
            if not await page.confirm('Activate this model?', 'Activate by force' if rejected
                                      else 'Activate', details, changes):
                return
            # the controller reads the file again even where its name is the same
            wanted = {'model': name, **({_FORCE: True} if rejected else {})}
            old = {key: now.parameter(CONTROLLER, key) for key in wanted}
            answer.set_text('sent …')
            forced = old.get(_FORCE) is False and page.visitor.may(Role.ENGINEER)
            try:
                answer.show(await page.act('parameters', CONTROLLER, wanted, old))
            finally:
                if forced:
                    # for this model alone, also where the page was closed
                    page.source.request(Action(page.visitor.name, 'parameters', CONTROLLER,
                                               {_FORCE: False}, {_FORCE: True}))

        def trained() -> tuple[str, bool]:
            status = page.source.snapshot.status(TRAINING)
            # a training replaces the file when it ends
            return ('', False) if training_running(status) else (
                page.source.learning.new_model(status.values))

        with box('row1'):
            new = page.button('', lambda: activate(*trained()), 'parameters')
            back = page.button('', lambda: activate(page.source.snapshot.previous_model),
                               'parameters')
            page.button('Reload model file', reload, 'reload')
        answer = AnswerLine(page)

    def show(now: Snapshot) -> None:
        control = now.status(CONTROL)
        name.set_text(control.values.get('model', '–'))
        task.show(control, status_card(control.values))
        origin.show(now.model)
        ranges = ', '.join(f'{face.label} {face.span_text(face.training)} {face.unit}'
                           for face in (*now.states, *now.inputs) if face.training)
        training.set_text(f'Training range: {ranges or "not known"}')
        file, rejected = trained()
        show_if(new, bool(file))
        new.set_text(f'Activate the {"rejected" if rejected else "new"} model …')
        show_if(back, bool(now.previous_model))
        back.set_text(f'Back to {now.previous_model} …')

    page.follow(show)


def _buttons(page: PageLayout, task: str,
             actions: Mapping[str, Callable[[], Awaitable[Answer | None]]]) -> list[ui.button]:
    """Add buttons for actions on a task, and the line of their answers; return the buttons."""
    async def press(act: Callable[[], Awaitable[Answer | None]]) -> None:
        if found := await act():
            answer.show(found)

    with box('row1'):
        buttons = [page.button(text, partial(press, act)) for text, act in actions.items()]
    answer = AnswerLine(page, lambda now: now.status(task).message)
    return buttons


def _recording(page: PageLayout) -> None:
    with page.card('recording', 'Recording', TRAINER):
        task = _Task()
        record, stop = _buttons(page, RECORDING, {
            'Record': partial(page.act, 'record', TRAINER, True),
            'Stop': partial(page.act, 'record', TRAINER, False)})

    def show(now: Snapshot) -> None:
        found = now.status(RECORDING)
        page.allow(record, 'bag' not in found.values, 'a recording is running')
        page.allow(stop, 'bag' in found.values, 'no recording is running')
        task.show(found, {key: value for key, value in found.values.items()
                          if not key.startswith('messages on') and value not in found.message})

    page.follow(show)


def _experiment(page: PageLayout) -> None:
    with page.card('experiment', 'Experiment', TRAINER):
        task = _Task()
        limits, obstacle = label('div', '', 'lines quiet'), label('div', '', 'hidden')

        async def start() -> Answer | None:
            lines = experiment_limits(page.source.snapshot)
            return await page.act('experiment', TRAINER, True) if await page.confirm(
                'Start the experiment?', 'Start the experiment',
                ['The experiment applies random steps within these limits:', *lines]) else None

        begin, end = _buttons(page, EXPERIMENT, {
            'Start …': start, 'End': partial(page.act, 'experiment', TRAINER, False)})

    def show(now: Snapshot) -> None:
        found = now.status(EXPERIMENT)
        reason = experiment_obstacle(now)
        obstacle.set_text(f'Start is not possible: {reason}')
        show_if(obstacle, bool(reason))
        page.allow(begin, not reason, reason)
        # also one that is over and still holds the inputs
        page.allow(end, 'topic' in found.values, 'no experiment is running')
        task.show(found, {'time left [s]' if key == 'left [s]' else key: value
                          for key, value in found.values.items()})
        limits.set_text('\n'.join(experiment_limits(now)))

    page.follow(show)


def experiment_obstacle(now: Snapshot) -> str:
    """Return why no experiment can start, and what to do, or nothing."""
    signal = now.parameter(TRAINER, 'experiment_signal')
    if now.experiment:
        return 'an experiment is running'
    if signal == 'command' and now.mode:
        return ('the controller commands the inputs; stop it, or set experiment_signal to '
                'setpoint or manual on the tuning page')
    wanted = {'setpoint': 'automatic', 'manual': 'manual'}.get(str(signal), now.mode)
    return '' if now.mode == wanted else (
        f'with experiment_signal = {signal}, the controller must be in {wanted} mode')


def experiment_limits(now: Snapshot) -> list[str]:
    """Return the steps and limits that hold in the mode of an experiment, in lines."""
    parameters = now.parameters.get(TRAINER, {})
    inputs = {face.name: face for face in now.inputs}
    if 'experiment_signal' not in parameters:
        return ['Trainer not running: no limits available']

    def text(name: str) -> str:
        value, unit = parameters[name].value, printed(parameters[name].unit)
        return f'{value:.6g} {unit}' if isinstance(value, float) else f'{value} {unit}'.rstrip()

    on = parameters['experiment_signal'].text
    lines = [f'steps: {on}, for {text("experiment_length")}, each '
             f'{text("experiment_min_hold_time")} to {text("experiment_max_hold_time")}']
    for name in parameters:
        signal, _, last = name.rpartition('.')
        if last != 'experiment_min':
            continue
        is_input = f'{signal}.safe_value' in parameters
        if on == 'setpoint' and f'{signal}.setpoint_min' in parameters:
            lines.append(f'{readable(signal)}: set-points {text(f"{signal}.setpoint_min")} to '
                         f'{text(f"{signal}.setpoint_max")}')
        if is_input and on == 'setpoint':
            # the steps are of set-points; the controller moves the inputs
            face = inputs.get(signal)
            lines.append(f'{readable(signal)}: moved by the controller within its limits' + (
                f', {face.span_text(face.limits)} {face.unit}' if face and face.limits else ''))
        else:
            what = 'steps within' if is_input else 'aborts outside'
            lines.append(f'{readable(signal)}: {what} {text(name)} to '
                         f'{text(f"{signal}.experiment_max")}')
    return lines


def training_running(status: TaskStatus) -> bool:
    """Return whether a training can be cancelled."""
    return _done(status) < 100.0 and status.level == OK and 'accepted' not in status.values


def _done(status: TaskStatus) -> float:
    try:
        return float(status.values.get(_DONE, 'nan'))
    except ValueError:
        return math.nan


def _training(page: PageLayout) -> None:
    with page.card('training', 'Training', TRAINER):
        progress = ui.linear_progress(0.0, show_value=False, size='14px').props(
            'aria-label="Progress of the training" color=grey-8')
        share = label('div', '', 'value')
        task = _Task(columns=True)
        train, cancel = _buttons(page, TRAINING, {
            'Train': partial(page.act, 'train', TRAINER),
            'Cancel': partial(page.act, 'cancel', TRAINER)})

    def show(now: Snapshot) -> None:
        found = now.status(TRAINING)
        done, running = _done(found), training_running(found)
        page.allow(train, not running, 'a training is running')
        page.allow(cancel, running, 'no training is running')
        progress.set_value(0.0 if math.isnan(done) else round(done) / 100.0)
        share.set_text('' if math.isnan(done) else f'{done:.0f} %')
        task.show(found, training_card(found.values))

    page.follow(show)
