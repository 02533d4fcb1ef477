# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The drift of a record: dead times and lags of the inputs, and the equations behind them."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from koopman_ros.core.arrays import Array
from koopman_ros.core.datasets import Episode, PlantDescription, sample_interval
from koopman_ros.core.units import SECONDS_PER_TIME_UNIT
from koopman_ros.execution import Backend
from koopman_ros.learning.identification import (
    estimate_parameters,
    find_dead_times,
    find_lags,
    IdentificationMethod,
    Identified,
    identify_measured,
    identify_non_affine,
    identify_structure,
    identify_unmeasured,
    lagged,
    with_lag,
)
from koopman_ros.learning.identification.excitation import check_inputs
from koopman_ros.learning.pipeline_progress import PipelineProgress
from koopman_ros.learning.task import TrainingTask
from koopman_ros.model import LONGEST_DEAD_TIME
from koopman_ros.plants import plant_class

# A command that is a state follows the input of the model with this lag, in samples of the record.
_COMMAND_LAG = 1.0


class IdentifiedDrift(NamedTuple):
    """Drift of a record, with dead times and lags."""

    found: Identified
    plant: PlantDescription  #: with the characteristics of its inputs
    episodes: list[Episode]  #: inputs behind their dead times and lags
    as_state: tuple[str, ...]  #: commands that are states of the drift


def estimate_drift(task: TrainingTask, plant: PlantDescription, episodes: list[Episode],
                   methods: Mapping[str, IdentificationMethod], progress: PipelineProgress,
                   backend: Backend) -> IdentifiedDrift:
    """
    Estimate dead times, lags and the drift of episodes as a task requests.

    :raises ValueError: for episodes that do not determine them, or a task that does not fit.
    """
    _check_disturbances(plant, episodes)
    if not task.physical_model:
        # before dead times move inputs apart that moved together
        check_inputs(plant, episodes)
    seconds = SECONDS_PER_TIME_UNIT[plant.time_unit]
    lag = known = _given_lag(task, plant, episodes) / seconds
    dead_time = _dead_time(task, plant, _behind(episodes, lag), progress)
    searched = [j for j, name in enumerate(plant.input_names) if task.lag.get(name) == -1.0]
    commanded, fixed = episodes, frozenset(task.characteristics)
    while True:
        if searched:
            lag = find_lags(plant, _delayed(commanded, dead_time / seconds), known, searched,
                            watch=lambda: progress.estimating(0, 1, 'lag'))
            dead_time = _dead_time(task, plant, _behind(commanded, lag), progress)
        episodes = _behind(_delayed(commanded, dead_time / seconds), lag)
        found = _identify(task, plant, episodes, methods, progress, backend, fixed)
        if not searched or found.drift.characteristics.keys() <= fixed:
            break
        # with the characteristics the lags are found better
        plant = replace(plant, characteristics=found.drift.characteristics)
        fixed = frozenset(plant.characteristics)
    found = replace(found, dead_time=found.dead_time + dead_time / seconds,
                    disturbances=plant.disturbance_names)
    moved = np.isin(plant.input_names, task.as_state) & (lag == 0.0)
    as_state = [name for name, own in zip(plant.input_names, moved, strict=True) if own]
    if lag.any() or as_state:
        found = with_lag(found, np.where(moved, _COMMAND_LAG * sample_interval(episodes), lag),
                         as_state)
    return IdentifiedDrift(found, plant, episodes, tuple(as_state))


def _identify(task: TrainingTask, plant: PlantDescription, episodes: list[Episode],
              methods: Mapping[str, IdentificationMethod], progress: PipelineProgress,
              backend: Backend, given: Collection[str]) -> Identified:
    """
    Estimate the drift: a polynomial, one with unmeasured states, or a plant's equations.

    :param given: inputs of which no characteristic is estimated.
    """
    seed, watch = task.seed, progress.estimating
    if task.physical_model:
        return estimate_parameters(plant, episodes, plant_class(task.physical_model),
                                   task.constants, seed=seed, watch=watch)
    if task.as_state:
        return identify_non_affine(plant, episodes, task.as_state, methods=methods, seed=seed,
                                   watch=watch, backend=backend)
    if task.unmeasured_states < 0 and not task.model:
        return identify_structure(plant, episodes, given=given, methods=methods,
                                  seed=seed, watch=watch, backend=backend,
                                  dead_times=not task.dead_time)
    if task.unmeasured_states > 0:
        return identify_unmeasured(plant, episodes, task.unmeasured_states, seed=seed,
                                   watch=watch, backend=backend, dead_times=not task.dead_time)
    return identify_measured(plant, episodes, given=given, methods=methods, seed=seed, watch=watch,
                             backend=backend)[0]


