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

"""The run-time model: lift, Jacobian, secants and drift against independent derivatives."""

from dataclasses import replace
import importlib

from koopman_ros.lifting import Coordinates, linearised_model, Provenance
from koopman_ros.plants import eigenvalues, two_state_reactor
import numpy as np
import pytest
from random_lifts import coordinates, random_lift

SHAPES = [(n_x, widths, identity)
          for n_x in (1, 2, 3) for widths in ((6,), (5, 4)) for identity in (True, False)]
every_shape = pytest.mark.parametrize(('n_x', 'widths', 'identity'), SHAPES)

# Truncation error h^4 f'''''/30 and rounding eps/h are both near 1e-13 for functions of order 1.
STEP = 1e-3


def derivative(function, x):
    """Differentiate by the five-point stencil: (..., m) -> (..., m, n_x) at one x (n_x,)."""
    columns = []
    for unit in np.eye(len(x)):
        f = {k: function(x + k * STEP * unit) for k in (-2, -1, 1, 2)}
        columns.append((f[-2] - f[2] + 8.0 * (f[1] - f[-1])) / (12.0 * STEP))
    return np.stack(columns, axis=-1)


def states(n_x, count=20, seed=1):
    return np.random.default_rng(seed).uniform(-1.5, 1.5, (count, n_x))


@every_shape
def test_origin_is_lifted_to_exactly_zero(n_x, widths, identity):
    model = random_lift(n_x, widths, identity=identity)
    np.testing.assert_array_equal(model.lift(np.zeros(n_x)), np.zeros(model.n_z))


@pytest.mark.parametrize('n_x', [1, 2, 3])
@pytest.mark.parametrize('widths', [(6,), (5, 4)])
def test_identity_coordinates_are_the_state(n_x, widths):
    model = random_lift(n_x, widths)
    for x in states(n_x):
        z, J = model.lift_and_jacobian(x)
        np.testing.assert_array_equal(z[:n_x], x)
        np.testing.assert_array_equal(J[:n_x], np.eye(n_x))


@every_shape
def test_a_batch_is_lifted_like_its_members(n_x, widths, identity):
    model = random_lift(n_x, widths, identity=identity)
    batch = states(n_x, 12)
    z, J = model.lift_and_jacobian(batch.reshape(3, 4, n_x))
    assert z.shape == (3, 4, model.n_z)
    assert J.shape == (3, 4, model.n_z, n_x)
    drift = model.drift(batch.reshape(3, 4, n_x))
    for i, x in enumerate(batch):
        place = np.unravel_index(i, (3, 4))
        # matrix and vector products may round differently
        np.testing.assert_allclose(z[place], model.lift(x), rtol=0, atol=1e-14)
        np.testing.assert_allclose(J[place], model.jacobian(x), rtol=0, atol=1e-14)
        np.testing.assert_allclose(drift[place], model.drift(x), rtol=1e-11, atol=1e-13)


@every_shape
def test_lift_and_jacobian_are_the_single_methods(n_x, widths, identity):
    model = random_lift(n_x, widths, identity=identity)
    batch = states(n_x)
    z, J = model.lift_and_jacobian(batch)
    np.testing.assert_array_equal(z, model.lift(batch))
    np.testing.assert_array_equal(J, model.jacobian(batch))


@every_shape
def test_jacobian_against_differences(n_x, widths, identity):
    model = random_lift(n_x, widths, identity=identity)
    for x in states(n_x):
        np.testing.assert_allclose(
            model.jacobian(x), derivative(model.lift, x), rtol=0, atol=1e-10)


@every_shape
def test_lift_and_jacobian_against_torch(n_x, widths, identity):
    torch = importlib.import_module('torch')
    model = random_lift(n_x, widths, identity=identity)
    layers = [(torch.tensor(w), torch.tensor(b)) for w, b in model.hidden]
    output = torch.tensor(model.output)

    def network(x):
        for weight, bias in layers:
            x = torch.tanh(weight @ x + bias)
        return output @ x

    def lift(x):
        free = network(x) - network(torch.zeros_like(x))
        return torch.cat([x, free]) if identity else free

    for x in states(n_x):
        point = torch.tensor(x)
        np.testing.assert_allclose(model.lift(x), lift(point).numpy(), rtol=0, atol=1e-14)
        np.testing.assert_allclose(
            model.jacobian(x), torch.func.jacrev(lift)(point).numpy(), rtol=0, atol=1e-13)


