# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The experiments: their data, and what learned controllers are measured by, in closed form."""

import numpy as np
import pytest
from scipy.linalg import solve_continuous_are

from koopman_ros.control import averaged, steady_state_target, Weights
from koopman_ros.learning import Edmd, fit, Linearisation
from koopman_ros.plants import (
    box_episodes,
    ControlAffineSystem,
    describe,
    ExcitationError,
    one_state_reactor,
    RandomStepDesign,
    scalar_example,
)
from studies.paper import reactor, two_state
from studies.paper.optimal_control import (
    exact_two_state_cost,
    exact_two_state_gain,
    scalar_optimal_cost,
)


@pytest.mark.parametrize('box', [two_state.WIDE, *two_state.NARROW.values()], ids=str)
def test_samples_stay_within_their_box_and_fill_it(box):
    samples = two_state.samples(box, 1, episodes=20)
    assert np.all(samples.x >= box.lower)
    assert np.all(samples.x <= box.upper)
    assert samples.u.min() >= box.inputs[0]
    assert samples.u.max() <= box.inputs[1]
    for low, high, x in zip(box.lower, box.upper, samples.x.T, strict=True):
        # where x1 starts at its lower side it leaves the box at once
        assert x.max() - x.min() > 0.75 * (high - low)
    np.testing.assert_allclose(
        samples.dxdt, two_state.SYSTEM.derivative(samples.x, samples.u), rtol=1e-12)


def test_episodes_that_no_input_keeps_in_their_box():
    design = RandomStepDesign(276.0, 277.0, 320.0, 321.0, 1.0, 0.5, max_redraws=0)
    with pytest.raises(ExcitationError, match=r'of 100 starts 0 could be kept in the box for 5\.0 '
                                              r'min, 1 are wanted; shorten the episodes'):
        box_episodes(one_state_reactor(), design, 1, 5.0, 0)


def test_the_same_seed_gives_the_same_samples():
    first, again, other = (box_episodes(reactor.SYSTEM, reactor.TRAINING, 12, 1.0, seed).digest()
                           for seed in (3, 3, 4))
    assert first == again != other


def test_the_scalar_plant_has_no_input():
    assert describe(scalar_example()).B.shape == (1, 0)


def test_linearised_control_of_the_two_state_example():
    """Ratios from a Lyapunov solution of the linear law on the exact lift."""
    samples = two_state.samples(two_state.WIDE, 0, episodes=5)
    linear = Linearisation(two_state.SYSTEM.drift_jacobian(np.zeros(2))).learn(
        describe(two_state.SYSTEM), samples)
    for R, ratio in ((1.0, 4.5297), (0.1, 1.9296)):
        loop = two_state.close_loop(linear, R)
        assert loop.cost / exact_two_state_cost(two_state.START, R) == pytest.approx(
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
        found = averaged(model, model.states.to_deviation(x), origin, weights)
        A = np.array([[-0.1, 0.0], [-x[0], 1.0]])
        P = solve_continuous_are(A, two_state.SYSTEM.B, np.eye(2), np.eye(1))
        expected = -two_state.SYSTEM.B.T @ P @ x
        np.testing.assert_allclose(model.inputs.to_physical(found.u), expected, rtol=0, atol=1e-8)


# K on (x1, x2, x1^2) and cost from (5, 5), from an independent Riccati solver
@pytest.mark.parametrize(('R', 'gain', 'cost'), [
    (1.0, [0.0, 2.41421356, -1.49559737], 990.1798),
    (0.1, [0.0, 4.31662479, -1.22749086], 253.2680),
    (0.001, [0.0, 32.6385840, -1.02512675], 127.1212)])
def test_two_state_optimum(R, gain, cost):
    np.testing.assert_allclose(exact_two_state_gain(R)[0], gain, rtol=1e-8, atol=1e-8)
    assert exact_two_state_cost(np.array([5.0, 5.0]), R) == pytest.approx(cost, abs=5e-5)


def test_the_exact_path_costs_what_the_riccati_equation_says():
    loop = two_state.exact_loop(1.0)
    rate = np.sum(loop.states ** 2, axis=1) + loop.inputs[:, 0] ** 2
    assert np.trapezoid(rate, loop.times) == pytest.approx(loop.cost, rel=1e-3)
    assert np.linalg.norm(loop.states[-1]) < 0.002


@pytest.mark.parametrize('a', [-1.5, 0.5])
@pytest.mark.parametrize('R', [1.0, 0.1])
def test_scalar_optimum_of_a_linear_plant(a, R):
    """P of the scalar Riccati equation 2 a P - P^2 b^2 / R + 1 = 0, for deviations from x_ref."""
    b, unit = 2.0, 10.0
    plant = ControlAffineSystem(
        name='linear', state_names=('x',), state_units=('K',), input_names=('u',),
        input_units=('K',), time_unit='min', drift=lambda x: a * x,
        drift_jacobian=lambda x: np.full((*x.shape, 1), a), B=np.array([[b]]),
        nominal_state=np.zeros(1), nominal_input=np.zeros(1))
    P = R / b ** 2 * (a + np.sqrt(a * a + b * b / R))
    assert scalar_optimal_cost(plant, 7.0, 2.0, R, unit) == pytest.approx(
        P * (5.0 / unit) ** 2, rel=1e-9)


def test_no_gain_does_better_than_the_optimum_on_the_reactor():
    """Constant gains with the true feed-forward come near the optimum and never below it."""
    system = one_state_reactor()
    optimum = scalar_optimal_cost(system, reactor.START, reactor.SETPOINT, 1.0, reactor.UNIT)
    held = reactor.equilibrium_input(system, [reactor.SETPOINT])[0]

    def cost(gain):
        def rate(_, y):
            e = (y[0] - reactor.SETPOINT) / reactor.UNIT
            u = held - gain * e * reactor.UNIT
            return [system.derivative(y[:1], [u])[0], e * e + (gain * e) ** 2]

        return reactor.solve_ivp(rate, (0.0, 30.0), [reactor.START, 0.0], rtol=1e-9,
                                 atol=1e-9).y[1, -1]

    costs = [cost(gain) for gain in (0.2, 0.4, 0.6, 0.8)]
    assert optimum < min(costs) < 1.1 * optimum
