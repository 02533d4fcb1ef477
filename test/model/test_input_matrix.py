# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""An input matrix that depends on the state: against differences, averages and its own weights."""

import numpy as np

from koopman_ros.model import InputTerms

TERMS = InputTerms(np.random.default_rng(0).standard_normal((9, 2, 3)))


def value(x, u):
    return TERMS.matrix(x) @ u


def test_derivative_and_average_are_those_of_the_polynomial():
    rng = np.random.default_rng(1)
    x, x_ref, u = rng.uniform(-1.0, 1.0, 2), rng.uniform(-1.0, 1.0, 2), rng.uniform(-1.0, 1.0, 3)
    step = 1e-6
    slope = np.stack([(value(x + step * e, u) - value(x - step * e, u)) / (2.0 * step)
                      for e in np.eye(2)], axis=-1)
    np.testing.assert_allclose(TERMS.jacobian(x, u), slope, rtol=0, atol=1e-8)
    averaged = TERMS.averaged_jacobian(x, x_ref, u)
    np.testing.assert_allclose(averaged @ (x - x_ref), value(x, u) - value(x_ref, u),
                               rtol=0, atol=1e-13)
    shares = (np.arange(20_000) + 0.5) / 20_000
    mean = TERMS.jacobian(x_ref + shares[:, None] * (x - x_ref), np.tile(u, (20_000, 1))).mean(0)
    np.testing.assert_allclose(averaged, mean, rtol=0, atol=1e-8)
    # many at once
    np.testing.assert_allclose(TERMS.jacobian(np.stack([x, x_ref]), np.stack([u, u]))[0],
                               TERMS.jacobian(x, u), rtol=0, atol=1e-14)


def test_weights_of_the_regressors_are_the_matrix_and_its_terms():
    rng = np.random.default_rng(2)
    weights, x, u = rng.standard_normal((2, 30)), rng.uniform(size=(50, 2)), rng.uniform(
        size=(50, 3))
    B, terms = InputTerms.split(weights, 3)
    expected = ((B + terms.matrix(x)) @ u[..., None])[..., 0]
    np.testing.assert_allclose(InputTerms.regressors(x, u, 3) @ weights.T, expected,
                               rtol=0, atol=1e-13)
    assert InputTerms.split(weights[:, :3], 3)[1] is None
