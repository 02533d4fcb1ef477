# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The task of a training, and the plant and signals that it describes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
import math
from typing import Any, TypeVar

import numpy as np

from koopman_ros.core.arrays import Array, frozen
from koopman_ros.core.characteristic import Characteristic
from koopman_ros.core.datasets import PlantDescription
from koopman_ros.core.message_fields import MessageField
from koopman_ros.core.units import SECONDS_PER_TIME_UNIT
from koopman_ros.model import Coordinates, LiftedModel
from koopman_ros.model_classes import SAME
from koopman_ros.records import RecordedInput, RecordedState

MOST_SAMPLES = 20_000  # more cost more time, and tell less and less


@dataclass(frozen=True)
class TrainingTask:
    """Input files, output file and settings of a retraining."""

    bags: tuple[str, ...]  #: files or folders
    output: str  #: model file to write, ending in ``.safetensors``; empty to write none
    model: str  #: file of the current model, empty to learn the first one
    states: tuple[RecordedState, ...]  #: those of the current model, in any order
    inputs: tuple[RecordedInput, ...]  #: likewise
    plant: str = ''  #: name of the plant in a first lift
    tolerance: float = 0.0  #: how far stamps of one sample of several states may lie apart, in s
    #: class to learn, a name of `compare`, ``'best'`` for the one that its rule takes, or
    #: ``'same'`` for that of the current model, the best if there is none
    model_class: str = SAME
    coordinates: int = 0  #: n_z of the identity lift; 0: two more than states
    seed: int = 0  #: of the split and of the training, and of the reduction of a long record
    #: samples that are learned from and judged by; a longer record is reduced to them, see
    #: :func:`read_record`
    most_samples: int = MOST_SAMPLES
    starts: int = 3  #: of each round of the training
    #: B where it is known, in state unit per input unit and second, by state and input; what is
    #: not named is 0; empty to learn B
    input_gain: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    #: degree of the polynomial B(x) that is learned; 0 for a constant, and where B is known
    input_matrix_degree: int = 0
    #: dead time of inputs by name, in s; of those not named it is found from the record
    dead_time: Mapping[str, float] = field(default_factory=dict)
    #: static characteristics of inputs by name, as values and effects in turn, in any unit of the
    #: effect; the ends of a line where it acts linearly; of those not named it is found
    characteristics: Mapping[str, Sequence[float]] = field(default_factory=dict)
    #: time constant with which inputs follow their commands, by name, in s: 0 for none, -1 to find
    #: it from a record of all states; the applied input is a state of the model
    lag: Mapping[str, float] = field(default_factory=dict)
    #: inputs that do not act linearly, also not through a characteristic: their commands are
    #: states of the model, and a law sets their rates; behind a lag the applied inputs are. Where
    #: all states are measured
    as_state: tuple[str, ...] = ()
    #: those of the inputs that are measured and not manipulated; they have no dead time and no lag
    disturbances: tuple[str, ...] = ()
    #: most states that are not in the bags, see :func:`identify_unmeasured`; the new lift is then
    #: not compared with the current one, which has other states. -1: as many as free runs of the
    #: record need, see :func:`identify_structure`; none if there is a current model
    unmeasured_states: int = 0
    #: class of a plant whose equations are fitted, as :func:`koopman_ros.plants.plant_class` takes
    #: it; empty for a polynomial. Its states that are not in the bags are estimated, too.
    physical_model: str = ''
    #: constants of it that are looked for, see :func:`koopman_ros.plants.estimated_parameters_of`
    constants: Mapping[str, tuple[float, float] | None] = field(default_factory=dict)
    #: lowest and highest set-point that the lift is wanted for, of some states by name, in their
    #: units
    setpoints: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    #: methods of identification, see :func:`methods_of`; where all states are measured
    methods: tuple[str, ...] = ('weak_form', 'total_variation')
    #: their parameters, by the name of the method
    method_parameters: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    margin: float = 0.1  #: see :class:`Thresholds`
    condition: float = 1e4  #: likewise
    #: where it is worked, see :func:`~koopman_ros.execution.backend_of`
    executor: str = ''
    #: file of a lift of a plant of the same kind, which training begins from; empty for nothing.
    warm_start_model: str = ''
    device: str = 'cpu'  #: where residuals are evaluated, as torch names it

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> TrainingTask:
        """Return a task from JSON fields; TypeError if one is unknown or missing."""
        states = tuple(RecordedState(**{**signal, 'place': MessageField(**signal['place'])})
                       for signal in values['states'])
        inputs = tuple(RecordedInput(**{
            **signal, **{place: MessageField(**signal[place]) if signal.get(place) else None
                         for place in ('command', 'measured')}})
            for signal in values['inputs'])
        return cls(**{**values, 'bags': tuple(values['bags']), 'states': states,
                      'inputs': inputs, 'disturbances': tuple(values.get('disturbances', ())),
                      'as_state': tuple(values.get('as_state', ())),
                      'methods': tuple(values.get('methods', cls.methods))})


