# Copyright 2026 The koopman_ros Authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The hand-derived normal equations against automatic differentiation of the plain residuals."""

from koopman_ros.lifting.residuals import Layout, lift, Problem
import numpy as np
import pytest
import torch

LAYOUTS = [Layout(n_x, n_x * identity + n_free, h, identity)
           for n_x, n_free, h in ((1, 1, 3), (1, 3, 8), (2, 2, 5), (3, 2, 4), (3, 4, 6))
           for identity in (True, False)]
every_layout = pytest.mark.parametrize('layout', LAYOUTS, ids=str)


def problem(layout, whitening=0.0, count=25, seed=0, chunk=4096):
    """Return a random problem and random parameters, all of order one."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    theta = normal(sum(layout.sizes))
    return Problem(layout, normal(count, layout.n_x), normal(count, layout.n_x), whitening,
                   chunk), theta


def free_coordinates(theta, layout, x):
    W, b, V, _ = layout.split(theta)
    return V @ (torch.tanh(W @ x + b) - torch.tanh(b))


def coordinates(theta, layout, x):
    """Write N(x) at one x as the paper has it."""
    free = free_coordinates(theta, layout, x)
    return torch.cat([x, free]) if layout.identity else free


def residuals(theta, of):
    """Stack J_N f - A N at all samples, over sqrt(N), and the whitening residuals."""
    layout = of.layout
    A = layout.split(theta)[3]
    parts, moment = [], 0.0
    for x, f in zip(of.x, of.f, strict=True):
        z = coordinates(theta, layout, x)
        J = torch.func.jacrev(coordinates, argnums=2)(theta, layout, x)
        parts.append((J @ f - A @ z) / len(of.x) ** 0.5)
        moment = moment + torch.outer(z, z) / len(of.x)
    if of.whitening:
        # every entry of the matrix, but those of identity coordinates alone, which are constant
        deviation = of.whitening ** 0.5 * (moment - torch.eye(layout.n_z).to(x))
        fixed = layout.n_z - layout.n_free
        parts += [deviation[fixed:].reshape(-1), deviation[:fixed, fixed:].reshape(-1)]
    return torch.cat(parts)


def assert_close(actual, expected):
    scale = float(expected.abs().max())
    np.testing.assert_allclose(actual.numpy(), expected.numpy(), rtol=0, atol=1e-12 * scale)


@every_layout
def test_lift_and_its_drift(layout):
    of, theta = problem(layout)
    lifted = lift(layout, theta, of.x, of.f, derivatives=False)
    assert lifted.z_dtheta is None
    assert lifted.dz_dtheta is None
    for i, (x, f) in enumerate(zip(of.x, of.f, strict=True)):
        assert_close(lifted.z[i], coordinates(theta, layout, x))
        J = torch.func.jacrev(coordinates, argnums=2)(theta, layout, x)
        assert_close(lifted.dz[i], J @ f)


@every_layout
@pytest.mark.parametrize('whitening', [0.0, 0.3])
def test_normal_equations(layout, whitening):
    of, theta = problem(layout, whitening)
    r, J = residuals(theta, of), torch.func.jacrev(residuals)(theta, of)
    normal = of.evaluate(theta, derivatives=True)
    assert normal.cost == pytest.approx(0.5 * float(r @ r), rel=1e-12)
    assert_close(normal.gradient, J.T @ r)
    assert_close(normal.matrix, J.T @ J)


@every_layout
def test_cost_alone_is_the_same_cost(layout):
    of, theta = problem(layout, whitening=0.7)
    alone = of.evaluate(theta, derivatives=False)
    assert alone.gradient is None
    assert alone.matrix is None
    assert alone.cost == of.evaluate(theta, derivatives=True).cost


@pytest.mark.parametrize('chunk', [1, 7, 24, 25, 26])
@pytest.mark.parametrize('layout', LAYOUTS[2:6], ids=str)
def test_chunks_add_up(layout, chunk):
    of, theta = problem(layout, whitening=0.5)
    whole = of.evaluate(theta, derivatives=True)
    parts = problem(layout, whitening=0.5, chunk=chunk)[0].evaluate(theta, derivatives=True)
    assert parts.cost == pytest.approx(whole.cost, rel=1e-13)
    assert_close(parts.gradient, whole.gradient)
    assert_close(parts.matrix, whole.matrix)


def test_split_and_join_are_inverse():
    layout = Layout(2, 5, 7, True)
    theta = torch.arange(sum(layout.sizes), dtype=torch.float64)
    W, b, V, A = layout.split(theta)
    assert (W.shape, b.shape, V.shape, A.shape) == ((7, 2), (7,), (3, 7), (5, 5))
    assert torch.equal(layout.join(W, b, V, A), theta)
