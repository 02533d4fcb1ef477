# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The predictive law against optima of its own, its limits, and what it does where it has none."""

from dataclasses import replace
import json
import math

import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_are
from scipy.optimize import lsq_linear

from koopman_ros.control import Controller, InputLimits, Settings
from koopman_ros.control.events import SetpointRequest
from koopman_ros.control.laws import Plan, receding_horizon, Tuning, Weights
from koopman_ros.control.laws.base import steady_state_target
from koopman_ros.control.laws.intervals import Intervals
from koopman_ros.control.laws.receding_horizon import RecedingHorizon
from koopman_ros.control.simulate import at, simulate
from koopman_ros.control.state import State
from koopman_ros.control.supervisor import LevelSettings, SupervisorSettings
from koopman_ros.estimation import Estimate
from koopman_ros.lifting import Coordinates, LiftedModel, linearised_model, Provenance
from koopman_ros.plants import ControlAffineSystem, Process, steady_state
from koopman_ros.plants.optimum import cost_along, optimum, Task
from koopman_ros.reasons import Code
from koopman_ros.replay.records import decoded, encoded
from support.closed_loops import shipped
from validation.shipped_models import library_system

PERIOD = 0.1  # s
Q, R = np.diag([1.0, 0.1]), np.eye(1)


def linear_plant(A: np.ndarray, B: np.ndarray, reach: float = 100.0
                 ) -> tuple[ControlAffineSystem, LiftedModel]:
    """Return dx/dt = A x + B u, in seconds and without scales, and its model."""
    n, m = B.shape
    names, forces = tuple(f'x{i}' for i in range(n)), tuple(f'u{i}' for i in range(m))
    system = ControlAffineSystem(
        'linear', names, ('1',) * n, forces, ('1/s',) * m, 's', lambda x: x @ A.T,
        lambda x: np.broadcast_to(A, (*x.shape[:-1], n, n)), B, np.zeros(n), np.zeros(m))
    states, inputs = (
        Coordinates(of, units, np.zeros(k), np.ones(k), np.full(k, -reach), np.full(k, reach))
        for of, units, k in ((names, ('1',) * n, n), (forces, ('1/s',) * m, m)))
    return system, linearised_model(A, B, states, inputs, 's', Provenance('linear'))


OSCILLATOR = linear_plant(np.array([[0.0, 1.0], [-1.0, -0.1]]), np.array([[0.0], [1.0]]))
UNSTABLE = linear_plant(np.array([[0.5, 1.0], [0.0, -1.0]]), np.array([[0.0], [1.0]]))
TWO_INPUTS = linear_plant(np.array([[0.2, 1.0], [-1.0, 0.1]]), np.array([[1.0, 0.2], [0.3, 1.0]]))
ANY = InputLimits(np.full(1, -np.inf), np.full(1, np.inf), np.full(1, np.inf))


def sampled(A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray, h: float
            ) -> tuple[np.ndarray, ...]:
    """Return A_d, B_d and the cost [[Q_d, S], [S', R_d]] of a period with a held input."""
    n, m = B.shape
    size = n + m
    F = np.zeros((size, size))
    F[:n, :n], F[:n, n:] = A, B
    W = np.zeros((size, size))
    W[:n, :n], W[n:, n:] = Q, R
    # C. F. Van Loan, 1978
    whole = expm(h * np.block([[-F.T, W], [np.zeros((size, size)), F]]))
    phi = whole[size:, size:]
    cost = phi.T @ whole[:size, size:]
    return phi[:n, :n], phi[:n, n:], cost[:n, :n], cost[:n, n:], cost[n:, n:]


def settings(model: LiftedModel, weights: tuple[np.ndarray, np.ndarray], limits: InputLimits,
             *laws: str, **others: object) -> Settings:
    return Tuning.for_model(
        model, state_weight=weights[0], input_weight=weights[1], limits=limits, **{
            'supervisor': SupervisorSettings(tuple(
                LevelSettings(law, 1e9) for law in laws or ('mpc',)), recovery_time=5.0),
            **others})


def run(pair: tuple[ControlAffineSystem, LiftedModel], own: Settings, x0: list[float],
        goal: list[float], samples: int = 100) -> object:
    system, model = pair
    return simulate(
        Controller(model, own), Process(system, 0, np.array(x0), np.zeros(system.n_u)),
        [at(0.0, SetpointRequest(0, np.array(goal)))], period=PERIOD, duration=PERIOD * samples)


# What it costs.


