# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Lifts of networks and of dictionaries: Jacobians and secants against independent derivatives."""

from dataclasses import FrozenInstanceError, replace
from fractions import Fraction
import importlib
from itertools import product
from math import prod

import numpy as np
import pytest

from koopman_ros.lifting import NetworkObservables, PolynomialObservables
from koopman_ros.lifting.activations import ACTIVATIONS
from support.random_lifts import random_network

NETWORKS = {
    f'{activation} {n_x} {widths} {identity}':
        random_network(n_x, widths, identity=identity, activation=activation)
    for activation in ACTIVATIONS for n_x in (1, 2, 3) for widths in ((6,), (5, 4))
    for identity in (True, False)}
MEANS = {name: network for name, network in NETWORKS.items()
         if len(network.hidden) == 1 or network.n_x == 1}
DICTIONARIES = {
    f'{n_x} to degree {degree}': PolynomialObservables.total_degree(n_x, degree)
    for n_x, degrees in ((1, (1, 2, 5)), (2, (1, 3, 4)), (3, (1, 2, 4))) for degree in degrees}
# the exact lift of the paper's two-state example
DICTIONARIES['incomplete'] = PolynomialObservables(np.array([[1, 0], [0, 1], [2, 0]], np.uint8))
LIFTS = NETWORKS | DICTIONARIES
SEPARATIONS = [2.0, 1e-2, 1e-5, 1e-8, 1e-9, 1e-12, 0.0]
NODES, WEIGHTS = np.polynomial.legendre.leggauss(40)

# Truncation error h^4 f'''''/30 and rounding eps/h are both near 1e-13 for functions of order 1.
STEP = 1e-3


def each(cases):
    """Run a test on one case after the other; the one that fails is named."""
    def each_case(test):
        def run():
            for name, case in cases.items():
                try:
                    test(case)
                except Exception as error:
                    error.add_note(f'with {name}')
                    raise
        run.__name__, run.__doc__ = test.__name__, test.__doc__
        return run
    return each_case


def derivative(function, x):
    """Differentiate by the five-point stencil: (..., m) -> (..., m, n_x) at x (..., n_x)."""
    steps = STEP * np.eye(x.shape[-1])
    f = {k: function(x[..., None, :] + k * steps) for k in (-2, -1, 1, 2)}
    return np.swapaxes((f[-2] - f[2] + 8.0 * (f[1] - f[-1])) / (12.0 * STEP), -1, -2)


def states(n_x, count=10, seed=1):
    return np.random.default_rng(seed).uniform(-1.5, 1.5, (count, n_x))


def jacobian(lift, x):
    return lift.lift_and_jacobian(x)[1]


def secants(lift, x, x_ref, w):
    return lift.lift_and_secants(x, x_ref, w)[2:]


def size(*arrays):
    return max(1.0, *(float(np.max(np.abs(array), initial=0.0)) for array in arrays))


def pairs(n_x):
    """Yield separations, references, states that far away, and directions."""
    for separation in SEPARATIONS:
        rng = np.random.default_rng(4)
        for reference in states(n_x, seed=2):
            yield separation, reference, reference + separation * rng.normal(size=n_x), (
                rng.normal(size=n_x))


# What holds for every lift

@each(LIFTS)
def test_shapes_origin_and_the_state_among_the_coordinates(lift):
    np.testing.assert_array_equal(lift.lift(np.zeros(lift.n_x)), np.zeros(lift.n_z))
    for x in states(lift.n_x):
        z, J = lift.lift_and_jacobian(x)
        M, H = secants(lift, x, -2.0 * x, np.ones(lift.n_x))
        assert z.shape == (lift.n_z,)
        assert J.shape == M.shape == H.shape == (lift.n_z, lift.n_x)
        if lift.identity:
            np.testing.assert_array_equal(z[:lift.n_x], x)
            for rows in (J, M):
                np.testing.assert_array_equal(rows[:lift.n_x], np.eye(lift.n_x))
            np.testing.assert_array_equal(H[:lift.n_x], np.zeros((lift.n_x, lift.n_x)))


