# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The run-time model: sizes, modes, drift, linearisation; boxes of signals, training states."""

from dataclasses import replace
import math
from types import SimpleNamespace

import numpy as np
import pytest

from koopman_ros.core.datasets import PlantDescription
from koopman_ros.learning import IncrementalTraining, train
from koopman_ros.learning.lift.residuals import deviations
from koopman_ros.model import (
    Box,
    Coordinates,
    InputTerms,
    linearised_model,
    NetworkObservables,
    PolynomialObservables,
    Provenance,
    TrainingStates,
)
from koopman_ros.plants import two_state_reactor
from studies.paper.optimal_control import exact_two_state_model
from support.random_lifts import coordinates, random_lift, random_network
from support.small_plants import BENT, bent_samples, TWO_STATE, two_state_samples


def states(n_x, count=20, seed=1):
    return np.random.default_rng(seed).uniform(-1.5, 1.5, (count, n_x))


@pytest.mark.parametrize('identity', [True, False])
@pytest.mark.parametrize('n_x', [1, 2, 3])
def test_rates_of_z_are_brought_to_the_nearest_rate_of_the_state(n_x, identity):
    """And the drift is that of A z, for a batch as for its members."""
    model = random_lift(n_x, 6, identity=identity)
    batch = states(n_x, 12)
    drift = model.drift(batch.reshape(3, 4, n_x)).reshape(12, n_x)
    for x, of_batch in zip(batch, drift, strict=True):
        z, J = model.lift_and_jacobian(x)
        expected = np.linalg.lstsq(J, model.A @ z, rcond=None)[0]
        np.testing.assert_allclose(model.drift(x), expected, rtol=1e-10, atol=1e-13)
        # matrix and vector products may round differently
        np.testing.assert_allclose(of_batch, model.drift(x), rtol=1e-11, atol=1e-13)
        for columns in ((), (1,), (3,)):
            rate = np.random.default_rng(3).normal(size=(model.n_z, *columns))
            found = model.onto_states(J) @ rate
            assert found.shape == (n_x, *columns)
            expected = np.linalg.lstsq(J, rate, rcond=None)[0]
            np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-13)


def test_a_lift_at_rest_moves_no_state():
    model = random_lift(1, identity=False)
    np.testing.assert_array_equal(
        model.onto_states(np.zeros((model.n_z, 1))) @ np.ones(model.n_z), [0.0])


def test_drift_of_a_dictionary_by_hand():
    """With z = (x, x^2) the first row of A z is the rate of x, whatever the second one says."""
    A = np.array([[-1.0, 0.25], [0.5, -3.0]])
    model = replace(random_lift(1), observables=PolynomialObservables.total_degree(1, 2),
                    A=A, readout=A[:1])
    x = np.linspace(-2.0, 2.0, 9)[:, None]
    expected = -x + 0.25 * x ** 2
    np.testing.assert_allclose(model.drift(x), expected, rtol=1e-13)
    np.testing.assert_allclose([model.drift(v) for v in x], expected, rtol=1e-13)
    np.testing.assert_array_equal(model.linearised.A, [[-1.0]])


def test_the_mismatch_of_a_lift_is_how_far_its_coordinates_go_another_way():
    """
    Of z = (x, x^2) with dx/dt = -x, dz/dt = (-x, -2 x^2), by hand.

    With as many states to both sides the two coordinates are whitened each by itself, and an A
    that has -2 + d makes d^2 / (1 + 4) of it.
    """
    lift = PolynomialObservables.total_degree(1, 2)
    x = np.linspace(-1.0, 1.0, 21)[:, None]
    for d in (0.0, 0.1, -0.5):
        model = replace(random_lift(1), observables=lift, A=np.diag([-1.0, -2.0 + d]),
                        readout=np.array([[-1.0, 0.0]]), training_states=TrainingStates(x, 0.1))
        assert model.mismatch == pytest.approx(d * d / 5.0, rel=1e-10, abs=1e-20)
        # the same under a pre-feedback that makes up for another drift
        K = np.array([[-2.0]])
        pushed = replace(model, pre_feedback=K,
                         readout=model.readout - model.B @ K @ [[1.0, 0.0]])
        assert pushed.mismatch == pytest.approx(model.mismatch, rel=1e-10, abs=1e-20)
        # without known states they are all over the box, which is not even about the middle
        spread = replace(model, training_states=None).mismatch
        assert (0.1 * d * d < spread < d * d) if d else spread < 1e-20
    assert replace(model, A=np.zeros((2, 2)), readout=np.zeros((1, 2))).mismatch == 0.0
    assert random_lift().linearised.mismatch < 1e-20