def _check_disturbances(plant: PlantDescription, episodes: Sequence[Episode]) -> None:
    """Raise ValueError for a measured disturbance that does not change in the record."""
    for name in plant.disturbance_names:
        j = plant.input_names.index(name)
        values = np.concatenate([one.u[:, j] for one in episodes])
        if not np.ptp(values) > 0.0:
            raise ValueError(f'{name} is {values[0]:.6g} in the whole record: leave it out of the '
                             'measured disturbances, or record while it changes')


def _dead_time(task: TrainingTask, plant: PlantDescription, episodes: Sequence[Episode],
               progress: PipelineProgress) -> Array:
    """Return the dead times (n_u,) as the task has them, or as estimated from the record, in s."""
    names, seconds = plant.input_names, SECONDS_PER_TIME_UNIT[plant.time_unit]
    if unknown := ', '.join(name for name in task.dead_time if name not in names):
        raise ValueError(f'dead_time names {unknown}: the inputs are {", ".join(names)}')
    given = np.array([task.dead_time.get(name, 0.0) for name in names])
    if not (np.all(np.isfinite(given)) and np.all(given >= 0.0)):
        raise ValueError(f'dead_time is {dict(task.dead_time)}, must be 0 s or more')
    if late := ', '.join(name for name in task.disturbances if task.dead_time.get(name)):
        raise ValueError(f'dead_time names {late}: a measured disturbance has none')
    known = [name in task.dead_time or name in task.disturbances for name in names]
    episodes = _delayed(episodes, given / seconds)
    if not episodes:
        raise ValueError(f'no episode is longer than dead_time = {max(given):g} s: record longer')
    if task.physical_model or all(known):
        return given
    return given + seconds * find_dead_times(
        episodes, known, watch=lambda: progress.estimating(0, 1, 'dead time')).values


def _delayed(episodes: Sequence[Episode], dead_time: Array) -> list[Episode]:
    return [late for one in episodes if (late := one.delayed(dead_time)) is not None]


def _behind(episodes: Sequence[Episode], lag: Array) -> list[Episode]:
    """Return episodes with inputs behind lags (n_u,), in time units; ValueError for none."""
    found = [late for one in episodes if (late := lagged(one, lag)) is not None]
    if episodes and not found:
        raise ValueError(f'no episode is longer than four lags of {max(lag):g}: record longer')
    return found


def _given_lag(task: TrainingTask, plant: PlantDescription, episodes: Sequence[Episode]) -> Array:
    """Return the lags (n_u,) that the task has, in s; 0 for one that is to be found."""
    names = plant.input_names
    if wrong := ', '.join(name for name in task.lag if name not in names or (
            name in task.disturbances and task.lag[name])):
        raise ValueError(f'lag names {wrong}: choose from the manipulated inputs '
                         f'{", ".join(name for name in names if name not in task.disturbances)}')
    shortest = 0.5 * SECONDS_PER_TIME_UNIT[plant.time_unit] * sample_interval(episodes)
    for name, value in task.lag.items():
        if not (value in (-1.0, 0.0) or shortest <= value <= LONGEST_DEAD_TIME):
            raise ValueError(f'lag of {name} is {value:g} s, must be {shortest:.3g} s (half of a '
                             f'sample interval) to {LONGEST_DEAD_TIME:g} s, 0 for none, or -1 to '
                             'find it')
        if value and any(one.linear and one.linear[names.index(name)] for one in episodes):
            raise ValueError(f'the record has the applied {name}: set its lag to 0, or record its '
                             'commands')
    return np.array([max(task.lag.get(name, 0.0), 0.0) for name in names])
