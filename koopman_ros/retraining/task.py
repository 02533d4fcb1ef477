# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Retraining from bags to the model file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
import hashlib
import json
import os
from pathlib import Path
import shutil

import numpy as np
from numpy.typing import NDArray

from koopman_ros.bags import Account, loop_episodes, RecordedInput, RecordedState
from koopman_ros.identification import Identified, identify, Stopped
from koopman_ros.learning import NoUsefulLift, Progress, Trained
from koopman_ros.lifting import Box, LiftedModel, load, save
from koopman_ros.plant_data import Episode
from koopman_ros.retraining.lift import decide, Decision, learn_lift, Thresholds
from koopman_ros.wire import place

CELLS = 10  # along each state and input, by which the visited share of their range is told

# Shares of the whole at which estimating, learning and judging begin and end.
_STAGES = {'estimate': (0.05, 0.35), 'learn': (0.35, 0.9), 'decide': (0.9, 1.0)}

# Called with the share done in [0, 1] and what is done now; True asks to stop.
OnProgress = Callable[[float, str], bool]


@dataclass(frozen=True)
class Task:
    """Input files, output file and settings of a retraining."""

    bags: tuple[str, ...]  #: files or folders
    output: str  #: model file to write, ending in ``.safetensors``
    model: str  #: file of the present lift
    temperature_topic: str = '/temperature'  #: absolute name of the measurements
    coolant_topic: str = '/coolant_setpoint'  #: absolute name of the coolant temperature that acts
    coordinates: int = 3  #: n_z of the new lift
    seed: int = 0  #: of the split and of the training
    starts: int = 3  #: of each round of the training
    input_gain: float = 0.0  #: B in 1/min where it is known, 0 to learn it
    input_delay: float = 0.0  #: dead time of the actuator, in s
    margin: float = 0.1  #: see :class:`Thresholds`
    condition: float = 1e4  #: likewise

    @classmethod
    def from_json(cls, text: str) -> Task:
        """Read a task; unknown or missing fields are a TypeError."""
        values = json.loads(text)
        return cls(**{**values, 'bags': tuple(values['bags'])})


@dataclass(frozen=True)
class Retrained:
    """Result of a retraining."""

    task: Task  #: the task
    account: Account  #: counts of used and dropped measurements
    found: Identified  #: the estimated drift
    trained: Trained | None  #: the lift, None when there is none worth judging
    decision: Decision | None  #: its figures, None without a lift
    reasons: tuple[str, ...]  #: why it was refused; empty when it was accepted
    coverage: float  #: share of the cells of the state-input box that the episodes visit
    present: LiftedModel  #: the lift that was in use; its time unit is that of the drift
    model_file: str = ''  #: where the lift was written, or an empty string

    @property
    def accepted(self) -> bool:
        """Whether the lift may be used."""
        return not self.reasons

    def summary(self) -> dict[str, object]:
        """Return the figures by name, for a JSON file; None is an error that is infinite."""
        drift = self.found.drift
        figures: dict[str, object] = {
            'accepted': self.accepted,
            'reasons': list(self.reasons),
            'warnings': list(self.decision.warnings) if self.decision else [],
            'model_file': self.model_file,
            'measurements_read': self.account.measurements,
            'measurements_used': self.account.used,
            'coverage': self.coverage,
            'derivative_method': self.found.method,
            'drift_degree': drift.degree,
            'input_gain_per_minute': (float(drift.input_matrix[0, 0])
                                      * 60.0 / self.present.seconds_per_time_unit),
            'noise_kelvin': float(self.found.noise[0]),
        }
        if self.decision and self.trained:
            figures |= {
                'heldout_error_kelvin': float(self.decision.rmse[0]),
                'heldout_error_of_present_lift_kelvin': float(self.decision.current_rmse[0]),
                'heldout_error_of_linear_model_kelvin': float(self.decision.linear_rmse[0]),
                'heldout_rw': self.trained.figures.fit.rw,
                'heldout_rx': self.trained.figures.fit.rx,
                'condition': self.trained.figures.fit.cond,
                'closed_loops': self.decision.loops,
                'closed_loops_arrived': self.decision.arrived,
            }
        return {name: None if isinstance(value, float) and not np.isfinite(value) else value
                for name, value in figures.items()}


