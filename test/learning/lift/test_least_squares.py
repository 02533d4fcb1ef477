# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Levenberg-Marquardt, and what it minimises: parameters, a pass, residuals, their derivatives."""

from functools import partial
import math

import numpy as np
import pytest
import torch

from koopman_ros.learning.lift.levenberg_marquardt import minimise, MinimumStatus, normal_equations
from koopman_ros.learning.lift.network import Layout, Pass
from koopman_ros.learning.lift.residuals import LiftProblem, ResidualWeights, ScaledSamples
from koopman_ros.model import NetworkObservables

COUNT = 11

# torch's own import of its forward derivatives
pytestmark = pytest.mark.filterwarnings('ignore:`torch.jit.script` is deprecated')

identity_or_free = pytest.mark.parametrize('identity', [True, False], ids=['identity', 'free'])


def normals(seed):
    """Return a source of normally distributed tensors."""
    return partial(torch.randn, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@identity_or_free
def test_training_and_run_time_evaluate_the_same_network(identity):
    layout = Layout(2, 4, 5, identity)
    normal = normals(0)
    parts, x, f = layout.split(normal(layout.size)), normal(20, 2), normal(20, 2)
    lifted = Pass(layout, parts, x, f)
    z, J = NetworkObservables(parts.W.numpy(), parts.b.numpy(), parts.V.numpy(),
                              identity).lift_and_jacobian(x.numpy())
    np.testing.assert_allclose(lifted.z, z, rtol=0, atol=1e-14)
    np.testing.assert_allclose(lifted.z_rate, (J @ f.numpy()[..., None])[..., 0],
                               rtol=0, atol=1e-14)


def random_problem(layout, weights, chunk=4, seed=1):
    """Return a problem and parameters of order one; the chunk does not divide the samples."""
    normal = normals(seed)
    data = ScaledSamples(normal(COUNT, layout.n_x), normal(COUNT, layout.n_x),
                         normal(COUNT, layout.n_u) if layout.n_u else None)
    return LiftProblem(layout, data, weights, chunk), normal(layout.size)


def residuals(theta, of):
    """Write the three residuals as the paper and the docstring have them."""
    layout, data, weights = of.layout, of.data, of.weights
    parts = layout.split(theta)

    def network(x):
        return torch.tanh(x @ parts.W.T + parts.b) @ parts.V.T

    def N(x):
        free = network(x) - network(torch.zeros_like(x))
        return torch.cat([x, free], 1) if layout.identity else free

    f = data.f if parts.B is None else data.f - data.u @ parts.B.T
    z, dz = torch.func.jvp(N, (data.x,), (f,))
    stack = [(dz - z @ parts.A.T).flatten() / COUNT ** 0.5]
    if weights.whitening:
        moment = z.T @ z / COUNT - torch.eye(layout.n_z, dtype=torch.float64)
        # entries of identity coordinates alone do not depend on the parameters
        fixed = layout.n_z - layout.n_free
        stack += [weights.whitening ** 0.5 * part.flatten()
                  for part in (moment[fixed:], moment[:fixed, fixed:])]
    if weights.decoder:
        W, b, V, c = parts.decoder
        back = torch.tanh(z @ W.T + b) @ V.T + c
        stack.append(weights.decoder ** 0.5 * (data.x - back).flatten() / COUNT ** 0.5)
    return torch.cat(stack)


def assert_normal_equations(of, theta):
    """Compare with automatic differentiation to 1e-12 of the largest entry."""
    r, J = residuals(theta, of), torch.func.jacrev(residuals)(theta, of)
    normal = normal_equations(of.add_residuals, theta)
    assert normal.cost == pytest.approx(0.5 * float(r @ r), rel=1e-12), of.layout
    for actual, expected in ((normal.gradient, J.T @ r), (normal.matrix, J.T @ J)):
        torch.testing.assert_close(
            actual, expected, rtol=0, atol=1e-12 * float(expected.abs().max()),
            msg=lambda text: f'{of.layout}\n{text}')


@identity_or_free
@pytest.mark.parametrize('n_u', [0, 2])
@pytest.mark.parametrize('weights', [
    ResidualWeights(), ResidualWeights(whitening=2.0), ResidualWeights(decoder=3.0),
    ResidualWeights(whitening=0.7, decoder=0.3)], ids=str)
def test_normal_equations(identity, n_u, weights):
    """Every term alone and together, for several numbers of states."""
    for n_x in (1, 3):
        assert_normal_equations(*random_problem(
            Layout(n_x, n_x + 2, 4, identity, n_u, 3), weights))


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


def rosenbrock(theta):
    return torch.stack([10.0 * (theta[1] - theta[0] ** 2), 1.0 - theta[0]])


def test_linear_least_squares():
    generator = torch.Generator().manual_seed(0)
    J, y = (torch.randn(*shape, generator=generator, dtype=torch.float64)
            for shape in ((30, 6), (30,)))
    expected, squares = np.linalg.lstsq(J.numpy(), y.numpy(), rcond=None)[:2]
    found = minimise(least_squares(lambda theta: J @ theta - y), vector(*[3.0] * 6),
                     max_iterations=100)
    # a cost that is flat to rounding locates its minimum to the square root of that
    np.testing.assert_allclose(found.theta.numpy(), expected, rtol=0, atol=1e-8)
    assert found.status is MinimumStatus.CONVERGED
    assert found.cost == pytest.approx(0.5 * float(squares[0]), rel=1e-12)


@pytest.mark.parametrize('place', ['the start', 'the gradient', 'everywhere else'])
def test_not_a_number_stalls(place):
    start = vector(1.0, 2.0)

    def residuals(theta, equations):
        bad = {'the start': True, 'the gradient': False,
               'everywhere else': not torch.equal(theta, start)}[place]
        equations.add_sums(math.nan if bad else 0.5 * float(theta @ theta),
                           theta * (math.nan if place == 'the gradient' else 1.0),
                           torch.eye(2).to(start))

    found = minimise(residuals, start, max_iterations=500)
    assert found.status is MinimumStatus.STALLED
    assert (found.iterations == 0) is (place == 'the start')
    assert found.iterations < 100
    assert torch.equal(found.theta, start)


@pytest.mark.parametrize(('limit', 'end', 'status'), [
    (4, 100, MinimumStatus.MAX_ITERATIONS), (100, 3, MinimumStatus.INTERRUPTED)])
def test_a_limit_or_an_interruption_keeps_the_best_so_far(limit, end, status):
    residuals = least_squares(rosenbrock)
    found = minimise(residuals, vector(-1.2, 1.0), max_iterations=limit,
                     monitor=lambda iteration, cost: iteration == end)
    assert (found.status, found.iterations) == (status, min(limit, end))
    assert found.cost == cost(residuals, found.theta) < cost(residuals, vector(-1.2, 1.0))


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
    # of the first evaluation there is nothing to keep
    if derivatives_too:
        with pytest.raises(KeyboardInterrupt):
            minimise(residuals, start, max_iterations=10)