def test_averaged_jacobian_of_a_cubic_drift_by_hand():
    """x1' = x2, x2' = -x1 + x2 - x1^2 x2; Simpson's rule gives the means of squares."""
    observables = PolynomialObservables(np.array([[1, 0], [0, 1], [2, 1]]))
    A = np.array([[0.0, 1.0, 0.0], [-1.0, 1.0, -1.0], [0.0, 0.0, 0.0]])
    model = replace(random_lift(2, n_free=1), observables=observables, A=A, readout=A[:2])
    for x, x_ref in zip(states(2), states(2, seed=2), strict=True):
        ends = np.array([x, 0.5 * (x + x_ref), x_ref])
        mixed, square = np.array([1.0, 4.0, 1.0]) / 6.0 @ np.stack(
            (ends[:, 0] * ends[:, 1], ends[:, 0] ** 2), axis=1)
        found = model.averaged_drift_jacobian(x, x_ref)
        np.testing.assert_allclose(found, [[0.0, 1.0], [-1.0 - 2.0 * mixed, 1.0 - square]],
                                   rtol=0, atol=1e-13)
        np.testing.assert_allclose(found @ (x - x_ref), model.drift(x) - model.drift(x_ref),
                                   rtol=0, atol=1e-13)


@pytest.mark.parametrize('identity', [True, False])
@pytest.mark.parametrize('n_x', [1, 2, 3])
def test_the_slope_of_the_drift_is_that_of_differences(n_x, identity):
    model = replace(random_lift(n_x, 6, identity=identity, n_u=2),
                    pre_feedback=np.random.default_rng(5).normal(size=(2, n_x)))
    batch, step = 0.5 * states(n_x, 6).reshape(2, 3, n_x), 1e-5 * np.eye(n_x)
    f, slope = model.drift_and_jacobian(batch)
    np.testing.assert_allclose(f, model.drift(batch), rtol=1e-12, atol=1e-13)
    ahead, behind = (model.drift(batch[..., None, :] + sign * step) for sign in (1.0, -1.0))
    differences = (ahead - behind).swapaxes(-1, -2) / 2e-5
    np.testing.assert_allclose(slope, differences, rtol=1e-6,
                               atol=1e-7 * np.max(np.abs(differences)))


@pytest.mark.parametrize('n_x', [1, 2, 3])
def test_averaged_jacobian_makes_the_difference_of_the_drift(n_x):
    model = random_lift(n_x)
    for x, x_ref in zip(0.5 * states(n_x), 0.5 * states(n_x, seed=2), strict=True):
        A = model.averaged_drift_jacobian(x, x_ref)
        np.testing.assert_allclose(A @ (x - x_ref), model.drift(x) - model.drift(x_ref),
                                   rtol=0, atol=1e-5)
        # at the reference it is the slope there
        np.testing.assert_allclose(model.averaged_drift_jacobian(x, x), model.drift_jacobian(x),
                                   rtol=0, atol=1e-9)
    batch = states(n_x, 6).reshape(2, 3, n_x)
    for x, of_batch in zip(batch.reshape(6, n_x), model.drift_jacobian(batch).reshape(
            6, n_x, n_x), strict=True):
        np.testing.assert_allclose(of_batch, model.drift_jacobian(x), rtol=0, atol=1e-9)


def read_out(n_x=2, units=5, **options):
    """Return a random lift with a random read-out of its hidden units."""
    weights = np.random.default_rng(0).normal(size=(n_x, n_x + units))
    return replace(random_lift(n_x, units, **options), readout=weights)


