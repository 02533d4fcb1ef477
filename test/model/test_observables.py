# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Lifts of networks and of monomials: Jacobians and secants against independent derivatives."""

from dataclasses import replace
from fractions import Fraction
from math import prod

import numpy as np
import pytest

from koopman_ros.model import NetworkObservables, PolynomialObservables
from support.random_lifts import random_network

NETWORKS = {f'network {n_x} {identity}': random_network(n_x, 6, identity=identity)
            for n_x in (1, 2, 3) for identity in (True, False)}
NETWORKS['linear'] = NetworkObservables.linear(2)
DICTIONARIES = {
    f'{n_x} to degree {degree}': PolynomialObservables.total_degree(n_x, degree)
    for n_x, degrees in ((1, (1, 2, 5)), (2, (1, 3, 4)), (3, (1, 2, 4))) for degree in degrees}
# the exact lift of the paper's two-state example
DICTIONARIES['incomplete'] = PolynomialObservables(np.array([[1, 0], [0, 1], [2, 0]], np.uint8))
LIFTS = NETWORKS | DICTIONARIES
every_lift = pytest.mark.parametrize('lift', LIFTS.values(), ids=LIFTS)
every_dictionary = pytest.mark.parametrize('lift', DICTIONARIES.values(), ids=DICTIONARIES)
SEPARATIONS = [2.0, 1e-2, 1e-5, 1e-8, 1e-9, 1e-12, 0.0]

# Truncation error h^4 f'''''/30 and rounding eps/h are both near 1e-13 for functions of order 1.
STEP = 1e-3


def derivative(function, x):
    """Differentiate by the five-point stencil: (..., m) -> (..., m, n_x) at x (..., n_x)."""
    steps = STEP * np.eye(x.shape[-1])
    f = {k: function(x[..., None, :] + k * steps) for k in (-2, -1, 1, 2)}
    return np.swapaxes((f[-2] - f[2] + 8.0 * (f[1] - f[-1])) / (12.0 * STEP), -1, -2)


def states(n_x, count=10, seed=1):
    return np.random.default_rng(seed).uniform(-1.5, 1.5, (count, n_x))


def jacobian(lift, x):
    return lift.lift_and_jacobian(x)[1]


def size(*arrays):
    return max(1.0, *(float(np.max(np.abs(array), initial=0.0)) for array in arrays))


def pairs(n_x):
    """Yield references, states at several distances, and directions."""
    for separation in SEPARATIONS:
        rng = np.random.default_rng(4)
        for reference in states(n_x, seed=2):
            yield reference, reference + separation * rng.normal(size=n_x), rng.normal(size=n_x)


@every_lift
def test_origin_states_among_the_coordinates_and_batches(lift):
    np.testing.assert_array_equal(lift.lift(np.zeros(lift.n_x)), np.zeros(lift.n_z))
    batch = states(lift.n_x, 6).reshape(2, 3, lift.n_x)
    found = lift.lift_and_derivatives(batch)
    first = lift.lift_and_jacobian(batch)
    for a, b in zip((lift.lift(batch), *first), (found[0], *found), strict=False):
        np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-13)
    for place in np.ndindex(2, 3):
        x = batch[place]
        z, (J, M, H) = lift.lift(x), lift.secants(x, -2.0 * x, np.ones(lift.n_x))
        for one, many in zip((z, J, *lift.lift_and_derivatives(x)), (*first, *found),
                             strict=True):
            np.testing.assert_allclose(one, many[place], rtol=1e-13, atol=1e-13)
        assert J.shape == M.shape == H.shape == (lift.n_z, lift.n_x)
        if lift.identity:
            np.testing.assert_array_equal(z[:lift.n_x], x)
            for rows, expected in ((J, 1.0), (M, 1.0), (H, 0.0)):
                np.testing.assert_array_equal(rows[:lift.n_x], expected * np.eye(lift.n_x))