@each(LIFTS)
def test_second_derivatives_are_those_of_the_jacobian(lift):
    batch = states(lift.n_x, 6).reshape(2, 3, lift.n_x)
    z, J, bend = lift.lift_and_derivatives(batch)
    np.testing.assert_allclose(z, lift.lift(batch), rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(J, jacobian(lift, batch), rtol=1e-13, atol=1e-13)
    expected = derivative(lambda x: jacobian(lift, x).reshape(*x.shape[:-1], -1), batch)
    np.testing.assert_allclose(bend, expected.reshape(bend.shape), rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(bend, bend.swapaxes(-1, -2), rtol=0.0, atol=1e-13 * size(bend))
    one = lift.lift_and_derivatives(batch[0, 1])
    for found, of_batch in zip(one, (z, J, bend), strict=True):
        np.testing.assert_allclose(found, of_batch[0, 1], rtol=1e-13, atol=1e-13)


@each(LIFTS)
def test_a_batch_is_lifted_like_its_members_and_at_once_as_by_the_single_methods(lift):
    batch = states(lift.n_x, 12)
    z, J = lift.lift_and_jacobian(batch.reshape(3, 4, lift.n_x))
    assert z.shape == (3, 4, lift.n_z)
    assert J.shape == (3, 4, lift.n_z, lift.n_x)
    # matrix and vector products may round differently
    np.testing.assert_allclose(
        z.reshape(12, -1), [lift.lift(x) for x in batch], rtol=1e-14, atol=1e-14)
    np.testing.assert_allclose(
        J.reshape(12, lift.n_z, -1), [jacobian(lift, x) for x in batch], rtol=1e-14, atol=1e-14)
    np.testing.assert_array_equal(lift.lift_and_jacobian(batch)[0], lift.lift(batch))
    x, x_ref, w = states(lift.n_x, 3, seed=5)
    both = lift.lift_and_secants(x, x_ref, w)[:2]
    for found, expected in zip(both, lift.lift_and_jacobian(x), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-14, atol=1e-14)


@each(LIFTS)
def test_derivatives_against_differences(lift):
    x, w = states(lift.n_x), np.random.default_rng(3).normal(size=lift.n_x)
    J = jacobian(lift, x)
    np.testing.assert_allclose(J, derivative(lift.lift, x), rtol=1e-9, atol=1e-9)
    # secants at zero separation are derivatives
    M, H = map(np.array, zip(*(secants(lift, point, point, w) for point in x), strict=True))
    np.testing.assert_allclose(M, J, rtol=1e-13, atol=1e-14)
    np.testing.assert_allclose(
        H, derivative(lambda y: jacobian(lift, y) @ w, x), rtol=1e-8, atol=1e-8)


@each(LIFTS)
def test_secants_are_exact(lift):
    for _, reference, x, w in pairs(lift.n_x):
        # x - reference is not the separation drawn: x is rounded
        e = x - reference
        z, J, M, H = lift.lift_and_secants(x, reference, w)
        z_ref, J_ref = lift.lift_and_jacobian(reference)
        np.testing.assert_allclose(M @ e, z - z_ref, rtol=1e-12, atol=1e-14 * size(z, z_ref))
        np.testing.assert_allclose(
            H @ e, J @ w - J_ref @ w, rtol=1e-12, atol=2e-14 * size(J, J_ref))


@each(LIFTS)
def test_neither_a_lift_nor_what_it_keeps_can_be_changed(lift):
    """Whoever changes a result in place must not change the next one."""
    x, x_ref, w = states(lift.n_x, 3, seed=5)
    before = lift.lift_and_secants(x.copy(), x_ref, w)
    for array in (*lift.lift_and_jacobian(x.copy()), *lift.lift_and_secants(x.copy(), x_ref, w)):
        array[...] = 7.0
    for a, b in zip(before, lift.lift_and_secants(x, x_ref, w), strict=True):
        np.testing.assert_array_equal(a, b)
    with pytest.raises(FrozenInstanceError):
        lift.identity = not lift.identity
    arrays = ((lift.exponents,) if isinstance(lift, PolynomialObservables)
              else (lift.output, *lift.hidden[0], *lift.hidden[-1]))
    for array in arrays:
        with pytest.raises(ValueError, match='read-only'):
            array[0] = 1


# Networks

@each(NETWORKS)
def test_network_against_torch(network):
    torch = importlib.import_module('torch')
    function = {'tanh': torch.tanh, 'sigmoid': torch.sigmoid, 'sine': torch.sin,
                'softplus': torch.nn.functional.softplus}[network.activation]
    layers = [(torch.tensor(w), torch.tensor(b)) for w, b in network.hidden]
    output = torch.tensor(network.output)

    def outputs(x):
        for weight, bias in layers:
            x = function(weight @ x + bias)
        return output @ x

    def lift(x):
        free = outputs(x) - outputs(torch.zeros_like(x))
        return torch.cat([x, free]) if network.identity else free

    for x in states(network.n_x):
        point = torch.tensor(x)
        z, J = network.lift_and_jacobian(x)
        np.testing.assert_allclose(z, lift(point).numpy(), rtol=0, atol=1e-14)
        np.testing.assert_allclose(
            J, torch.autograd.functional.jacobian(lift, point).numpy(), rtol=0, atol=1e-13)


@each(MEANS)
def test_network_secants_are_means(network):
    """
    At small separations only M and H themselves say whether something cancelled.

    For one layer and for one state they are means of derivatives along the segment.
    """
    for separation, reference, x, w in pairs(network.n_x):
        if separation not in SEPARATIONS[::3]:
            continue
        M, H = secants(network, x, reference, w)
        points = reference + 0.5 * (1.0 + NODES[:, None]) * (x - reference)
        mean = np.einsum('k,kij->ij', 0.5 * WEIGHTS, jacobian(network, points))
        np.testing.assert_allclose(M, mean, rtol=0, atol=1e-13)
        curvature = derivative(lambda y, w=w: jacobian(network, y) @ w, points)
        mean = np.einsum('k,kij->ij', 0.5 * WEIGHTS, curvature)
        np.testing.assert_allclose(H, mean, rtol=0, atol=1e-9)


@pytest.mark.parametrize('n_x', [1, 2, 3])
def test_a_network_without_layers_is_the_state(n_x):
    lift = NetworkObservables((), np.zeros((0, n_x)), identity=True)
    assert (lift.n_x, lift.n_z) == (n_x, n_x)
    x = states(n_x)
    z, J = lift.lift_and_jacobian(x)
    np.testing.assert_array_equal(z, x)
    np.testing.assert_array_equal(J, np.broadcast_to(np.eye(n_x), (10, n_x, n_x)))
    np.testing.assert_array_equal(lift.lift(x), x)
    M, H = secants(lift, x[0], x[1], x[2])
    np.testing.assert_array_equal(M, np.eye(n_x))
    np.testing.assert_array_equal(H, np.zeros((n_x, n_x)))


@pytest.mark.parametrize(('change', 'message'), [
    ({'output': np.zeros((3, 4))}, r'incompatible output: expected \(3, 5\), got \(3, 4\)'),
    ({'output': np.zeros(5)}, r'incompatible output: expected \(-1, 5\), got \(5,\)'),
    ({'output': np.full((3, 5), np.nan)}, 'output must be finite'),
    ({'hidden': ((np.zeros((5, 2)), np.zeros(4)),)},
     r'incompatible weight of hidden layer 0: expected \(4, 2\), got \(5, 2\)'),
    ({'hidden': ((np.zeros(5), np.zeros(5)),)},
     r'incompatible weight of hidden layer 0: expected \(5, -1\), got \(5,\)'),
    ({'hidden': ((np.zeros((5, 2)), np.zeros((5, 1))),)},
     r'incompatible weight of hidden layer 0: expected \(-1, 2\), got \(5, 2\)'),
    ({'hidden': ((np.zeros((5, 2)), np.zeros(5)), (np.zeros((5, 4)), np.zeros(5)))},
     r'incompatible weight of hidden layer 1: expected \(5, 5\), got \(5, 4\)'),
    ({'hidden': ((np.zeros((5, 2)), np.full(5, np.inf)),)},
     'bias of hidden layer 0 must be finite'),
    ({'hidden': ()}, 'a lift with free coordinates needs a hidden layer'),
    ({'hidden': (), 'output': np.zeros((0, 2)), 'identity': False},
     'a lift needs coordinates: set identity, or give rows of output'),
    ({'output': np.zeros((0, 5)), 'identity': False}, 'a lift needs coordinates'),
    ({'activation': 'relu'}, "must be one of 'tanh', 'sigmoid', 'sine', 'softplus', got 'relu'"),
])
def test_a_network_that_does_not_fit_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        replace(random_network(), **change)


# Dictionaries, against their definition in rational numbers

def monomial(x, exponents):
    return prod(Fraction(v) ** int(k) for v, k in zip(x, exponents, strict=True))


def partial(x, exponents, *by):
    """Differentiate a monomial by the states of these indices, one after the other."""
    factor, left = 1, list(map(int, exponents))
    for i in by:
        factor, left[i] = factor * left[i], left[i] - 1
        if factor == 0:
            return Fraction(0)
    return factor * monomial(x, left)


def corners(n_x):
    """Return states of either sign, at zero and on the axes."""
    return [*states(n_x), *np.eye(n_x), -np.eye(n_x)[0], np.zeros(n_x), np.full(n_x, -3.0)]


@each(DICTIONARIES)
def test_dictionary_against_fractions(dictionary):
    n_x = dictionary.n_x
    w = states(n_x, 1, seed=3)[0]
    for x in corners(n_x)[6:]:
        z, J = dictionary.lift_and_jacobian(x)
        _, H = secants(dictionary, x, x, w)
        for i, row in enumerate(dictionary.exponents):
            assert z[i] == pytest.approx(float(monomial(x, row)), rel=1e-14, abs=0)
            for j in range(n_x):
                assert J[i, j] == pytest.approx(float(partial(x, row, j)), rel=1e-14, abs=0)
                hessian = sum(partial(x, row, j, k) * Fraction(w[k]) for k in range(n_x))
                assert H[i, j] == pytest.approx(float(hessian), rel=1e-12, abs=1e-13)


@each(DICTIONARIES)
def test_dictionary_secants_against_fractions(dictionary):
    """In rational numbers the differences are exact, so those of the smallest steps tell too."""
    n_x = dictionary.n_x
    rng = np.random.default_rng(4)
    for separation, reference in product(SEPARATIONS, corners(n_x)[8:]):
        x = reference + separation * rng.normal(size=n_x)
        w = rng.normal(size=n_x)
        M, H = secants(dictionary, x, reference, w)
        e = [Fraction(a) - Fraction(b) for a, b in zip(x, reference, strict=True)]
        scale = float(max(map(abs, e)))
        for i, row in enumerate(dictionary.exponents):
            found = sum(Fraction(M[i, j]) * e[j] for j in range(n_x))
            exact = monomial(x, row) - monomial(reference, row)
            assert abs(found - exact) <= 1e-14 * scale * size(M)
            found = sum(Fraction(H[i, j]) * e[j] for j in range(n_x))
            exact = sum((partial(x, row, k) - partial(reference, row, k)) * Fraction(w[k])
                        for k in range(n_x))
            assert abs(found - exact) <= 1e-14 * scale * size(H)


@pytest.mark.parametrize(('n_x', 'degree', 'exponents'), [
    (1, 4, [[1], [2], [3], [4]]),
    (2, 3, [[1, 0], [0, 1], [2, 0], [1, 1], [0, 2], [3, 0], [2, 1], [1, 2], [0, 3]]),
    (3, 2, [[1, 0, 0], [0, 1, 0], [0, 0, 1], [2, 0, 0], [1, 1, 0], [1, 0, 1], [0, 2, 0],
            [0, 1, 1], [0, 0, 2]]),
])
def test_monomials_of_a_total_degree(n_x, degree, exponents):
    dictionary = PolynomialObservables.total_degree(n_x, degree)
    np.testing.assert_array_equal(dictionary.exponents, exponents)
    assert (dictionary.n_x, dictionary.n_z, dictionary.identity) == (n_x, len(exponents), True)
    for nothing in ((0, degree), (n_x, 0), (-1, degree)):
        with pytest.raises(ValueError, match='must be at least 1, got {} and {}'.format(*nothing)):
            PolynomialObservables.total_degree(*nothing)


@pytest.mark.parametrize(('exponents', 'error', 'message'), [
    (np.eye(2), TypeError, 'exponents must be integers, got float64'),
    ([[True]], TypeError, 'exponents must be integers, got bool'),
    ([1, 2], ValueError, r'incompatible exponents: expected \(n_z, n_x\), got \(2,\)'),
    (np.zeros((3, 0), dtype=int), ValueError, r'expected \(n_z, n_x\), got \(3, 0\)'),
    ([[1], [-1]], ValueError, 'exponents must be at least 0, got -1'),
    ([[2], [1]], ValueError, r'first 1 rows of exponents must be the states, .* got \[\[2\]\]'),
    ([[0, 1], [1, 0]], ValueError, r'must be the states, .* got \[\[0, 1\], \[1, 0\]\]'),
    ([[1, 0]], ValueError, r'must be the states, the identity matrix, got \[\[1, 0\]\]'),
    ([[1], [2], [0]], ValueError, r'a constant, which N\(0\) = 0 rules out: drop it'),
    ([[1], [3], [2], [3]], ValueError, r'the row \[3\] of exponents comes 2 times: keep one'),
])
def test_exponents_that_do_not_fit_are_refused(exponents, error, message):
    with pytest.raises(error, match=message):
        PolynomialObservables(exponents)
