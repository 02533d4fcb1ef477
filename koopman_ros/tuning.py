# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The tuning of a controller: one object, one row per parameter."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
import math
from typing import Any, Self

import numpy as np

from koopman_ros.core.arrays import Array, expect, real, short_repr
from koopman_ros.core.declaration import (
    ANY,
    column,
    for_signals,
    nested,
    parameter,
    plugin_parameters,
    Settings,
    UNBOUNDED,
    value_column,
)
from koopman_ros.core.plugins import short_name
from koopman_ros.model import LiftedModel, LONGEST_DEAD_TIME


class _Limits(Settings):
    """Settings with a lower and an upper limit."""

    lower: Array
    upper: Array

    def __post_init__(self) -> None:
        super().__post_init__()
        lower, upper = np.asarray(self.lower), np.asarray(self.upper)
        alike = lower.shape == upper.shape or 0 in (lower.ndim, upper.ndim)
        if alike and np.any(lower > upper):
            raise ValueError(f'lower = {lower.tolist()} must be below upper = {upper.tolist()}')


@dataclass(frozen=True)
class InputLimits(_Limits):
    """
    Range and rate limits of the inputs.

    >>> limits = InputLimits(lower=0.0, upper=[12.0, 10.0], rate=2.0)
    >>> limits.within([13.0, 5.0]).tolist()
    [12.0, 5.0]
    """

    lower: Array = value_column('inputs', 0.0, 'Smallest command.', name='min')
    upper: Array = value_column('inputs', 0.0, 'Largest command.', name='max')
    rate: Array = column(
        'inputs', 0.0, 'Rate limit of the command; 0: none.', '{unit}/s', name='rate_limit',
        none=ANY)

    def within(self, u: Array) -> Array:
        """Return the input (n_u,) of the range that is nearest."""
        return np.minimum(np.maximum(u, self.lower), self.upper)


@dataclass(frozen=True)
class SensorLimits(_Limits):
    """
    Limits of the sensors and of the rates of their signals, one number per measured signal.

    >>> float(SensorLimits(lower=0.0, upper=0.6, jump=0.005).at_rest)
    0.005
    """

    lower: Array = value_column(
        'measured', -UNBOUNDED, 'Lower end of the sensor range.', name='sensor_min')
    upper: Array = value_column(
        'measured', UNBOUNDED, 'Upper end of the sensor range.', name='sensor_max')
    rate: Array = column(
        'measured', 0.0, 'Fastest physically possible change; 0: no check.', '{unit}/s',
        name='max_rate', none=ANY)
    jump: Array = column(
        'measured', 0.0, 'Largest change between two measurements due to noise alone; 0: no '
                         'check.',
        name='max_step', none=ANY)
    report_on_change: Array = column(
        'measured', 0.0, 'Heartbeat interval of a sensor that reports only changes: the signal '
                         'counts as unchanged for this time after each message; 0: it reports '
                         'every sample.',
        's', maximum=86400.0, read_only=True)
    deadband: Array = column(
        'measured', 0.0, 'Largest change that such a sensor does not report.')
    stuck_sensor_timeout: float = parameter(
        20.0, 'Time after which an unchanged measurement counts as a stuck sensor, if the model '
              'moved by more than half of max_step; 0: no check.', 's', 0.0, 86400.0)

    @cached_property
    def unreported(self) -> Array:
        """The largest change (n_y,) that a sensor does not report."""
        return np.where(self.report_on_change > 0.0, self.deadband, 0.0)

    @cached_property
    def at_rest(self) -> Array:
        """The largest difference (n_y,) of two measurements of a signal at rest."""
        return self.jump + self.unreported