@pytest.mark.parametrize('pair', [OSCILLATOR, UNSTABLE, TWO_INPUTS])
@pytest.mark.parametrize('interval', [0.05, 0.5, 2.0])
def test_without_limits_it_is_the_sampled_regulator_of_a_linear_plant(pair, interval):
    system, model = pair
    A, B, R = model.A, model.B, np.eye(system.n_u)
    Ad, Bd, Qd, S, Rd = sampled(A, B, Q, R, interval)
    P = solve_discrete_are(Ad, Bd, Qd, Rd, s=S)
    K = np.linalg.solve(Rd + Bd.T @ P @ Bd, Bd.T @ P @ Ad + S.T)
    law = RecedingHorizon(model, Tuning(Weights(Q, R)))
    x, wide = np.array([0.7, -0.4]), InputLimits(*(
        np.full(system.n_u, end) for end in (-np.inf, np.inf, np.inf)))
    target = steady_state_target(model, np.zeros(2))
    found = law.compute(Estimate(x, np.zeros(2)), target, wide, None, interval)
    assert found.failure is None
    # its integration is by Runge and Kutta, its cost by Simpson
    np.testing.assert_allclose(found.u, -K @ x, rtol=3e-3, atol=1e-3 * np.max(np.abs(K @ x)))


def test_a_range_is_planned_for_as_well_as_can_be():
    """Against bounded least squares over a long horizon with an input of its own each sample."""
    system, model = OSCILLATOR
    x0, most, samples = np.array([2.0, 0.0]), 0.4, 300
    Ad, Bd, Qd, S, Rd = sampled(model.A, model.B, Q, R, PERIOD)
    root = np.linalg.cholesky(np.block([[Qd, S], [S.T, Rd]])).T
    rows, right, power, reach = [], [], x0, np.zeros((2, samples))
    for k in range(samples):
        pick = np.zeros((1, samples))
        pick[0, k] = 1.0
        rows.append(root @ np.vstack([reach, pick]))
        right.append(-root @ np.concatenate([power, [0.0]]))
        power, reach = Ad @ power, Ad @ reach + Bd @ pick
    best = lsq_linear(np.concatenate(rows), np.concatenate(right), (-most, most), tol=1e-14)
    assert np.sum(np.abs(best.x) > most - 1e-6) > 10
    own = settings(model, (np.diag(Q), np.diag(R)), InputLimits(
        np.full(1, -most), np.full(1, most), np.full(1, np.inf)))
    loop = run(OSCILLATOR, own, [2.0, 0.0], [0.0, 0.0], samples)
    assert set(loop.levels) == {'mpc'}
    assert np.max(np.abs(loop.commands)) <= most
    task = Task(system, x0, np.zeros(2), np.zeros(1), np.diag(Q), np.diag(R), PERIOD, samples)
    # the first sample's input is of the Riccati equation
    assert cost_along(task, loop.states, loop.commands[:-1]) / (2.0 * best.cost) == pytest.approx(
        1.0, abs=2e-3)


@pytest.mark.parametrize(('name', 'goal', 'weights', 'period', 'samples'), [
    ('pendulum', {'angle': 0.0, 'rate': 0.0}, [1.0, 0.1], 0.02, 150),
    ('fed_reactor', None, None, 5.0, 60)])
def test_on_a_learned_lift_it_costs_next_to_the_optimum_of_the_plant(
        name, goal, weights, period, samples):
    system, model = library_system(name), shipped(name)
    if goal is None:
        x_ref = model.states.center + 0.2 * model.states.scale
        goal = {system.state_names[-1]: x_ref[-1]}
        weights = (1.0 / model.states.scale ** 2).tolist()
    x_ref, u_ref = steady_state(system, goal)
    x0 = np.array([np.pi / 3.0, 0.0]) if name == 'pendulum' else system.nominal_state
    scale = np.ones(system.n_u) if name == 'pendulum' else 1.0 / model.inputs.scale ** 2
    task = Task(system, x0, x_ref, u_ref, np.array(weights), scale,
                period / system.seconds_per_time_unit, samples)
    wide = InputLimits(*(np.full(system.n_u, end) for end in (-1e6, 1e6, np.inf)))
    own = settings(model, (task.Q, task.R), wide)
    loop = simulate(
        Controller(model, own), Process(system, 0, x0, system.nominal_input),
        [at(0.0, SetpointRequest(0, x_ref))], period=period, duration=period * samples)
    assert set(loop.levels) == {'mpc'}
    assert 1.0 - 1e-6 < cost_along(task, loop.states, loop.commands[:-1]) / optimum(
        task).cost < 1.002


# Limits.


START = [0.3, 0.0]


