# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The hand-derived normal equations against automatic differentiation of the plain residuals."""

from dataclasses import replace
import itertools
from pathlib import Path
import subprocess
import sys

import pytest
import torch

import koopman_ros
from koopman_ros.learning.levenberg_marquardt import normal_equations
from koopman_ros.learning.network import Layout
from koopman_ros.learning.residuals import Problem, ResidualWeights, ScaledSamples

FUNCTIONS = {'tanh': torch.tanh, 'sigmoid': torch.sigmoid, 'sine': torch.sin,
             'softplus': torch.nn.functional.softplus}
COUNT = 11

# torch's own import of its forward derivatives
pytestmark = pytest.mark.filterwarnings('ignore:`torch.jit.script` is deprecated')

every_depth = pytest.mark.parametrize('hidden', [(5,), (4, 3), (3, 4, 2)], ids=str)
every_activation = pytest.mark.parametrize('activation', FUNCTIONS)
identity_or_free = pytest.mark.parametrize('identity', [True, False], ids=['identity', 'free'])


def random_problem(layout, weights, chunk=4, seed=1):
    """Return a problem and parameters of order one; the chunk does not divide the samples."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    data = ScaledSamples(normal(COUNT, layout.n_x), normal(COUNT, layout.n_x),
                normal(COUNT, layout.n_u) if layout.n_u else None)
    return Problem(layout, data, weights, chunk), normal(layout.size)


def residuals(theta, of):
    """Write the three residuals as the paper and the docstring have them."""
    layout, data, weights = of.layout, of.data, of.weights
    parts, function = layout.split(theta), FUNCTIONS[layout.activation]

    def network(x):
        for W, b in parts.hidden:
            x = function(x @ W.T + b)
        return x @ parts.V.T if parts.hidden else x[:, :0]

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
    assert_close(normal.gradient, J.T @ r, of=of)
    assert_close(normal.matrix, J.T @ J, of=of)


def assert_close(actual, expected, tolerance=1e-12, of=None):
    torch.testing.assert_close(
        actual, expected, rtol=0, atol=tolerance * float(expected.abs().max()),
        msg=lambda text: f'{of.layout if of else ""}\n{text}')


@every_depth
@every_activation
def test_normal_equations(hidden, activation):
    """Every combination of the other sizes, with two of three numbers of states."""
    for number, (identity, n_u, decoder) in enumerate(
            itertools.product((True, False), (0, 2), (0, 3))):
        for n_x in (1 + number % 3, 1 + (number + 1) % 3):
            layout = Layout(n_x, n_x + 2, hidden, identity, activation, n_u, decoder)
            assert_normal_equations(*random_problem(
                layout, ResidualWeights(whitening=0.7, decoder=0.3 if decoder else 0.0)))


@every_depth
@identity_or_free
@pytest.mark.parametrize('weights', [
    ResidualWeights(), ResidualWeights(whitening=2.0), ResidualWeights(decoder=3.0)], ids=str)
def test_each_term_alone(hidden, identity, weights):
    """The term besides that of the dynamics is found as the difference from the dynamics alone."""
    of, theta = random_problem(Layout(2, 3, hidden, identity, decoder=3), weights)
    assert_normal_equations(of, theta)
    alone = normal_equations(of.with_weights(ResidualWeights()).add_residuals, theta)
    dynamics = COUNT * of.layout.n_z
    r, J = residuals(theta, of), torch.func.jacrev(residuals)(theta, of)
    both = normal_equations(of.add_residuals, theta)
    assert both.cost - alone.cost == pytest.approx(0.5 * float(r[dynamics:] @ r[dynamics:]),
                                                   rel=1e-11, abs=1e-15)
    J = J[dynamics:]
    torch.testing.assert_close(both.matrix - alone.matrix, J.T @ J, rtol=0,
                               atol=1e-12 * float(both.matrix.abs().max()))


def test_the_lift_without_a_network_is_linear_regression():
    of, theta = random_problem(Layout(2, 2, (), True, n_u=1), ResidualWeights())
    assert_normal_equations(of, theta)


LAYOUT = Layout(2, 4, (5,), True, n_u=1, decoder=3)
ALL_TERMS = ResidualWeights(whitening=0.5, decoder=0.2)


@pytest.mark.parametrize('chunk', [1, 3, 10, 11, 12])
def test_chunks_add_up(chunk):
    of, theta = random_problem(LAYOUT, ALL_TERMS, chunk=4096)
    whole = normal_equations(of.add_residuals, theta)
    parts = normal_equations(replace(of, chunk=chunk).add_residuals, theta)
    assert parts.cost == pytest.approx(whole.cost, rel=1e-13)
    assert_close(parts.gradient, whole.gradient, 1e-13)
    assert_close(parts.matrix, whole.matrix, 1e-13)


def test_cost_alone_is_the_same_cost():
    of, theta = random_problem(LAYOUT, ALL_TERMS)
    alone = normal_equations(of.add_residuals, theta, derivatives=False)
    assert not alone.gradient.any()
    assert alone.cost == normal_equations(of.add_residuals, theta).cost


def test_other_weights_leave_the_rest():
    of, _ = random_problem(LAYOUT, ALL_TERMS)
    other = of.with_weights(ResidualWeights(1.0))
    assert (other.layout, other.chunk, other.weights) == (of.layout, 4, ResidualWeights(1.0))
    assert other.data is of.data


def test_b_needs_inputs():
    with pytest.raises(ValueError, match='the inputs are needed to learn B'):
        Problem(LAYOUT, ScaledSamples(torch.zeros(3, 2), torch.zeros(3, 2)), ResidualWeights())


def test_a_decoder_weight_needs_a_decoder():
    with pytest.raises(ValueError, match='a decoder weight needs a decoder network'):
        Problem(Layout(1, 2, (3,), True), ScaledSamples(torch.zeros(3, 1), torch.zeros(3, 1)),
                ResidualWeights(decoder=1.0))


MEMORY = """
import resource
from koopman_ros.learning.network import Layout
from koopman_ros.learning.residuals import Problem, ResidualWeights
from koopman_ros.learning.residuals import ScaledSamples
from koopman_ros.learning.levenberg_marquardt import normal_equations
import torch
torch.set_num_threads(1)
layout = Layout(2, 5, (8,), True)
theta = 0.1 * torch.ones(layout.size, dtype=torch.float64)
peaks = []
for count in (6_000, 60_000):
    x = torch.linspace(-1.0, 1.0, 2 * count, dtype=torch.float64).view(count, 2)
    problem = Problem(layout, ScaledSamples(x, x), ResidualWeights(1.0))
    normal_equations(problem.add_residuals, theta)
    peaks.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
print(peaks[1] - peaks[0])
"""


def test_memory_does_not_grow_with_the_samples():
    """The residual Jacobian of ten times the samples would take 170 MB, the samples take 1 MB."""
    result = subprocess.run([sys.executable, '-c', MEMORY], capture_output=True, text=True,
                            timeout=240, check=False, cwd=Path(koopman_ros.__file__).parents[1])
    assert result.returncode == 0, result.stderr
    assert int(result.stdout) < 32 * 1024  # KiB
