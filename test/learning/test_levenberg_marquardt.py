# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Levenberg-Marquardt on problems with known minima, and every way in which it ends."""

from itertools import pairwise
import math

import numpy as np
import pytest
import torch

from koopman_ros.learning.levenberg_marquardt import minimise, MinimumStatus, normal_equations


def least_squares(residual):
    """Turn a residual function into what `minimise` takes."""
    def residuals(theta, equations):
        J = torch.func.jacrev(residual)(theta) if equations.derivatives else None
        equations.add(residual(theta), J)
    return residuals


def cost(residuals, theta):
    return normal_equations(residuals, theta, derivatives=False).cost


def vector(*values):
    return torch.tensor(values, dtype=torch.float64)


def linear_problem(rows=30, columns=6, seed=0):
    generator = torch.Generator().manual_seed(seed)
    J = torch.randn(rows, columns, generator=generator, dtype=torch.float64)
    y = torch.randn(rows, generator=generator, dtype=torch.float64)
    return J, y


def rosenbrock(theta):
    return torch.stack([10.0 * (theta[1] - theta[0] ** 2), 1.0 - theta[0]])


def test_linear_least_squares():
    J, y = linear_problem()
    expected, squares = np.linalg.lstsq(J.numpy(), y.numpy(), rcond=None)[:2]
    for limit in (5, 100):
        found = minimise(least_squares(lambda theta: J @ theta - y), vector(*[3.0] * 6),
                         max_iterations=limit)
        # a cost that is flat to rounding locates its minimum to the square root of that
        np.testing.assert_allclose(found.theta.numpy(), expected, rtol=0, atol=1e-8)
    assert found.status is MinimumStatus.CONVERGED
    assert found.cost == pytest.approx(0.5 * float(squares[0]), rel=1e-12)


@pytest.mark.parametrize('start', [(-1.2, 1.0), (0.0, 0.0), (5.0, -5.0), (-3.0, 10.0)])
def test_rosenbrock_valley(start):
    found = minimise(least_squares(rosenbrock), vector(*start), max_iterations=200)
    assert found.status is MinimumStatus.CONVERGED
    assert found.iterations < 100
    np.testing.assert_allclose(found.theta.numpy(), [1.0, 1.0], rtol=0, atol=1e-9)


def test_a_minimum_that_is_not_zero():
    """The residuals (x, 1 + x^2 / 4) have their least squares, 1, at x = 0."""
    found = minimise(least_squares(lambda t: torch.cat([t, 1.0 + 0.25 * t * t])), vector(2.0),
                     max_iterations=200)
    assert found.status is MinimumStatus.CONVERGED
    assert found.cost == pytest.approx(0.5, rel=1e-9)
    assert abs(float(found.theta[0])) < 1e-4


def test_units_of_parameters_do_not_matter():
    units = vector(1e3, 1e-3)
    one = minimise(least_squares(rosenbrock), vector(-1.2, 1.0), max_iterations=12)
    other = minimise(least_squares(lambda theta: rosenbrock(theta / units)),
                     vector(-1.2, 1.0) * units, max_iterations=12)
    assert other.cost == pytest.approx(one.cost, rel=1e-6)
    np.testing.assert_allclose((other.theta / units).numpy(), one.theta.numpy(), rtol=1e-6)


def test_iteration_limit_is_reported():
    residuals = least_squares(rosenbrock)
    found = minimise(residuals, vector(-1.2, 1.0), max_iterations=4)
    assert found.status is MinimumStatus.MAX_ITERATIONS
    assert found.iterations == 4
    assert found.cost == cost(residuals, found.theta)
    assert found.cost < cost(residuals, vector(-1.2, 1.0))


def test_not_a_number_at_the_start_stalls():
    start = vector(1.0, 2.0)
    found = minimise(least_squares(lambda theta: theta * math.nan), start, max_iterations=50)
    assert found.status is MinimumStatus.STALLED
    assert (found.cost, found.iterations) == (math.inf, 0)
    assert torch.equal(found.theta, start)


