# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Activations of a network, with slopes and divided differences in which nothing cancels.

The divided difference of f between a and b is (f(a) - f(b)) / (a - b), and f'(a) where a = b.
Each is rewritten by an identity of its function, so that it stays correct to rounding, relative
to the largest slope, however close a and b are.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from koopman_ros.arrays import Array


@dataclass(frozen=True)
class Activation:
    """An activation f, applied to each element; every array has the same shape."""

    value: Callable[[Array], Array]  #: a -> f(a)
    slope: Callable[[Array, Array], Array]  #: a, f(a) -> f'(a)
    #: a, b, f(a), f(b) -> those of f and of f' between a and b
    divided_differences: Callable[[Array, Array, Array, Array], tuple[Array, Array]]


def activation_named(name: str) -> Activation:
    """Return the activation of this name; raise ValueError with the known names where none is."""
    # not by hash: what a file holds in the place of a name may have none
    if name not in tuple(ACTIVATIONS):
        known = ', '.join(map(repr, ACTIVATIONS))
        raise ValueError(f'activation must be one of {known}, got {name!r}')
    return ACTIVATIONS[name]


def _per_delta(function: Callable[[Array], Array], delta: Array) -> Array:
    """Return function(delta) / delta of tanh or sin, which is 1 at 0."""
    # only differences for which the ratio is 1 to rounding change by this
    apart = delta + np.copysign(1e-300, delta)
    return function(apart) / apart


def _tanh_slope(a: Array, t: Array) -> Array:
    return 1.0 - t * t


def _tanh_differences(a: Array, b: Array, t_a: Array, t_b: Array) -> tuple[Array, Array]:
    """Use tanh a - tanh b = tanh(a - b) (1 - tanh a tanh b)."""
    slope = _per_delta(np.tanh, a - b) * (1.0 - t_a * t_b)
    return slope, -(t_a + t_b) * slope


def _sigmoid(a: Array) -> Array:
    e = np.exp(-np.abs(a))
    return np.where(a < 0.0, e, 1.0) / (1.0 + e)


def _sigmoid_slope(a: Array, s: Array) -> Array:
    return s * (1.0 - s)


def _sigmoid_differences(a: Array, b: Array, s_a: Array, s_b: Array) -> tuple[Array, Array]:
    """Use the identity of tanh, as sigmoid a = (1 + tanh(a / 2)) / 2, and s' = s - s^2."""
    mean = s_a * (1.0 - s_b) + s_b * (1.0 - s_a)
    slope = 0.5 * _per_delta(np.tanh, 0.5 * (a - b)) * mean
    return slope, (1.0 - s_a - s_b) * slope


def _sine_slope(a: Array, s: Array) -> Array:
    return np.cos(a)


def _sine_differences(a: Array, b: Array, s_a: Array, s_b: Array) -> tuple[Array, Array]:
    """Use sin a - sin b = 2 cos((a + b) / 2) sin((a - b) / 2), and its like for the cosine."""
    middle = 0.5 * (a + b)
    ratio = _per_delta(np.sin, 0.5 * (a - b))
    return np.cos(middle) * ratio, -np.sin(middle) * ratio


def _softplus(a: Array) -> Array:
    return np.logaddexp(0.0, a)


def _softplus_slope(a: Array, p: Array) -> Array:
    return _sigmoid(a)


def _softplus_differences(a: Array, b: Array, p_a: Array, p_b: Array) -> tuple[Array, Array]:
    """
    Use softplus a - softplus b = log(1 + sigmoid(b) (exp(a - b) - 1)).

    That exponential overflows where a and b are far apart; there nothing cancels.
    """
    delta = a - b
    small, far = np.abs(delta) < 1e-8, np.abs(delta) > 1.0
    safe = np.where(small | far, 1.0, delta)
    s_a, s_b = _sigmoid(a), _sigmoid(b)
    near = np.where(small, 0.5 * (s_a + s_b), np.log1p(s_b * np.expm1(safe)) / safe)
    slope = np.where(far, (p_a - p_b) / np.where(far, delta, 1.0), near)
    return slope, _sigmoid_differences(a, b, s_a, s_b)[0]


ACTIVATIONS: Mapping[str, Activation] = MappingProxyType({
    'tanh': Activation(np.tanh, _tanh_slope, _tanh_differences),
    'sigmoid': Activation(_sigmoid, _sigmoid_slope, _sigmoid_differences),
    'sine': Activation(np.sin, _sine_slope, _sine_differences),
    'softplus': Activation(_softplus, _softplus_slope, _softplus_differences),
})
