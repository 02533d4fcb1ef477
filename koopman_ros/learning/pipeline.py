# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Retraining from bags, or from a record that was read, to the model file."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
import glob
import hashlib
import os
from pathlib import Path
import shutil

import numpy as np

from koopman_ros.core.arrays import Array
from koopman_ros.core.datasets import Episode, sample_interval
from koopman_ros.core.paths import backup_path
from koopman_ros.core.progress import progress_line
from koopman_ros.core.units import difference_text, NANOSECONDS, SECONDS_PER_TIME_UNIT
from koopman_ros.execution import Backend, backend_of
from koopman_ros.learning.acceptance import (
    AcceptanceResult,
    evaluate_model,
    Thresholds,
    uncovered_setpoints,
)
from koopman_ros.learning.downsampling import coverage
from koopman_ros.learning.drift_estimation import estimate_drift
from koopman_ros.learning.drift_sampling import alternative_models, compare_classes
from koopman_ros.learning.free_run import AnyModel, FREE_RUN, FreeRun, simulate
from koopman_ros.learning.identification import (
    Identified,
    methods_of,
    Stopped,
)
from koopman_ros.learning.lift.scaling import checked_device
from koopman_ros.learning.lift.training import TrainingFailed
from koopman_ros.learning.model_selection import ClassComparison
from koopman_ros.learning.pipeline_progress import JUDGED, OnProgress, PipelineProgress, WRITING
from koopman_ros.learning.record import read_record, RecordSource, reduced, TrainingRecord
from koopman_ros.learning.task import resolve_signals, TrainingTask
from koopman_ros.learning.training_result import TrainingResult
from koopman_ros.learning.unfinished import Interrupted, UnfinishedTraining
from koopman_ros.model import LiftedModel, load, save
from koopman_ros.model_classes import BEST, CLASSES, IDENTITY_LIFT, SAME
from koopman_ros.records import Record, RecordedInput, RecordedState

# A smaller change, in half-ranges of the current model's range, is neither a spike nor a jump.
_LEAST_JUMP = 0.1

DRIFT, LINEAR_MODEL = 'estimated drift', 'best linear model'  #: compared with the new model
# % of the motion: errors on another day scatter by more than smaller differences say.
_LESS_FIT = 1.0


def retrain(task: TrainingTask, on_progress: OnProgress | None = None, *,
            record: Record | None = None, test: Record | None = None) -> TrainingResult:
    """
    Read the bags, estimate the drift, learn a lift of it, judge it, and write it.

    An accepted lift goes to the output file; the file that it replaces is kept as
    ``.previous.safetensors``. A rejected lift goes to ``.rejected.safetensors``. If the lift that
    training makes of a sibling's would be rejected, training starts again without the sibling.
    An interrupted training keeps its best model so far as ``.unfinished.safetensors``.
    The result does not depend on the executor of the task.

    :param on_progress: called with the share done and a text; True stops the training, which
        returns the result so far. By default a terminal shows both on one line.
    :param record: to learn from, in place of the bags of the task.
    :param test: a record that takes no part in the training. The new model is rejected if its free
        run errs more there than that of the best linear model.
    :raises BagReadError: for bags that cannot be used.
    :raises ModelFileError: when the current or the initial model cannot be read.
    :raises ValueError: for episodes that do not determine a model, or a task that does not fit.
    :raises Stopped: when `on_progress` returned True before a class was learned.
    :raises Interrupted: at Ctrl-C, with the result so far.
    :raises WorkerLost: when workers are lost and none takes over.
    :raises SchedulerLost: when a scheduler is not reached, or lost.
    """
    checked_device(task.device)
    unfinished = UnfinishedTraining()
    try:
        # a drift that diverges is found by its values
        with (np.errstate(all='ignore'), backend_of(task.executor) as backend,
              progress_line() as report):
            result = _retrain(backend, task, on_progress or (lambda *now: bool(report(*now))),
                              record, test, unfinished)
    except Stopped:
        if unfinished.result is None:
            raise
        return unfinished.result
    except KeyboardInterrupt as interrupt:
        raise Interrupted(unfinished.result) from interrupt
    unfinished.discard()
    return result


