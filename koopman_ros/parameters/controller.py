# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Parameters of the controller node, and of the replay: its own beside a controller's."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
import math
from types import MappingProxyType
from typing import Any

import numpy as np

from koopman_ros.arrays import Array
from koopman_ros.control import (
    Controller,
    InputLimits,
    LAWS,
    LevelSettings,
    Settings,
    SupervisorSettings,
)
from koopman_ros.estimation import ESTIMATORS, SensorLimits
from koopman_ros.lifting import LiftedModel
from koopman_ros.parameters.table import (
    ConfigurationError,
    in_own_units,
    lowest,
    parameter,
    ParameterTable,
    per_signal,
    signal_value,
    UNBOUNDED,
)
from koopman_ros.parameters.wire import (
    DEFAULT_SYSTEM,
    InputPlaces,
    named_units,
    preset,
    Signals,
    signals_of,
    StatePlaces,
    system_of,
    Wiring,
)
from koopman_ros.plugs import plug
from koopman_ros.signals import Outputs
from koopman_ros.units import conversion, display_unit, SECONDS_PER_MINUTE


@dataclass(frozen=True)
class StateParameters(StatePlaces):
    """What is tuned for a measured state."""

    weight: float = parameter(1.0, 'cost of its squared error', '1/({unit})^2', 0.0, 1e12)
    setpoint_ramp: float = parameter(
        0.0, 'fastest change of the tracked set-point; 0 for a step', '{unit}/s', 0.0, 1e9)
    min: float = signal_value(
        -UNBOUNDED, 'lowest value that the predictive law plans for, and leaves where it must')
    max: float = signal_value(
        UNBOUNDED, 'highest value that the predictive law plans for, likewise')
    sensor_min: float = signal_value(
        -UNBOUNDED, 'lowest value that the sensor can measure')
    sensor_max: float = signal_value(
        UNBOUNDED, 'highest value that the sensor can measure')
    max_rate: float = parameter(
        0.0, 'fastest change that is physically possible; 0 for any', '{unit}/s', 0.0, 1e9)
    max_jump: float = parameter(
        0.0, 'change between two measurements that is accepted beside that rate, for noise; 0 for '
        'any', '{unit}', 0.0, 1e9)
    pi_gain: float = parameter(
        0.0, 'change of the command per error, of the law pi: the first signal with one moves the '
        'first input, and so on; 0 for signals that it does not control', 'of input/({unit})',
        -1e9, 1e9)
    pi_time: float = parameter(
        60.0, 'integral time of that law', 's', 0.0, 86400.0, open_minimum=True)
    noise: float = parameter(
        0.0, 'standard deviation of the noise of its sensor, for a Kalman filter; 0 for that of '
        'the record that the model was learned from', '{unit}', 0.0, 1e9)


@dataclass(frozen=True)
class EstimatedParameters:
    """What is tuned for a state that is not measured."""

    weight: float = parameter(0.0, 'cost of its squared error', '1/({unit})^2', 0.0, 1e12)
    min: float = signal_value(
        -UNBOUNDED, 'lowest value that the predictive law plans for, and leaves where it must')
    max: float = signal_value(
        UNBOUNDED, 'highest value that the predictive law plans for, likewise')
    initial_error: float = parameter(
        0.0, 'how wrong the first guess of it may be, as a standard deviation; 0 for a fourth of '
        'the trained range', '{unit}', 0.0, 1e9)


@dataclass(frozen=True)
class InputParameters(InputPlaces):
    """What is tuned for an input."""

    weight: float = parameter(
        1.0, 'cost of its squared deviation from its steady value', '1/({unit})^2', 0.0, 1e12,
        open_minimum=True)
    min: float = signal_value(0.0, 'lowest command')
    max: float = signal_value(0.0, 'highest command')
    rate_limit: float = parameter(
        0.0, 'fastest change of the command; 0 for any', '{unit}/s', 0.0, 1e9)
    max_disturbance: float = parameter(
        0.0, 'largest disturbance that is accepted, as a change of the input; 0 for any', '{unit}',
        0.0, 1e9)
    wander: float = parameter(
        0.0, 'how far an unknown influence wanders in a minute, as a change of the input, for a '
        'Kalman filter; 0 for what suits the model', '{unit}', 0.0, 1e9)
    tolerance: float = parameter(
        UNBOUNDED, 'how far the measured input may be from its command before the observer goes '
        'by it, as at a limit of the actuator', '{unit}', 0.0, UNBOUNDED)
    safe: float = signal_value(
        0.0, 'what is safe whatever happened, commanded when nothing else can be; brought within '
        'min and max')


