# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Parameters of the controller node, and of the replay, which has those as well."""

from collections.abc import Mapping
import contextlib
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np

from koopman_ros.control import Controller, LAWS
from koopman_ros.control.laws import Law
from koopman_ros.core.declaration import nested, of_other_states, parameter, per_signal
from koopman_ros.core.plugins import plugin_class, short_name
from koopman_ros.core.signals import Outputs
from koopman_ros.estimation import Estimator, ESTIMATORS
from koopman_ros.model import LiftedModel
from koopman_ros.parameters.signal_topics import (
    AnalysisPlaces,
    box_defaults,
    DEFAULT_SYSTEM,
    InputPlaces,
    MeasuredPlace,
    named_units,
    plant_defaults,
    Signals,
    signals_of,
    SignalTopics,
    StatePlaces,
    system_of,
)
from koopman_ros.parameters.table import ConfigurationError, ParameterTable
from koopman_ros.tuning import largest_bandwidth, time_defaults, Tuning

#: parameters in the file of a whole loop that a controller does not need: its model has them
OF_THE_MODEL = ('disturbances_measured',)


@dataclass(frozen=True)
class ControllerParameters:
    """Snapshot of the controller's parameters."""

    system: str = parameter(
        DEFAULT_SYSTEM, 'Name of a bundled plant, whose model, topics and tuning become the '
        'defaults; any other name: no defaults.', read_only=True)
    model: str = parameter(
        '', 'Name of a bundled model, or path of a .safetensors model file.')
    states_measured: tuple[str, ...] = parameter(
        ('',), 'Measured signals with their units, e.g. level [m]. The model must have them; its '
               'other states are estimated. An empty name: all states but applied inputs behind '
               'a lag.', read_only=True)
    inputs_commanded: tuple[str, ...] = parameter(
        ('',), 'Inputs with their units, e.g. pump [V]. The model must have them. An empty name: '
               'all inputs.', read_only=True)
    autostart: bool = parameter(
        True, 'Configure and activate at start-up; false: left to a lifecycle manager.',
        read_only=True)
    synchronisation_tolerance: float = parameter(
        0.0, 'Largest difference between the stamps of messages that belong to one '
             'measurement.', 's',
        0.0, 10.0, read_only=True)
    sample_time: float = parameter(
        1.0, 'Time between two commands if all measured signals have a report_on_change.', 's',
        0.01, 3600.0, read_only=True)
    tuning: Tuning = nested(Tuning)
    measurement_timeout: float = parameter(
        10.0, 'Plant time without a newer measurement after which the inputs are held and '
              'diagnostics report ERROR; 0: no timeout.', 's', 0.0, 86400.0)
    max_measurement_age: float = parameter(
        5.0, 'Age of a measurement on receipt above which diagnostics warn; 0: no warning.',
        's', 0.0, 86400.0)
    load_rejected_model: bool = parameter(
        False, 'Also load a model that its training rejected.')
    model_check_factor: float = parameter(
        2.0, 'A new model is rejected if its prediction error on recent measurements exceeds that '
             'of the current model by more than this factor; 0: no check.', '', 0.0, 1e6,
        smallest=1.0)
    model_check_length: float = parameter(
        600.0, 'Length of the measurement history used by that check.', 's', 0.0, 86400.0,
        open_minimum=True)
    states: Mapping[str, StatePlaces] = per_signal(StatePlaces, 'measured')
    inputs: Mapping[str, InputPlaces] = per_signal(InputPlaces)
    disturbances: Mapping[str, MeasuredPlace] = per_signal(MeasuredPlace)
    #: of all states that the tuning is for
    every_state: Mapping[str, AnalysisPlaces] = per_signal(AnalysisPlaces, 'states')


def built(parameters: ControllerParameters, model: LiftedModel) -> Controller:
    """
    Return the controller with a model, which may have states that are not measured.

    :raises ValueError: if the measured signals do not suffice for the estimator.
    """
    own = signals_of(model, parameters.tuning.controlled, parameters.states)
    tuning = of_other_states(parameters.tuning, tuple(parameters.every_state), model.states.names)
    return Controller(model, replace(tuning, controlled=own.controlled), Outputs(
        tuple(own.states), tuple(own.states.values()),
        np.eye(model.n_x)[[model.states.names.index(name) for name in own.states]]))


def _cross_check(signals: Signals, values: ControllerParameters) -> str:
    tuning = values.tuning
    if tuning.learned_model_margin > tuning.linear_model_margin:
        return (f'learned_model_margin = {tuning.learned_model_margin} must be at most '
                f'linear_model_margin = {tuning.linear_model_margin}: change the other one first')
    try:
        for law in tuning.fallback_order:
            plugin_class(law, 'law', LAWS, Law)
    except ValueError as error:
        return f'fallback_order = {list(tuning.fallback_order)}: {error}'
    try:
        plugin_class(tuning.estimator or 'measured_state', 'estimator', ESTIMATORS, Estimator)
    except ValueError as error:
        return f'estimator = {tuning.estimator!r}: {error}'
    return SignalTopics.of(signals, values).check()


def _plugin_parameters(given: Mapping[str, Any]) -> dict[str, type[Any]]:
    """Return the parameter dataclasses of known plug-ins, and of those that values name."""
    found: dict[str, type[Any]] = {}
    # the check of the parameters rejects anything that is no plug-in
    for name in dict.fromkeys((*LAWS, *given.get('fallback_order', ()))):
        with contextlib.suppress(ValueError):
            found[short_name(name)] = plugin_class(name, 'law', LAWS, Law).Parameters
    for name in dict.fromkeys((*ESTIMATORS, *filter(None, (given.get('estimator'),)))):
        with contextlib.suppress(ValueError):
            found[short_name(name)] = plugin_class(
                name, 'estimator', ESTIMATORS, Estimator).Parameters
    return found