@dataclass(frozen=True)
class DisturbanceLimits(_Limits):
    """Sensor limits of the measured disturbances; if one is violated, the last value is held."""

    lower: Array = value_column(
        'disturbances', -UNBOUNDED, 'Lower end of the sensor range.', name='sensor_min')
    upper: Array = value_column(
        'disturbances', UNBOUNDED, 'Upper end of the sensor range.', name='sensor_max')
    rate: Array = column(
        'disturbances', 0.0, 'Fastest physically possible change; 0: no check.', '{unit}/s',
        name='max_rate', none=ANY)
    timeout: Array = column(
        'disturbances', 60.0, 'Age of the last measurement above which diagnostics warn; its '
        'value is held. 0: no check.', 's', 0.0, 86400.0, none=ANY)


@dataclass(frozen=True)
class Tuning(Settings):
    """
    The tuning of a controller, in the units of the model's signals.

    A field of each of some signals takes one number for all of them, or an array.

    >>> tuning = Tuning.for_model(model, state_weight=1e4, observer_bandwidth=0.05,
    ...                           limits=InputLimits(lower=0.0, upper=12.0, rate=2.0))
    >>> tuning.observer_bandwidth, tuning.safe_value.shape
    (0.05, (2,))
    """

    state_weight: Array = column(
        'states', 0.0, 'Weight of the squared control error of this '
                       'state.', '1/({unit})^2', maximum=1e30,
        name='weight')
    input_weight: Array = column(
        'inputs', 1.0, 'Weight of the squared deviation of this input from its steady value.',
        '1/({unit})^2', maximum=1e30, open_minimum=True, name='weight')
    limits: InputLimits = nested(InputLimits)
    dead_time: Array = column(
        'inputs', -1.0, 'Dead time between this input, as commanded or measured, and its effect; '
        '-1: that of the model.', 's', -1.0, LONGEST_DEAD_TIME)
    sensor: SensorLimits = nested(SensorLimits)
    disturbances: DisturbanceLimits = nested(DisturbanceLimits)
    controlled: tuple[str, ...] = parameter(
        ('',), 'Measured signals with a set-point, at most as many as there are inputs; an empty '
        'name: all measured signals.', read_only=True)
    setpoint_ramp: Array = column(
        'controlled', 0.0, 'Rate limit of the active set-point; 0: steps.', '{unit}/s',
        none=ANY)
    setpoint_filter_time: float = parameter(
        0.0, 'Time constant of the set-point filter; 0: no filter.', 's',
        0.0, 86400.0)
    estimator: str = parameter(
        '', 'State estimator: disturbance_observer or measured_state (all states measured), '
            'extended_kalman_filter or unscented_kalman_filter, or module:class for your own; '
            'empty: chosen automatically.', code=True)
    observer_bandwidth: float = parameter(
        0.0, 'Bandwidth of the disturbance observer. Higher removes offsets sooner and passes '
        'more noise to the inputs. 0: no observer. Kalman filters: see disturbance_noise.', '1/s',
        0.0, 1000.0)
    max_disturbance: Array = column(
        'inputs', 0.0, 'Bound of the estimated disturbance, as an equivalent change of this '
                       'input; 0: none.', none=ANY)
    tracking_tolerance: Array = column(
        'inputs', UNBOUNDED, 'Deviation of the applied input from its command above which the '
                             'estimator uses the applied input.')
    measurement_noise: Array = column(
        'measured', 0.0, 'Standard deviation of the measurement noise (Kalman filters); 0: that '
                         'of the training data.')
    uncertain_noise_factor: float = parameter(
        3.0, 'Factor of the measurement noise of a signal while its quality is uncertain (Kalman '
             'filters).', '', 1.0, 1e6)
    disturbance_noise: Array = column(
        'inputs', 0.0, "Standard deviation of the input disturbance's random walk in one minute "
                       '(Kalman filters); 0: derived from the model.')
    initial_error: Array = column(
        'states', 0.0, 'Standard deviation of the initial estimate of this state (Kalman '
                       'filters); 0: a quarter of the trained range.')
    analysis_delay: Array = column(
        'states', 0.0, 'Largest delay of a value on analysis_topic, which corrects a Kalman '
                       'filter at its stamp (within the last 300 samples); 0: late values are '
                       'rejected.',
        's', maximum=86400.0)
    analysis_noise: Array = column(
        'states', 0.0, 'Standard deviation of the noise of a late value; 0: a hundredth of the '
                       'trained range.')
    fallback_order: tuple[str, ...] = parameter(
        ('sdre', 'linear'), 'Control laws, best first: mpc (model predictive), sdre '
                            '(state-dependent Riccati equation), linear (LQR), pi, or '
                            'module:class for your own.',
        code=True)
    learned_model_margin: float = parameter(
        0.1, 'Distance outside the trained range, in half-ranges, up to which the nonlinear laws '
             'act, at least the spacing of the stored training states; the linear law acts '
             'beyond it.', '', 0.0, UNBOUNDED)
    linear_model_margin: float = parameter(
        0.5, 'Distance outside the trained range, in half-ranges, up to which the laws linear and '
             'pi act; the safe inputs are commanded beyond it.', '', 0.0, UNBOUNDED)
    safe_value: Array = value_column(
        'inputs', 0.0, 'Safe value: commanded if no law can act; limited to min and max.')
    hold_timeout: float = parameter(
        60.0, 'Time without a usable measurement or law after which the safe inputs are '
              'commanded.', 's', 0.0, 86400.0)
    recovery_time: float = parameter(
        10.0, 'Time for which a better law must be available before it takes over again.', 's',
        0.0, 86400.0)
    safe_latch: bool = parameter(
        False, 'Keep the safe inputs, once commanded, until an operator clears them by '
               '~/clear_safe_state, also over a restart.')
    bumpless_transfer_time: float = parameter(
        0.0, 'Time constant of the bumpless transfer after a change of law, model, tuning or '
             'mode.',
        's', 0.0, 86400.0)
    max_gain: float = parameter(
        1000.0, 'Largest allowed norm of a Riccati gain, in scaled coordinates.', '',
        0.0, 1e9, open_minimum=True)
    # the root of the machine's precision; `ros2 param load` reads 1e-8 as a text
    max_riccati_residual: float = parameter(
        1.5e-8, 'Largest allowed relative residual of a Riccati equation.', '',
        0.0, 1.0, open_minimum=True)
    #: own parameters of laws and estimators, by name
    plugins: Mapping[str, Any] = plugin_parameters()

    __repr__ = short_repr

    def dead_times(self, model: LiftedModel) -> Array:
        """Return the dead time (n_u,) of each input of a model in s."""
        return np.where(self.dead_time < 0.0, model.dead_time, self.dead_time)

    def of_plugin(self, name: str, kind: type[Any]) -> Any:
        """Return the own parameters of a plug-in by its name; those of `kind` by default."""
        found = self.plugins.get(short_name(name))
        return kind() if found is None else found

    def for_signals(self, model: LiftedModel, measured: Sequence[str]) -> Self:
        """
        Return the tuning with one number for each signal.

        :param measured: names of the signals that are measured.
        :raises ValueError: naming the mismatch.
        """
        states, inputs = model.states.names, model.inputs.names
        every = tuple(name for i, name in enumerate(states) if (
            name in measured and i not in model.lagged.values())) or tuple(
                states[i] for i in model.measured)
        controlled = tuple(filter(None, self.controlled)) or every
        if list(controlled) != [name for name in states if name in controlled]:
            raise ValueError(f'controlled must be some of the states {", ".join(states)}, each '
                             f'once and in this order, got {", ".join(controlled)}')
        if len(inputs) < len(controlled) and controlled not in (states, every):
            raise ValueError(f'{len(inputs)} inputs cannot control {len(controlled)} signals '
                             f'({", ".join(controlled)}): list at most {len(inputs)} in '
                             'controlled, or leave it empty for a compromise between all states')
        signals = {'states': states, 'measured': measured, 'controlled': controlled,
                   'inputs': inputs, 'disturbances': model.disturbances.names}
        made = for_signals(replace(self, controlled=controlled), signals)
        tolerance = made.tracking_tolerance.copy()
        # the applied input is a state of the model there
        tolerance[[j for j in model.lagged if j not in model.commanded]] = UNBOUNDED
        made = replace(made, tracking_tolerance=tolerance, plugins={
            name: for_signals(own, signals) for name, own in self.plugins.items()})
        if not np.any(made.state_weight > 0.0):
            raise ValueError('state_weight must not be 0 for all states')
        for limits, kind, names in ((made.limits, 'input', inputs), (
                made.sensor, 'sensor', measured), (
                made.disturbances, 'disturbance', model.disturbances.names)):
            if not np.all(limits.lower < limits.upper):
                raise ValueError(f'{kind} limits of {", ".join(names)} must be lower < upper, got '
                                 f'{limits.lower.tolist()} and {limits.upper.tolist()}')
        if not np.all(np.isfinite(made.safe_value)):
            raise ValueError(f'safe_value must be finite, got {made.safe_value.tolist()}')
        if not made.fallback_order or len(set(made.fallback_order)) != len(made.fallback_order):
            raise ValueError('fallback_order must list at least one law, each once, got '
                             f'{made.fallback_order}')
        return made

    @classmethod
    def for_model(cls, model: LiftedModel, **given: Any) -> Self:
        """
        Return a tuning with weights, ranges and safe inputs of a model, except the given ones.

        The weights are 1 on deviations scaled by the model, but 0 on states that are not measured,
        the inputs' limits their trained range, and the safe inputs the nominal ones; of times see
        :func:`time_defaults`. These are the defaults of the controller node, too.
        """
        expect(model=(model, LiftedModel))
        inputs, weights = model.inputs, np.zeros(model.n_x)
        dead_time = real(given.get('dead_time', -1.0), 'dead_time')
        longest = np.max(np.where(dead_time < 0.0, model.dead_time, dead_time), initial=0.0)
        weights[model.measured] = 1.0 / model.states.scale[model.measured] ** 2
        return cls(**{
            'state_weight': weights,
            'input_weight': 1.0 / inputs.scale ** 2,
            'limits': InputLimits(inputs.lower, inputs.upper),
            'safe_value': inputs.center,
            **time_defaults(model, float(longest)), **given})