def test_a_read_out_by_hand():
    """Of f = 3 x - 2 (tanh(2 x + 1) - tanh(1)), beside whatever z and A are."""
    model = replace(random_lift(1, 1), observables=NetworkObservables(
        np.array([[2.0]]), np.array([1.0]), np.ones((3, 1)), identity=True),
        readout=np.array([[3.0, -2.0]]))
    x = np.linspace(-1.0, 1.0, 7)
    np.testing.assert_allclose(model.drift(x[:, None])[:, 0],
                               3.0 * x - 2.0 * (np.tanh(2.0 * x + 1.0) - np.tanh(1.0)),
                               rtol=0, atol=1e-14)
    slope = 3.0 - 4.0 / np.cosh(2.0 * x + 1.0) ** 2
    np.testing.assert_allclose([model.drift_jacobian(np.array([v]))[0, 0] for v in x], slope,
                               rtol=0, atol=1e-14)
    np.testing.assert_allclose(model.linearised.A, [[3.0 - 4.0 / np.cosh(1.0) ** 2]], rtol=1e-14)
    assert model.linearised.readout is None


@pytest.mark.parametrize('identity', [True, False])
def test_a_pre_feedback_is_taken_out_of_the_drift(identity):
    """A z is the rate under u = K x, of which B K x is the input's share."""
    model = replace(random_lift(3, n_u=2, identity=identity),
                    pre_feedback=np.random.default_rng(5).normal(size=(2, 3)))
    for x in states(3, 5):
        z, J = model.lift_and_jacobian(x)
        expected = np.linalg.lstsq(J, model.A @ z, rcond=None)[0] - (
            model.B @ model.pre_feedback @ x)
        np.testing.assert_allclose(model.drift(x), expected, rtol=0, atol=1e-12)
        np.testing.assert_allclose(model.drift(np.array([x, x])), [expected] * 2,
                                   rtol=0, atol=1e-12)
        # what the features say is the drift itself
        weights = np.ones((3, model.observables.features.n_z))
        np.testing.assert_array_equal(
            replace(model, readout=weights).drift(x),
            replace(model, readout=weights, pre_feedback=None).drift(x))
    step = 1e-6 * np.eye(3)
    slope = (model.drift(step) - model.drift(-step)).T / 2e-6
    linear = model.linearised
    np.testing.assert_allclose(linear.A, slope, rtol=0, atol=1e-8)
    assert linear.pre_feedback is None
    np.testing.assert_allclose(linear.drift(step), step @ linear.A.T, rtol=0, atol=1e-20)


def under_pre_feedback(model, K):
    """Return the model of the same plant whose A is that of the plant under u = K x."""
    push = model.jacobian(np.zeros(model.n_x)) @ model.B
    A = np.array(model.A)
    A[:, :model.n_x] += push @ K
    return replace(model, A=A, pre_feedback=K)


def test_a_plant_is_the_same_with_and_without_pre_feedback():
    """The exact lift of the two-state example, whose J B is constant: drift, modes, mismatch."""
    exact, x = exact_two_state_model(), states(2)
    for model in (exact, replace(exact, readout=None)):
        closed = under_pre_feedback(model, np.array([[0.3, -3.0]]))
        np.testing.assert_allclose(closed.drift(x), model.drift(x), rtol=0, atol=1e-13)
        np.testing.assert_allclose(closed.linearised.A, model.linearised.A, rtol=0, atol=1e-14)
        assert closed.mismatch < 1e-25
        # the eigenvalues are those of the closed loop
        assert (model.is_hurwitz, closed.is_hurwitz) == (False, True)
        assert not closed.adds_unstable_modes
    assert under_pre_feedback(exact, np.array([[0.0, 2.0]])).adds_unstable_modes is False
    grows = replace(exact, A=exact.A + np.diag([0.0, 0.0, 1.0]))
    assert under_pre_feedback(grows, np.array([[0.0, -3.0]])).adds_unstable_modes


