# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The predictive law against independent optima, its limits, and its failures."""

from dataclasses import fields, replace
import math
import sys
import time

import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_are
from scipy.optimize import lsq_linear, minimize

from koopman_ros.control import Controller, InputLimits, Tuning
from koopman_ros.control.events import SetpointRequest
from koopman_ros.control.laws.base import LawResult
from koopman_ros.control.mpc import MPCParameters, RecedingHorizon
from koopman_ros.control.mpc.grid import HorizonGrid
from koopman_ros.control.state import State
from koopman_ros.control.steady_state import steady_state_target
from koopman_ros.core.integration import runge_kutta_step
from koopman_ros.core.paths import model_path
from koopman_ros.core.status import StatusCode
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.estimation import Estimate
from koopman_ros.evaluation.loop import at, LoopRun, run_loop
from koopman_ros.evaluation.optimal_cost import cost_along, optimum, Task
from koopman_ros.model import Coordinates, LiftedModel, linearised_model, load, Provenance
from koopman_ros.plants import Actuator, ControlAffineSystem, plant_class, Process, steady_state
from support.random_lifts import random_lift

PERIOD = 0.1  # s
Q = np.array([1.0, 0.1])


def shipped(name: str) -> LiftedModel:
    return load(model_path(name))


def linear_plant(A: np.ndarray, B: np.ndarray, reach: float = 100.0
                 ) -> tuple[ControlAffineSystem, LiftedModel]:
    """Return dx/dt = A x + B u, in seconds and without scales, and its model."""
    n, m = B.shape
    names, forces = tuple(f'x{i}' for i in range(n)), tuple(f'u{i}' for i in range(m))
    system = ControlAffineSystem(
        'linear', names, ('1',) * n, forces, ('1/s',) * m, 's', lambda x: x @ A.T,
        B, np.zeros(n), np.zeros(m),
        drift_jacobian=lambda x: np.broadcast_to(A, (*x.shape[:-1], n, n)))
    states, inputs = (
        Coordinates(of, units, np.zeros(k), np.ones(k), np.full(k, -reach), np.full(k, reach))
        for of, units, k in ((names, ('1',) * n, n), (forces, ('1/s',) * m, m)))
    return system, linearised_model(A, B, states, inputs, 's', Provenance('linear'))


OSCILLATOR = linear_plant(np.array([[0.0, 1.0], [-1.0, -0.1]]), np.array([[0.0], [1.0]]))
UNSTABLE = linear_plant(np.array([[0.5, 1.0], [0.0, -1.0]]), np.array([[0.0], [1.0]]))
TWO_INPUTS = linear_plant(np.array([[0.2, 1.0], [-1.0, 0.1]]), np.array([[1.0, 0.2], [0.3, 1.0]]))


def limits(most: float = math.inf, rate: float = math.inf) -> InputLimits:
    return InputLimits(-most, most, rate)


def tuning(model: LiftedModel, **given: object) -> Tuning:
    return Tuning.for_model(model, **{
        'state_weight': Q, 'input_weight': 1.0, 'limits': limits(), 'fallback_order': ('mpc',),
        'learned_model_margin': 100.0, 'linear_model_margin': 100.0, 'recovery_time': 5.0,
        **given})


def law(model: LiftedModel, own: MPCParameters | None = None, **given: object
        ) -> RecedingHorizon:
    return RecedingHorizon(
        model, tuning(model, **given).for_signals(model, model.states.names),
        own or MPCParameters())


def compute(one: RecedingHorizon, x: list[float], goal: tuple[float, ...] = (0.0, 0.0),
            memory: object = None, interval: float = PERIOD, previous: float | None = None
            ) -> LawResult:
    target = steady_state_target(one.model, np.array(goal))
    return one.compute(Estimate(np.array(x), np.zeros(len(x))), target, memory, interval,
                       None if previous is None else np.array([previous]))