def _retrain(backend: Backend, task: TrainingTask, on_progress: OnProgress,
             given: Record | None, test: Record | None, unfinished: UnfinishedTraining
             ) -> TrainingResult:
    progress, thresholds = PipelineProgress(on_progress), _checked(task)
    current, sibling = (load(path).joined if path else None
                        for path in (task.model, task.warm_start_model))
    if task.model_class == SAME:
        task = replace(task, model_class=BEST if current is None else (
            current.provenance.model_class or IDENTITY_LIFT))
    plant, states, inputs = resolve_signals(task, current)
    methods = methods_of(task.methods, task.method_parameters)
    if task.output:
        # a folder that cannot be written should fail now, not after the training
        Path(task.output).parent.mkdir(parents=True, exist_ok=True)
    units = [{one.name: one.unit for one in some} for some in (states, inputs)]
    test = None if test is None else test.of(*units)
    record = (_read(backend, task, states, inputs, current, progress) if given is None else
              reduced(given.of(*units), task.most_samples, task.seed, hidden=_hidden(task)))
    if not record.episodes:
        raise ValueError('the record holds no usable segment of measurements: '
                         + '; '.join(record.account.lines()))
    seconds = SECONDS_PER_TIME_UNIT[plant.time_unit]
    episodes = [replace(episode, time=episode.time / seconds,
                        input_time=episode.input_time / seconds)
                for episode in record.episodes]
    estimate = estimate_drift(task, plant, episodes, methods, progress, backend)
    found, plant, episodes = estimate.found, estimate.plant, estimate.episodes
    dead_time = seconds * found.dead_time
    recorded = Record(replace(plant, time_unit='s', B=None, input_matrix_degree=0),
                      tuple(one for one in record.episodes if one.delayed(dead_time) is not None),
                      record.account, task.bags)
    if found.hidden:
        episodes = found.episodes
    box = found.drift.box
    if current is not None and (box.states.names, box.states.units) != (
            current.states.names, current.states.units):
        current = None
    if current is None:
        # an input that keeps the plant somewhere in the middle is not far
        plant = replace(plant, state_names=box.states.names, state_units=box.states.units, B=None,
                        nominal_state=box.states.center, nominal_input=box.inputs.center)
    elif found.hidden:
        plant = replace(current.plant, B=None, disturbance_names=plant.disturbance_names)
    bare = TrainingResult(task, record.account, found, None, None, (), coverage(episodes, box),
                     plant, current, reduction=record.reduction)

    def on_class(learned: ClassComparison) -> None:
        others = f'; classes not tried: {", ".join(learned.untried)}' * bool(learned.untried)
        reasons = 'the training was interrupted before the acceptance test' + others,
        model = _with_origin(replace(learned.model, dead_time=dead_time), found, episodes,
                             learned.chosen.name, reasons).with_disturbances(task.disturbances)
        unfinished.keep(replace(bare, learned=learned.with_model(model), reasons=reasons))

    learned, decision, reasons = _learn(bare, sibling, thresholds, progress, backend, on_class)
    if learned is None or decision is None:
        return replace(bare, reasons=reasons)
    learned = learned.with_model(replace(learned.model, dead_time=dead_time))
    offsets = found.offsets / seconds if len(found.offsets) == len(recorded.episodes) else (
        np.zeros((len(recorded.episodes), len(box.states))))
    # commands are no states of a record
    offsets = offsets[:, :offsets.shape[1] - len(estimate.as_state)]
    runs = _free_runs(learned, recorded, test, offsets)
    init = runs['test'].init if test else None
    others = {name: _free_runs(replace(found, drift=drift), recorded, test, offsets, init)
              for name, drift in ((DRIFT, found.drift), (LINEAR_MODEL, found.linear))}
    decision = replace(decision, reasons=(
        *decision.reasons, *_failed_runs(runs, others)), warnings=(
        *decision.warnings, *uncovered_setpoints(learned.model.states, task.setpoints),
        *(f'{one.name} = {one}' for one in found.constants if one.standing.value),
        *[f'not compared with the current model {task.model}, which has other states'
          ] * bool(task.model and current is None)))
    progress('decide', WRITING, 'writing')
    model = _with_figures(
        _with_origin(learned.model, found, episodes, learned.chosen.name, decision.reasons),
        decision, min(bare.coverage.values()), episodes, runs['record']
    ).with_disturbances(task.disturbances)
    result = replace(bare, learned=learned.with_model(model), decision=decision,
                     reasons=decision.reasons, free_runs=runs, compared_runs=others)
    if not task.output:
        return result
    path = _place(Path(task.output), decision.accepted)
    save(model, path)
    return replace(result, model_file=str(path), alternative_files=_save_alternatives(
        Path(task.output), alternative_models(found, plant, dead_time)))