@every_lift
def test_derivatives_are_those_of_differences(lift):
    x, w = states(lift.n_x), np.random.default_rng(3).normal(size=lift.n_x)
    _, J, bend = lift.lift_and_derivatives(x)
    np.testing.assert_allclose(J, derivative(lift.lift, x), rtol=1e-9, atol=1e-9)
    expected = derivative(lambda x: jacobian(lift, x).reshape(*x.shape[:-1], -1), x)
    np.testing.assert_allclose(bend, expected.reshape(bend.shape), rtol=1e-8, atol=1e-9)
    # secants between equal states are derivatives
    M, H = map(np.array, zip(*(lift.secants(y, y, w)[1:] for y in x), strict=True))
    np.testing.assert_allclose(M, J, rtol=1e-13, atol=1e-14)
    np.testing.assert_allclose(H, bend @ w, rtol=1e-12, atol=1e-13)


@every_lift
def test_secants_are_exact(lift):
    for reference, x, w in pairs(lift.n_x):
        # x - reference is not the separation drawn: x is rounded
        e = x - reference
        z, (J, M, H) = lift.lift(x), lift.secants(x, reference, w)
        z_ref, J_ref = lift.lift_and_jacobian(reference)
        np.testing.assert_allclose(M @ e, z - z_ref, rtol=1e-12, atol=1e-14 * size(z, z_ref))
        np.testing.assert_allclose(
            H @ e, J @ w - J_ref @ w, rtol=1e-12, atol=2e-14 * size(J, J_ref))


@pytest.mark.parametrize(('change', 'message'), [
    ({'V': np.zeros((3, 4))}, r'incompatible V: expected \(any, 5\), got \(3, 4\)'),
    ({'V': np.zeros(5)}, r'incompatible V: expected \(any, 5\), got \(5,\)'),
    ({'V': np.full((3, 5), np.nan)}, 'V must be finite'),
    ({'W': np.zeros(5)}, 'incompatible W'),
    ({'b': np.zeros(4)}, r'incompatible b: expected \(5,\), got \(4,\)'),
    ({'b': np.zeros((5, 1))}, 'incompatible b'),
    ({'b': np.full(5, np.inf)}, 'b must be finite'),
    ({'W': np.zeros((0, 2)), 'b': np.zeros(0), 'V': np.zeros((3, 0))}, 'needs hidden units'),
    ({'V': np.zeros((0, 5)), 'identity': False}, 'a lift needs coordinates'),
])
def test_a_network_that_does_not_fit_is_rejected(change, message):
    with pytest.raises(ValueError, match=message):
        replace(random_network(), **change)


# Monomials, against their definition in rational numbers

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
    return [*states(n_x, 2), *np.eye(n_x), -np.eye(n_x)[0], np.zeros(n_x), np.full(n_x, -3.0)]


@every_dictionary
def test_monomials_against_fractions(lift):
    n_x = lift.n_x
    for x in corners(n_x):
        z, J, bend = lift.lift_and_derivatives(x)
        for i, row in enumerate(lift.exponents):
            assert z[i] == pytest.approx(float(monomial(x, row)), rel=1e-14, abs=0)
            for j in range(n_x):
                assert J[i, j] == pytest.approx(float(partial(x, row, j)), rel=1e-14, abs=0)
                for k in range(n_x):
                    assert bend[i, j, k] == pytest.approx(
                        float(partial(x, row, j, k)), rel=1e-14, abs=0)


@pytest.mark.parametrize(('exponents', 'error', 'message'), [
    (np.eye(2), TypeError, 'integers, got float64'),
    ([[True]], TypeError, 'integers, got bool'),
    ([1, 2], ValueError, 'incompatible exponents'),
    (np.zeros((3, 0), dtype=int), ValueError, 'incompatible exponents'),
    ([[1], [-1]], ValueError, 'at least 0, got -1'),
    ([[2], [1]], ValueError, 'must be the states'),
    ([[0, 1], [1, 0]], ValueError, 'must be the states'),
    ([[1, 0]], ValueError, 'must be the states'),
    ([[1], [2], [0]], ValueError, 'constant'),
    ([[1], [3], [2], [3]], ValueError, r'the row \[3\] of exponents'),
])
def test_exponents_that_do_not_fit_are_rejected(exponents, error, message):
    with pytest.raises(error, match=message):
        PolynomialObservables(exponents)