def _dynamics(model: LiftedModel) -> dict[str, Any]:
    """Return defaults for a model's modes: an unstable plant cannot wait, and needs a plan."""
    modes = model.modes
    fastest, slowest = float(np.max(np.abs(modes))), float(np.min(np.abs(modes)))
    levels = {} if np.all(modes.real <= 0.0) else {'fallback_order': ('mpc', 'sdre', 'linear')}
    # a window, a fifth of it, is to show the slowest mode, and not to let an unstable one run off
    shown = max(slowest, 0.1 * fastest, float(np.max(modes.real)), 1e-3)
    return {**levels,
            'sample_time': (
                min(max(float(f'{0.1 / fastest:.2g}'), 0.01), 1.0) if fastest > 0.0 else 1.0),
            'model_check_length': min(float(f'{10.0 / shown:.2g}'), 86400.0)}


def _longest_dead_time(model: LiftedModel, given: Mapping[str, Any]) -> float:
    named = (given.get(f'{name}.dead_time') for name in model.inputs.names)
    return max((seconds if isinstance(seconds, float) and seconds >= 0.0 else known
                for seconds, known in zip(named, model.dead_time.tolist(), strict=True)),
               default=0.0)


def table_of(model: LiftedModel, given: Mapping[str, Any] = MappingProxyType({})
             ) -> ParameterTable[ControllerParameters]:
    """
    Return the parameters of a controller with a model.

    Its trained range, scaling and time constants are the defaults, unless the preset of a plant
    overrides them.

    :param given: values that are known already, of which system, signals and plug-ins count.
    :raises ConfigurationError: for signals, given or of a preset, that the model has not.
    """
    system = system_of(given)
    own = plant_defaults(system, 'controller')
    found = signals_of(model)
    named = [named_units(tuple(filter(None, given.get(kind, ()))) or own.get(kind, ()))
             for kind in ('states_measured', 'inputs_commanded')]
    expected = Signals(named[0] or found.states, named[1] or found.inputs,
                       disturbances=found.disturbances)
    if expected.inputs != found.inputs or not expected.states.items() <= found.every.items():
        raise ConfigurationError(
            f'the model has {found}, the system {system!r} has {expected}: choose a model of that '
            'system, correct states_measured and inputs_commanded, or set system to the plant of '
            'the model (for a plant that is not bundled: -p "system:=\'\'")')
    signals = signals_of(model, tuple(given.get('controlled', own.get('controlled', ()))),
                         expected.states)
    defaults: dict[str, Any] = {**signals.defaults(), **_dynamics(model)}
    box = model.inputs
    defaults |= box_defaults(box, min=box.lower, max=box.upper, safe_value=box.center)
    for one in (model.states, box):
        defaults |= {f'{name}.weight': 1.0 / scale ** 2
                     for name, scale in zip(one.names, one.scale.tolist(), strict=True)
                     if name in signals.units}
    defaults |= {**own, 'system': system}
    dead_time = _longest_dead_time(model, {**defaults, **given})
    defaults = {**time_defaults(model, dead_time), **defaults}
    if dead_time > 0.0:
        # of a plant's file, too
        defaults['observer_bandwidth'] = min(defaults['observer_bandwidth'], float(
            f'{largest_bandwidth(dead_time, float(np.min(np.abs(model.modes)))):.2g}'))
    return ParameterTable(
        ControllerParameters, partial(_cross_check, signals),
        lambda values: built(values, model),
        (('min', 'max'), ('sensor_min', 'sensor_max')),
        signals={'states': signals.every, 'measured': signals.states,
                 'controlled': {name: signals.states[name] for name in signals.controlled},
                 'inputs': signals.inputs, 'disturbances': signals.disturbances},
        plugins=_plugin_parameters({**own, **given}), defaults=defaults)


@dataclass(frozen=True)
class ReplayParameters:
    """Snapshot of the replay's parameters; a controller's may be given for the new model."""

    system: str = parameter(
        DEFAULT_SYSTEM, 'Bundled plant whose topics the bag has; any other name: no defaults.')
    model: str = parameter(
        '', 'Location of recorded models that are not bundled: a .safetensors file, a name, or a '
            'folder of such files.')
    bags: tuple[str, ...] = parameter(
        ('run_1',), 'Bags to replay, each as a separate run: .mcap files or bag folders.')
    new_model: str = parameter(
        '', 'Model, by name or path, whose commands are compared with the recorded ones. Recorded '
            'controller parameters apply unless they are given here. Empty: only check that the '
            'recorded commands are reproduced.')
    output: str = parameter(
        'replay', 'Folder for report.md, summary.json and the plots; existing files are replaced.')
    tolerance: float = parameter(
        0.1, 'Difference between two commands, in the unit of the input, above which they count '
             'as different.', '', 0.0, 1e9)
    recover: bool = parameter(
        False, 'Read the intact part of bags that are damaged or were not closed.')
    last: float = parameter(
        0.0, 'Length of the last part of each bag to replay, from the snapshot before it; 0: the '
        'whole bag.', 's', 0.0, 1e9)


def _check_replay(values: ReplayParameters) -> str:
    if not values.bags or not all(values.bags):
        return f'bags = {list(values.bags)} must contain at least one path and no empty one'
    if not values.output:
        return "output = '' must name a folder, e.g. replay"
    return ''


REPLAY_TABLE = ParameterTable(ReplayParameters, _check_replay)
