# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Simulation of a plant whose input is held constant over each sample period."""

from collections.abc import Sequence
from enum import Enum
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from koopman_ros.core.arrays import Array, frozen
from koopman_ros.core.datasets import DriftSamples, Episode
from koopman_ros.core.integration import adaptive
from koopman_ros.plants.system import ControlAffineSystem

LOOSEST_RTOL = 1e-9
# Smallest tolerance that scipy accepts without a warning.
TIGHTEST_RTOL = 100.0 * float(np.finfo(np.float64).eps)
# A stiff runaway would otherwise take tiny steps for ever; a reactor needs about ten a minute.
_MAX_STEPS_PER_HOLD = 20_000


class IntegrationFailure(Enum):
    """Why a simulation ended early, and what to do about it."""

    OUT_OF_BOUNDS = ('the state left its bounds; choose an input that keeps it inside, or widen '
                     'the bounds')
    NON_FINITE = 'the rate of the state is not finite there; start where the model is defined'
    STEP_TOO_SMALL = 'the state diverges; stop earlier, or set bounds'
    TOO_MANY_STEPS = 'the integration needs too many steps; shorten the hold times'


class Limits(NamedTuple):
    """Tolerances and state bounds (n_x,) of an integration, for one system."""

    rtol: float
    atol: Array
    lower: Array
    upper: Array


class IntegrationError(RuntimeError):
    """
    A simulation could not reach the end of its time, with plant, state, cause and next step.

    :ivar failure: the cause.
    :ivar time: when, in time units.
    :ivar state: the offending state (n_x,).
    """

    def __init__(self, sentence: str, failure: IntegrationFailure, time: float, state: Array
                 ) -> None:
        # All of them as args, so that the error survives pickling between processes.
        super().__init__(sentence, failure, time, state)
        self.failure = failure
        self.time = time
        self.state = state

    def __str__(self) -> str:
        return str(self.args[0])


def integration_limits(system: ControlAffineSystem, rtol: float = 1e-10,
                       lower: Array | None = None, upper: Array | None = None) -> Limits:
    """
    Return the precision of an integration, and its bounds, by default the system's own.

    The absolute tolerance is `rtol` times the magnitude of each nominal state.

    :param rtol: relative tolerance of each integration step, in [2.3e-14, 1e-9].
    :raises ValueError: when a tolerance cannot be used.
    """
    if not TIGHTEST_RTOL <= rtol <= LOOSEST_RTOL:
        raise ValueError(
            f'rtol is {rtol:.3g}, must lie in [{TIGHTEST_RTOL:.3g}, {LOOSEST_RTOL:.3g}]')
    atol = rtol * system.state_scale
    # zero would divide zero by zero in the error norm of a state that is exactly zero
    if not np.all((atol > 0.0) & (atol < np.inf)):
        raise ValueError(f'atol is {atol}, must be finite and above 0')
    return Limits(rtol, atol, system.state_lower if lower is None else lower,
                  system.state_upper if upper is None else upper)


def hold(system: ControlAffineSystem, start: Array, u: Array, duration: float,
         limits: Limits, *, start_time: float = 0.0) -> Array:
    """
    Integrate a state over one hold; the plants are not stiff within their bounds.

    :param start_time: time of its start, for the message of an error.
    :return: the state at its end (n_x,).
    :raises IntegrationError: when the end is not reached.
    """
    constant = None if callable(system.B) else u @ system.B.T

    def rate(_: float, x: Array) -> Array:
        return system.drift(x) + (system.forcing(x, u) if constant is None else constant)

    def failed(failure: IntegrationFailure, elapsed: float, x: Array) -> IntegrationError:
        return _integration_error(system, limits, failure, start_time + elapsed, x)

    # Stages of a step that is then rejected may overflow.
    with np.errstate(all='ignore'):
        if not _inside(start, limits):
            raise failed(IntegrationFailure.OUT_OF_BOUNDS, 0.0, start)
        # DOP853 would never return from a first step that begins with an infinite rate
        if not np.all(np.isfinite(rate(0.0, start))):
            raise failed(IntegrationFailure.NON_FINITE, 0.0, start)
        end, arrived = adaptive(
            rate, start, duration, rtol=limits.rtol, atol=limits.atol, most=_MAX_STEPS_PER_HOLD,
            inside=lambda x: _inside(x, limits))
    x: Array = end.y
    if arrived:
        return x
    raise failed(IntegrationFailure.STEP_TOO_SMALL if end.status == 'failed' else
                 IntegrationFailure.TOO_MANY_STEPS if _inside(x, limits) else
                 IntegrationFailure.OUT_OF_BOUNDS, end.t, x)