def run(pair: tuple[ControlAffineSystem, LiftedModel], x0: list[float], goal: list[float],
        samples: int = 100, own: MPCParameters | None = None, **given: object) -> LoopRun:
    system, model = pair
    plugins = {} if own is None else {'mpc': own}
    return run_loop(
        Controller(model, tuning(model, plugins=plugins, **given)),
        Process(system, 0, np.array(x0), np.zeros(system.n_u)),
        [at(0.0, SetpointRequest(0, np.array(goal)))], period=PERIOD, duration=PERIOD * samples)


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


# Cost.


@pytest.mark.parametrize('pair', [OSCILLATOR, UNSTABLE, TWO_INPUTS])
@pytest.mark.parametrize('interval', [0.05, 0.5, 2.0])
def test_without_limits_it_is_the_sampled_regulator_of_a_linear_plant(pair, interval):
    system, model = pair
    Ad, Bd, Qd, S, Rd = sampled(model.A, model.B, np.diag(Q), np.eye(system.n_u), interval)
    P = solve_discrete_are(Ad, Bd, Qd, Rd, s=S)
    K = np.linalg.solve(Rd + Bd.T @ P @ Bd, Bd.T @ P @ Ad + S.T)
    x = np.array([0.7, -0.4])
    found = compute(law(model), x, interval=interval)
    assert found.failure is None
    # it integrates by Runge and Kutta, and its cost by Simpson
    np.testing.assert_allclose(found.u, -K @ x, rtol=3e-3, atol=1e-3 * np.max(np.abs(K @ x)))