@dataclass(frozen=True)
class ControllerParameters:
    """Snapshot of the controller's parameters, in the units that people read."""

    system: str = parameter(
        DEFAULT_SYSTEM, 'plant that is shipped, whose model, topics and tuning are the defaults '
        'here; any other name for none', read_only=True)
    model: str = parameter(
        '', 'name of a shipped model, or path of a .safetensors model file')
    states_measured: tuple[str, ...] = parameter(
        ('',), 'measured signals with their units, e.g. level [m], which the model must have; its '
        'other states are estimated; an empty name for all that it has', read_only=True)
    inputs_commanded: tuple[str, ...] = parameter(
        ('',), 'inputs with their units, likewise', read_only=True)
    controlled: tuple[str, ...] = parameter(
        ('',), 'measured signals that have a set-point, at most as many as there are inputs; an '
        'empty name for all', read_only=True)
    autostart: bool = parameter(
        True, 'configure and activate itself at the start; false leaves that to a lifecycle '
        'manager', read_only=True)
    synchronisation_tolerance: float = parameter(
        0.0, 'how far the stamps of messages may be apart that together are one measurement', 's',
        0.0, 10.0, read_only=True)
    setpoint_filter: float = parameter(
        0.0, 'time constant with which the tracked set-point follows its ramp; 0 for none', 's',
        0.0, 86400.0)
    disturbance_bandwidth: float = parameter(
        0.0, 'how fast disturbances are estimated: more removes offsets sooner, less lets less '
        'noise through to the inputs; 0 switches the observer off', '1/s', 0.0, 1000.0)
    estimator: str = parameter(
        '', 'how states are estimated: extended_kalman_filter or unscented_kalman_filter, one of '
        'which a state needs that is not measured; disturbance_observer; measured_state takes '
        'measurements as they are; module:class is one of your own; empty for the one that suits',
        code=True)
    transfer_time: float = parameter(
        0.0, 'time constant in which the inputs move to what another law, model, tuning or mode '
        'asks for', 's', 0.0, 86400.0)
    levels: tuple[str, ...] = parameter(
        ('sdre', 'linear'), 'laws, the best first: mpc plans ahead, within limits of the states; '
        'sdre solves the Riccati equation; linear has one gain; pi asks nothing of the model; '
        'module:class is one of your own', code=True)
    law_deadline: float = parameter(
        0.0, 'how long a law may take for a sample before the next one of the levels acts in its '
        'place; 0 for any time', 's', 0.0, 3600.0)
    compiled: bool = parameter(
        False, 'let compiled functions answer in place of those in numpy, once they are there '
        'after the first command; needs the extra fast', read_only=True)
    validity_margin: float = parameter(
        0.1, 'how far outside the trained range laws act, in halves of its width, all but the '
        'linear one; beyond, the linear law does', '', 0.0, 100.0)
    linear_margin: float = parameter(
        0.5, 'how far outside the trained range the linear law acts, in halves of its width; '
        'beyond, the safe inputs are commanded', '', 0.0, 100.0)
    hold_timeout: float = parameter(
        60.0, 'how long the inputs are held without a usable measurement or law before they go to '
        'their safe values', 's', 0.0, 86400.0)
    recovery_time: float = parameter(
        10.0, 'how long a better law must have been possible before it acts again', 's', 0.0,
        86400.0)
    measurement_timeout: float = parameter(
        10.0, 'plant time without a measurement whose stamp advances after which the inputs are '
        'held and diagnostics turn to ERROR; 0 switches this off', 's', 0.0, 86400.0)
    max_measurement_age: float = parameter(
        5.0, 'age of a measurement at its arrival from which on diagnostics warn; 0 switches this '
        'off', 's', 0.0, 86400.0)
    frozen_timeout: float = parameter(
        20.0, 'how long a measurement may stay bit-identical while the model moves by more '
        'than half of its max_jump; 0 for ever', 's', 0.0, 86400.0)
    max_gain: float = parameter(
        1000.0, 'largest Riccati gain, in scaled coordinates, that is acted on; small weights '
        'need a large one', '', 0.0, 1e9, open_minimum=True)
    min_riccati_digits: float = parameter(
        8.0, 'decimal digits to which a solution must fulfil its Riccati equation to be acted on',
        '', 0.0, 15.0)
    load_refused_model: bool = parameter(
        False, 'load a model file although its training refused it')
    model_check_factor: float = parameter(
        2.0, 'how many times worse than the present model another one may predict what was '
        'measured lately, and yet be put into the running loop; 0 for any', '', 0.0, 1e6,
        smallest=1.0)
    model_check_length: float = parameter(
        600.0, 'how much of what was measured is kept for that', 's', 0.0, 86400.0,
        open_minimum=True)
    states: Mapping[str, StateParameters] = per_signal(StateParameters)
    estimated: Mapping[str, EstimatedParameters] = per_signal(EstimatedParameters)
    inputs: Mapping[str, InputParameters] = per_signal(InputParameters)

    def settings(self, signals: Signals) -> Settings:
        """
        Return the tuning of the control step, in the units of the model.

        What a model estimates that these are not the parameters of has their defaults.
        """
        def column(of: Mapping[str, Any], attribute: str,
                   change: Callable[[float], float] = lambda value: value) -> Array:
            return np.array([change(getattr(of[name], attribute)) for name in of])

        states, inputs, own = self.states, self.inputs, signals.inputs
        controlled = {name: states[name] for name in signals.controlled}
        every = {name: states.get(name) or self.estimated.get(name, EstimatedParameters())
                 for name in signals.every}
        lower, upper = (in_own_units(every, end, signals.every) for end in ('min', 'max'))
        for i, (name, unit) in enumerate(signals.every.items()):
            lower[i] = lower[i] if every[name].min > lowest(display_unit(unit)) else -math.inf
            upper[i] = upper[i] if every[name].max < UNBOUNDED else math.inf
        limited = bool(np.any(np.isfinite([lower, upper])))
        return Settings(
            controlled=() if tuple(every) == signals.controlled else signals.controlled,
            state_weight=column(every, 'weight'),
            input_weight=column(inputs, 'weight'),
            limits=InputLimits(in_own_units(inputs, 'min', own), in_own_units(inputs, 'max', own),
                               column(inputs, 'rate_limit', _or_any)),
            setpoint_ramp=column(controlled, 'setpoint_ramp', _or_any),
            setpoint_filter=self.setpoint_filter,
            observer_bandwidth=self.disturbance_bandwidth,
            estimator=self.estimator,
            noise=column(states, 'noise'),
            wander=column(inputs, 'wander') / math.sqrt(SECONDS_PER_MINUTE),
            initial_error=np.array([getattr(of, 'initial_error', 0.0) for of in every.values()]),
            max_disturbance=column(inputs, 'max_disturbance', _or_any),
            input_tolerance=column(inputs, 'tolerance'),
            transfer_time=self.transfer_time,
            safe_input=in_own_units(inputs, 'safe', own),
            state_lower=lower if limited else np.zeros(0),
            state_upper=upper if limited else np.zeros(0),
            pi_gain=np.array([getattr(of, 'pi_gain', 0.0) for of in every.values()]),
            pi_time=np.array([getattr(of, 'pi_time', np.inf) for of in every.values()]),
            deadline=_or_any(self.law_deadline),
            max_gain=self.max_gain,
            max_residual=10.0 ** -self.min_riccati_digits,
            sensor=SensorLimits(
                lower=in_own_units(states, 'sensor_min', signals.states),
                upper=in_own_units(states, 'sensor_max', signals.states),
                rate=column(states, 'max_rate', _or_any),
                jump=column(states, 'max_jump', _or_any),
                frozen_timeout=_or_any(self.frozen_timeout)),
            supervisor=SupervisorSettings(
                tuple(LevelSettings(law, self.linear_margin if law in ('linear', 'pi')
                                    else self.validity_margin) for law in self.levels),
                self.hold_timeout, self.recovery_time))