def retrain(task: Task, on_progress: OnProgress = lambda *_: False) -> Retrained:
    """
    Read the bags, estimate the drift, learn a lift of it, judge it, and write it.

    An accepted lift goes to the output file, and what was there before is kept beside it as
    ``.previous.safetensors``; a refused one goes to ``.refused.safetensors``.

    :raises BagReadError: for bags that cannot be used.
    :raises ModelFileError: when the present lift cannot be read.
    :raises ValueError: for episodes that do not determine a model, or a task that does not fit.
    :raises Stopped: when `on_progress` asked for it; nothing is written then.
    """
    thresholds = Thresholds(task.margin, task.condition)
    if Path(task.output).suffix != '.safetensors':
        raise ValueError(f'output = {task.output!r} must end in .safetensors')
    current = load(task.model)
    _check_signals(current, task.model)
    # a folder that cannot be written should fail now, not after the training
    Path(task.output).parent.mkdir(parents=True, exist_ok=True)
    _stop_if(on_progress(0.0, 'reading bags'))
    (x,), (x_unit,) = current.states.names, current.states.units
    (u,), (u_unit,) = current.inputs.names, current.inputs.units
    recorded, account = loop_episodes(
        task.bags, [RecordedState(x, x_unit, place(task.temperature_topic, x, x_unit))],
        [RecordedInput(u, u_unit, place(task.coolant_topic, u, u_unit), delay=task.input_delay)])
    if not recorded:
        raise ValueError('the bags hold no usable segment of measurements: '
                         + '; '.join(account.lines()))
    seconds = current.seconds_per_time_unit
    episodes = [replace(episode, time=episode.time / seconds,
                        input_time=episode.input_time / seconds) for episode in recorded]
    B = np.array([[task.input_gain * seconds / 60.0]]) if task.input_gain else None
    found = identify(
        replace(current.plant, B=B), episodes, seed=task.seed,
        watch=lambda done, total, text: on_progress(
            _at('estimate', done / total), f'estimating: {text}'))
    bare = Retrained(task, account, found, None, None, (), coverage(episodes, found.drift.box),
                     current)
    try:
        trained = learn_lift(found, current.plant, task.coordinates, seed=task.seed,
                             starts=task.starts, watch=lambda now: on_progress(
                                 _at('learn', now.finished / now.total), _learning(now)))
    except NoUsefulLift as error:
        _stop_if(on_progress(_at('decide', 0.0), 'judging'))
        return replace(bare, reasons=(str(error),))
    # a training that was stopped ends with its best so far
    _stop_if(on_progress(_at('decide', 0.0), 'judging'))
    decision = decide(found, trained, current, thresholds)
    _stop_if(on_progress(_at('decide', 0.9), 'writing'))
    model = _with_provenance(trained.model, found, decision, bare.coverage, episodes)
    path = _place(Path(task.output), decision.accepted)
    save(model, path)
    return replace(bare, trained=replace(trained, model=model), decision=decision,
                   reasons=decision.reasons, model_file=str(path))


def visited_cells(episodes: Sequence[Episode], box: Box) -> NDArray[np.int64]:
    """Return the cells (K, n_x + n_u) of the box that measurements and their inputs lie in."""
    found = []
    for episode in episodes:
        u = box.inputs.to_deviation(episode.inputs_at(episode.time))
        scaled = np.hstack([box.states.to_deviation(episode.x), u])
        found.append(np.clip((0.5 * (scaled + 1.0) * CELLS).astype(np.int64), 0, CELLS - 1))
    return np.unique(np.concatenate(found), axis=0)


def coverage(episodes: Sequence[Episode], box: Box) -> float:
    """Return the share of the cells of the box that are visited."""
    cells = visited_cells(episodes, box)
    return len(cells) / float(CELLS) ** cells.shape[1]


def _check_signals(model: LiftedModel, path: str) -> None:
    if (model.n_x, model.n_u) == (1, 1):
        return
    states, inputs = (
        ', '.join(f'{name} [{unit}]' for name, unit in zip(a.names, a.units, strict=True))
        for a in (model.states, model.inputs))
    raise ValueError(
        f'the present lift {path} has {states} as states and {inputs} as inputs, bags of the '
        'loop hold one of each: name a lift of these')


def _at(stage: str, share: float) -> float:
    begin, end = _STAGES[stage]
    return begin + share * (end - begin)


def _stop_if(stop: bool) -> None:
    if stop:
        raise Stopped


def _learning(now: Progress) -> str:
    rw = '' if np.isnan(now.rw) else f', rw {now.rw:.1e}'
    return f'learning: n_z {now.n_z}, start {min(now.finished + 1, now.total)} of {now.total}{rw}'


def _with_provenance(model: LiftedModel, found: Identified, decision: Decision, covered: float,
                     episodes: list[Episode]) -> LiftedModel:
    sha = hashlib.sha256()
    for episode in episodes:
        for array in (episode.time, episode.x, episode.input_time, episode.u):
            sha.update(np.ascontiguousarray(array).astype('<f8').tobytes())
    metrics = {**model.provenance.metrics, 'rollout_rmse': float(decision.rmse[0]),
               'noise': float(decision.noise[0]), 'coverage': covered}
    # a refused lift may diverge
    metrics = {name: value for name, value in metrics.items() if np.isfinite(value)}
    return replace(model, provenance=replace(
        model.provenance, data_digest=sha.hexdigest(), metrics=metrics,
        method=f'{found.method}, drift of degree {found.drift.degree}'))


def _place(output: Path, accepted: bool) -> Path:
    """Return where a lift is written; an accepted one moves its predecessor aside."""
    if not accepted:
        return output.with_suffix('.refused.safetensors')
    if output.exists():
        previous = output.with_suffix('.previous.safetensors')
        previous.unlink(missing_ok=True)
        # a second name, so that there is a model under the first one at every moment
        try:
            os.link(output, previous)
        except OSError:
            # not every file system has them
            shutil.copy2(output, previous)
    return output