class Doubled(LiftedModel):
    """A model with a drift of its own."""

    def drift(self, x: np.ndarray) -> np.ndarray:
        return 2.0 * super().drift(x)

    def drift_and_jacobian(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        f, J = super().drift_and_jacobian(x)
        return 2.0 * f, 2.0 * J


def test_drift_of_a_subclass_is_planned_with():
    _, model = OSCILLATOR
    own = Doubled(**{item.name: getattr(model, item.name) for item in fields(model)})
    _, same = linear_plant(2.0 * model.A, model.B)
    np.testing.assert_allclose(compute(law(own), [0.7, -0.4]).u,
                               compute(law(same), [0.7, -0.4]).u, rtol=1e-6)


def test_range_is_planned_for_optimally():
    """Against bounded least squares over a long horizon with an input of its own each sample."""
    system, model = OSCILLATOR
    x0, most, samples = np.array([2.0, 0.0]), 0.4, 300
    Ad, Bd, Qd, S, Rd = sampled(model.A, model.B, np.diag(Q), np.eye(1), PERIOD)
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
    loop = run(OSCILLATOR, [2.0, 0.0], [0.0, 0.0], samples, limits=limits(most))
    assert set(loop.levels) == {'mpc'}
    assert np.max(np.abs(loop.commands)) <= most
    task = Task(system, x0, np.zeros(2), np.zeros(1), Q, np.ones(1), PERIOD, samples)
    # the first sample's input is of the Riccati equation
    assert cost_along(task, loop.states, loop.commands[:-1]) / (2.0 * best.cost) == pytest.approx(
        1.0, abs=2e-3)


@pytest.mark.parametrize('change_after', [None, 75.0])
def test_plan_with_active_limits_is_that_of_a_general_optimiser(change_after):
    """Against SLSQP on simulations of the model, with range, rate and limits of the states."""
    model, interval, x = shipped('two_state'), 30.0, [-0.3, -0.2]
    u_max, change, e_max = 0.15, 0.12, [9.0, 0.08]
    inputs, states, w = model.inputs, model.states, np.array([0.01, -0.02])
    one = RecedingHorizon(model, Tuning.for_model(
        model, limits=InputLimits(inputs.center - u_max * inputs.scale,
                                  inputs.center + u_max * inputs.scale,
                                  change * inputs.scale / interval),
        input_weight=0.1 / inputs.scale ** 2, learned_model_margin=100.0, linear_model_margin=100.0
        ).for_signals(model, states.names),
        MPCParameters(upper=states.center + np.array(e_max) * states.scale))
    # temperatures, with the concentrations at which they can be held
    target, end = (steady_state_target(model, np.array([kelvin]), controlled=np.array([1]))
                   for kelvin in (0.2, 0.12))
    estimate = Estimate(np.array(x), w)
    if change_after is None:
        end = target
    else:
        target = replace(target, later=((change_after, end),))
    found = one.compute(estimate, target, None, interval, inputs.center)
    assert found.failure is None
    problem = one.planner.problem(estimate, target, interval, inputs.center)
    lengths, N = problem.grid.lengths, len(problem.grid.lengths)
    # the share of each interval in which the later target holds
    edges = problem.grid.times * model.seconds_per_time_unit
    share = np.clip((edges[1:] - (change_after or np.inf)) / np.diff(edges), 0.0, 1.0)[:, None]
    x_refs, u_refs = ((1.0 - share) * now + share * then for now, then in (
        (target.x, end.x), (target.u, end.u)))

    def simulated(u: np.ndarray) -> tuple[float, np.ndarray]:
        y, nodes = np.append(x, 0.0), []
        for v, length, x_ref, u_ref in zip(u, lengths, x_refs, u_refs, strict=True):
            def rate(y: np.ndarray, v: float = v, x_ref: np.ndarray = x_ref,
                     u_ref: np.ndarray = u_ref) -> np.ndarray:
                e, e_u = y[:2] - x_ref, v - u_ref[0]
                return np.append(model.drift(y[:2]) + model.B @ [v] + w, e @ e + 0.1 * e_u ** 2)

            for _ in range(4):
                y = runge_kutta_step(rate, y, length / 4)
            nodes.append(y[:2])
        e = nodes[-1] - end.x
        return y[2] + e @ problem.terminal @ e, np.array(nodes)

    best = minimize(
        lambda u: simulated(u)[0], np.zeros(N), method='SLSQP', bounds=[(-u_max, u_max)] * N,
        constraints=[
            {'type': 'ineq', 'fun': lambda u: problem.change[:, 0] - np.diff(u, prepend=0.0)},
            {'type': 'ineq', 'fun': lambda u: problem.change[:, 0] + np.diff(u, prepend=0.0)},
            {'type': 'ineq', 'fun': lambda u: (e_max - simulated(u)[1]).ravel()}],
        options={'ftol': 1e-10, 'maxiter': 200})
    assert best.success
    planned = found.memory[0][:, 0]
    if change_after is None:
        assert np.sum(np.abs(planned) > u_max - 1e-6) == 1
        assert np.sum(np.abs(np.diff(planned, prepend=0.0)) > change - 1e-6) == 1
        assert found.plan.at_state.tolist() == [0.0, 1.0]
    np.testing.assert_allclose(planned, best.x, atol=2e-3)
    assert simulated(planned)[0] == pytest.approx(best.fun, rel=1e-3)


@pytest.mark.parametrize(('settings', 'code'), [
    ({}, None), ({'iterations': 1, 'usable': 0.0}, StatusCode.PLAN_MOVES)])
def test_settings_decide_when_a_plan_may_be_used(monkeypatch, settings, code):
    monkeypatch.setattr(
        RecedingHorizon, 'settings', replace(RecedingHorizon.settings, **settings))
    _, model = OSCILLATOR
    level = Controller(model, tuning(model)).levels['mpc']
    found = level.compute(np.array([0.5, 0.0]), Estimate(np.zeros(2), np.zeros(2)), None, PERIOD,
                          None, np.zeros(1))[1]
    assert (found.failure and found.failure.code) is code


@pytest.mark.parametrize('dead_time', [0.0, 0.5])
def test_a_scheduled_setpoint_is_prepared_for(monkeypatch, dead_time):
    system, model = OSCILLATOR
    model = replace(model, dead_time=np.array([dead_time]))

    def tracked() -> tuple[float, np.ndarray]:
        """Return the integral of the squared error, and the commands before the set-point."""
        loop = run_loop(
            Controller(model, tuning(model)),
            Process(system, 0, np.zeros(2), np.zeros(1), Actuator(dead_time=dead_time)),
            [at(0.0, SetpointRequest(4 * NANOSECONDS, np.array([1.0, 0.0])))],
            period=PERIOD, duration=8.0)
        error = loop.states - np.where(loop.times[:, None] < 3.0, 0.0, [1.0, 0.0])
        return PERIOD * float(np.sum(Q * error ** 2)), loop.commands[loop.times < 2.9]

    cost, before = tracked()
    assert np.abs(before).max() > 0.1
    monkeypatch.setattr(RecedingHorizon, 'horizon', lambda *_: 0.0)
    late, before = tracked()
    assert not before.any()
    assert cost < 0.4 * late


@pytest.mark.parametrize(('name', 'period', 'samples'), [
    ('pendulum', 0.02, 150), ('fed_reactor', 5.0, 60)])
def test_on_a_learned_lift_it_costs_next_to_the_optimum_of_the_plant(name, period, samples):
    system, model = plant_class(name)().system(), shipped(name)
    if name == 'pendulum':
        goal, weights, scale = {'angle': 0.0, 'rate': 0.0}, np.array([1.0, 0.1]), np.ones(1)
        x0 = np.array([np.pi / 3.0, 0.0])
    else:
        goal = {system.state_names[-1]: (model.states.center + 0.2 * model.states.scale)[-1]}
        weights, scale = 1.0 / model.states.scale ** 2, 1.0 / model.inputs.scale ** 2
        x0 = system.nominal_state
    x_ref, u_ref = steady_state(system, goal)
    task = Task(system, x0, x_ref, u_ref, weights, scale, period / system.seconds_per_time_unit,
                samples)
    loop = run_loop(
        Controller(model, tuning(model, state_weight=weights, input_weight=scale,
                                 limits=limits(1e6))),
        Process(system, 0, x0, system.nominal_input), [at(0.0, SetpointRequest(0, x_ref))],
        period=period, duration=period * samples)
    assert set(loop.levels) == {'mpc'}
    assert 1.0 - 1e-6 < cost_along(task, loop.states, loop.commands[:-1]) / optimum(
        task).cost < 1.002


# Limits.


def test_rate_of_the_inputs_is_planned_for():
    """A law without knowledge of it lets an unstable plant run further before it returns."""
    start, costs = [0.3, 0.0], {}
    for name in ('mpc', 'sdre'):
        loop = run(UNSTABLE, start, [0.0, 0.0], 200, input_weight=0.1, limits=limits(5.0, 1.0),
                   fallback_order=(name,))
        steps = np.abs(np.diff(np.concatenate([np.zeros((1, 1)), loop.commands]), axis=0))
        assert np.max(steps[1:]) <= PERIOD * 1.0 + 1e-9
        costs[name] = cost_along(
            Task(UNSTABLE[0], np.array(start), np.zeros(2), np.zeros(1), Q, np.full(1, 0.1),
                 PERIOD, 200), loop.states, loop.commands[:-1])
        if name == 'mpc':
            assert np.sum(steps > 0.99 * PERIOD) > 5
            np.testing.assert_allclose(loop.states[-1], 0.0, atol=1e-3)
    assert costs['mpc'] < 0.9 * costs['sdre']


def test_limits_of_the_states_are_kept():
    goal, most, highest = [1.0, 0.0], 1.02, {}
    for name, own in (('free', MPCParameters()),
                      ('kept', MPCParameters(upper=np.array([most, np.inf])))):
        loop = run(OSCILLATOR, [0.0, 0.0], goal, own=own, limits=limits(20.0),
                   state_weight=np.array([1.0, 0.0]), input_weight=0.05)
        assert set(loop.levels) == {'mpc'}
        highest[name] = float(np.max(loop.states[:, 0]))
        np.testing.assert_allclose(loop.states[-1], goal, atol=2e-3)
    assert highest['free'] > most + 0.02
    assert highest['kept'] <= most + 1e-3


def test_state_beyond_its_limit_is_brought_back():
    loop = run(OSCILLATOR, [2.0, 0.5], [0.5, 0.0], 150, limits=limits(2.0),
               own=MPCParameters(upper=np.array([1.0, np.inf])))
    assert set(loop.levels) == {'mpc'}
    assert np.all(loop.states[60:, 0] <= 1.0 + 1e-3)


def test_input_outside_a_narrowed_range_returns_at_its_rate():
    found = compute(law(OSCILLATOR[1], limits=limits(1.0, 2.0)), [0.0, 0.0], previous=3.0)
    assert found.failure is None
    assert found.u == pytest.approx([2.8])
    # in the whole plan, also where it would help to stay outside
    plan = compute(law(OSCILLATOR[1], limits=limits(1.0, 2.0)), [50.0, 0.0], previous=3.0).plan
    reach = 3.0 - 2.0 * (plan.times[:len(plan.inputs)] + PERIOD)
    assert plan.inputs[:12, 0] == pytest.approx(np.maximum(1.0, reach)[:12], abs=1e-6)


@pytest.mark.parametrize('own', [
    MPCParameters(lower=np.array([1.0, 0.0]), upper=np.array([1.0, 1.0])),
    MPCParameters(lower=np.array([2.0, -np.inf]), upper=np.array([1.0, np.inf]))])
def test_contradictory_limits_of_the_states_are_rejected(own):
    with pytest.raises(ValueError, match='min < max'):
        law(OSCILLATOR[1], own)


# The plan.


def test_plan_is_the_motion_of_the_plant_under_its_inputs():
    """Of a linear plant by the matrix exponential."""
    _, model = OSCILLATOR
    x = np.array([0.7, -0.4])
    found = compute(law(model), x)
    plan = found.plan
    assert plan.times[:2] == pytest.approx([0.0, PERIOD])
    np.testing.assert_array_equal(plan.inputs[0], found.u)
    assert len(plan.times) == len(plan.states) == len(plan.inputs) + 1
    for k, h in enumerate(np.diff(plan.times)):
        np.testing.assert_allclose(plan.states[k], x, atol=2e-3)
        whole = expm(h * np.block([[model.A, model.B], [np.zeros((1, 3))]]))
        x = whole[:2, :2] @ x + whole[:2, 2:] @ plan.inputs[k]
    assert not any(side.any() for side in (plan.at_range, plan.at_rate, plan.at_state))


def test_plan_is_in_the_units_of_the_signals():
    model = shipped('reactor_nz4')
    found = compute(law(model, state_weight=1.0), 2.0 / model.states.scale, (0.0,), interval=1.0)
    assert found.plan.states[0] == pytest.approx(model.states.center + 2.0)
    assert found.plan.times[1] == pytest.approx(1.0)
    np.testing.assert_array_equal(found.plan.inputs[0], found.u)


@pytest.mark.parametrize('side', [-1.0, 1.0])
@pytest.mark.parametrize(('most', 'rate', 'state', 'active'), [
    (50.0, 1e3, math.inf, (0.0, 0.0, 0.0)), (2.0, 1e3, math.inf, (1.0, 0.0, 0.0)),
    (50.0, 5.0, math.inf, (0.0, 1.0, 0.0)),
    # a limit that the unconstrained path would exceed
    (50.0, 1e3, 1.01, (0.0, 0.0, 1.0))])
def test_plan_names_the_active_limits(side, most, rate, state, active):
    bound = np.array([state, math.inf])
    one = law(OSCILLATOR[1], MPCParameters(lower=-bound, upper=bound), limits=limits(most, rate),
              state_weight=np.array([1.0, 0.0]), input_weight=0.05)
    plan = compute(one, [0.0, 0.0], (side, 0.0), previous=0.0).plan
    at_range, at_rate, at_state = side * np.array(active)
    assert (plan.at_range.tolist(), plan.at_rate.tolist()) == ([at_range], [at_rate])
    assert plan.at_state.tolist() == [at_state, 0.0]


# Failures.


def test_without_a_package_the_next_level_acts_with_the_advice(monkeypatch):
    for name in [name for name in sys.modules if name.startswith('koopman_ros.control.mpc.')]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, 'daqp', None)
    loop = run(OSCILLATOR, [1.0, 0.0], [0.0, 0.0], 20, fallback_order=('mpc', 'sdre'))
    assert set(loop.levels) == {'sdre'}
    why = loop.reports[-1].reason
    assert (why.code, why.cause.code) == (StatusCode.LAW_FAILED, StatusCode.PACKAGE_MISSING)
    assert why.cause.values['package'] == 'daqp'


