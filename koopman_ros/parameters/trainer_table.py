# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Table of the trainer's parameters: defaults of its signals, and checks between parameters."""

from collections.abc import Mapping
import contextlib
from dataclasses import fields
from functools import partial
from types import MappingProxyType
from typing import Any

from koopman_ros.core.characteristic import Characteristic
from koopman_ros.execution import executor_rejection
from koopman_ros.identification_methods import parameters_of
from koopman_ros.model import LiftedModel
from koopman_ros.parameters.equations import rejected
from koopman_ros.parameters.signal_topics import (
    ACTIVE_CONSTRAINTS,
    AUDIT_LOG,
    box_defaults,
    CONTROLLER_INTERNALS,
    DIAGNOSTICS,
    EVENT_LOG,
    InputPlaces,
    MeasuredPlace,
    named_units,
    plant_defaults,
    PREDICTED_TRAJECTORY,
    rejection,
    Signals,
    signals_of,
    SignalTopics,
    StatePlaces,
    system_of,
)
from koopman_ros.parameters.table import ConfigurationError, ParameterTable
from koopman_ros.parameters.trainer import TrainerParameters


def trainer_table(present: LiftedModel | None, given: Mapping[str, Any] = MappingProxyType({})
                  ) -> ParameterTable[TrainerParameters]:
    """
    Return the parameters of a trainer.

    :param present: the lift in use, whose signals and box are the defaults, or None without one.
    :param given: known values, of which system and signals are used.
    :raises ConfigurationError: if the signals are unknown.
    """
    system = system_of(given)
    own = plant_defaults(system, 'trainer')
    signals = trainer_signals(present, {**own, **given})
    defaults: dict[str, Any] = dict(signals.defaults())
    wiring = _wiring(signals, {**own, **given})
    usual = (*wiring.topics, CONTROLLER_INTERNALS, PREDICTED_TRAJECTORY, ACTIVE_CONSTRAINTS,
             EVENT_LOG, AUDIT_LOG, DIAGNOSTICS)
    # a preset may have more topics than these, but not those of disturbances and qualities
    own['topics'] = tuple(dict.fromkeys((*own.get('topics', usual), *(
        place.topic for places in (wiring.measured_disturbances, wiring.quality)
        for place in places.values()))))
    if present is not None:
        inputs = present.inputs
        states = present.states.only([name for name in present.states.names if (
            name in signals.states or not present.lagged)])
        defaults |= {
            'input_matrix_degree': present.input_matrix_degree,
            **{f'{name}.as_state': j in present.commanded
               for j, name in enumerate(inputs.names)},
            **{f'{name}.lag': 0.0 if j in present.commanded else seconds
               for j, (name, seconds) in enumerate(zip(
                   inputs.names, present.lag.tolist(), strict=True))},
            **box_defaults(states, experiment_min=states.lower, experiment_max=states.upper,
                           setpoint_min=states.lower, setpoint_max=states.upper),
            **box_defaults(inputs, experiment_min=inputs.lower, experiment_max=inputs.upper,
                           safe_value=inputs.center)}
    methods: dict[str, type[Any]] = {}
    for names in ((), given.get('identification_methods', ())):
        # the check of the parameters rejects anything that is no method
        with contextlib.suppress(ValueError):
            methods |= parameters_of(tuple(filter(None, names)))
    return ParameterTable(
        TrainerParameters, partial(_cross_check, signals), partial(_plan, signals),
        signals={'states': signals.states, 'inputs': signals.inputs,
                 'disturbances': signals.disturbances}, plugins=methods,
        defaults={**defaults, **own, 'system': system})