@pytest.mark.parametrize('seed', range(10))
def test_an_integrator_is_no_mode_that_the_lift_adds(seed):
    """However its eigenvalue is rounded, in the lift and in the linearised model."""
    rng = np.random.default_rng(seed)
    T = np.linalg.qr(rng.normal(size=(2, 2)))[0]
    A = np.zeros((4, 4))
    A[:2, :2], A[2:, 2:] = T @ np.diag([0.0, -1.0]) @ T.T, [[-3.0, 1.0], [0.0, -4.0]]
    # nothing moves the first direction, along which an integrator is
    A[:2, 2:], A[2:, :2] = 0.1 * np.outer(T[:, 1], rng.normal(size=2)), rng.normal(size=(2, 2))
    # squares are flat at the nominal point, where the drift's slope is the first block
    observables = PolynomialObservables(np.array([[1, 0], [0, 1], [2, 0], [0, 2]]))
    model = replace(random_lift(n_free=2), observables=observables, A=A)
    assert not model.adds_unstable_modes


@pytest.mark.parametrize('model', [
    read_out(), read_out(3, 6, identity=False), read_out(1, 4),
    replace(random_lift(n_free=7), observables=PolynomialObservables.total_degree(2, 3),
            readout=np.random.default_rng(0).normal(size=(2, 9)))],
    ids=['identity', 'free', 'one state', 'monomials'])
def test_the_drift_of_a_read_out_and_its_slope(model):
    """At rest at the nominal point exactly; its slope is that of differences."""
    np.testing.assert_array_equal(model.drift(np.zeros(model.n_x)), 0.0)
    batch = states(model.n_x, 6)
    np.testing.assert_allclose(model.drift(batch), [model.drift(x) for x in batch],
                               rtol=0, atol=1e-13)
    for x in batch:
        step = 1e-6 * np.eye(model.n_x)
        slope = (model.drift(x + step) - model.drift(x - step)).T / 2e-6
        np.testing.assert_allclose(model.drift_jacobian(x), slope, rtol=0, atol=2e-8)
        difference = model.drift(x) - model.drift(batch[0])
        np.testing.assert_allclose(model.averaged_drift_jacobian(x, batch[0]) @ (x - batch[0]),
                                   difference, rtol=0, atol=1e-12)


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


def test_linearisation_in_units_has_the_eigenvalues_of_the_plant():
    system, model = linear_reactor()
    assert model.is_hurwitz
    assert model.seconds_per_time_unit == 60.0
    x = system.nominal_state + np.array([0.02, -3.0])
    u = system.nominal_input + 4.0
    rate = model.states.scale * (
        model.drift(model.states.to_deviation(x)) + model.B @ model.inputs.to_deviation(u))
    jacobian = system.drift_jacobian(system.nominal_state)
    expected = jacobian @ (x - system.nominal_state) + system.B @ (u - system.nominal_input)
    np.testing.assert_allclose(rate, expected, rtol=1e-13)
    np.testing.assert_allclose(np.sort_complex(model.eigenvalues),
                               np.sort_complex(np.linalg.eigvals(jacobian)), rtol=1e-12)


@pytest.mark.parametrize(('A', 'slowest_first', 'hurwitz'), [
    ([[-3.0, 1.0, 0.0], [0.0, -0.5, 0.0], [0.0, 0.0, -7.0]], [-0.5, -3.0, -7.0], True),
    ([[-1.0, 5.0], [0.0, -1e-7]], [-1e-7, -1.0], True),
    ([[-1.0, 5.0], [0.0, 0.0]], [0.0, -1.0], False),
    ([[0.0, 1.0], [-1.0, 0.0]], [1j, -1j], False),
    ([[-1.0, 0.0], [0.0, 1e-9]], [1e-9, -1.0], False),
])
def test_eigenvalues_come_slowest_first_and_every_mode_has_to_decay(A, slowest_first, hurwitz):
    model = replace(random_lift(n_x=1, n_free=len(A) - 1), A=np.array(A))
    np.testing.assert_allclose(model.eigenvalues, slowest_first, rtol=1e-14, atol=1e-16)
    assert model.is_hurwitz is hurwitz