def test_plan_that_takes_too_long_costs_one_sample(monkeypatch):
    # each reading of the clock is 10 s after the one before in the sixth sample
    late, now = [False], [0.0]

    def perf_counter() -> float:
        now[0] += 10.0 * late[0]
        return now[0]

    monkeypatch.setattr(time, 'perf_counter', perf_counter)
    controller = Controller(OSCILLATOR[1], tuning(
        OSCILLATOR[1], fallback_order=('mpc', 'sdre'),
        plugins={'mpc': MPCParameters(time_limit=5.0)}))
    state = controller.request_setpoint(State(), np.zeros(2))[0]
    levels = []
    for k in range(12):
        late[0] = k == 6
        state, _, report = controller.step(state, np.array([0.5, 0.0]), int(1e8) * (k + 1))
        levels.append((report.level, report.reason and report.reason.cause.code))
    assert levels == [*[('mpc', None)] * 6, ('sdre', StatusCode.TOO_LATE), *[('mpc', None)] * 5]


def test_plan_outside_the_data_is_not_followed():
    _, model = linear_plant(OSCILLATOR[1].A, OSCILLATOR[1].B, reach=1.0)
    # fast, with little to brake it
    one = law(model, input_weight=100.0, learned_model_margin=0.1)
    found = compute(one, [0.9, 0.9])
    assert (found.u, found.failure.code) == (None, StatusCode.PLAN_OUTSIDE)
    assert found.failure.values['outside'] > 0.1
    assert compute(one, [0.5, 0.0]).failure is None