def test_the_rate_of_the_inputs_is_planned_for():
    """A law that does not know it lets an unstable plant run further before it brings it back."""
    limits = InputLimits(np.full(1, -5.0), np.full(1, 5.0), np.full(1, 1.0))
    costs = {}
    for law in ('mpc', 'sdre'):
        own = settings(UNSTABLE[1], (np.diag(Q), 0.1 * np.diag(R)), limits, law)
        loop = run(UNSTABLE, own, START, [0.0, 0.0], 200)
        steps = np.abs(np.diff(np.concatenate([np.zeros((1, 1)), loop.commands]), axis=0))
        assert np.max(steps[1:]) <= PERIOD * 1.0 + 1e-9
        costs[law] = cost_along(
            Task(UNSTABLE[0], np.array(START), np.zeros(2), np.zeros(1), np.diag(Q),
                 0.1 * np.diag(R), PERIOD, 200), loop.states, loop.commands[:-1])
        if law == 'mpc':
            # the rate held it back, and it is what it planned with
            assert np.sum(steps > 0.99 * PERIOD) > 5
            np.testing.assert_allclose(loop.states[-1], 0.0, atol=1e-3)
    assert costs['mpc'] < 0.9 * costs['sdre']


def test_limits_of_the_states_are_kept_where_they_can_be():
    goal, most = [1.0, 0.0], 1.02
    wide = InputLimits(np.full(1, -20.0), np.full(1, 20.0), np.full(1, np.inf))
    weights = (np.array([1.0, 0.0]), np.array([0.05]))
    highest = {}
    for name, bounds in (('free', {}), ('kept', {
            'state_lower': np.full(2, -np.inf), 'state_upper': np.array([most, np.inf])})):
        loop = run(OSCILLATOR, settings(OSCILLATOR[1], weights, wide, **bounds), [0.0, 0.0], goal)
        assert set(loop.levels) == {'mpc'}
        highest[name] = float(np.max(loop.states[:, 0]))
        np.testing.assert_allclose(loop.states[-1], goal, atol=2e-3)
    assert highest['free'] > most + 0.02
    assert highest['kept'] <= most + 1e-3


def test_a_state_that_is_beyond_its_limit_is_brought_back():
    bounds = {'state_lower': np.full(2, -np.inf), 'state_upper': np.array([1.0, np.inf])}
    limits = InputLimits(np.full(1, -2.0), np.full(1, 2.0), np.full(1, np.inf))
    loop = run(OSCILLATOR, settings(
        OSCILLATOR[1], (np.diag(Q), np.diag(R)), limits, **bounds), [2.0, 0.5], [0.5, 0.0], 150)
    assert set(loop.levels) == {'mpc'}
    assert np.all(loop.states[60:, 0] <= 1.0 + 1e-3)


def test_a_range_that_was_tightened_is_come_back_to_at_the_rate():
    _, model = OSCILLATOR
    law = RecedingHorizon(model, Tuning(Weights(Q, R)))
    limits = InputLimits(np.full(1, -1.0), np.full(1, 1.0), np.full(1, 2.0))
    found = law.compute(
        Estimate(np.zeros(2), np.zeros(2)), steady_state_target(model, np.zeros(2)), limits, None,
        PERIOD, last=np.array([3.0]))
    # its plan begins at 3 - 0.2, of which the range leaves 1
    assert (found.failure, found.u) == (None, np.array([1.0]))
    assert float(found.memory[0][0, 0]) == pytest.approx(2.8, abs=1e-6)


# What it says of it.


def test_the_plan_is_what_the_plant_does_under_its_inputs():
    """Between nodes a linear plant goes as the matrix exponential says."""
    _, model = OSCILLATOR
    found = RecedingHorizon(model, Tuning(Weights(Q, R))).compute(
        Estimate(np.array([0.7, -0.4]), np.zeros(2)), steady_state_target(model, np.zeros(2)), ANY,
        None, PERIOD)
    plan, x = found.plan, np.array([0.7, -0.4])
    assert plan.times[:2] == pytest.approx([0.0, PERIOD])
    np.testing.assert_array_equal(plan.inputs[0], found.u)
    assert len(plan.times) == len(plan.states) == len(plan.inputs) + 1
    for k, h in enumerate(np.diff(plan.times)):
        np.testing.assert_allclose(plan.states[k], x, atol=2e-3)
        whole = expm(h * np.block([[model.A, model.B], [np.zeros((1, 3))]]))
        x = whole[:2, :2] @ x + whole[:2, 2:] @ plan.inputs[k]
    assert not any(side.any() for side in (plan.at_range, plan.at_rate, plan.at_state))