def _save_alternatives(output: Path, models: Sequence[LiftedModel]) -> tuple[str, ...]:
    """Write the alternatives in place of those of the training before; return their files."""
    for old in output.parent.glob(f'{glob.escape(output.stem)}.alternative_*.safetensors'):
        old.unlink()
    files = [output.with_suffix(f'.alternative_{k}.safetensors')
             for k in range(1, 1 + len(models))]
    for path, model in zip(files, models, strict=True):
        save(model, path)
    return tuple(map(str, files))


def _hidden(task: TrainingTask) -> bool:
    return bool(task.unmeasured_states or task.physical_model)


def _read(backend: Backend, task: TrainingTask, states: Sequence[RecordedState],
          inputs: Sequence[RecordedInput], current: LiftedModel | None, progress: PipelineProgress
          ) -> TrainingRecord:
    """Read the bags of a task."""
    source = RecordSource(
        task.bags, states, inputs, tolerance_ns=round(task.tolerance * NANOSECONDS),
        least_jumps=None if current is None else (_LEAST_JUMP * current.states.scale).tolist())
    progress('read', 0.0, 'reading bags')
    return read_record(source, task.most_samples, task.seed, hidden=_hidden(task),
                       tick=progress.reading(2 * source.size()), backend=backend)


def _free_runs(model: AnyModel, recorded: Record, test: Record | None, offsets: Array,
               init: int | None = None) -> dict[str, FreeRun]:
    """Simulate the record, with the offset of each episode, and the test record."""
    runs = {'record': simulate(model, recorded, offsets=offsets)}
    if test is not None:
        runs['test'] = simulate(model, test, init, usual=runs['record'].rmse)
    return runs


def _failed_runs(runs: Mapping[str, FreeRun], others: Mapping[str, Mapping[str, FreeRun]]
                 ) -> Iterator[str]:
    """Say that a free run diverges, or is clearly worse on the test record than a linear one."""
    for name, own in runs.items():
        linear, test = others[LINEAR_MODEL][name], name == 'test'
        # that of an unstable plant leaves the measured range by any model, be it finite or not
        if own.diverged and (test or any(np.isnan(one[name].leaves) for one in others.values())):
            yield (f'its free run of the {"test " * test}record diverges: from {own.leaves:.4g} '
                   f'{own.plant.time_unit} on it errs by more than the measured range')
        elif test and np.mean(linear.fit) > np.mean(own.fit) + _LESS_FIT:
            yield (f'the error of its free run of the test record, {own.error_text()}, is above '
                   f'that of the best linear model, {linear.error_text()}, by more than '
                   f'{_LESS_FIT:g} % of the motion')
        elif test:
            # motion below the usual error is none
            yield from (
                f'its free run of the test record errs by {difference_text(rmse, unit)} in '
                f'{state}, more than the mean value does (fit {fit:.1f} %): record under such '
                'conditions, too'
                for state, unit, rmse, fit, usual in zip(
                    own.names, own.units, own.rmse, own.fit, runs['record'].rmse, strict=True)
                if fit < 0.0 and rmse > (1.0 - fit / 100.0) * usual)


def _checked(task: TrainingTask) -> Thresholds:
    """Return the thresholds of a task; ValueError for fields that do not fit."""
    if task.model_class not in (*CLASSES, BEST, SAME):
        raise ValueError(f'model_class = {task.model_class!r} must be one of '
                         f'{", ".join((*CLASSES, BEST, SAME))}')
    if task.output and Path(task.output).suffix != '.safetensors':
        raise ValueError(f'output = {task.output!r} must end in .safetensors')
    return Thresholds(task.margin, task.condition)