def test_plan_that_rests_outside_the_data_is_followed():
    """Rounding of the estimate puts its later states further outside than the first."""
    _, model = linear_plant(np.diag([-1.0, -2.0]), np.eye(2), reach=1.0)
    x = np.array([1.3, 0.2])
    found = compute(law(model, learned_model_margin=0.1), x * (1.0 - 1e-13), x)
    assert found.failure is None
    np.testing.assert_allclose(found.u, -model.A @ x, atol=1e-6)


@pytest.mark.parametrize('x', [[math.nan, 0.0], [math.inf, 0.0], [1e300, 0.0]])
def test_state_that_is_not_finite_has_no_plan(x):
    with np.errstate(all='ignore'):
        found = compute(law(OSCILLATOR[1]), x)
    assert found.u is None
    assert found.failure is not None


def test_infeasible_quadratic_program_costs_one_sample():
    one = law(OSCILLATOR[1], limits=limits(1.0))
    one.planner._lower = np.full(1, 2.0)
    found = compute(one, [0.0, 0.0])
    assert (found.u, found.failure.code, found.passing) == (None, StatusCode.PLAN_NOT_SOLVED, True)


def test_target_beyond_the_range_is_approached_to_the_limit():
    """An infeasible target leaves an offset and a saturated input, not a failure."""
    loop = run(OSCILLATOR, [0.0, 0.0], [0.0, 0.0], 3, limits=limits(0.4))
    one = law(OSCILLATOR[1], limits=limits(0.4))
    found = compute(one, loop.states[-1], (1.0, 0.0), previous=0.0)
    assert found.failure is None
    assert found.u == pytest.approx([0.4])