def built(parameters: ControllerParameters, model: LiftedModel) -> Controller:
    """
    Return the controller with a model, whatever that has beside the measured signals.

    :raises ValueError: where the estimator cannot do with what is measured.
    """
    own = signals_of(model, parameters.controlled, parameters.states)
    return Controller(model, parameters.settings(own), Outputs(
        tuple(own.states), tuple(own.states.values()),
        np.eye(model.n_x)[[model.states.names.index(name) for name in own.states]]))


def _or_any(bound: float) -> float:
    """Return a bound, of which 0 stands for none."""
    return bound or math.inf


def _cross_check(signals: Signals, values: ControllerParameters) -> str:
    if values.validity_margin > values.linear_margin:
        return (f'validity_margin = {values.validity_margin} must be at most linear_margin = '
                f'{values.linear_margin}: change the other one first')
    for law in values.levels:
        try:
            plug(law, 'law', LAWS)
        except ValueError as error:
            return f'levels = {list(values.levels)}: {error}'
    try:
        plug(values.estimator or 'measured_state', 'estimator', ESTIMATORS)
    except ValueError as error:
        return f'estimator = {values.estimator!r}: {error}'
    return Wiring(signals, values.states, values.inputs).check()


def _dynamics(model: LiftedModel) -> dict[str, Any]:
    """Return what suits a model's modes: an unstable plant cannot wait, and is planned for."""
    modes = np.linalg.eigvals(
        model.drift_jacobian(np.zeros(model.n_x))) / model.seconds_per_time_unit
    fastest, slowest = float(np.max(np.abs(modes))), float(np.min(np.abs(modes)))
    stable = bool(np.all(modes.real < 0.0)) and fastest > 0.0
    levels = {} if np.all(modes.real <= 0.0) else {'levels': ('mpc', 'sdre', 'linear')}
    # a window, a fifth of it, is to show the slowest mode, and not to let an unstable one run off
    shown = max(slowest, 0.1 * fastest, float(np.max(modes.real)), 1e-3)
    return {**levels,
            'model_check_length': min(float(f'{10.0 / shown:.2g}'), 86400.0),
            'transfer_time': min(float(f'{0.5 / fastest:.2g}'), 86400.0) if stable else 0.0,
            'disturbance_bandwidth': min(float(f'{fastest:.2g}'), 1000.0) if stable else 0.0}