def resolve_signals(task: TrainingTask, current: LiftedModel | None
          ) -> tuple[PlantDescription, Sequence[RecordedState], Sequence[RecordedInput]]:
    """
    Return the plant as far as the task describes it, and its signals in order.

    :param current: the current model, if there is one.
    :raises ValueError: for a task whose parts do not fit each other or the current model.
    """
    if task.physical_model and (task.unmeasured_states > 0 or task.input_gain):
        raise ValueError(f'physical_model = {task.physical_model!r} defines the states and the '
                         'effect of the inputs: set unmeasured_states to 0 and give no input_gain')
    if task.physical_model and task.characteristics:
        raise ValueError(f'characteristics name {", ".join(task.characteristics)}, but '
                         f'physical_model = {task.physical_model!r} defines how inputs act')
    _check_as_state(task)
    if task.constants and not task.physical_model:
        raise ValueError(f'constants name {", ".join(task.constants)}, but no physical_model is '
                         'given')
    states: Sequence[RecordedState] = task.states
    inputs: Sequence[RecordedInput] = task.inputs
    if current is None:
        plant = _unknown(task)
    else:
        some = [name for name in current.states.names
                if name in {state.name for state in states}]
        # the others are estimated
        partly = bool(task.physical_model or task.lag or task.as_state) and (
            0 < len(some) < len(current.states))
        states = _in_order(states, current.states.only(some) if partly else current.states,
                           'state', task.model)
        inputs = _in_order(inputs, current.inputs, 'input', task.model)
        plant = current.plant if not partly else replace(
            _unknown(replace(task, states=tuple(states), inputs=tuple(inputs))),
            name=current.plant.name, time_unit=current.plant.time_unit)
    # the actuator lags; its applied input is calculated
    inputs = [replace(one, measured=None) if task.lag.get(one.name) else one for one in inputs]
    return replace(plant, B=_known_gain(task, plant),
                   input_matrix_degree=task.input_matrix_degree,
                   disturbance_names=task.disturbances, characteristics={} if (
                       task.physical_model) else {
                       **plant.characteristics, **_characteristics(task, plant)}), states, inputs


def _check_as_state(task: TrainingTask) -> None:
    """Raise ValueError for inputs as states that the rest of a task excludes."""
    manipulated = [one.name for one in task.inputs if one.name not in task.disturbances]
    if unknown := ', '.join(name for name in task.as_state if name not in manipulated):
        raise ValueError(f'as_state names {unknown}: choose from the manipulated inputs '
                         f'{", ".join(manipulated)}')
    if both := ', '.join(name for name in task.as_state if name in task.characteristics):
        raise ValueError(f'as_state and characteristic are both given of {both}: give one of them')
    if task.as_state and (task.unmeasured_states > 0 or task.physical_model or task.input_gain
                          or task.input_matrix_degree):
        raise ValueError('as_state needs all states measured and estimates how inputs act: set '
                         'unmeasured_states and input_matrix_degree to 0, and give no '
                         'physical_model and no input_matrix')


_Signal = TypeVar('_Signal', RecordedState, RecordedInput)


def _in_order(given: Sequence[_Signal], required: Coordinates, kind: str, path: str
              ) -> list[_Signal]:
    """Return signals in the order of a lift; ValueError where they are not the same."""
    by_name = {signal.name: signal for signal in given}
    found = {(signal.name, signal.unit) for signal in given}
    if len(by_name) != len(given) or found != set(
            zip(required.names, required.units, strict=True)):
        listed, needed = (
            ', '.join(f'{name} [{unit}]' for name, unit in pairs) or 'none'
            for pairs in (((s.name, s.unit) for s in given),
                          zip(required.names, required.units, strict=True)))
        raise ValueError(f'the current model {path} has the {kind}s {needed}, but the task has '
                         f'{listed}: give the same names and units, each once')
    return [by_name[name] for name in required.names]


def _unknown(task: TrainingTask) -> PlantDescription:
    """Return the plant of a task without a lift; its nominal point is unknown."""
    states, inputs = task.states, task.inputs
    return PlantDescription(task.plant, tuple(signal.name for signal in states),
                            tuple(signal.unit for signal in states),
                            tuple(signal.name for signal in inputs),
                            tuple(signal.unit for signal in inputs), 's',
                            np.full(len(states), np.nan), np.full(len(inputs), np.nan), None)


def _characteristics(task: TrainingTask, plant: PlantDescription) -> dict[str, Characteristic]:
    if unknown := ', '.join(name for name in task.characteristics
                            if name not in plant.input_names):
        raise ValueError(f'characteristics name {unknown}: the inputs are '
                         f'{", ".join(plant.input_names)}')
    return {name: Characteristic.of(points[::2], points[1::2]) for name, points in (
        (name, frozen(points, f'the characteristic of {name}', (None,)))
        for name, points in task.characteristics.items())}


def _known_gain(task: TrainingTask, plant: PlantDescription) -> Array | None:
    """Return B (n_x, n_u) of a task per time unit of a plant, None to learn it."""
    if not task.input_gain:
        return None
    B = np.zeros((len(plant.state_names), len(plant.input_names)))
    for state, row in task.input_gain.items():
        for name, gain in row.items():
            if state not in plant.state_names or name not in plant.input_names:
                raise ValueError(
                    f'input_gain names {name} acting on {state}: the lift has the states '
                    f'{", ".join(plant.state_names)} and the inputs '
                    f'{", ".join(plant.input_names)}')
            if not math.isfinite(gain):
                raise ValueError(f'input_gain of {name} on {state} is {gain}, must be finite')
            B[plant.state_names.index(state), plant.input_names.index(name)] = gain
    return B * SECONDS_PER_TIME_UNIT[plant.time_unit]
