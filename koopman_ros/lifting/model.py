# Copyright 2026 The koopman_ros Authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The run-time lifted model: lift, Jacobian, secants and projected drift, in numpy alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

SECONDS_PER_TIME_UNIT = {'s': 1.0, 'min': 60.0}


def _frozen(value: ArrayLike, name: str, shape: tuple[int, ...]) -> Array:
    """Return a read-only float64 copy of `value`, or say what is wrong with it."""
    array = np.array(value, dtype=np.float64, copy=True)
    if array.shape != shape:
        raise ValueError(f'incompatible {name}: expected {shape}, got {array.shape}')
    if not np.all(np.isfinite(array)):
        raise ValueError(f'{name} holds values that are not finite')
    array.setflags(write=False)
    return array


@dataclass(frozen=True)
class Coordinates:
    """
    Names, units, scaling and training box of the states or of the inputs.

    A physical value v maps to the deviation (v - center) / scale that the network sees.

    :param names: one name a coordinate, e.g. ``('temperature',)``.
    :param units: one unit a coordinate, e.g. ``('K',)``.
    :param center: (n,) nominal point, in units.
    :param scale: (n,) positive, in units.
    :param lower: (n,) lower corner of the training box, in units.
    :param upper: (n,) upper corner of the training box, in units.
    :raises ValueError: on inconsistent sizes, a scale that is not positive or an empty box.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    center: Array
    scale: Array
    lower: Array
    upper: Array

    def __post_init__(self) -> None:
        n = len(self.names)
        if len(self.units) != n:
            raise ValueError(f'incompatible units: expected {n}, got {len(self.units)}')
        for name in ('center', 'scale', 'lower', 'upper'):
            object.__setattr__(self, name, _frozen(getattr(self, name), name, (n,)))
        if np.any(self.scale <= 0.0):
            raise ValueError(f'scale must be positive, got {self.scale.tolist()}')
        if np.any(self.lower >= self.upper):
            raise ValueError(f'the box is empty: lower {self.lower.tolist()}, '
                             f'upper {self.upper.tolist()}')

    def __len__(self) -> int:
        return len(self.names)

    def to_deviation(self, value: Array) -> Array:
        """Map physical values (..., n) to scaled deviations (..., n)."""
        return (value - self.center) / self.scale

    def to_physical(self, deviation: Array) -> Array:
        """Map scaled deviations (..., n) to physical values (..., n)."""
        return self.center + deviation * self.scale

    def violation(self, value: Array) -> float:
        """
        Measure how far a physical value (n,) lies outside the training box.

        :return: largest excess over a side of the box, as a fraction of half its width; 0 inside,
            infinity for a value that is not finite.
        """
        if not np.all(np.isfinite(value)):
            return float('inf')
        half = 0.5 * (self.upper - self.lower)
        excess = np.maximum(self.lower - value, value - self.upper) / half
        return max(0.0, float(np.max(excess, initial=0.0)))


@dataclass(frozen=True)
class Provenance:
    """
    Where a lift comes from and how good it was found to be.

    :param plant: name of the plant it was learned from.
    :param seed: seed of the training run, or None for a model that was not trained.
    :param data_digest: SHA-256 of the training samples, in hexadecimal.
    :param metrics: held-out figures: ``rw``, ``rx`` and ``cond`` without unit,
        ``rollout_rmse`` in state units.
    :param package_version: version of koopman_ros that made it.
    """

    plant: str
    seed: int | None = None
    data_digest: str = ''
    metrics: Mapping[str, float] = field(default_factory=dict)
    package_version: str = ''


@dataclass(frozen=True)
class LiftedModel:
    """
    A lift z = N(x) with dz/dt = A z + J_N(x) B u (paper, equation for control-affine systems).

    All methods work in scaled deviations from the nominal point (see :class:`Coordinates`),
    with time in `time_unit`. The first n_x coordinates of z are the state itself when
    `identity` is set; N(0) = 0 by construction. Without hidden layers and with `identity`
    the model is a linearisation.

    :param hidden: (weight (h_i, h_{i-1}), bias (h_i,)) of each tanh layer, h_0 = n_x.
    :param output: (n_z - n_x, h) with `identity`, else (n_z, h): weights of the last layer.
    :param A: (n_z, n_z) in 1/time unit.
    :param B: (n_x, n_u) in scaled coordinates.
    :param identity: whether z starts with the state.
    :param states: the states' names, units, scaling and training box.
    :param inputs: the inputs' names, units, scaling and training box.
    :param time_unit: ``'s'`` or ``'min'``.
    :param provenance: origin and held-out figures.
    :raises ValueError: naming the array that does not fit and both shapes.
    """

    hidden: tuple[tuple[Array, Array], ...]
    output: Array
    A: Array
    B: Array
    identity: bool
    states: Coordinates
    inputs: Coordinates
    time_unit: str
    provenance: Provenance

    def __post_init__(self) -> None:
        n_x, n_u = len(self.states), len(self.inputs)
        if self.time_unit not in SECONDS_PER_TIME_UNIT:
            raise ValueError(f"time_unit must be 's' or 'min', got {self.time_unit!r}")
        width, layers = n_x, []
        for i, (weight, bias) in enumerate(self.hidden):
            h = np.shape(bias)[0] if np.ndim(bias) == 1 else -1
            layers.append((_frozen(weight, f'weight of hidden layer {i}', (h, width)),
                           _frozen(bias, f'bias of hidden layer {i}', (h,))))
            width = h
        object.__setattr__(self, 'hidden', tuple(layers))
        n_z = np.shape(self.A)[0] if np.ndim(self.A) == 2 else -1
        free = n_z - n_x if self.identity else n_z
        if free < 0:
            raise ValueError(f'incompatible A: n_z must be at least n_x = {n_x}, got {n_z}')
        if free > 0 and not self.hidden:
            raise ValueError('a lift with free coordinates needs a hidden layer')
        object.__setattr__(self, 'output', _frozen(self.output, 'output', (free, width)))
        object.__setattr__(self, 'A', _frozen(self.A, 'A', (n_z, n_z)))
        object.__setattr__(self, 'B', _frozen(self.B, 'B', (n_x, n_u)))

    @property
    def n_x(self) -> int:
        """Number of states."""
        return len(self.states)

    @property
    def n_u(self) -> int:
        """Number of inputs."""
        return len(self.inputs)

    @property
    def n_z(self) -> int:
        """Number of lifted coordinates."""
        return self.A.shape[0]

    @property
    def seconds_per_time_unit(self) -> float:
        """Length of the model's time unit in seconds."""
        return SECONDS_PER_TIME_UNIT[self.time_unit]

    @cached_property
    def eigenvalues(self) -> NDArray[np.complex128]:
        """Eigenvalues (n_z,) of A in 1/time unit, slowest (largest real part) first."""
        values = np.linalg.eigvals(self.A).astype(np.complex128)
        return values[np.argsort(-values.real)]

    @cached_property
    def is_hurwitz(self) -> bool:
        """Whether every mode of A decays."""
        return bool(np.all(self.eigenvalues.real < 0.0))

    @cached_property
    def _activation_at_zero(self) -> Array:
        h = np.zeros(self.n_x)
        for weight, bias in self.hidden:
            h = np.tanh(weight @ h + bias)
        return h

    @cached_property
    def _identity_rows(self) -> Array:
        return np.eye(self.n_x)

    def lift(self, x: Array) -> Array:
        """Evaluate z = N(x): (..., n_x) -> (..., n_z)."""
        h = x
        for weight, bias in self.hidden:
            h = np.tanh(h @ weight.T + bias)
        free = (h - self._activation_at_zero) @ self.output.T if self.hidden else x[..., :0]
        return np.concatenate((x, free), axis=-1) if self.identity else free

    def jacobian(self, x: Array) -> Array:
        """Evaluate J_N(x) = dN/dx: (..., n_x) -> (..., n_z, n_x)."""
        return self.lift_and_jacobian(x)[1]

    def lift_and_jacobian(self, x: Array) -> tuple[Array, Array]:
        """Evaluate N(x) and J_N(x) in one forward pass; shapes as in the single methods."""
        h = x
        eye = np.broadcast_to(self._identity_rows, (*x.shape, self.n_x))
        T = eye
        for weight, bias in self.hidden:
            h = np.tanh(h @ weight.T + bias)
            T = (1.0 - h * h)[..., None] * (weight @ T)
        if not self.hidden:
            return x, eye
        free = (h - self._activation_at_zero) @ self.output.T
        J = self.output @ T
        if self.identity:
            return np.concatenate((x, free), axis=-1), np.concatenate((eye, J), axis=-2)
        return free, J

    def secants(self, x: Array, x_ref: Array, w: Array) -> tuple[Array, Array]:
        """
        Evaluate the secants of N and of J_N w between two states, exactly.

        With e = x - x_ref they satisfy N(x) - N(x_ref) = M e and
        J_N(x) w - J_N(x_ref) w = H e; with one hidden layer M is the mean of J_N along the
        segment. Each tanh contributes its divided difference, so nothing cancels as e goes to 0.

        :param x: (n_x,) state.
        :param x_ref: (n_x,) reference.
        :param w: (n_x,) constant direction, e.g. B u_ref.
        :return: M (n_z, n_x) and H (n_z, n_x).
        """
        h, h_ref, p = x, x_ref, w
        T = self._identity_rows
        G = np.zeros((self.n_x, self.n_x))
        for weight, bias in self.hidden:
            a, a_ref = weight @ h + bias, weight @ h_ref + bias
            h, h_ref = np.tanh(a), np.tanh(a_ref)
            slope, slope_of_slope = _divided_differences(a - a_ref, h, h_ref)
            q = weight @ p
            T = weight @ T
            G = (slope_of_slope * q)[:, None] * T + (1.0 - h_ref * h_ref)[:, None] * (weight @ G)
            T = slope[:, None] * T
            p = (1.0 - h * h) * q
        if not self.hidden:
            return T, G
        M, H = self.output @ T, self.output @ G
        if self.identity:
            M = np.concatenate((self._identity_rows, M))
            H = np.concatenate((np.zeros((self.n_x, self.n_x)), H))
        return M, H

    def drift(self, x: Array) -> Array:
        """Evaluate the projected drift J_N(x)^+ A N(x), the model's f: (..., n_x) -> same."""
        z, J = self.lift_and_jacobian(x)
        return (np.linalg.pinv(J) @ (z @ self.A.T)[..., None])[..., 0]


def _divided_differences(delta: Array, t: Array, t_ref: Array) -> tuple[Array, Array]:
    """
    Return the divided differences of tanh and of its derivative between a_ref and a.

    tanh a - tanh b = tanh(a - b) (1 - tanh a tanh b), hence no cancellation at small `delta`.

    :param delta: (h,) a - a_ref.
    :param t: (h,) tanh(a).
    :param t_ref: (h,) tanh(a_ref).
    """
    small = np.abs(delta) < 1e-8
    safe = np.where(small, 1.0, delta)
    slope = np.where(small, 1.0, np.tanh(safe) / safe) * (1.0 - t * t_ref)
    return slope, -(t + t_ref) * slope
