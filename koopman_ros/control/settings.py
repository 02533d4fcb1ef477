# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What a controller is tuned by, one number per signal, checked against the model's signals."""

from dataclasses import dataclass, field
import math
from typing import Any, Self

import numpy as np

from koopman_ros.arrays import Array, as_arrays, brief
from koopman_ros.control.limits import InputLimits
from koopman_ros.control.supervisor import SupervisorSettings
from koopman_ros.estimation import SensorLimits
from koopman_ros.lifting import LiftedModel
from koopman_ros.signals import Outputs, per_signal

# What is taken where nobody says how uncertain the plant is: noise as a share of the half width of
# the training box, an influence as a share of the inputs', after the slowest time constant, and a
# first guess.
_NOISE, _WANDER, _GUESS = 1e-3, 0.1, 0.5
_LONGEST = 86400.0  # s, of time constants


def _none() -> Array:
    return np.zeros(0)


@dataclass(frozen=True)
class Settings:
    """What an engineer tunes, in the units of the signals."""

    state_weight: Array  #: (n_x,) weights of squared state errors, per state unit squared
    input_weight: Array  #: (n_u,) weights of squared input deviations, per input unit squared
    limits: InputLimits  #: range and rate of the inputs
    setpoint_ramp: Array  #: (n_c,) largest change of the set-point per second; infinity for steps
    max_disturbance: Array  #: (n_u,) largest disturbance that is allowed for, in input units
    #: (n_u,) how far, in input units, a measured input may be from its command before the command
    #: counts as not reached
    input_tolerance: Array
    safe_input: Array  #: (n_u,) commanded when nothing else can be, in input units
    sensor: SensorLimits  #: which measurements are accepted
    #: (n_c,) names of the states that are given set-points, in the model's order; empty for all.
    #: The others go where the model's steady state has them
    controlled: tuple[str, ...] = ()
    setpoint_filter: float = 0.0  #: time constant in s with which the set-point follows its ramp
    #: of the disturbance observer in 1/s; 0 for none, as in the paper
    observer_bandwidth: float = 0.0
    #: its name in :data:`koopman_ros.estimation.ESTIMATORS`, or module:class; empty for the
    #: disturbance observer, or none of it where its bandwidth is 0, and for the extended Kalman
    #: filter where not every state is measured
    estimator: str = ''
    #: for Kalman filters, empty or 0 for what suits the model: (n_y,) standard deviation of the
    #: noise of the measurements, in their units
    noise: Array = field(default_factory=_none)
    #: (n_u,) how far an unknown influence wanders in a second, as a change of each input, in input
    #: units; over longer times with their square root
    wander: Array = field(default_factory=_none)
    #: (n_x,) how wrong the first guess of a state may be, in state units
    initial_error: Array = field(default_factory=_none)
    #: time constant in s in which the difference between two laws or models, or from manual mode,
    #: fades
    transfer_time: float = 30.0
    #: (n_x,) lowest states, to `state_upper` (n_x,), that a law with a horizon plans for, in state
    #: units; infinity for none, both empty where there are none at all
    state_lower: Array = field(default_factory=_none)
    state_upper: Array = field(default_factory=_none)
    #: (n_x,) of the law `pi`: change of the command per error, in units; 0 for states that it does
    #: not control, empty for none at all
    pi_gain: Array = field(default_factory=_none)
    pi_time: Array = field(default_factory=_none)  #: (n_x,) and its integral times in s
    #: seconds that a law may take for a sample before the next one acts; infinity for any
    deadline: float = np.inf
    max_gain: float = 1e3  #: bound on the norm of the Riccati gain in scaled coordinates
    max_residual: float = 1e-8  #: bound on the relative Riccati residual
    #: which laws act, and when
    supervisor: SupervisorSettings = field(default_factory=SupervisorSettings)

    __repr__ = brief

    def __post_init__(self) -> None:
        as_arrays(self, 'state_weight', 'input_weight', 'setpoint_ramp', 'max_disturbance',
                  'input_tolerance', 'safe_input', 'state_lower', 'state_upper', 'noise',
                  'wander', 'initial_error', 'pi_gain', 'pi_time')
        weights, costs = self.state_weight, self.input_weight
        for name, fits, words in (
                ('state_weight', np.isfinite(weights) & (weights >= 0.0) & np.any(weights > 0.0),
                 'finite, at least 0 and not all 0'),
                ('input_weight', np.isfinite(costs) & (costs > 0.0), 'finite and above 0'),
                ('safe_input', np.isfinite(self.safe_input), 'finite'),
                ('setpoint_ramp', self.setpoint_ramp > 0.0, 'above 0'),
                ('max_disturbance', self.max_disturbance > 0.0, 'above 0'),
                ('input_tolerance', self.input_tolerance >= 0.0, 'at least 0'),
                ('deadline', self.deadline > 0.0, 'above 0'),
                ('pi_gain', np.isfinite(self.pi_gain), 'finite'),
                ('pi_time', self.pi_time > 0.0, 'above 0'),
                *((name, getattr(self, name) >= 0.0, 'at least 0')
                  for name in ('noise', 'wander', 'initial_error'))):
            if not np.all(fits):
                raise ValueError(f'{name} must be {words}, got '
                                 f'{np.asarray(getattr(self, name)).tolist()}')
        for name in ('setpoint_filter', 'observer_bandwidth', 'transfer_time'):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise ValueError(f'{name} must be finite and at least 0, got '
                                 f'{getattr(self, name)}')

    @classmethod
    def for_model(cls, model: LiftedModel, *, state_weight: Array, input_weight: Array,
                  limits: InputLimits, **others: Any) -> Self:
        """
        Return settings that restrict nothing but what is given.

        Set-points step, every finite measurement is accepted, every command counts as reached,
        disturbances are not bounded, and the nominal input is the safe one.
        """
        n_x, n_u = model.n_x, model.n_u
        n_c = len(others.get('controlled') or model.states)
        return cls(**{
            'state_weight': state_weight, 'input_weight': input_weight, 'limits': limits,
            'setpoint_ramp': np.full(n_c, np.inf), 'max_disturbance': np.full(n_u, np.inf),
            'input_tolerance': np.full(n_u, np.inf), 'safe_input': model.inputs.center,
            'sensor': SensorLimits.none(n_x), **others})

    def uncertainty(self, model: LiftedModel, outputs: Outputs) -> tuple[Array, Array, Array]:
        """
        Return noise, wander and initial error, what suits the model where they are not said.

        The noise of an output that is a state is that of the record that the model was learned
        from, where there was one.
        """
        metrics, names = model.provenance.metrics, model.states.names
        recorded = np.array([metrics.get(
            f'noise_{name}' if len(names) > 1 else 'noise', 0.0) if name in names else 0.0
            for name in outputs.names])
        half = 0.5 * (model.states.upper - model.states.lower)
        slowest = float(np.min(np.abs(np.linalg.eigvals(
            model.drift_jacobian(np.zeros(model.n_x)))))) / model.seconds_per_time_unit
        defaults = (np.where(recorded > 0.0, recorded, _NOISE * np.abs(outputs.C) @ half),
                    _WANDER * 0.5 * (model.inputs.upper - model.inputs.lower)
                    * math.sqrt(max(slowest, 1.0 / _LONGEST)), _GUESS * half)
        noise, wander, error = (
            np.where(own > 0.0, own, default) if len(own) else default for own, default in zip(
                (self.noise, self.wander, self.initial_error), defaults, strict=True))
        return noise, wander, error

    def check(self, model: LiftedModel, outputs: Outputs) -> None:
        """Check that there is one number for each signal; a ValueError names which not."""
        states, inputs = model.states.names, model.inputs.names
        controlled = self.controlled or states
        if list(controlled) != [name for name in states if name in controlled]:
            raise ValueError(f'controlled must be some of the states {", ".join(states)}, each '
                             f'once and in this order, got {", ".join(controlled)}')
        if len(inputs) < len(controlled) < len(states):
            raise ValueError(f'{len(inputs)} inputs cannot hold {len(controlled)} signals '
                             f'({", ".join(controlled)}): name at most {len(inputs)} in '
                             'controlled, or leave it empty for a compromise between all states')
        for names, signals in (
                (('state_weight',), states), (('setpoint_ramp',), controlled),
                (('input_weight', 'max_disturbance', 'input_tolerance', 'safe_input'), inputs)):
            for name in names:
                per_signal(name, getattr(self, name), signals)
        for name, signals in (('noise', outputs.names), ('wander', inputs),
                              ('initial_error', states), ('pi_gain', states),
                              ('pi_time', states)):
            if len(getattr(self, name)):
                per_signal(name, getattr(self, name), signals)
        if len(self.state_lower) or len(self.state_upper):
            for name in ('state_lower', 'state_upper'):
                per_signal(name, getattr(self, name), states)
            if not np.all(self.state_lower < self.state_upper):
                raise ValueError('state limits must be lower < upper, got '
                                 f'{self.state_lower.tolist()} and {self.state_upper.tolist()}')
        self.limits.check(inputs)
        self.sensor.check(outputs.names)