# Memory.


def test_warm_start_converges_to_the_plan_of_a_cold_one():
    one = law(OSCILLATOR[1])
    memory = compute(one, [0.0, 0.0]).memory
    cold = compute(one, [0.0, 0.0], (50.0, 0.0))
    warm = compute(one, [0.0, 0.0], (50.0, 0.0), memory)
    np.testing.assert_allclose(warm.u, cold.u, rtol=1e-6)


@pytest.mark.parametrize('memory', [
    (np.zeros((5, 1)), np.zeros((6, 3)), np.full(5, PERIOD)), (1, 2), 'text', {'plan': None}])
def test_memory_of_another_model_or_law_is_ignored(memory):
    one = law(OSCILLATOR[1])
    assert compute(one, [0.7, -0.4], memory=memory).u.tobytes() == compute(
        one, [0.7, -0.4]).u.tobytes()


def test_first_sample_is_that_of_the_riccati_equation():
    found = compute(law(OSCILLATOR[1]), [0.6, -0.4], interval=0.0)
    assert found.failure is None
    assert (found.memory, found.plan) == (None, None)
    assert found.info.form != 'planned'


# The grid.


@pytest.mark.parametrize('interval', [0.01, 0.1, 1.0, 10.0])
def test_horizon_grows_from_the_sample_and_ends_in_time(interval):
    lengths = law(UNSTABLE[1]).planner.grid(interval).lengths
    assert lengths[0] == interval
    assert np.all(np.diff(lengths) >= 0.0)
    assert 3 <= len(lengths) <= 30
    # eight time constants of the growing mode, or three samples
    assert np.sum(lengths) <= max(8.0 / 0.5, 3.0 * interval) + interval