def time_defaults(model: LiftedModel, dead_time: float) -> dict[str, float]:
    """
    Return bandwidth of the observer and time of the bumpless transfer for a model's modes.

    Both are 0 for an unstable plant, which cannot wait. Otherwise the observer is as fast as the
    fastest mode, or, behind a dead time, as :func:`largest_bandwidth`; the transfer takes half of
    that mode's time constant.

    :param dead_time: the longest of the inputs, in s.
    """
    rates = np.abs(model.modes)
    fastest, slowest = float(np.max(rates)), float(np.min(rates))
    if not (fastest > 0.0 and np.all(model.modes.real < 0.0)):
        return {'observer_bandwidth': 0.0, 'bumpless_transfer_time': 0.0}
    bandwidth = fastest if dead_time == 0.0 else min(
        fastest, largest_bandwidth(dead_time, slowest))
    return {'observer_bandwidth': min(float(f'{bandwidth:.2g}'), 1000.0),
            'bumpless_transfer_time': min(float(f'{0.5 / fastest:.2g}'), 86400.0)}


def largest_bandwidth(dead_time: float, slowest: float) -> float:
    """
    Return the bandwidth of an observer in 1/s with which its loop keeps a margin.

    It grows with the dead time in time constants of the plant, whose decay damps the loop. For
    first-order plants and laws with a gain of 0.7 to 2.3, in inverse gains of the plant, the
    maximum sensitivity is at most 1.93, and dead time and gain may be twice as large as known;
    the integral of the error after a load step is about that of a PI controller by the rules of
    S. Skogestad (J. Process Control 13 (2003)), also where the dead time is 30 % shorter or longer
    than known.

    :param dead_time: the longest of the inputs, in s, above 0.
    :param slowest: rate of the model's slowest mode, in 1/s.
    """
    return (1.0 + math.sqrt(1.0 + 8.0 * slowest * dead_time)) / (1.8 * dead_time)