@every_shape
@pytest.mark.parametrize('separation', [2.0, 1e-2, 1e-5, 1e-8, 1e-9, 1e-12, 0.0])
def test_secants_are_exact(n_x, widths, identity, separation):
    model = random_lift(n_x, widths, identity=identity)
    rng = np.random.default_rng(4)
    nodes, weights = np.polynomial.legendre.leggauss(30)
    for reference in states(n_x, seed=2):
        x = reference + separation * rng.normal(size=n_x)
        w = rng.normal(size=n_x)
        M, H = model.secants(x, reference, w)
        # x - reference is not the separation drawn: x is rounded
        e = x - reference
        np.testing.assert_allclose(
            M @ e, model.lift(x) - model.lift(reference), rtol=0, atol=1e-14)
        np.testing.assert_allclose(
            H @ e, model.jacobian(x) @ w - model.jacobian(reference) @ w, rtol=0, atol=2e-14)
        if len(widths) == 1 or n_x == 1:
            # At small separations only M itself says whether something cancelled. For one layer
            # and for one state it is the mean of the Jacobian along the segment.
            points = reference + 0.5 * (1.0 + nodes[:, None]) * e
            mean = np.einsum('k,kij->ij', 0.5 * weights, model.jacobian(points))
            np.testing.assert_allclose(M, mean, rtol=0, atol=1e-13)


@every_shape
def test_secants_at_zero_separation_are_derivatives(n_x, widths, identity):
    model = random_lift(n_x, widths, identity=identity)
    w = np.random.default_rng(3).normal(size=n_x)
    for x in states(n_x):
        M, H = model.secants(x, x, w)
        np.testing.assert_allclose(M, model.jacobian(x), rtol=0, atol=1e-14)
        np.testing.assert_allclose(
            H, derivative(lambda y: model.jacobian(y) @ w, x), rtol=0, atol=1e-9)


@every_shape
@pytest.mark.parametrize('separation', [1e-4, 0.99e-8, 1.01e-8, 1e-10])
def test_secants_are_continuous(n_x, widths, identity, separation):
    """Around 1e-8 another formula takes over; nothing may jump there."""
    model = random_lift(n_x, widths, identity=identity)
    w = np.ones(n_x)
    for x in states(n_x):
        at_zero = model.secants(x, x, w)
        nearby = model.secants(x + separation, x, w)
        for a, b in zip(at_zero, nearby, strict=True):
            assert np.max(np.abs(a - b)) <= 20.0 * separation + 1e-14


@every_shape
def test_drift_is_the_least_squares_projection(n_x, widths, identity):
    model = random_lift(n_x, widths, identity=identity)
    for x in states(n_x):
        z, J = model.lift_and_jacobian(x)
        expected = np.linalg.lstsq(J, model.A @ z, rcond=None)[0]
        np.testing.assert_allclose(model.drift(x), expected, rtol=1e-10, atol=1e-13)


def linear_reactor():
    system = two_state_reactor()
    below, above = np.array([0.1, 9.0]), np.array([0.1, 5.0])
    return system, linearised_model(
        system.drift_jacobian(system.nominal_state), system.B,
        Coordinates(system.state_names, system.state_units, system.nominal_state,
                    np.array([0.1, 10.0]), system.nominal_state - below,
                    system.nominal_state + above),
        Coordinates(system.input_names, system.input_units, system.nominal_input,
                    np.array([7.0]), np.array([290.0]), np.array([310.0])),
        system.time_unit, Provenance(system.name))


def test_linearisation_is_a_lift_with_itself():
    _, model = linear_reactor()
    x = states(2)
    np.testing.assert_array_equal(model.lift(x), x)
    np.testing.assert_array_equal(model.jacobian(x), np.broadcast_to(np.eye(2), (20, 2, 2)))
    np.testing.assert_allclose(model.drift(x), x @ model.A.T, rtol=1e-14, atol=1e-15)
    M, H = model.secants(x[0], x[1], x[2])
    np.testing.assert_array_equal(M, np.eye(2))
    np.testing.assert_array_equal(H, np.zeros((2, 2)))


def test_linearisation_in_units():
    system, model = linear_reactor()
    x = system.nominal_state + np.array([0.02, -3.0])
    u = system.nominal_input + 4.0
    rate = model.states.scale * (
        model.drift(model.states.to_deviation(x)) + model.B @ model.inputs.to_deviation(u))
    jacobian = system.drift_jacobian(system.nominal_state)
    expected = jacobian @ (x - system.nominal_state) + system.B @ (u - system.nominal_input)
    np.testing.assert_allclose(rate, expected, rtol=1e-13)


def test_linearisation_has_the_eigenvalues_of_the_plant():
    system, model = linear_reactor()
    np.testing.assert_allclose(
        np.sort_complex(model.eigenvalues), eigenvalues(system, system.nominal_state), rtol=1e-12)
    assert model.is_hurwitz
    assert model.seconds_per_time_unit == 60.0


def with_drift_matrix(A):
    return replace(random_lift(n_x=1, n_free=len(A) - 1), A=np.array(A))


def test_eigenvalues_come_slowest_first():
    model = with_drift_matrix([[-3.0, 1.0, 0.0], [0.0, -0.5, 0.0], [0.0, 0.0, -7.0]])
    np.testing.assert_allclose(model.eigenvalues, [-0.5, -3.0, -7.0], rtol=1e-14)


@pytest.mark.parametrize(('A', 'hurwitz'), [
    ([[-1.0, 5.0], [0.0, -1e-9]], True),
    ([[-1.0, 5.0], [0.0, 0.0]], False),
    ([[0.0, 1.0], [-1.0, 0.0]], False),
    ([[-1.0, 0.0], [0.0, 1e-9]], False),
])
def test_hurwitz_needs_every_mode_to_decay(A, hurwitz):
    assert with_drift_matrix(A).is_hurwitz is hurwitz