@pytest.mark.parametrize(('horizon', 'count', 'longest', 'total'), [
    (10.0, 5, math.inf, 10.0), (5.0, 5, math.inf, 5.0), (1.0, 3, math.inf, 3.0),
    (1e6, 30, math.inf, 1e6), (7.0, 1, math.inf, 1.0), (100.0, 4, 2.0, 7.0)])
def test_grid_reaches_its_horizon(horizon, count, longest, total):
    lengths = HorizonGrid.growing(horizon, 1.0, count, longest).lengths
    assert (lengths[0], len(lengths)) == (1.0, count)
    assert np.sum(lengths) == pytest.approx(total)


def test_plan_is_shifted_by_a_sample():
    new = HorizonGrid(np.array([1.0, 0.5, 1.5, 2.0]))
    u, x = np.array([[1.0], [2.0], [3.0]]), np.array([[0.0, 5.0], [1.0, 4.0], [3.0, 2.0],
                                                      [7.0, -2.0]])
    inputs, nodes = new.shift(u, x, np.array([1.0, 1.0, 2.0]))
    np.testing.assert_array_equal(inputs[:, 0], [2.0, 3.0, 3.0, 3.0])
    # at 1, 2, 2.5, 4 and beyond the end
    np.testing.assert_allclose(nodes, [[1.0, 4.0], [3.0, 2.0], [4.0, 1.0], [7.0, -2.0],
                                       [7.0, -2.0]])


def test_a_plan_that_a_lift_cannot_follow_costs_one_sample():
    """Where the derivative of a free lift is not finite it has no pseudo-inverse."""
    one = law(random_lift(2, identity=False, n_u=1))
    lengths = one.planner.grid(PERIOD).lengths
    N = len(lengths)
    plan = np.zeros((N, 1)), np.full((N + 1, 2), np.inf), lengths
    found = compute(one, [0.0, 0.0], memory=plan)
    assert (found.u, found.failure.code, found.passing) == (None, StatusCode.PLAN_NOT_SOLVED, True)
