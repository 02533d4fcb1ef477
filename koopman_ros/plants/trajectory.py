# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What a simulated plant did: sampled states and the inputs held between the samples."""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np

from koopman_ros.plants.system import ControlAffineSystem, FloatArray


@dataclass(frozen=True, eq=False)
class Trajectory:
    """
    Sampled states and zero-order-hold inputs, of one trajectory or of M at the same times.

    The arrays are made read-only, not copied.

    :param times: sample times (K + 1,), in time units.
    :param states: states at those times (K + 1, n_x), or (M, K + 1, n_x).
    :param inputs: inputs (K, n_u), or (M, K, n_u); input n is held from sample n to n + 1.
    """

    times: FloatArray
    states: FloatArray
    inputs: FloatArray

    def __post_init__(self) -> None:
        holds = self.inputs.shape[-2]
        if self.times.shape != (holds + 1,):
            raise ValueError(
                f'incompatible times: expected ({holds + 1},), got {self.times.shape}')
        expected = (*self.inputs.shape[:-2], holds + 1, self.states.shape[-1])
        if self.states.shape != expected:
            raise ValueError(f'incompatible states: expected {expected}, got {self.states.shape}')
        for array in (self.times, self.states, self.inputs):
            array.flags.writeable = False


@dataclass(frozen=True, eq=False)
class DerivativeSamples:
    """
    States with the exact rates and the inputs at them: what a lift is learned from.

    :param x: states (N, n_x).
    :param x_dot: their rates dx/dt (N, n_x), in state units per time unit.
    :param u: the inputs (N, n_u) acting there.
    """

    x: FloatArray
    x_dot: FloatArray
    u: FloatArray


def sample_derivatives(system: ControlAffineSystem, trajectory: Trajectory) -> DerivativeSamples:
    """
    Evaluate dx/dt at every sample of a trajectory, with the input that is held from there on.

    The last sample of each trajectory has no such input and is left out; M trajectories are
    joined one after another, N = M K.

    :raises ValueError: when the trajectory is not one of this system.
    """
    x, u = _joined(trajectory.states[..., :-1, :]), _joined(trajectory.inputs)
    return DerivativeSamples(x=x, x_dot=system.derivative(x, u), u=u)


def _joined(samples: FloatArray) -> FloatArray:
    # A length of -1 would be ambiguous for samples of no input.
    return samples.reshape(math.prod(samples.shape[:-1]), samples.shape[-1])


def sample_times(
    start_time: float, sample_period: float, holds: int, substeps: int = 1,
) -> FloatArray:
    """
    Return start_time + n / substeps * sample_period for n = 0 ... holds * substeps.

    Each is computed by itself, so that no round-off adds up, and the ends of the holds are the
    same whatever `substeps` is.
    """
    return start_time + sample_period * (np.arange(holds * substeps + 1) / substeps)