def test_a_printed_model_shows_its_ranges_rates_and_verdict():
    model = exact_two_state_model()
    model = replace(model, provenance=replace(
        model.provenance, metrics={'rx': 0.25, f'free_run_{model.states.names[0]}': 0.5},
        accepted=False, reasons=('too few loops',)),
        dead_time=np.array([7.5]))
    lines = str(model).splitlines()
    for name, unit in zip(model.states.names, model.states.units, strict=True):
        assert sum(f'state {name}: trained from' in line and line.endswith(unit)
                   for line in lines) == 1
    assert f'{model.eigenvalues.real[0]:.4g} per {model.time_unit}' in str(model)
    assert '  held-out residual of the drift, relative: 0.25' in lines
    assert any(line.startswith('  free-run error (RMS)') and line.endswith(': 0.5')
               for line in lines)
    assert f'  dead time of {model.inputs.names[0]}: 7.5 s' in lines
    assert lines[-1] == '  acceptance: rejected (too few loops)'
    in_notebook = []
    model._repr_pretty_(SimpleNamespace(text=in_notebook.append), False)
    assert in_notebook == [str(model)]


def test_a_model_cannot_be_changed():
    A = -np.eye(5)
    model = replace(random_lift(), A=A)
    A[0, 0] = 9.0
    assert model.A[0, 0] == -1.0
    for array in (model.A, model.B, model.E, model.states.center):
        with pytest.raises(ValueError, match='read-only'):
            array[0] = 1.0


@pytest.mark.parametrize(('change', 'message'), [
    ({'A': np.zeros((5, 4))}, r'incompatible A: expected \(5, 5\), got \(5, 4\)'),
    ({'A': np.zeros((6, 6))}, r'incompatible A: expected \(5, 5\), got \(6, 6\)'),
    ({'A': np.zeros(5)}, r'incompatible A: expected \(5, 5\), got \(5,\)'),
    ({'A': np.full((5, 5), np.nan)}, 'A must be finite'),
    ({'B': np.zeros((1, 2))}, r'incompatible B: expected \(2, 1\), got \(1, 2\)'),
    ({'B': np.array([[1.0], [np.inf]])}, 'B must be finite'),
    ({'observables': random_network(3)}, 'incompatible observables: expected 2 states, got 3'),
    ({'observables': random_network(n_free=4)},
     r'incompatible A: expected \(6, 6\), got \(5, 5\)'),
    ({'observables': random_network(identity=False)},
     r'incompatible A: expected \(3, 3\), got \(5, 5\)'),
    ({'observables': PolynomialObservables.total_degree(2, 3)},
     r'incompatible A: expected \(9, 9\), got \(5, 5\)'),
    ({'readout': np.zeros((2, 5))}, r'incompatible readout: expected \(2, 7\), got \(2, 5\)'),
    ({'readout': np.full((2, 7), np.nan)}, 'readout must be finite'),
    ({'pre_feedback': np.zeros((2, 1))},
     r'incompatible pre_feedback: expected \(1, 2\), got \(2, 1\)'),
    ({'pre_feedback': np.full((1, 2), np.inf)}, 'pre_feedback must be finite'),
    ({'E': np.ones((2, 1))}, r'incompatible E: expected \(2, 0\), got \(2, 1\)'),
    ({'disturbances': coordinates('d', 1)}, r'incompatible E: expected \(2, 1\)'),
    ({'time_unit': 'h'}, "time_unit must be 's' or 'min', got 'h'"),
    ({'training_states': TrainingStates(np.zeros((1, 3)), 0.0)},
     'incompatible training_states: expected 2 states, got 3'),
])
def test_a_model_that_does_not_fit_is_rejected(change, message):
    with pytest.raises(ValueError, match=message):
        replace(random_lift(), **change)