def test_the_plan_is_in_the_units_of_the_signals():
    model = shipped('reactor_nz4')
    seconds = 1.0
    x = np.array([2.0 / model.states.scale[0]])
    found = RecedingHorizon(model, Tuning(Weights(np.eye(1), np.eye(1)))).compute(
        Estimate(x, np.zeros(1)), steady_state_target(model, np.zeros(1)), ANY, None, seconds)
    assert found.plan.states[0] == pytest.approx(model.states.center + 2.0)
    assert found.plan.times[1] == pytest.approx(seconds)
    np.testing.assert_array_equal(found.plan.inputs[0], found.u)


@pytest.mark.parametrize('side', [-1.0, 1.0])
def test_the_plan_says_which_limits_are_active(side):
    _, model = OSCILLATOR

    def plan(reach: float, rate: float, most: float = math.inf) -> Plan:
        bound = np.array([most, math.inf])
        law = RecedingHorizon(model, Tuning(
            Weights(np.diag([1.0, 0.0]), 0.05 * R), state_lower=-bound, state_upper=bound))
        limits = InputLimits(np.full(1, -reach), np.full(1, reach), np.full(1, rate))
        return law.compute(Estimate(np.zeros(2), np.zeros(2)),
                           steady_state_target(model, np.array([side, 0.0])), limits, None,
                           PERIOD, last=np.zeros(1)).plan

    def active(found: Plan) -> list[list[float]]:
        return [found.at_range.tolist(), found.at_rate.tolist(), found.at_state.tolist()]

    assert active(plan(50.0, 1e3)) == [[0.0], [0.0], [0.0, 0.0]]
    assert active(plan(2.0, 1e3)) == [[side], [0.0], [0.0, 0.0]]
    assert active(plan(50.0, 5.0)) == [[0.0], [side], [0.0, 0.0]]
    # a limit that the free path would go beyond
    assert active(plan(50.0, 1e3, 1.01)) == [[0.0], [0.0], [side, 0.0]]


# Where it has none.


def nowhere(law: RecedingHorizon, x: list[float], **others: object) -> object:
    target = steady_state_target(law.model, np.zeros(2))
    return law.compute(Estimate(np.array(x), np.zeros(2)), target, ANY, None, PERIOD, **others)


def test_without_its_solver_the_next_level_acts_and_says_why(monkeypatch):
    monkeypatch.setattr(receding_horizon, 'PACKAGE', 'no_such_solver')
    own = settings(OSCILLATOR[1], (np.diag(Q), np.diag(R)), ANY, 'mpc', 'sdre')
    loop = run(OSCILLATOR, own, [1.0, 0.0], [0.0, 0.0], 20)
    assert set(loop.levels) == {'sdre'}
    why = loop.reports[-1].reason
    assert (why.code, why.cause.code) == (Code.LAW_FAILED, Code.PACKAGE_MISSING)


def test_a_plan_that_takes_too_long_costs_one_sample(monkeypatch):
    own = settings(OSCILLATOR[1], (np.diag(Q), np.diag(R)), ANY, 'mpc', 'sdre', deadline=5.0)
    # each look at the clock is 10 s after the one before while it is late, else none
    late, now = [False], [0.0]

    def tell() -> float:
        now[0] += 10.0 * late[0]
        return now[0]

    monkeypatch.setattr(receding_horizon.time, 'perf_counter', tell)
    controller = Controller(OSCILLATOR[1], own)
    state = controller.request_setpoint(State(), np.zeros(2))[0]
    levels = []
    for k in range(12):
        late[0] = k == 6
        state, _, report = controller.step(state, np.array([0.5, 0.0]), int(1e8) * (k + 1))
        levels.append((report.level, report.reason and report.reason.cause.code))
    assert levels == [*[('mpc', None)] * 6, ('sdre', Code.TOO_LATE), *[('mpc', None)] * 5]


def test_a_plan_out_of_the_data_is_not_followed():
    _, model = linear_plant(OSCILLATOR[1].A, OSCILLATOR[1].B, reach=1.0)
    # fast ahead of where it is, with little to brake it
    law = RecedingHorizon(model, Tuning(Weights(Q, 100.0 * R), margin=0.1))
    found = nowhere(law, [0.9, 0.9])
    assert (found.u, found.failure.code) == (None, Code.PLAN_OUTSIDE)
    assert found.failure.values['outside'] > 0.1
    assert nowhere(law, [0.5, 0.0]).failure is None


@pytest.mark.parametrize('x', [[math.nan, 0.0], [math.inf, 0.0], [1e300, 0.0]])
def test_what_is_no_state_has_no_plan(x):
    with np.errstate(all='ignore'):
        found = nowhere(RecedingHorizon(OSCILLATOR[1], Tuning(Weights(Q, R))), x)
    assert found.u is None
    assert found.failure is not None