def _learn(bare: TrainingResult, sibling: LiftedModel | None, thresholds: Thresholds,
           progress: PipelineProgress, backend: Backend,
           on_class: Callable[[ClassComparison], None]
           ) -> tuple[ClassComparison | None, AcceptanceResult | None, tuple[str, ...]]:
    """Return the classes, the decision, and the reasons of a rejection; from a sibling first."""
    task, found = bare.task, bare.found
    learned: ClassComparison | None = None
    decision: AcceptanceResult | None = None
    warnings: tuple[str, ...] = ()
    for begin in (None,) if sibling is None else (sibling, None):
        learned, decision, progress.learned = None, None, 0.0
        try:
            learned = compare_classes(
                found, bare.plant, thresholds, model_class=task.model_class,
                n_z=task.coordinates or 2 + len(found.drift.box.states), seed=task.seed,
                starts=task.starts, watch=progress.learning, judging=progress.judging,
                device=task.device, backend=backend, begin=begin, on_class=on_class)
        except TrainingFailed as error:
            reasons: tuple[str, ...] = (str(error),)
        progress('decide', JUDGED, 'judging')
        if learned is not None:
            decision = evaluate_model(found, learned, bare.present, thresholds,
                                      watch=progress.judging_further, backend=backend,
                                      setpoints=task.setpoints)
            decision = replace(decision, warnings=(*decision.warnings, *warnings))
            reasons = decision.reasons
        if not reasons:
            break
        warnings = (f'trained without warm start, because the model from {task.warm_start_model} '
                    f'would be rejected: {"; ".join(reasons)}',)
    return learned, decision, reasons


def _with_origin(model: LiftedModel, found: Identified, episodes: Sequence[Episode],
                 model_class: str, reasons: tuple[str, ...]) -> LiftedModel:
    """Return a model with its record, its class and its verdict."""
    sha = hashlib.sha256()
    for episode in episodes:
        for array in (episode.time, episode.x, episode.input_time, episode.u):
            sha.update(np.ascontiguousarray(array).astype('<f8').tobytes())
        sha.update(bytes(episode.linear))
    measured = model.states.names[:len(model.states) - found.hidden] if found.hidden else ()
    return replace(model, states_measured=measured, provenance=replace(
        model.provenance, data_digest=sha.hexdigest(), model_class=model_class,
        method=f'{found.method}, {found.drift.form}', accepted=not reasons, reasons=reasons))


def _with_figures(model: LiftedModel, decision: AcceptanceResult, covered: float,
                  episodes: Sequence[Episode], run: FreeRun) -> LiftedModel:
    """Return a model with the figures of its acceptance."""
    metrics = {**model.provenance.metrics, 'coverage': covered,
               'sample_interval': sample_interval(episodes) * model.seconds_per_time_unit}
    for label, values in (('rollout_rmse', decision.rmse), ('noise', decision.noise)):
        labels = [label] if len(values) == 1 else [
            f'{label}_{name}' for name in model.states.names]
        metrics |= dict(zip(labels, map(float, values), strict=True))
    metrics |= {f'{FREE_RUN}_{name}': float(error)
                for name, error in zip(run.names, run.rmse, strict=True)}
    # a rejected lift may diverge
    metrics = {name: value for name, value in metrics.items() if np.isfinite(value)}
    return replace(model, verified_loops=decision.law_check.tried,
                   rate_band=None if decision.plant is None else decision.plant.band,
                   provenance=replace(model.provenance, metrics=metrics,
                                      closed_loops=decision.statement))


def _place(output: Path, accepted: bool) -> Path:
    """Return where a lift is written; an accepted one moves its predecessor aside."""
    if not accepted:
        return output.with_suffix('.rejected.safetensors')
    if output.exists():
        previous = backup_path(output)
        previous.unlink(missing_ok=True)
        # a second name, so that there is a model under the first one at every moment
        try:
            os.link(output, previous)
        except OSError:
            # not every file system has them
            shutil.copy2(output, previous)
    return output