def test_a_measured_disturbance_acts_as_the_input_that_it_was():
    joined = random_lift(n_u=3)
    model = joined.with_disturbances(('u2', 'u0'))
    assert (model.inputs.names, model.disturbances.names) == (('u1',), ('u2', 'u0'))
    line = '  measured disturbance u2: trained from -279.15 to -271.65 degC'
    assert line in str(model).splitlines()
    x, u = np.array([0.3, -0.2]), np.array([4.0, 2.0, -1.0])
    rate = joined.rate_under(joined.inputs.to_deviation(u))(x)
    w = model.disturbance_rate(u[[2, 0]])
    np.testing.assert_allclose(
        model.rate_under(model.inputs.to_deviation(u[[1]]), w)(x), rate, rtol=1e-12)
    back = model.joined
    assert back.inputs.names == ('u1', 'u2', 'u0')
    np.testing.assert_array_equal(back.B, joined.B[:, [1, 2, 0]])
    assert not len(back.disturbances)
    assert back.with_disturbances(('u2', 'u0')).joined.inputs.names == back.inputs.names
    np.testing.assert_array_equal(model.linearised.E, model.E)
    # at its nominal value it does nothing
    np.testing.assert_array_equal(model.disturbance_rate(model.disturbances.center), 0.0)
    assert joined.with_disturbances(()) is joined is joined.joined


@pytest.mark.parametrize(('changes', 'names', 'message'), [
    ({}, ('x',), 'unknown names x: choose from u0, u1'),
    ({'input_terms': InputTerms(np.ones((2, 2, 2)))}, ('u1',), 'must not depend on the state'),
    ({'pre_feedback': np.ones((2, 2))}, ('u1',), 'must not depend on the state'),
    ({'dead_time': np.array([0.0, 3.0])}, ('u1',), 'has no dead time'),
])
def test_an_input_that_cannot_be_a_disturbance_is_rejected(changes, names, message):
    with pytest.raises(ValueError, match=message):
        replace(random_lift(n_u=2), **changes).with_disturbances(names)


@pytest.mark.parametrize(('change', 'message'), [
    ({'units': ('K',)}, 'incompatible units: expected 2, got 1'),
    ({'center': np.zeros(3)}, r'incompatible center: expected \(2,\), got \(3,\)'),
    ({'scale': np.ones((2, 1))}, r'incompatible scale: expected \(2,\), got \(2, 1\)'),
    ({'scale': np.array([1.0, 0.0])}, r'scale must be positive, got \[1.0, 0.0\]'),
    ({'scale': np.array([1.0, -1.0])}, r'scale must be positive, got \[1.0, -1.0\]'),
    ({'lower': np.array([np.nan, 0.0])}, 'lower must be finite'),
    ({'upper': np.array([0.0, np.inf])}, 'upper must be finite'),
    ({'lower': np.array([4.0, 0.0])}, r'the box is empty: lower \[4.0, 0.0\], upper \[3.5, 2.5\]'),
    ({'lower': np.array([3.5, 0.0])}, 'the box is empty'),
])
def test_coordinates_that_do_not_fit_are_rejected(change, message):
    with pytest.raises(ValueError, match=message):
        replace(coordinates('x', 2), **change)


def test_coordinates_scale_both_ways():
    c = coordinates('x', 2)
    np.testing.assert_array_equal(c.to_deviation(np.array([4.0, -0.5])), [2.0, -1.0])
    np.testing.assert_array_equal(c.to_physical(np.array([2.0, -1.0])), [4.0, -0.5])
    batch = states(2)
    np.testing.assert_allclose(c.to_deviation(c.to_physical(batch)), batch, rtol=0, atol=1e-15)


# The box is [2, 3.5] x [-2, 2.5], with half-ranges 0.75 and 2.25.
@pytest.mark.parametrize(('value', 'violation'), [
    ([3.0, 0.0], 0.0), ([2.0, 2.5], 0.0), ([3.5, -2.0], 0.0), ([4.25, 0.0], 1.0),
    ([1.25, 0.0], 1.0), ([3.0, 7.0], 2.0), ([5.0, -4.25], 2.0), ([3.5, -8.75], 3.0),
    *((value, np.inf) for value in (
        [np.nan, 0.0], [3.0, np.nan], [np.inf, 0.0], [5.0, -np.inf], [np.nan, 70.0])),
])
def test_violation_counts_half_widths(value, violation):
    assert coordinates('x', 2).violation(np.array(value)) == pytest.approx(violation, rel=1e-15)


