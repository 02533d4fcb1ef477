# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The experiments: their data, what they measure, and their known answers."""

import numpy as np
import pytest
from scipy.linalg import solve_continuous_are

from koopman_ros.control import projected, steady_state_target, Weights
from koopman_ros.learning import Edmd, fit, Linearisation
from koopman_ros.plants import scalar_example
from validation.paper import reactor, two_state
from validation.paper.datasets import describe

BOXES = [two_state.WIDE, *two_state.NARROW.values()]


@pytest.mark.parametrize('box', BOXES, ids=str)
def test_samples_stay_within_their_box_and_fill_it(box):
    samples = two_state.samples(box, 1)
    assert np.all(samples.x >= box.lower)
    assert np.all(samples.x <= box.upper)
    assert samples.u.min() >= box.inputs[0]
    assert samples.u.max() <= box.inputs[1]
    for low, high, x in zip(box.lower, box.upper, samples.x.T, strict=True):
        # where x1 starts at its lower side it leaves the box at once
        assert x.max() - x.min() > 0.75 * (high - low)
    np.testing.assert_allclose(
        samples.dxdt, two_state.SYSTEM.derivative(samples.x, samples.u), rtol=1e-12)


def test_the_same_seed_gives_the_same_samples():
    first, again, other = (reactor.training_samples(seed).digest() for seed in (3, 3, 4))
    assert first == again != other


def test_linearised_control_of_the_two_state_example():
    """Ratios from a Lyapunov solution of the linear law on the exact lift."""
    samples = two_state.samples(two_state.WIDE, 0, episodes=5)
    linear = Linearisation(two_state.SYSTEM.drift_jacobian(np.zeros(2))).learn(
        describe(two_state.SYSTEM), samples)
    for R, ratio in ((1.0, 4.5297), (0.1, 1.9296)):
        loop = two_state.close_loop(linear, R)
        assert loop.cost / two_state.exact_two_state_cost(two_state.START, R) == pytest.approx(
            ratio, abs=1e-3)


def test_monomials_control_the_two_state_example_by_its_exact_drift():
    """The drift is of degree 2, and f(x) = (the mean of df/dx from 0 to x) x by hand."""
    samples = two_state.samples(two_state.WIDE, 0, episodes=5)
    model = Edmd(2).learn(describe(two_state.SYSTEM), samples)
    assert fit(model, samples.x, samples.dxdt, samples.u).rx < 1e-20
    scale = model.states.scale
    weights = Weights(np.diag(scale ** 2), np.diag(model.inputs.scale ** 2))
    origin = steady_state_target(model, model.states.to_deviation(np.zeros(2)))
    for x in samples.x[::8]:
        found = projected(model, model.states.to_deviation(x), origin, weights)
        A = np.array([[-0.1, 0.0], [-x[0], 1.0]])
        P = solve_continuous_are(A, two_state.SYSTEM.B, np.eye(2), np.eye(1))
        expected = -two_state.SYSTEM.B.T @ P @ x
        np.testing.assert_allclose(model.inputs.to_physical(found.u), expected, rtol=0, atol=1e-8)


def test_the_scalar_plant_has_no_input():
    assert describe(scalar_example()).B.shape == (1, 0)