def trainer_signals(present: LiftedModel | None, given: Mapping[str, Any]) -> Signals:
    """Return the signals that parameters name, or else those of a lift."""
    states, inputs = (tuple(filter(None, given.get(name, ())))
                      for name in ('states_measured', 'inputs_commanded'))
    if bool(states) != bool(inputs) or not (states or present):
        raise ConfigurationError(
            f'the measured signals and inputs of the system {system_of(given)!r} are unknown: set '
            "states_measured and inputs_commanded, each a list like ['level [m]'], or set model")
    controlled = tuple(filter(None, given.get('controlled', ())))
    if present is not None and not states:
        return signals_of(present, controlled)
    measured = named_units(states)
    disturbances = named_units(tuple(filter(None, given.get('disturbances_measured', ()))))
    return Signals(measured, named_units(inputs), controlled or tuple(measured),
                   disturbances=disturbances or (
                       {} if present is None else signals_of(present).disturbances))


def _wiring(signals: Signals, given: Mapping[str, Any]) -> SignalTopics:
    """Return the places of signals, the usual ones but for those that parameters name."""
    chosen = {**signals.defaults(), **given}

    def own(kind: type[Any], name: str) -> Any:
        return kind(**{row.name: chosen[f'{name}.{row.name}'] for row in fields(kind)
                       if f'{name}.{row.name}' in chosen})

    return SignalTopics(signals, {name: own(StatePlaces, name) for name in signals.states},
                        {name: own(InputPlaces, name) for name in signals.inputs},
                        disturbances={name: own(MeasuredPlace, name)
                                      for name in signals.disturbances})


def _plan(signals: Signals, values: TrainerParameters) -> None:
    """Try the plan of an experiment, where there are bounds for one."""
    if not values.missing(signals):
        values.experiment(signals)


def _cross_check(signals: Signals, values: TrainerParameters) -> str:
    if reason := rejection(values.topics):
        return reason
    if values.output.endswith('.mcap') and (values.max_bag_size or values.max_bag_duration):
        return (f'output = {values.output!r} is a single file, which max_bag_size and '
                'max_bag_duration cannot split: name a folder, without .mcap')
    if reason := executor_rejection(values.executor):
        return reason
    try:
        parameters_of(values.identification_methods)
    except ValueError as error:
        return f'identification_methods = {list(values.identification_methods)}: {error}'
    if not values.model_output.endswith('.safetensors'):
        return f'model_output = {values.model_output!r} must end in .safetensors'
    n_x, n_u = len(signals.states), len(signals.inputs) + len(signals.disturbances)
    if values.input_matrix_degree and signals.disturbances:
        return (f'input_matrix_degree is {values.input_matrix_degree}, must be 0 with measured '
                'disturbances, whose effect does not depend on the state')
    if values.input_matrix != (0.0,) and len(values.input_matrix) != n_x * n_u:
        return (f'input_matrix has {len(values.input_matrix)} numbers, must have {n_x} rows of '
                f'{n_u}, or a single 0 to learn it')
    if values.input_matrix != (0.0,) and values.input_matrix_degree:
        return (f'input_matrix_degree is {values.input_matrix_degree}, must be 0 if input_matrix '
                'is given')
    if values.unmeasured_states > 0 and values.input_matrix_degree:
        return (f'input_matrix_degree is {values.input_matrix_degree}, must be 0 if '
                'unmeasured_states is above 0, because B would depend on them')
    if values.physical_model and values.unmeasured_states > 0:
        return (f'unmeasured_states is {values.unmeasured_states}, must be 0 if physical_model is '
                'set, which defines the states')
    if values.physical_model and values.input_matrix != (0.0,):
        return ('input_matrix must be a single 0 if physical_model is set, which defines the '
                'effect of the inputs')
    for name, one in values.inputs.items():
        if one.characteristic != (0.0,):
            try:
                Characteristic.of(one.characteristic[::2], one.characteristic[1::2])
            except ValueError as error:
                return f'{name}.characteristic = {list(one.characteristic)}: {error}'
    return (rejected(values.physical_model, values.estimated_constants)
            or SignalTopics.of(signals, values).check())


def preset_wiring(system: str, disturbances: tuple[str, ...] = ()) -> SignalTopics | None:
    """Return the places of the signals of a plant that is shipped, or None for another."""
    if not (own := plant_defaults(system, 'trainer')):
        return None
    if disturbances:
        own |= {'disturbances_measured': disturbances}
    return _wiring(trainer_signals(None, own), own)
