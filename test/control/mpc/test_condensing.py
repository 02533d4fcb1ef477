# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Compiled drift, roll-out and condensing against finite differences and SciPy."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from koopman_ros.control.mpc.condensing import condense, drift, roll_out
from koopman_ros.control.mpc.model_arrays import model_arrays
from koopman_ros.model import InputTerms, LiftedModel, PolynomialObservables
from support.random_lifts import random_lift

RNG = np.random.default_rng(0)


def with_readout(model: LiftedModel) -> LiftedModel:
    n_phi = model.observables.features.n_z
    return replace(model, readout=RNG.normal(size=(model.n_x, n_phi)) / n_phi)


def polynomial(model: LiftedModel) -> LiftedModel:
    lift = PolynomialObservables.total_degree(model.n_x, 3)
    return replace(model, observables=lift, A=0.3 * RNG.normal(size=(lift.n_z, lift.n_z)))


def with_input_terms(model: LiftedModel) -> LiftedModel:
    count = PolynomialObservables.total_degree(model.n_x, 2).n_z
    return replace(model, input_terms=InputTerms(RNG.normal(size=(count, *model.B.shape))))


# a model of each kind that the compiled functions distinguish
MODELS = {
    'identity lift': random_lift(2, n_u=1),
    'identity lift, one state': random_lift(1, n_u=1),
    'free lift': random_lift(2, identity=False, n_u=2),
    'read-out': with_readout(random_lift(3, n_u=2)),
    'polynomial': polynomial(random_lift(2, n_u=1)),
    'polynomial, read-out': with_readout(polynomial(random_lift(2, n_u=1))),
    'pre-feedback': replace(random_lift(2, n_u=1), pre_feedback=np.array([[0.4, -0.7]])),
    'B(x)': with_input_terms(random_lift(2, n_u=2)),
    'linear': random_lift(2, n_u=1).linearised,
}


def differences(function: Callable[[np.ndarray], np.ndarray], x: np.ndarray) -> np.ndarray:
    """Return the Jacobian of a function by central differences, the last axis that of x."""
    return np.stack([(function(x + step) - function(x - step)) / 2e-5
                     for step in 1e-5 * np.eye(len(x))], axis=-1)


@pytest.mark.parametrize('model', MODELS.values(), ids=MODELS)
def test_drift_and_its_jacobian(model: LiftedModel) -> None:
    x = 0.5 * RNG.normal(size=(6, model.n_x))
    f, J = drift(model_arrays(model), x)
    np.testing.assert_allclose(f, model.drift(x), rtol=1e-9, atol=1e-10)
    for row, slope in zip(x, J, strict=True):
        np.testing.assert_allclose(slope, differences(model.drift, row), rtol=1e-6, atol=1e-7)


def simulated(model: LiftedModel, x: np.ndarray, u: np.ndarray, w: np.ndarray, length: float,
              rate: Callable[[np.ndarray], float] = lambda _: 0.0) -> np.ndarray:
    """Return the state after an interval, and the integral of a rate of cost."""
    def rates(_: float, y: np.ndarray) -> np.ndarray:
        state = y[:-1]
        return np.append(model.drift(state) + model.forcing(state, u) + w, rate(state))

    return solve_ivp(rates, (0.0, length), np.append(x, 0.0), rtol=1e-10, atol=1e-12).y[:, -1]


@pytest.mark.parametrize('model', MODELS.values(), ids=MODELS)
def test_roll_out_with_its_sensitivities_and_cost(model: LiftedModel) -> None:
    n, m = model.B.shape
    u, x = RNG.normal(size=(2, m)), 0.3 * RNG.normal(size=(3, n))
    w, x_ref, u_ref = 0.1 * RNG.normal(size=n), RNG.normal(size=(2, n)), RNG.normal(size=(2, m))
    lengths, Q, R = np.array([0.1, 0.2]), np.diag(1.0 + np.arange(n)), np.diag(2.0 + np.arange(m))
    ends, cost = roll_out(model_arrays(model), u, x, w, x_ref, u_ref, lengths, 10, Q, R)

    for k, length in enumerate(lengths):
        def interval(deviation: np.ndarray, k: int = k, length: float = length) -> np.ndarray:
            """Return end and cost of node and input with a deviation."""
            v = u[k] + deviation[n:]
            return simulated(model, x[k] + deviation[:n], v, w, length, lambda state: (
                (state - x_ref[k]) @ Q @ (state - x_ref[k])
                + (v - u_ref[k]) @ R @ (v - u_ref[k])))

        exact, slope = interval(np.zeros(n + m)), differences(interval, np.zeros(n + m))
        np.testing.assert_allclose(ends[k, :, 0], exact[:n], rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(ends[k, :, 1:], slope[:n], rtol=1e-4, atol=1e-5)
        # the last block leaves out the curvature of the trajectory (Gauss and Newton)
        np.testing.assert_allclose(cost[k, 0, 0], exact[n], rtol=1e-4)
        np.testing.assert_allclose(2.0 * cost[k, 1:, 0], slope[n], rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(cost[k], cost[k].T)


def test_condensed_cost_is_that_of_the_simulated_plan() -> None:
    """Of a linear plant the quadratic program is exact."""
    model = MODELS['linear']
    n, m, N, Q, R = 2, 1, 4, np.diag([1.0, 3.0]), np.array([[0.5]])
    u, x = RNG.normal(size=(N, m)), RNG.normal(size=(N + 1, n))
    start, w, x_ref, u_ref = (RNG.normal(size=size) for size in (n, n, n, m))
    lengths, terminal = np.array([0.1, 0.15, 0.2, 0.3]), np.array([[2.0, 0.3], [0.3, 1.0]])
    ends, cost = roll_out(model_arrays(model), u, x, w, np.tile(x_ref, (N, 1)),
                          np.tile(u_ref, (N, 1)), lengths, 20, Q, R)
    nodes, by_inputs, H, f = condense(x, start, x_ref, ends, cost, terminal)

    def simulate(v: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the cost and the nodes of changed inputs."""
        state, total, path = start, 0.0, [start]
        for held, length in zip(u + v.reshape(N, m), lengths, strict=True):
            def rate(at: np.ndarray, e_u: np.ndarray = held - u_ref) -> float:
                return (at - x_ref) @ Q @ (at - x_ref) + e_u @ R @ e_u

            *state, part = simulated(model, np.array(state), held, w, length, rate)
            total += part
            path.append(np.array(state))
        return total + (state - x_ref) @ terminal @ (state - x_ref), np.array(path)

    before, path = simulate(np.zeros(N * m))
    np.testing.assert_allclose(nodes, path, atol=1e-7)
    np.testing.assert_array_equal(H, H.T)
    for v in RNG.normal(size=(3, N * m)):
        after, path = simulate(v)
        np.testing.assert_allclose(v @ H @ v + 2.0 * f @ v, after - before, rtol=1e-6)
        np.testing.assert_allclose(nodes + by_inputs @ v, path, atol=1e-7)


def test_nan_stays_nan_in_its_own_row() -> None:
    f, J = drift(model_arrays(MODELS['free lift']), np.array([[np.nan, 0.0], [0.1, 0.2]]))
    assert not np.isfinite(f[0]).all()
    assert not np.isfinite(J[0]).all()
    assert np.isfinite(f[1]).all()