def test_a_model_cannot_be_changed():
    A = -np.eye(5)
    model = replace(random_lift(), A=A)
    A[0, 0] = 9.0
    assert model.A[0, 0] == -1.0
    for array in (model.A, model.B, model.output, *model.hidden[0], model.states.center):
        with pytest.raises(ValueError, match='read-only'):
            array[0] = 1.0


@pytest.mark.parametrize(('change', 'message'), [
    ({'A': np.zeros((5, 4))}, r'incompatible A: expected \(5, 5\), got \(5, 4\)'),
    ({'A': np.zeros((6, 6))}, r'incompatible output: expected \(4, 5\), got \(3, 5\)'),
    ({'A': np.zeros((1, 1))}, 'incompatible A: n_z must be at least n_x = 2, got 1'),
    ({'A': np.full((5, 5), np.nan)}, 'A holds values that are not finite'),
    ({'B': np.zeros((1, 2))}, r'incompatible B: expected \(2, 1\), got \(1, 2\)'),
    ({'B': np.array([[1.0], [np.inf]])}, 'B holds values that are not finite'),
    ({'output': np.zeros((3, 4))}, r'incompatible output: expected \(3, 5\), got \(3, 4\)'),
    ({'identity': False}, r'incompatible output: expected \(5, 5\), got \(3, 5\)'),
    ({'hidden': ((np.zeros((5, 3)), np.zeros(5)),)},
     r'incompatible weight of hidden layer 0: expected \(5, 2\), got \(5, 3\)'),
    ({'hidden': ((np.zeros((5, 2)), np.zeros(4)),)},
     r'incompatible weight of hidden layer 0: expected \(4, 2\), got \(5, 2\)'),
    ({'hidden': ((np.zeros((5, 2)), np.zeros(5)), (np.zeros((5, 4)), np.zeros(5)))},
     r'incompatible weight of hidden layer 1: expected \(5, 5\), got \(5, 4\)'),
    ({'hidden': ((np.zeros((5, 2)), np.full(5, np.inf)),)},
     'bias of hidden layer 0 holds values that are not finite'),
    ({'hidden': ()}, 'a lift with free coordinates needs a hidden layer'),
    ({'time_unit': 'h'}, "time_unit must be 's' or 'min', got 'h'"),
])
def test_a_model_that_does_not_fit_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        replace(random_lift(), **change)


@pytest.mark.parametrize(('change', 'message'), [
    ({'units': ('K',)}, 'incompatible units: expected 2, got 1'),
    ({'center': np.zeros(3)}, r'incompatible center: expected \(2,\), got \(3,\)'),
    ({'scale': np.ones((2, 1))}, r'incompatible scale: expected \(2,\), got \(2, 1\)'),
    ({'scale': np.array([1.0, 0.0])}, r'scale must be positive, got \[1.0, 0.0\]'),
    ({'scale': np.array([1.0, -1.0])}, r'scale must be positive, got \[1.0, -1.0\]'),
    ({'lower': np.array([np.nan, 0.0])}, 'lower holds values that are not finite'),
    ({'upper': np.array([0.0, np.inf])}, 'upper holds values that are not finite'),
    ({'lower': np.array([4.0, 0.0])}, r'the box is empty: lower \[4.0, 0.0\], upper \[3.5, 2.5\]'),
    ({'lower': np.array([3.5, 0.0])}, 'the box is empty'),
])
def test_coordinates_that_do_not_fit_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        replace(coordinates('x', 2), **change)


def test_coordinates_scale_both_ways():
    c = coordinates('x', 2)
    np.testing.assert_array_equal(c.to_deviation(np.array([4.0, -0.5])), [2.0, -1.0])
    np.testing.assert_array_equal(c.to_physical(np.array([2.0, -1.0])), [4.0, -0.5])
    batch = states(2)
    np.testing.assert_allclose(c.to_deviation(c.to_physical(batch)), batch, rtol=0, atol=1e-15)


# The box is [2, 3.5] x [-2, 2.5], with half widths 0.75 and 2.25.
@pytest.mark.parametrize(('value', 'violation'), [
    ([3.0, 0.0], 0.0),
    ([2.0, 2.5], 0.0),
    ([3.5, -2.0], 0.0),
    ([4.25, 0.0], 1.0),
    ([1.25, 0.0], 1.0),
    ([3.0, 7.0], 2.0),
    ([5.0, -4.25], 2.0),
    ([3.5, -8.75], 3.0),
])
def test_violation_counts_half_widths(value, violation):
    assert coordinates('x', 2).violation(np.array(value)) == pytest.approx(violation, rel=1e-15)


def test_model_without_inputs():
    model = replace(random_lift(), inputs=coordinates('u', 0), B=np.zeros((2, 0)))
    assert model.n_u == 0
    assert model.inputs.violation(np.zeros(0)) == 0.0