def test_model_without_inputs():
    model = replace(random_lift(), inputs=coordinates('u', 0), B=np.zeros((2, 0)),
                    dead_time=np.zeros(0))
    assert model.n_u == 0
    assert model.inputs.violation(np.zeros(0)) == 0.0


# Boxes, from the range of samples.

def test_box_scales_by_half_the_range_from_the_nominal_point():
    samples = bent_samples()
    box = Box.of(BENT, samples.x, samples.u)
    np.testing.assert_array_equal(box.states.center, [3.0])
    np.testing.assert_array_equal(box.inputs.center, [0.5])
    np.testing.assert_array_equal(box.states.lower, samples.x.min(axis=0))
    np.testing.assert_array_equal(box.states.upper, samples.x.max(axis=0))
    np.testing.assert_array_equal(box.states.scale, np.ptp(samples.x, axis=0) / 2.0)
    assert (box.states.names, box.inputs.units, box.time_unit) == (
        ('level',), ('m/s',), 's')
    # the equation holds in deviations, too
    x, rate, u = deviations(box, samples)
    np.testing.assert_allclose(
        rate, (-x - 0.3 * box.states.scale * x * x) + u @ box.input_matrix(BENT.B).T,
        rtol=0, atol=1e-14)
    # and without inputs
    plant = PlantDescription('free', ('x',), ('1',), (), (), 's', np.zeros(1), np.zeros(0),
                             np.zeros((1, 0)))
    samples = replace(samples, u=np.zeros((180, 0)))
    box = Box.of(plant, samples.x, samples.u)
    assert len(box.inputs) == 0
    assert box.input_matrix(plant.B).shape == (1, 0)
    assert deviations(box, samples)[2].shape == (180, 0)


@pytest.mark.parametrize(('changes', 'message'), [
    ({'u': np.full((180, 1), 0.5)}, '0.5 m/s: excite the plant'),
    ({'x': np.full((180, 1), 3.0)}, '3.0 m: excite the plant'),
    ({'u': np.zeros((180, 2))}, 'values of 2 signals for 1 names: flow')])
def test_constant_or_mismatched_signals_have_no_box(changes, message):
    samples = bent_samples()
    with pytest.raises(ValueError, match=message):
        Box.of(BENT, changes.get('x', samples.x), changes.get('u', samples.u))
    with pytest.raises(ValueError, match=r'incompatible B: expected \(1, 1\), got \(2, 1\)'):
        Box.of(BENT, samples.x, samples.u).input_matrix(np.ones((2, 1)))


# Representative states of the training data.

# an L along two sides of the box [-1, 1] x [-1, 1]
L_SHAPE = np.array([[-1.0, y] for y in np.linspace(-1.0, 1.0, 21)]
                   + [[x, -1.0] for x in np.linspace(-0.9, 1.0, 20)])
ONES = np.ones(2)


def test_few_states_are_all_kept_once_and_fill_completely():
    assert len(TrainingStates.of(np.zeros((9, 2)), ONES).states) == 1
    found = TrainingStates.of(L_SHAPE, ONES)
    assert found.fill_distance == 0.0
    assert {tuple(x) for x in found.states} == {tuple(x) for x in L_SHAPE}
    # the corner of the box that holds no data
    assert found.distance(ONES, ONES) == pytest.approx(2.0)
    assert found.distance(np.array([-1.0, -1.0]), ONES) == 0.0


