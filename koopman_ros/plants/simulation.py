# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Simulation of a plant whose input is held constant over each sample period."""

from collections.abc import Sequence
import math

import numpy as np
from numpy.typing import ArrayLike

from koopman_ros.arrays import frozen
from koopman_ros.plant_data import Episode, Samples
from koopman_ros.plants.integration import hold, IntegratorSettings, resolved_limits
from koopman_ros.plants.system import ControlAffineSystem, FloatArray

_DEFAULT_SETTINGS = IntegratorSettings()


def advance(system: ControlAffineSystem, x: ArrayLike, u: ArrayLike, duration: float, *,
            settings: IntegratorSettings = _DEFAULT_SETTINGS) -> FloatArray:
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
    start, held = system.checked_state('x', x), system.checked_input('u', u)
    return hold(system, start, held, duration, resolved_limits(system, settings))


def simulate(system: ControlAffineSystem, x0: ArrayLike, inputs: ArrayLike, sample_period: float,
             *, substeps: int = 1, start_time: float = 0.0,
             settings: IntegratorSettings = _DEFAULT_SETTINGS) -> Episode:
    """
    Simulate a plant under zero-order-hold inputs.

    :param x0: initial state (n_x,).
    :param inputs: inputs (K, n_u), each held for one sample period; (K, 0) without inputs.
    :param sample_period: length of each hold, in time units, > 0.
    :param substeps: samples recorded in each hold; the episode then has K * substeps + 1.
    :param start_time: time of `x0`, in time units.
    :return: the states at all samples, and an input for each but the last.
    :raises ValueError: when an argument does not fit.
    :raises IntegrationError: when the end is not reached.
    """
    x = system.checked_state('x0', x0)
    held = frozen(inputs, 'inputs', (None, system.n_u))
    if not 0.0 < sample_period < math.inf:
        raise ValueError(
            f'sample_period is {sample_period} {system.time_unit}, must be finite and above 0')
    if substeps < 1:
        raise ValueError(f'substeps is {substeps}, must be at least 1')
    # each by itself, so that no round-off adds up, and the same at the ends of the holds
    # whatever `substeps` is
    times = start_time + sample_period * (np.arange(len(held) * substeps + 1) / substeps)
    held = np.repeat(held, substeps, axis=0)
    limits = resolved_limits(system, settings)
    states = np.empty((len(times), system.n_x))
    states[0] = x
    for n, u in enumerate(held):
        states[n + 1] = hold(system, states[n], u, sample_period / substeps, limits,
                             start_time=float(times[n]))
    return Episode(times, states, times[:-1], held)


def sample_derivatives(system: ControlAffineSystem, episodes: Sequence[Episode]) -> Samples:
    """
    Evaluate dx/dt exactly at the samples of simulated episodes, but for the last of each.

    :param system: the plant.
    :param episodes: as :func:`simulate` returns them, with an input for each sample but the last.
    :raises ValueError: when the episodes are not of this system.
    """
    return Samples(
        np.concatenate([episode.x[:-1] for episode in episodes]),
        np.concatenate([system.derivative(episode.x[:-1], episode.u) for episode in episodes]),
        np.concatenate([episode.u for episode in episodes]),
        np.repeat(np.arange(len(episodes)), [len(episode.u) for episode in episodes]),
        np.concatenate([episode.time[:-1] for episode in episodes]))
