# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Riccati equations against another solver, to the border of what can be solved; steps."""

import numpy as np
import pytest
from scipy.linalg import block_diag, expm, solve_continuous_are, solve_discrete_are

from koopman_ros.core.integration import runge_kutta_step
from koopman_ros.core.solvers import decaying, over_interval, solve_riccati, spectral_radius
from koopman_ros.core.status import StatusCode

SIZES = [(n, m) for n in range(1, 9) for m in range(1, 4)]


def random_problem(n, m, seed):
    """Return A with modes to either side of the axis, B, a singular Q = C'C and R."""
    rng = np.random.default_rng([n, m, seed])
    A = rng.normal(size=(n, n)) / np.sqrt(n) - 0.3 * np.eye(n)
    C = rng.normal(size=(max(1, n // 2), n))
    W = rng.normal(size=(m, m))
    return A, rng.normal(size=(n, m)), C.T @ C, W @ W.T + 0.3 * np.eye(m)


def residual(P, A, B, Q, R):
    """Evaluate the Riccati equation as it stands in the books, relative to its terms."""
    terms = (A.T @ P, P @ A, -P @ B @ np.linalg.inv(R) @ B.T @ P, Q)
    return np.linalg.norm(sum(terms)) / sum(np.linalg.norm(term) for term in terms)


def assert_close(solution, P, K):
    assert np.linalg.norm(solution.P - P) <= 1e-9 * np.linalg.norm(P)
    assert np.linalg.norm(solution.K - K) <= 1e-9 * np.linalg.norm(K)


@pytest.mark.parametrize('seed', range(5))
def test_random_pairs_against_scipy(seed):
    for n, m in SIZES:
        A, B, Q, R = random_problem(n, m, seed)
        solution = solve_riccati(A, B, Q, R)
        assert solution.solved, (n, m)
        P = solve_continuous_are(A, B, Q, R)
        assert_close(solution, P, np.linalg.solve(R, B.T @ P))
        np.testing.assert_array_equal(solution.P, solution.P.T)
        assert solution.gain == pytest.approx(np.linalg.svd(solution.K)[1][0], rel=1e-12)
        assert solution.residual <= 1e-6
        assert residual(solution.P, A, B, Q, R) <= 1e-6
        np.testing.assert_array_equal(solution.loop, A - B @ solution.K)
        assert np.all(np.linalg.eigvals(solution.loop).real < 0.0)
        # positive semidefinite up to rounding
        assert np.linalg.eigvalsh(solution.P)[0] >= -1e-10 * np.linalg.norm(P)


@pytest.mark.parametrize(('a', 'b', 'q', 'r'), [
    (1.0, 2.0, 3.0, 0.5), (-1.0, 2.0, 3.0, 0.5), (0.0, 1.0, 1.0, 1.0), (5.0, 0.5, 1.0, 10.0),
    (-0.957887316, 2.092050209, 1.0, 0.1), (1e-8, 1e4, 1e8, 1e-4)])
def test_scalar_plants_in_closed_form(a, b, q, r):
    solution = solve_riccati(*(np.array([[value]]) for value in (a, b, q, r)))
    assert solution.solved
    p = r / b ** 2 * (a + np.sqrt(a * a + q * b * b / r))
    assert solution.P[0, 0] == pytest.approx(p, rel=1e-12)
    assert solution.K[0, 0] == pytest.approx(p * b / r, rel=1e-12)


@pytest.mark.parametrize('h', [0.0, 0.3])
@pytest.mark.parametrize('factor', [1e-9, 1e9])
def test_the_unit_of_the_cost_does_not_matter(factor, h):
    for n, m in SIZES:
        A, B, Q, R = random_problem(n, m, seed=7)
        solution = solve_riccati(A, B, Q, R, interval=h)
        other = solve_riccati(A, B, factor * Q, factor * R, interval=h)
        assert other.solved, (n, m)
        assert_close(other, factor * solution.P, solution.K)


def nearly_uncontrollable(reach):
    """Return a plant whose unstable mode is reached by the input no more than `reach`."""
    return np.diag([1.0, -1.0]), np.array([[reach], [1.0]]), np.eye(2), np.eye(1)


@pytest.mark.parametrize('reach', [1e-2, 1e-3, 1e-4])
def test_the_residual_reported_is_that_of_the_solution_and_bounded(reach):
    problem = nearly_uncontrollable(reach)
    solution = solve_riccati(*problem)
    # how large it is depends on how the processor rounds; its own rounding errors are of 1e-16
    assert solution.residual == pytest.approx(residual(solution.P, *problem), rel=1e-2, abs=1e-14)
    strict = solve_riccati(*problem, max_residual=0.5 * solution.residual)
    assert strict.failure is StatusCode.RICCATI_INACCURATE
    assert strict.residual == solution.residual > 0.0


@pytest.mark.parametrize('reach', [0.1, 0.03, 0.01])
def test_a_bound_on_the_gain(reach):
    problem = nearly_uncontrollable(reach)
    # the unstable mode alone asks for 2 / reach
    solution = solve_riccati(*problem)
    assert solution.solved
    assert solution.gain > 2.0 / reach
    assert solve_riccati(*problem, max_gain=1.001 * solution.gain).solved
    rejected = solve_riccati(*problem, max_gain=0.999 * solution.gain)
    assert rejected.failure is StatusCode.GAIN_TOO_LARGE
    assert rejected.gain == solution.gain


@pytest.mark.parametrize('exponent', range(3, 17))
def test_a_nearly_uncontrollable_mode_is_never_solved_within_a_bound(exponent):
    """Closer still, the gain computed is small again: only the residual tells that it is wrong."""
    solution = solve_riccati(*nearly_uncontrollable(10.0 ** -exponent), max_gain=1e3)
    assert solution.failure in (StatusCode.RICCATI_INACCURATE, StatusCode.GAIN_TOO_LARGE,
                               StatusCode.NOT_STABILISABLE)


OSCILLATOR = np.array([[0.0, 2.0], [-2.0, 0.0]])

# A, B, Q in coordinates in which the fault is plain.
BEYOND = {
    'unstable mode out of reach': (
        np.diag([1.0, -1.0, -2.0]), [0.0, 1.0, 1.0], np.eye(3)),
    'unstable mode out of reach that drives another': (
        np.array([[1.0, 0.0], [1.0, -1.0]]), [0.0, 1.0], np.eye(2)),
    'constant mode out of reach': (np.diag([0.0, -1.0]), [0.0, 1.0], np.eye(2)),
    'integrator without weight': (np.diag([0.0, -1.0]), [1.0, 1.0], np.diag([0.0, 1.0])),
    'oscillator without weight': (
        block_diag(OSCILLATOR, -1.0), [0.0, 1.0, 1.0], np.diag([0.0, 0.0, 1.0])),
    'oscillator out of reach': (block_diag(OSCILLATOR, -1.0), [0.0, 0.0, 1.0], np.eye(3)),
}


@pytest.mark.parametrize('h', [0.0, 0.3])
@pytest.mark.parametrize('case', BEYOND)
def test_problems_without_a_stabilising_solution_are_recognised(case, h):
    A, b, Q = BEYOND[case]
    solution = solve_riccati(A, np.array(b)[:, None], Q, np.eye(1), interval=h)
    assert solution.failure is StatusCode.NOT_STABILISABLE
    assert not np.any(solution.K)
    assert not np.any(solution.P)
    assert (solution.gain, solution.residual) == (np.inf, np.inf)
    # nor in other coordinates
    for seed in range(25):
        T = np.random.default_rng(seed).normal(size=A.shape)
        inverse = np.linalg.inv(T)
        solution = solve_riccati(T @ A @ inverse, (T @ b)[:, None], inverse.T @ Q @ inverse,
                                 np.eye(1), interval=h)
        assert not solution.solved, seed


@pytest.mark.parametrize('h', [0.0, 0.3])
def test_riccati_problems_with_bad_numbers_are_not_solved(h):
    for place, name in enumerate('ABQR'):
        for value in (np.nan, np.inf, -np.inf):
            problem = [-np.eye(2), np.eye(2), np.eye(2), np.eye(2)]
            problem[place] = np.full((2, 2), value)
            solution = solve_riccati(*problem, interval=h)
            assert not solution.solved, (name, value)
    solution = solve_riccati(-np.eye(2), np.eye(2), np.zeros((2, 2)), np.eye(2), interval=h)
    assert solution.failure is StatusCode.NOT_STABILISABLE


@pytest.mark.parametrize('h', [0.0, 0.3])
def test_nothing_escapes_at_any_magnitude(h):
    rng = np.random.default_rng(8)
    solved = 0
    for _ in range(1000):
        n, m = int(rng.integers(1, 5)), int(rng.integers(1, 3))
        A, B, Q, R = (array * 10.0 ** rng.uniform(-300.0, 300.0)
                      for array in random_problem(n, m, seed=1))
        solution = solve_riccati(A, B, Q, R, interval=h)
        if solution.solved:
            solved += 1
            assert np.all(np.isfinite(solution.K))
            assert solution.residual <= 1e-6
    assert solved > 10


def test_riccati_without_an_input_gives_its_cost_and_without_an_input_weight_none():
    solution = solve_riccati(-np.eye(2), np.zeros((2, 1)), np.eye(2), np.eye(1))
    assert solution.solved
    np.testing.assert_allclose(solution.P, 0.5 * np.eye(2), rtol=1e-14)
    np.testing.assert_array_equal(solution.K, np.zeros((1, 2)))
    solution = solve_riccati(-np.eye(1), np.eye(1), np.eye(1), np.zeros((1, 1)))
    assert solution.failure is StatusCode.NOT_STABILISABLE


# The sampled regulator.

@pytest.mark.parametrize('h', [0.03, 0.3, 2.0])
def test_sampled_random_pairs_against_scipy(h):
    for n, m in SIZES:
        A, B, Q, R = random_problem(n, m, seed=3)
        # themselves held to an exponential below
        D, W = over_interval(A, B, Q, R, h)
        phi, gamma, N, R_d = np.eye(n) + D[:n, :n], D[:n, n:], W[:n, n:], W[n:, n:]
        solution = solve_riccati(A, B, Q, R, interval=h)
        assert solution.solved
        P = solve_discrete_are(phi, gamma, W[:n, :n], R_d, s=N)
        assert_close(solution, P, np.linalg.solve(
            R_d + gamma.T @ P @ gamma, gamma.T @ P @ phi + N.T))
        np.testing.assert_allclose(solution.loop, phi - gamma @ solution.K, rtol=0, atol=1e-12)
        assert np.max(np.abs(np.linalg.eigvals(solution.loop))) < 1.0


def test_the_cost_of_the_sampled_regulator_is_its_solution_and_minimal():
    """Summed over 100 intervals of 10 Runge-Kutta steps each, for several gains at once."""
    A, B, Q, R = random_problem(3, 1, seed=4)
    h, start = 0.4, np.array([1.0, -0.5, 0.3])
    solution = solve_riccati(A, B, Q, R, interval=h)

    changes = 0.05 * np.vstack((np.zeros(3), np.eye(3), -np.eye(3)))
    gains = np.vstack((solution.K + changes, solve_riccati(A, B, Q, R).K))
    y = np.tile(np.append(start, 0.0), (len(gains), 1))
    for _ in range(100):
        u = -np.sum(gains * y[:, :3], axis=1, keepdims=True)
        effort = R[0, 0] * u ** 2

        def rate(y, u=u, effort=effort):
            x = y[:, :3]
            return np.hstack((x @ A.T + u @ B.T, np.sum(x @ Q * x, 1, keepdims=True) + effort))

        for _ in range(10):
            y = runge_kutta_step(rate, y, h / 10)
    least, *others, continuous = y[:, 3]
    assert least == pytest.approx(start @ solution.P @ start, rel=1e-5)
    assert min(others) > least
    assert continuous > 1.001 * least


def test_the_sampled_gain_tends_to_the_continuous_one():
    for n, m in SIZES:
        problem = random_problem(n, m, seed=5)
        continuous = solve_riccati(*problem).K
        far, near = (solve_riccati(*problem, interval=h).K for h in (2e-6, 1e-6))
        assert np.linalg.norm(far - continuous) > 0.0
        # what remains after the term in h is of its square
        assert np.linalg.norm(2.0 * near - far - continuous) <= 1e-9 * np.linalg.norm(continuous)
        # nor is anything lost where samples come in a burst
        assert solve_riccati(*problem, interval=1e-12).residual <= 1e-9


@pytest.mark.parametrize('rate', [1e3, 1e6, 1e9])
def test_modes_that_decay_within_an_interval(rate):
    """One that only follows the input counts as weight of the input, but for h rate = inf."""
    h, slow = 2.0, np.array([[0.5]])
    A, B = np.diag([-rate, 0.5]), np.array([[rate], [1.0]])
    found = solve_riccati(A, B, np.diag([0.3, 1.0]), 0.2 * np.eye(1), interval=h)
    reduced = solve_riccati(slow, np.eye(1), np.eye(1), 0.5 * np.eye(1), interval=h)
    assert found.solved
    assert found.K[0, 1] == pytest.approx(reduced.K[0, 0], rel=2.0 / (h * rate) + 1e-12)
    # and one without weight that moves nothing else does not count
    found = solve_riccati(A, B, np.diag([0.0, 1.0]), 0.5 * np.eye(1), interval=h)
    np.testing.assert_allclose(found.K, [[0.0, reduced.K[0, 0]]], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize('gain', [1e-2, 1.0, 1e2])
@pytest.mark.parametrize('periods', [1, 2, 5])
def test_samples_as_far_apart_as_a_period_do_not_see_an_oscillation(gain, periods):
    problem = OSCILLATOR, np.array([[0.0], [gain]]), np.eye(2), np.eye(1)
    assert solve_riccati(*problem, interval=0.9 * np.pi).solved
    found = solve_riccati(*problem, interval=periods * np.pi)
    assert not found.solved


# The integrals over an interval, which the sampled regulator is made of.

@pytest.mark.parametrize('h', [1e-9, 1e-3, 0.1, 0.3, 2.0])
def test_the_interval_against_an_exponential_of_blocks(h):
    """Van Loan, 1978: [-F', W; 0, F], and [F, I; 0, 0] for D, which loses no digits."""
    for n, m in SIZES:
        A, B, Q, R = random_problem(n, m, seed=6)
        D, W = over_interval(A, B, Q, R, h)
        N = n + m
        F, weight = np.zeros((N, N)), block_diag(Q, R)
        F[:n, :n], F[:n, n:] = A, B
        block = expm(h * np.block([[-F.T, weight], [np.zeros_like(F), F]]))
        expected = block[N:, N:].T @ block[:N, N:]
        assert np.linalg.norm(W - expected) <= 2e-12 * np.linalg.norm(expected)
        whole = expm(h * np.block([[F, np.eye(N)], [np.zeros((N, 2 * N))]]))
        assert np.linalg.norm(D - F @ whole[:N, N:]) <= 1e-13 * max(
            np.linalg.norm(D), h * np.linalg.norm(F))


@pytest.mark.parametrize('value', [np.nan, np.inf])
@pytest.mark.parametrize('n', [2, 3])
def test_a_matrix_that_is_not_finite_has_no_stable_eigenvalues(n, value):
    for M in (np.full((n, n), value), np.diag([value, *[0.5] * (n - 1)]),
              np.diag([*[0.5] * (n - 1), value])):
        assert spectral_radius(M) == np.inf
    assert spectral_radius(0.5 * np.eye(n)) == 0.5


@pytest.mark.parametrize('seed', range(10))
def test_an_integrator_does_not_decay_on_whichever_side_rounding_leaves_its_eigenvalue(seed):
    rng = np.random.default_rng(seed)
    # an integrator, a double one, and modes that decay
    blocks = (np.zeros((1, 1)), np.eye(2, k=1), np.diag([-1.0, -3.0, -1e-4]))
    T = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    values = np.linalg.eigvals(T @ block_diag(*blocks) @ T.T)
    assert np.count_nonzero(decaying(values)) == 3
    assert np.count_nonzero(decaying(-values)) == 0
    assert not decaying(np.zeros(2, complex)).any()
