# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Sparse quadratic programs, by their conditions of optimality and another solver."""

import daqp
import numpy as np
import pytest
from scipy import sparse
from scipy.linalg import null_space

from koopman_ros.core.quadratic_program import solve_quadratic_program


def program(seed, p=12, equations=4, rows=20):
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((p, p))
    A, C = rng.standard_normal((equations, p)), rng.standard_normal((rows, p))
    # w = 0 is feasible, at the edge of half of the inequalities
    d = np.maximum(rng.uniform(-1.0, 1.0, rows), 0.0)
    return root @ root.T, 3.0 * rng.standard_normal(p), A, C, d


@pytest.mark.parametrize('seed', range(5))
def test_the_solution_is_that_of_another_solver(seed):
    H, g, A, C, d = program(seed)
    free = null_space(A)
    y, *_ = daqp.solve(np.ascontiguousarray(free.T @ H @ free), free.T @ g,
                       np.ascontiguousarray(C @ free), d, np.full(len(d), -1e30),
                       np.zeros(len(d), np.int32))
    found = solve_quadratic_program(sparse.csr_array(H), g, sparse.csr_array(A),
                                    sparse.csr_array(C), d, size=1.0)
    np.testing.assert_allclose(found, free @ y, rtol=0, atol=1e-6)
    np.testing.assert_allclose(A @ found, 0.0, atol=1e-9)
    assert np.all(C @ found <= d + 1e-9)
    assert np.sum(C @ found > d - 1e-6) > 1


def test_without_inequalities_it_is_one_linear_system():
    H, g, *_ = program(0)
    none = sparse.csr_array((0, len(g)))
    found = solve_quadratic_program(sparse.csr_array(H), g, none, none, np.zeros(0), size=1.0)
    np.testing.assert_allclose(found, -np.linalg.solve(H, g), rtol=1e-9)


def test_a_solution_that_is_not_reached_is_said():
    H, g, A, C, d = program(0)
    with pytest.raises(ValueError, match='after 2 iterations'):
        solve_quadratic_program(sparse.csr_array(H), g, sparse.csr_array(A), sparse.csr_array(C),
                                d, size=1.0, max_iterations=2)
