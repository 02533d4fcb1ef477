# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Lifted models with random weights, for tests of what holds for any of them."""

import numpy as np

from koopman_ros.model import Coordinates, LiftedModel, NetworkObservables, Provenance


def coordinates(prefix: str, n: int) -> Coordinates:
    """Return n coordinates with a center, a scale and a box of their own each."""
    index = np.arange(float(n))
    center, scale = 3.0 - 2.0 * index, 0.5 + index
    return Coordinates(
        tuple(f'{prefix}{i}' for i in range(n)), ('K',) * n, center, scale,
        center - 2.0 * scale, center + scale)


def random_network(n_x: int = 2, units: int = 5, *, identity: bool = True, n_free: int = 3,
                   seed: int | np.random.Generator = 0) -> NetworkObservables:
    """Return a network of order one with n_free outputs from so many hidden units."""
    rng = np.random.default_rng(seed)
    return NetworkObservables(
        rng.normal(size=(units, n_x)) / np.sqrt(n_x), rng.normal(size=units),
        rng.normal(size=(n_free, units)) / np.sqrt(units), identity)


def random_lift(n_x: int = 2, units: int = 5, *, identity: bool = True, n_u: int = 1,
                n_free: int = 3, seed: int = 0) -> LiftedModel:
    """Return a model with such a network, and A and B of order one."""
    rng = np.random.default_rng(seed)
    observables = random_network(n_x, units, identity=identity, n_free=n_free, seed=rng)
    n_z = observables.n_z
    return LiftedModel(
        observables=observables,
        A=0.3 * rng.normal(size=(n_z, n_z)) - np.eye(n_z),
        B=rng.normal(size=(n_x, n_u)),
        states=coordinates('x', n_x),
        inputs=coordinates('u', n_u),
        time_unit='min',
        provenance=Provenance('random', seed, 'ab12', {'rw': 0.25, 'cond': 1e3}, '0.1.0'))


def change_of_variable(scale: float = 1.0, gain: float = 1.0) -> LiftedModel:
    """Return the free lift z = tanh(x) of one state, dz/dt = -z + J(x) gain u."""
    c = Coordinates(('x',), ('1',), np.zeros(1), np.array([scale]), -np.ones(1), np.ones(1))
    itself = NetworkObservables(np.eye(1), np.zeros(1), np.eye(1), identity=False)
    return LiftedModel(itself, -np.eye(1), np.array([[gain]]), c, c, 's',
                       Provenance('change of variable'))