def table_of(model: LiftedModel, given: Mapping[str, Any] = MappingProxyType({})
             ) -> ParameterTable[ControllerParameters]:
    """
    Return the parameters of a controller with a model.

    Its training box, scaling and time constants are the defaults, unless the preset of a plant
    says otherwise.

    :param given: what is known of the values already, of which system and signals count.
    :raises ConfigurationError: for signals, given or of a preset, that the model has not.
    """
    system = system_of(given)
    own = preset(system, 'controller')
    found = signals_of(model)
    named = [named_units(tuple(filter(None, given.get(kind, ()))) or own.get(kind, ()))
             for kind in ('states_measured', 'inputs_commanded')]
    expected = Signals(named[0] or found.states, named[1] or found.inputs)
    if expected.inputs != found.inputs or not expected.states.items() <= found.states.items():
        raise ConfigurationError(
            f'the model has {found}, the system {system!r} has {expected}: choose a model of that '
            'system, correct states_measured and inputs_commanded, or name in system what the '
            'model is of (none that is shipped: -p "system:=\'\'")')
    signals = signals_of(model, tuple(given.get('controlled', own.get('controlled', ()))),
                         expected.states)
    defaults: dict[str, Any] = {**signals.defaults(), **_dynamics(model)}
    for name, scale in zip(model.states.names, model.states.scale.tolist(), strict=True):
        if name in signals.states:
            defaults[f'{name}.weight'] = 1.0 / scale ** 2
    box = model.inputs
    for i, (name, unit) in enumerate(zip(box.names, box.units, strict=True)):
        shown = conversion(unit, display_unit(unit))
        defaults |= {f'{name}.weight': 1.0 / float(box.scale[i]) ** 2,
                     f'{name}.min': shown(float(box.lower[i])),
                     f'{name}.max': shown(float(box.upper[i])),
                     f'{name}.safe': shown(float(box.center[i]))}
    return ParameterTable(
        ControllerParameters, partial(_cross_check, signals),
        lambda values: built(values, model),
        (('min', 'max'), ('sensor_min', 'sensor_max')),
        signals={'states': signals.states, 'estimated': signals.estimated,
                 'inputs': signals.inputs},
        defaults={**defaults, **own, 'system': system})


@dataclass(frozen=True)
class ReplayParameters:
    """Snapshot of the replay's parameters; a controller's may be given for the new model."""

    system: str = parameter(
        DEFAULT_SYSTEM, 'plant that is shipped, whose topics are those of the bag; any other '
        'name for none')
    model: str = parameter(
        '', 'where a recorded model is looked for beside the shipped ones: a name, a .safetensors '
        'file or a folder of them')
    bags: tuple[str, ...] = parameter(
        ('run_1',), 'bags to replay, each a run of its own: .mcap files or bag folders')
    new_model: str = parameter(
        '', 'model whose commands are compared with the recorded ones, by name or path, under the '
        'recorded parameters but for those of a controller that are given here, too; empty only '
        'checks that the recorded commands are reproduced')
    output: str = parameter(
        'replay', 'folder for report.md, summary.json and the pictures; older ones in it are '
        'replaced')
    tolerance: float = parameter(
        0.1, 'difference of two commands, in the unit of the input, from which on it is counted '
        'and marked', '', 0.0, 1e9)
    recover: bool = parameter(
        False, 'read bags that were not closed or are damaged as far as they are whole')
    last: float = parameter(
        0.0, 'how much of the end of each bag is replayed, from the snapshot before it; 0 for all '
        'of it', 's', 0.0, 1e9)


def _check_replay(values: ReplayParameters) -> str:
    if not values.bags or not all(values.bags):
        return f'bags = {list(values.bags)} must hold at least one path and no empty one'
    if not values.output:
        return "output = '' must name a folder, e.g. replay"
    return ''


REPLAY_TABLE = ParameterTable(ReplayParameters, _check_replay)