def _inside(x: Array, limits: Limits) -> bool:
    return bool(np.all((x >= limits.lower) & (x <= limits.upper)))


def _integration_error(system: ControlAffineSystem, limits: Limits, failure: IntegrationFailure,
                       time: float, state: Array) -> IntegrationError:
    outside = ''.join(
        f', {name} outside [{lower:.10g}, {upper:.10g}]{"" if unit == "1" else " " + unit}'
        for name, unit, x, lower, upper in zip(
            system.state_names, system.state_units, state, limits.lower, limits.upper,
            strict=True)
        if not lower <= x <= upper)
    return IntegrationError(
        f'{system.name}: {system.describe_state(state)} at {time:.6g} {system.time_unit}'
        f'{outside}: {failure.value}', failure, time, state.copy())


def advance(system: ControlAffineSystem, x: ArrayLike, u: ArrayLike, duration: float) -> Array:
    """
    Integrate a state (n_x,) over one interval with the input (n_u,) held constant.

    :param duration: its length, in time units, >= 0.
    :raises ValueError: when an argument does not fit.
    :raises IntegrationError: when the end is not reached; its time counts from the start.
    """
    if not 0.0 <= duration < math.inf:
        raise ValueError(
            f'duration is {duration} {system.time_unit}, must be finite and not negative')
    return hold(system, system.checked_state('x', x), system.checked_input('u', u), duration,
                integration_limits(system))


def simulate(system: ControlAffineSystem, x0: ArrayLike, inputs: ArrayLike, sample_period: float,
             *, start_time: float = 0.0, limits: Limits | None = None) -> Episode:
    """
    Simulate a plant under zero-order-hold inputs.

    :param x0: initial state (n_x,), at `start_time`.
    :param inputs: inputs (K, n_u), each held for one sample period, in time units.
    :param limits: precision and bounds, by default those of :func:`integration_limits`.
    :return: the states at K + 1 samples, and an input for each but the last.
    :raises ValueError: when an argument does not fit.
    :raises IntegrationError: when the end is not reached.
    """
    x = system.checked_state('x0', x0)
    held = np.array(frozen(inputs, 'inputs', (None, system.n_u)))
    if not 0.0 < sample_period < math.inf:
        raise ValueError(
            f'sample_period is {sample_period} {system.time_unit}, must be finite and above 0')
    # each by itself, so that no round-off adds up
    times = start_time + sample_period * np.arange(float(len(held) + 1))
    limits = limits or integration_limits(system)
    states = np.empty((len(times), system.n_x))
    states[0] = x
    for n, u in enumerate(held):
        states[n + 1] = hold(system, states[n], u, sample_period, limits,
                             start_time=float(times[n]))
    return Episode(times, states, times[:-1], held)


def sample_derivatives(system: ControlAffineSystem, episodes: Sequence[Episode]) -> DriftSamples:
    """Evaluate dx/dt exactly at the samples of episodes by :func:`simulate`, but the last."""
    return DriftSamples(
        np.concatenate([episode.x[:-1] for episode in episodes]),
        np.concatenate([system.derivative(episode.x[:-1], episode.u) for episode in episodes]),
        np.concatenate([episode.u for episode in episodes]),
        np.repeat(np.arange(len(episodes)), [len(episode.u) for episode in episodes]),
        np.concatenate([episode.time[:-1] for episode in episodes]))
