# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Simulation of a plant whose input is held constant over each sample period."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from koopman_ros.plants.integration import (
    hold,
    IntegratorSettings,
    largest_stack,
    Limits,
    resolved_limits,
)
from koopman_ros.plants.system import checked_array, ControlAffineSystem, FloatArray
from koopman_ros.plants.trajectory import sample_times, Trajectory

_DEFAULT_SETTINGS = IntegratorSettings()


def advance(
    system: ControlAffineSystem,
    x: ArrayLike,
    u: ArrayLike,
    duration: float,
    *,
    settings: IntegratorSettings = _DEFAULT_SETTINGS,
) -> FloatArray:
    """
    Integrate a plant over one interval with its input held constant.

    :param x: the state at its start (n_x,).
    :param u: the held input (n_u,).
    :param duration: its length, in time units, >= 0.
    :return: the state at its end (n_x,).
    :raises ValueError: when an argument does not fit.
    :raises IntegrationError: when the end is not reached; its time counts from the start.
    """
    if not 0.0 <= duration < math.inf:
        raise ValueError(
            f'duration is {duration} {system.time_unit}, must be finite and not negative')
    start = system.checked_state('x', x)[None, :]
    held = system.checked_input('u', u)[None, :]
    end: FloatArray = hold(system, start, held, duration, resolved_limits(system, settings))[0]
    return end


def simulate(
    system: ControlAffineSystem,
    x0: ArrayLike,
    inputs: ArrayLike,
    sample_period: float,
    *,
    substeps: int = 1,
    start_time: float = 0.0,
    settings: IntegratorSettings = _DEFAULT_SETTINGS,
) -> Trajectory:
    """
    Simulate a plant under zero-order-hold inputs.

    :param x0: initial state (n_x,).
    :param inputs: inputs (K, n_u), each held for one sample period; (K, 0) without inputs.
    :param sample_period: length of each hold, in time units, > 0.
    :param substeps: samples recorded in each hold; the trajectory then has K * substeps holds.
    :param start_time: time of `x0`, in time units.
    :raises ValueError: when an argument does not fit.
    :raises IntegrationError: when the end is not reached.
    """
    starts = system.checked_state('x0', x0)[None, :]
    held = checked_array('inputs', inputs, (None, system.n_u))[None, :, :]
    times = _checked_times(system, start_time, sample_period, held.shape[1], substeps)
    held = np.repeat(held, substeps, axis=1)
    states = _sampled_states(
        system, starts, held, times, sample_period / substeps, resolved_limits(system, settings))
    return Trajectory(times=times, states=states[0], inputs=held[0])


def simulate_many(
    system: ControlAffineSystem,
    x0: ArrayLike,
    inputs: ArrayLike,
    sample_period: float,
    *,
    substeps: int = 1,
    start_time: float = 0.0,
    settings: IntegratorSettings = _DEFAULT_SETTINGS,
) -> Trajectory:
    """
    Simulate M trajectories of a plant as one stacked equation, each as precisely as alone.

    :param x0: initial states (M, n_x).
    :param inputs: inputs (M, K, n_u), each held for one sample period.
    :param sample_period: length of each hold, in time units, > 0.
    :param substeps: samples recorded in each hold; the trajectories then have K * substeps holds.
    :param start_time: time of `x0`, in time units.
    :return: states (M, K * substeps + 1, n_x), inputs (M, K * substeps, n_u), shared times.
    :raises ValueError: when an argument does not fit.
    :raises IntegrationError: when one of them does not reach the end; it says which.
    """
    starts = checked_array('x0', x0, (None, system.n_x))
    held = checked_array('inputs', inputs, (len(starts), None, system.n_u))
    times = _checked_times(system, start_time, sample_period, held.shape[1], substeps)
    held = np.repeat(held, substeps, axis=1)
    limits = resolved_limits(system, settings)
    size = largest_stack(limits.rtol)
    states = np.empty((len(starts), len(times), system.n_x))
    for first in range(0, len(starts), size):
        stack = slice(first, first + size)
        states[stack] = _sampled_states(
            system, starts[stack], held[stack], times, sample_period / substeps, limits, first)
    return Trajectory(times=times, states=states, inputs=held)


def _checked_times(
    system: ControlAffineSystem,
    start_time: float,
    sample_period: float,
    holds: int,
    substeps: int,
) -> FloatArray:
    if not 0.0 < sample_period < math.inf:
        raise ValueError(
            f'sample_period is {sample_period} {system.time_unit}, must be finite and above 0')
    if substeps < 1:
        raise ValueError(f'substeps is {substeps}, must be at least 1')
    return sample_times(start_time, sample_period, holds, substeps)


def _sampled_states(
    system: ControlAffineSystem,
    starts: FloatArray,
    inputs: FloatArray,
    times: FloatArray,
    duration: float,
    limits: Limits,
    first: int = 0,
) -> FloatArray:
    """Integrate a stack (M, n_x) hold by hold to (M, K + 1, n_x)."""
    states = np.empty((len(starts), len(times), system.n_x))
    states[:, 0] = starts
    for n, time in enumerate(times[:-1]):
        states[:, n + 1] = hold(
            system, states[:, n], inputs[:, n], duration, limits,
            start_time=float(time), first=first)
    return states
