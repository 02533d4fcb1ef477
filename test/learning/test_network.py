# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The places of the parameters in their vector, and one pass against automatic differentiation."""

import numpy as np
import pytest
import torch

from koopman_ros.learning.network import ACTIVATIONS, Layout, Pass
from koopman_ros.lifting import NetworkObservables


def normal(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed),
                       dtype=torch.float64)


@pytest.mark.parametrize('hidden', [(), (7,), (4, 3), (2, 5, 3)], ids=str)
@pytest.mark.parametrize('identity', [True, False])
@pytest.mark.parametrize(('n_u', 'decoder'), [(0, 0), (2, 0), (0, 3), (1, 4)])
def test_split_and_join_are_inverse(hidden, identity, n_u, decoder):
    layout = Layout(2, 2 if identity and not hidden else 5, hidden, identity, 'sine', n_u, decoder)
    theta = torch.arange(layout.size, dtype=torch.float64)
    parts = layout.split(theta)
    assert [b.shape for _, b in parts.hidden] == [(h,) for h in hidden]
    assert [W.shape for W, _ in parts.hidden] == list(zip(hidden, (2, *hidden), strict=False))
    assert parts.V.shape == (layout.n_free, hidden[-1] if hidden else 0)
    assert parts.A.shape == (layout.n_z, layout.n_z)
    assert (None if parts.B is None else parts.B.shape) == ((2, n_u) if n_u else None)
    assert (parts.decoder is None) == (decoder == 0)
    assert torch.equal(layout.join(parts), theta)


def test_split_gives_views():
    layout = Layout(1, 3, (4,), True)
    theta = torch.zeros(layout.size, dtype=torch.float64)
    layout.split(theta).A.fill_(1.0)
    assert float(theta.sum()) == 9.0


def test_the_order_of_the_vector():
    layout = Layout(1, 2, (1,), True, n_u=1, decoder=1)
    parts = layout.split(torch.arange(14.0))
    assert parts.hidden[0][0].tolist() == [[0.0]]
    assert parts.hidden[0][1].tolist() == [1.0]
    assert parts.V.tolist() == [[2.0]]
    assert parts.A.tolist() == [[3.0, 4.0], [5.0, 6.0]]
    assert parts.B.tolist() == [[7.0]]
    assert [part.flatten().tolist() for part in parts.decoder] == [
        [8.0, 9.0], [10.0], [11.0], [12.0]]
    assert layout.size == 13


@pytest.mark.parametrize('sizes', [(3, 2, (4,), True), (0, 1, (4,), False), (1, 2, (0,), True),
                                   (1, 2, (3, 0), True)], ids=str)
def test_sizes_that_do_not_fit(sizes):
    with pytest.raises(ValueError, match='sizes do not fit: Layout'):
        Layout(*sizes)


def test_an_unknown_activation():
    with pytest.raises(ValueError, match="tanh, sigmoid, sine, softplus, got 'relu'"):
        Layout(1, 2, (3,), True, 'relu')


@pytest.mark.parametrize('name', ACTIVATIONS)
def test_derivatives_of_activations(name):
    a = torch.linspace(-3.0, 3.0, 13, dtype=torch.float64)

    def value(t):
        return ACTIVATIONS[name](t)[0]

    slope = torch.func.vmap(torch.func.grad(value))
    _, first, second = ACTIVATIONS[name](a)
    torch.testing.assert_close(first, slope(a), rtol=0, atol=1e-15)
    torch.testing.assert_close(
        second, torch.func.vmap(torch.func.grad(torch.func.grad(value)))(a), rtol=0, atol=1e-14)


@pytest.mark.parametrize('name', ACTIVATIONS)
@pytest.mark.parametrize('hidden', [(5,), (4, 3), (3, 4, 2)], ids=str)
@pytest.mark.parametrize('identity', [True, False])
def test_a_pass_is_what_the_model_evaluates_at_run_time(name, hidden, identity):
    layout = Layout(2, 4, hidden, identity, name)
    parts = layout.split(normal(layout.size))
    x, f = normal(20, 2, seed=1), normal(20, 2, seed=2)
    lifted = Pass(layout, parts, x, f)
    z, J = NetworkObservables(
        tuple((W.numpy(), b.numpy()) for W, b in parts.hidden), parts.V.numpy(), identity,
        name).lift_and_jacobian(x.numpy())
    np.testing.assert_allclose(lifted.z, z, rtol=0, atol=1e-14)
    np.testing.assert_allclose(lifted.jacobian(), J, rtol=0, atol=1e-14)
    np.testing.assert_allclose(lifted.z_rate, (J @ f.numpy()[..., None])[..., 0],
                               rtol=0, atol=1e-14)