def test_limits_that_contradict_each_other_are_said():
    _, model = OSCILLATOR
    law = RecedingHorizon(model, Tuning(Weights(Q, R)))
    limits = InputLimits(np.full(1, -1.0), np.full(1, 1.0), np.full(1, np.inf))
    object.__setattr__(limits, 'lower', np.full(1, 2.0))
    found = law.compute(Estimate(np.zeros(2), np.zeros(2)),
                        steady_state_target(model, np.zeros(2)), limits, None, PERIOD)
    assert (found.u, found.failure.code, found.passing) == (None, Code.PLAN_NOT_SOLVED, True)


# The same again.


def test_what_it_remembers_comes_back_from_a_record_bit_for_bit():
    law = RecedingHorizon(OSCILLATOR[1], Tuning(Weights(Q, R)))
    first = nowhere(law, [0.7, -0.4])
    memory = decoded(json.loads(json.dumps(encoded(first.memory))))
    target = steady_state_target(law.model, np.zeros(2))
    estimate = Estimate(np.array([0.6, -0.4]), np.zeros(2))
    again = [law.compute(estimate, target, ANY, own, PERIOD).u.tobytes()
             for own in (first.memory, memory)]
    assert again[0] == again[1]


def test_what_a_model_of_another_size_remembers_is_not_gone_by():
    law = RecedingHorizon(OSCILLATOR[1], Tuning(Weights(Q, R)))
    other = (np.zeros((5, 1)), np.zeros((6, 3)), np.full(5, PERIOD))
    own = nowhere(law, [0.7, -0.4]).u.tobytes()
    for memory in (other, (1, 2), 'text', {'plan': None}):
        target = steady_state_target(law.model, np.zeros(2))
        estimate = Estimate(np.array([0.7, -0.4]), np.zeros(2))
        assert law.compute(estimate, target, ANY, memory, PERIOD).u.tobytes() == own


def test_the_horizon_grows_from_the_sample_and_ends_in_time():
    law = RecedingHorizon(UNSTABLE[1], Tuning(Weights(Q, R)))
    for interval in (0.01, 0.1, 1.0, 10.0):
        lengths = law.lengths(interval)
        assert lengths[0] == interval
        assert np.all(np.diff(lengths) >= 0.0)
        assert 3 <= len(lengths) <= 30
        # eight time constants of what grows, or three samples
        assert np.sum(lengths) <= max(8.0 / 0.5, 3.0 * interval) + interval


def test_a_plan_is_moved_on_by_a_sample():
    """Its nodes go on between the old ones, its inputs are those that held then."""
    old, new = Intervals(np.array([1.0, 1.0, 2.0])), Intervals(np.array([1.0, 0.5, 1.5, 2.0]))
    u, x = np.array([[1.0], [2.0], [3.0]]), np.array([[0.0, 5.0], [1.0, 4.0], [3.0, 2.0],
                                                      [7.0, -2.0]])
    inputs, nodes = new.shifted(u, x, old.lengths)
    np.testing.assert_array_equal(inputs[:, 0], [2.0, 3.0, 3.0, 3.0])
    # at 1, 2, 2.5, 4 and beyond the end
    np.testing.assert_allclose(nodes, [[1.0, 4.0], [3.0, 2.0], [4.0, 1.0], [7.0, -2.0],
                                       [7.0, -2.0]])


def test_the_first_sample_is_answered_by_the_riccati_equation():
    law = RecedingHorizon(OSCILLATOR[1], Tuning(Weights(Q, R)))
    target = steady_state_target(law.model, np.zeros(2))
    estimate = Estimate(np.array([0.6, -0.4]), np.zeros(2))
    found = law.compute(estimate, target, ANY, None, 0.0)
    assert (found.memory, found.figures.form) != (None, 'planned')
    assert found.u.tobytes() == law._riccati.compute(
        estimate, target, ANY, None, 0.0).u.tobytes()


def test_a_set_point_far_off_is_planned_for_anew():
    law = RecedingHorizon(replace(OSCILLATOR[1]), Tuning(Weights(Q, R)))
    there = steady_state_target(law.model, np.array([50.0, 0.0]))
    memory = nowhere(law, [0.0, 0.0]).memory
    estimate = Estimate(np.zeros(2), np.zeros(2))
    cold = law.compute(estimate, there, ANY, None, PERIOD)
    warm = law.compute(estimate, there, ANY, memory, PERIOD)
    np.testing.assert_allclose(warm.u, cold.u, rtol=1e-6)