@pytest.mark.parametrize('gradient', [1.0, math.nan])
def test_not_a_number_in_the_gradient_or_everywhere_else_stalls(gradient):
    start = vector(1.0, 2.0)

    def residuals(theta, equations):
        elsewhere = 0.0 if torch.equal(theta, start) or math.isnan(gradient) else math.nan
        equations.add_sums(0.5 * float(theta @ theta) + elsewhere, theta * gradient,
                           torch.eye(2).to(start))

    found = minimise(residuals, start, max_iterations=500)
    assert found.status is MinimumStatus.STALLED
    assert found.iterations < 100
    assert torch.equal(found.theta, start)


@pytest.mark.parametrize('end', [1, 3])
def test_interruption_keeps_the_best_so_far(end):
    residuals = least_squares(rosenbrock)
    found = minimise(residuals, vector(-1.2, 1.0), max_iterations=100,
                     monitor=lambda iteration, cost: iteration == end)
    assert found.status is MinimumStatus.INTERRUPTED
    assert found.iterations == end
    assert found.cost == cost(residuals, found.theta)


def test_cost_never_rises():
    costs = []
    found = minimise(least_squares(rosenbrock), vector(-1.2, 1.0), max_iterations=100,
                     monitor=lambda iteration, cost: costs.append(cost))
    assert found.status is MinimumStatus.CONVERGED
    assert all(later <= earlier for earlier, later in pairwise(costs))


def test_every_status_says_what_to_do():
    assert 'increase `max_iterations`' in MinimumStatus.MAX_ITERATIONS.value
    assert 'check the data and try another seed' in MinimumStatus.STALLED.value
    assert 'the best parameters so far are kept' in MinimumStatus.INTERRUPTED.value


def test_the_default_tolerance_is_a_thousandth_over_twenty_steps():
    """A cost that falls by `share` in each step goes on while 20 steps lower it by 1/1000."""
    def steps(share, limit):
        costs = iter(range(10 * limit))

        def residuals(theta, equations):
            # every trial is followed by an evaluation with derivatives at the same place
            equations.add_sums((1.0 - share) ** ((next(costs) + 1) // 2), vector(-1e-3),
                               torch.eye(1).double())

        return minimise(residuals, vector(0.0), max_iterations=limit)

    assert steps(6e-5, 200).status is MinimumStatus.MAX_ITERATIONS
    found = steps(4e-5, 200)
    assert (found.status, found.iterations) == (MinimumStatus.CONVERGED, 20)


@pytest.mark.parametrize('derivatives_too', [True, False])
def test_an_interrupt_from_the_keyboard_keeps_the_best_so_far(derivatives_too):
    valley, calls = least_squares(rosenbrock), []

    def residuals(theta, equations):
        calls.append(theta)
        if len(calls) > 6 and equations.derivatives is derivatives_too:
            raise KeyboardInterrupt
        valley(theta, equations)

    start = vector(-1.2, 1.0)
    found = minimise(residuals, start, max_iterations=100)
    assert found.status is MinimumStatus.INTERRUPTED
    assert found.cost == cost(valley, found.theta) < cost(valley, start)


def test_an_interrupt_of_the_first_evaluation_passes_on():
    def residuals(theta, equations):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        minimise(residuals, vector(1.0), max_iterations=10)


@pytest.mark.parametrize('count', [1, 7])
def test_blocks_of_residuals_add_up(count):
    J, y = linear_problem()
    theta = vector(*range(6))

    def residuals(theta, equations):
        for rows in (slice(0, 11), slice(11, 30)):
            equations.add(J[rows] @ theta - y[rows], J[rows], count)

    found, r = normal_equations(residuals, theta), J @ theta - y
    assert found.cost == pytest.approx(0.5 * float(r @ r) / count, rel=1e-14)
    torch.testing.assert_close(found.gradient, J.T @ r / count, rtol=1e-13, atol=1e-13)
    torch.testing.assert_close(found.matrix, J.T @ J / count, rtol=1e-13, atol=1e-13)
