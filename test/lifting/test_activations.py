# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Activations: values, slopes and divided differences against closed forms in more digits."""

import numpy as np
import pytest

from koopman_ros.lifting.activations import activation_named, ACTIVATIONS

LONG = np.longdouble
every_activation = pytest.mark.parametrize('name', ACTIVATIONS)


def sech2(a):
    return 1.0 / np.cosh(a) ** 2


# value, slope and curvature, by formulas other than those under test
REFERENCES = {
    'tanh': (
        lambda a: np.expm1(2 * a) / (np.expm1(2 * a) + 2), sech2,
        lambda a: -2 * np.tanh(a) * sech2(a)),
    'sigmoid': (
        lambda a: 1 / (1 + np.exp(-a)), lambda a: sech2(a / 2) / 4,
        lambda a: -np.tanh(a / 2) * sech2(a / 2) / 4),
    'sine': (np.sin, np.cos, lambda a: -np.sin(a)),
    'softplus': (
        lambda a: np.log1p(np.exp(a)), lambda a: 1 / (1 + np.exp(-a)),
        lambda a: sech2(a / 2) / 4),
}

NODES, WEIGHTS = np.polynomial.legendre.leggauss(24)

POINTS = np.array([-40.0, -15.0, -4.0, -1.3, -1e-3, -1e-9, 0.0, 1e-12, 0.2, 0.9, 2.5, 7.0, 36.0])
SEPARATIONS = [0.0, 5e-324, 1e-300, 1e-16, 1e-12, 0.99e-8, 1.01e-8, 1e-5, 1e-2, 0.3, 0.99, 1.01,
               2.0, 9.0, 50.0, 700.0]


def mean_along(function, a, b):
    """Average over the segment from b to a: 24 nodes are exact to rounding up to length one."""
    a, b = LONG(a), LONG(b)
    points = b + 0.5 * (1 + LONG(NODES)[:, None]) * (a - b)
    return (0.5 * LONG(WEIGHTS)[:, None] * function(points)).sum(axis=0)


def quotient(function, a, b):
    a, b = LONG(a), LONG(b)
    return (function(a) - function(b)) / (a - b)


def assert_close(actual, expected, a=0.0):
    """Compare to rounding; that of an argument beyond one counts too, which shifts a sine."""
    error = np.abs(actual - expected)
    assert np.all(error <= 1e-15 * np.maximum(1.0, np.abs(a))), error.max()


def differences(name, a, b):
    f = activation_named(name)
    return f.divided_differences(a, b, f.value(a), f.value(b))


@every_activation
def test_value_and_slope(name):
    f = activation_named(name)
    a = np.linspace(-40.0, 40.0, 401)
    found = f.value(a)
    value, slope, _ = REFERENCES[name]
    np.testing.assert_allclose(found, value(LONG(a)).astype(float), rtol=1e-15, atol=1e-15)
    assert_close(f.slope(a, found), slope(LONG(a)))


@every_activation
def test_divided_differences(name):
    references, b = REFERENCES[name], POINTS
    for separation in (sign * size for size in SEPARATIONS for sign in (1.0, -1.0)):
        # an element each; a - b is not the separation asked for, since a is rounded
        a = b + separation
        larger = np.maximum(np.abs(a), np.abs(b)) if name == 'sine' else 0.0
        mean, functions = ((mean_along, references[1:]) if abs(separation) <= 1.0
                           else (quotient, references[:2]))
        for found, function in zip(differences(name, a, b), functions, strict=True):
            assert_close(found, mean(function, a, b), larger)


@pytest.mark.parametrize(('name', 'slope', 'slope_of_slope'), [
    ('tanh', 1e-4, 0.0), ('sigmoid', 0.5e-4, 0.0), ('softplus', 0.5, 0.5e-4)])
def test_arguments_that_saturate(name, slope, slope_of_slope):
    """From -10000 to 10000; a warning about overflow would be an error."""
    found = differences(name, np.array([1e4]), np.array([-1e4]))
    np.testing.assert_allclose(found, [[slope], [slope_of_slope]], rtol=1e-14, atol=0)
    for a, limit in ((1e4, 1.0), (-1e4, 0.0)):
        far = differences(name, np.array([a]), np.array([a + 0.5]))
        expected = limit if name == 'softplus' else 0.0
        np.testing.assert_allclose(far, [[expected], [0.0]], rtol=0, atol=1e-15)


@pytest.mark.parametrize(('a', 'b'), [(-30.0, -30.5), (-30.0, -32.0), (-300.0, -300.0 + 1e-6)])
def test_tails_of_sigmoid_and_softplus_keep_their_digits(a, b):
    """Far below zero both are exp(a) to rounding, and so are the means of their slopes."""
    expected = np.exp(b) * np.expm1(a - b) / (a - b)
    for name in ('sigmoid', 'softplus'):
        slope, slope_of_slope = differences(name, np.array([a]), np.array([b]))
        np.testing.assert_allclose(slope, expected, rtol=1e-12)
        np.testing.assert_allclose(slope_of_slope, expected, rtol=1e-12)


@pytest.mark.parametrize('name', ['relu', 'Tanh', '', None, ['tanh']])
def test_an_unknown_name_is_refused_with_the_known_ones(name):
    with pytest.raises(ValueError, match=(
            "activation must be one of 'tanh', 'sigmoid', 'sine', 'softplus', got ")):
        activation_named(name)