def test_many_states_are_thinned_and_none_is_outside():
    states = np.random.default_rng(0).uniform(-1.0, 1.0, (3000, 2))
    states = states[states.min(axis=1) < 0.0]
    found = TrainingStates.of(states, ONES)
    assert found.states.shape == (256, 2)
    nearest = [np.min(np.max(np.abs(found.states - x), axis=1)) for x in states]
    assert found.fill_distance == max(nearest)
    # 256 squares of this half side would cover three quarters of the box
    assert 0.5 * math.sqrt(3.0 / 256.0) <= found.fill_distance < 2.0 * math.sqrt(3.0 / 256.0)
    assert max(found.distance(x, ONES) for x in states) == 0.0
    assert found.distance(np.array([0.6, 0.6]), ONES) == pytest.approx(0.6, abs=0.15)


def test_distance_of_a_model_is_the_larger_of_box_and_data():
    model = random_lift()
    model = replace(model, states=replace(
        model.states, center=np.zeros(2), scale=np.array([1.0, 2.0]), lower=np.array([-1.0, -2.0]),
        upper=np.array([1.0, 2.0])), training_states=TrainingStates.of(L_SHAPE, ONES))
    # in state units, the second coordinate is scaled by 2
    assert model.distance(np.array([1.0, 2.0])) == pytest.approx(2.0)
    assert model.distance(np.array([-1.0, 1.5])) == pytest.approx(0.05)
    assert model.distance(np.array([-1.0, 5.0])) == pytest.approx(1.5)
    assert model.distance(np.array([np.nan, 0.0])) == math.inf
    boxed = replace(model, training_states=None)
    assert boxed.distance(np.array([1.0, 2.0])) == 0.0
    assert boxed.distance(np.array([-1.0, 5.0])) == model.states.violation(np.array([-1.0, 5.0]))


@pytest.mark.parametrize(('states', 'fill', 'words'), [
    (np.zeros((0, 2)), 0.0, 'M from 1 to 256'), (np.zeros((257, 2)), 0.0, 'M from 1 to 256'),
    (np.zeros(2), 0.0, 'M from 1 to 256'), (np.full((1, 2), np.nan), 0.0, 'must be finite'),
    (np.zeros((1, 2)), -1.0, 'fill_distance must be'), (np.zeros((1, 2)), math.inf, 'fill_dis')])
def test_what_does_not_fit_is_rejected(states, fill, words):
    with pytest.raises(ValueError, match=words):
        TrainingStates(states, fill)


def test_training_on_several_states_notes_them_and_on_one_does_not():
    recipe = IncrementalTraining(3, hidden_first=3, max_iterations=2)
    samples = two_state_samples()
    model = train(TWO_STATE, samples, recipe, starts=1, reject=False).model
    known = model.training_states
    assert known is not None
    assert known.states.shape == (256, 2)
    # but for rounding on the way to scaled deviations and back
    assert all(model.distance(x) < 1e-12 for x in samples.x)
    assert model.distance(np.array([-6.0, 12.0])) > 0.5
    assert train(BENT, bent_samples(), IncrementalTraining(2, hidden_first=3, max_iterations=2),
                 starts=1, reject=False).model.training_states is None


def test_lists_do_as_arrays_do_and_another_size_is_rejected():
    model, x = random_lift(), [0.3, -0.2]
    for act in (model.lift, model.jacobian, model.drift, model.distance):
        np.testing.assert_array_equal(act(x), act(np.array(x)))
        with pytest.raises(ValueError, match=r'incompatible state: expected one number for each '
                                             r'of x0, x1 in the last axis, got \(3,\)'):
            act(np.zeros(3))
    with pytest.raises(ValueError, match='level: choose from x0, x1'):
        model.states.only(['level'])
    plant = replace(model.plant, nominal_state=[1.0, 1.0])
    with pytest.raises(ValueError, match='incompatible x: expected one row'):
        Box.of(plant, [1.0, 2.0], [[1.0]])


def test_the_mismatch_of_a_lift_that_overflows_at_a_training_state_is_an_error():
    # LAPACK's decomposition of a matrix with infinities does not return
    model = random_lift()
    far = replace(model, training_states=TrainingStates(np.array([[1e200, 0.0], [0.0, 0.1]]), 0.1))
    with np.errstate(all='ignore'), pytest.raises(np.linalg.LinAlgError, match='not finite'):
        assert far.mismatch
