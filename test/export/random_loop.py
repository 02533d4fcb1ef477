# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Loops of random models and tunings, of every kind that can be exported."""

from dataclasses import replace
import math
from typing import Any

import numpy as np

from koopman_ros.control import Controller
from koopman_ros.core.signals import Outputs
from koopman_ros.model import (
    Coordinates,
    LiftedModel,
    NetworkObservables,
    PolynomialObservables,
)
from koopman_ros.model.input_matrix import InputTerms
from koopman_ros.model.lifted_model import Provenance
from koopman_ros.model.training_data import TrainingStates, VerifiedLoops
from koopman_ros.tuning import InputLimits, SensorLimits, Tuning

INTERVAL = 0.5  # s


def random_loop(seed: int) -> Controller:
    """Return the loop of a number, with a time constant of about 20 s."""
    rng = np.random.default_rng(seed)
    model = _model(rng)
    n, m, names = model.n_x, model.n_u, model.states.names

    def some(*values: Any) -> Any:
        return values[rng.integers(len(values))]

    partly = n > 1 and m < n and rng.random() < 0.5
    C = np.eye(n)[:max(1, n - 1)] if partly else np.eye(n)
    outputs = Outputs(names[:len(C)], model.states.units[:len(C)], C)
    half = 0.5 * (model.states.upper - model.states.lower)
    controlled = names[:m] if m < n else some(names, names[:1])
    inputs = model.inputs
    return Controller(model, Tuning.for_model(
        model, controlled=controlled,
        limits=InputLimits(inputs.lower, inputs.upper, some(np.full(m, np.inf), inputs.scale)),
        dead_time=some(np.full(m, -1.0), np.full(m, 1.7), rng.uniform(0.0, 3.0, m)),
        sensor=SensorLimits(
            np.full(len(C), -1e9), np.full(len(C), 1e9), some(np.full(len(C), np.inf), half[
                :len(C)]), some(np.full(len(C), np.inf), 0.1 * half[:len(C)]), 3.0),
        setpoint_ramp=some(np.full(len(controlled), np.inf), 0.05 * np.ones(len(controlled))),
        setpoint_filter_time=some(0.0, 5.0),
        estimator='extended_kalman_filter' if partly else some(
            '', 'measured_state', 'extended_kalman_filter'),
        observer_bandwidth=some(0.0, 0.3),
        max_disturbance=some(np.full(m, np.inf), 0.3 * inputs.scale),
        tracking_tolerance=0.01 * inputs.scale, measurement_noise=np.zeros(len(C)),
        disturbance_noise=np.zeros(m), initial_error=np.zeros(n),
        fallback_order=some(('sdre', 'linear'), ('sdre',), ('linear',)),
        hold_timeout=some(2.0, 20.0), recovery_time=2.0, bumpless_transfer_time=some(0.0, 4.0),
        safe_value=some(inputs.center, inputs.lower)), outputs)


def _model(rng: np.random.Generator) -> LiftedModel:
    n, m = int(rng.integers(1, 4)), int(rng.integers(1, 3))
    identity, h = bool(rng.random() < 0.6), 6
    if rng.random() < 0.3:
        lift: Any = PolynomialObservables.total_degree(n, int(rng.integers(2, 4)))
    else:
        free = int(rng.integers(0, 4)) if identity else n + int(rng.integers(0, 2))
        V = 0.3 * rng.normal(size=(free, h)) / math.sqrt(h)
        W = rng.normal(size=(h, n))
        if not identity:
            V[:n] += np.linalg.pinv(W)
        lift = NetworkObservables(W, 0.3 * rng.normal(size=h), V, identity)
    features = lift.features.n_z
    A = -np.diag(rng.uniform(0.5, 3.0, lift.n_z)) + 0.2 * rng.normal(size=(lift.n_z, lift.n_z))
    readout = None
    if rng.random() < 0.4:
        readout = 0.1 * rng.normal(size=(n, features))
        readout[:, :n] -= np.diag(rng.uniform(0.5, 3.0, n))
    B = np.eye(n, m) + 0.3 * rng.normal(size=(n, m))
    states = Coordinates(tuple('xyz'[:n]), ('m',) * n, rng.normal(size=n), rng.uniform(
        0.5, 2.0, n), np.zeros(n), np.ones(n))
    states = replace(states, lower=states.center - states.scale, upper=states.center + (
        states.scale))
    inputs = Coordinates(tuple('uv'[:m]), ('V',) * m, rng.normal(size=m), rng.uniform(
        0.5, 2.0, m), np.full(m, -10.0), np.full(m, 10.0))
    inputs = replace(inputs, lower=inputs.center - 2.0 * inputs.scale,
                     upper=inputs.center + 2.0 * inputs.scale)
    some = rng.uniform(-1.0, 1.0, (30, n))
    return LiftedModel(
        lift, 3.0 * A, 3.0 * B, states, inputs, 'min', Provenance('random'),
        training_states=TrainingStates(some, 0.3) if rng.random() < 0.5 else None,
        readout=None if readout is None else 3.0 * readout,
        input_terms=InputTerms(0.2 * rng.normal(size=(PolynomialObservables.total_degree(
            n, 2).n_z, n, m))) if rng.random() < 0.3 else None,
        pre_feedback=0.2 * rng.normal(size=(m, n)) if rng.random() < 0.3 else None,
        verified_loops=VerifiedLoops(some, rng.uniform(-1.0, 1.0, (30, n)), rng.random(30) < 0.3)
        if rng.random() < 0.3 else None,
        dead_time=rng.choice([0.0, 1.0], m))
