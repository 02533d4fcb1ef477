# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The optimal control problem of a sample, and its quadratic programs, solved by daqp."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
import math

import daqp
import numpy as np
from numpy.typing import NDArray

from koopman_ros.control.laws.base import LaterInputs, Plan, Target, Weights
from koopman_ros.control.laws.riccati import feedback
from koopman_ros.control.mpc.condensing import condense, roll_out
from koopman_ros.control.mpc.grid import HorizonGrid, PlanningSettings
from koopman_ros.core.arrays import Array
from koopman_ros.core.integration import fastest_rate, integrate
from koopman_ros.core.solvers import RiccatiSolution, solve_riccati
from koopman_ros.core.status import Reason, reason, StatusCode
from koopman_ros.estimation import Estimate, held_means
from koopman_ros.model import LiftedModel
from koopman_ros.tuning import Tuning

# Of daqp.
_INFINITY = 1e30
_SOLVED = (1, 2)  # exit flags: optimal, and optimal with a soft constraint violated
_SOFT = 8  # the mark of a soft constraint


@dataclass(frozen=True)
class PlanningProblem:
    """The optimal control problem of a sample, in scaled deviations and the model's time unit."""

    start: Array  #: (n_x,) estimated state
    w: Array  #: (n_x,) estimated disturbance of its rate
    target: Target  #: set-point
    previous: Array | None  #: (n_u,) last command
    grid: HorizonGrid  #: of N intervals
    steps: int  #: of the integration in each interval
    terminal: Array  #: (n_x, n_x) weight of the error at the end
    change: Array  #: (N, n_u) largest change of an input from one interval to the next
    #: (n_u,) interval in which the command of each input acts first
    begins: NDArray[np.intp]
    under_way: Array  #: (N, n_u) inputs that act until then; anything from there on
    x_ref: Array  #: (N, n_x) mean reference in each interval
    u_ref: Array  #: (N, n_u) input that holds it
    end: Target  #: that in force at the end

    @property
    def free(self) -> NDArray[np.bool_]:
        """Which inputs (N, n_u) of a plan are to be found."""
        return np.arange(len(self.change))[:, None] >= self.begins

    def commanded(self, u: Array) -> Array:
        """Return the inputs (n_u,) of a plan (N, n_u) that are commanded now."""
        return u[self.begins, np.arange(u.shape[1])]


class Planner:
    """
    Plans of one model and tuning, in scaled deviations and the model's time unit.

    A plan is its inputs u (N, n_u) and nodes x (N + 1, n_x).

    :param weights: the cost.
    :param state_lower: (n_x,) soft limits of the states, to `state_upper`, in state units.
    """

    def __init__(self, model: LiftedModel, tuning: Tuning, weights: Weights,
                 settings: PlanningSettings, state_lower: Array, state_upper: Array) -> None:
        self._settings = settings
        self._model, self._tuning, self._weights = model, tuning, weights
        inputs, limits = model.inputs, tuning.limits
        self._lower = np.maximum(inputs.to_deviation(limits.lower), -_INFINITY)
        self._upper = np.minimum(inputs.to_deviation(limits.upper), _INFINITY)
        self._rate = limits.rate * model.seconds_per_time_unit / inputs.scale
        self._state_lower, self._state_upper = (
            model.states.to_deviation(bound) for bound in (state_lower, state_upper))
        for j, i in model.commanded.items():
            # the law sets its rate, and the limits are those of a state
            self._lower[j], self._upper[j], self._rate[j] = -_INFINITY, _INFINITY, np.inf
            for bounds, strictest, limit in ((self._state_lower, max, limits.lower[j]),
                                             (self._state_upper, min, limits.upper[j])):
                bounds[i] = strictest(
                    bounds[i], (limit - model.states.center[i]) / model.states.scale[i])
        self._slope = model.drift_jacobian(np.zeros(model.n_x))
        # the same from sample to sample, mostly
        self._grid, self._cost_to_go = lru_cache(8)(self._new_grid), lru_cache(8)(self._new_cost)

    # The problem of a sample.

    def problem(self, estimate: Estimate, target: Target, interval: float,
                previous: Array | None, later: LaterInputs | None = None) -> PlanningProblem:
        """
        Return the problem of an estimate and a target.

        :param interval: seconds between samples.
        :param previous: (n_u,) last command, in input units, or None.
        :param later: which inputs act later than others, or None.
        """
        model = self._model
        after = np.zeros(model.n_u) if later is None else (
            later.seconds / model.seconds_per_time_unit)
        grid = self.grid(interval, float(np.max(after, initial=0.0)))
        if later is not None:
            grid = grid.with_nodes(after)
        begins = np.searchsorted(grid.times, after - 1e-6 * grid.sample)
        rates = self._rate * model.inputs.slope(
            model.inputs.center if previous is None else previous)
        change = grid.since_change * rates
        change[begins, np.arange(model.n_u)] = grid.sample * rates
        # B(x) changes the slope with the input
        end = target.after(float(grid.times[-1]) * model.seconds_per_time_unit)
        fastest, terminal = self._cost_to_go(
            tuple(end.x.tolist()),
            () if model.input_terms is None else tuple(end.u.tolist()),
            grid.sample)
        rate = max(fastest_rate(self._slope), fastest,
                   fastest_rate(model.drift_jacobian(estimate.x)))
        rule = self._settings.rule
        steps = rule.count(float(grid.lengths[-1]), rate) or rule.most
        return PlanningProblem(
            estimate.x, estimate.w, target,
            None if previous is None else model.inputs.to_deviation(previous), grid, steps,
            terminal, change, begins, np.zeros_like(change) if later is None else (
                self._under_way(grid, later.pieces)), *self._references(grid, target), end)

    def grid(self, interval: float, after: float = 0.0) -> HorizonGrid:
        """
        Return the horizon for a sample interval in s.

        :param after: time until all inputs act, by which it is longer.
        """
        return self._grid(interval / self._model.seconds_per_time_unit, after)

    def _under_way(self, grid: HorizonGrid, pieces: list[tuple[float, Array]]) -> Array:
        """Return the means (N, n_u) of inputs that act one after another."""
        model = self._model
        durations = np.array([seconds for seconds, _ in pieces]) / model.seconds_per_time_unit
        return held_means(
            np.concatenate(([0.0], np.cumsum(durations))),
            np.array([model.inputs.to_deviation(u) for _, u in pieces]), grid.times)

    def _references(self, grid: HorizonGrid, target: Target) -> tuple[Array, Array]:
        """Return the mean references (N, n_x) and (N, n_u) of the intervals."""
        if not target.later:
            return np.tile(target.x, (len(grid.lengths), 1)), np.tile(
                target.u, (len(grid.lengths), 1))
        times, every = zip((0.0, target), *target.later, strict=True)
        edges = np.array(times) / self._model.seconds_per_time_unit
        edges = np.append(edges, max(edges[-1], grid.times[-1]) + grid.sample)
        return (held_means(edges, np.array([one.x for one in every]), grid.times),
                held_means(edges, np.array([one.u for one in every]), grid.times))

    def _new_grid(self, sample: float, after: float) -> HorizonGrid:
        A, B = self._slope, self._model.B
        found = self._regulator(A, B, sample)
        settings = self._settings
        horizon = settings.most * sample
        closed = np.linalg.eigvals(A - B @ found.K).real
        if found.solved and np.all(closed < 0.0):
            horizon = settings.horizon / float(np.min(-closed))
        growing = float(np.max(np.linalg.eigvals(A).real))
        if growing > 0.0:
            horizon = min(horizon, settings.unstable / growing)
        horizon += after
        count = int(min(max(math.ceil(horizon / sample), settings.fewest), settings.most))
        # modes much faster than those of the closed loop end it sooner
        fastest = fastest_rate(A)
        longest = max(sample, settings.steps * settings.rule.time_constants / fastest
                      if fastest else math.inf)
        return HorizonGrid.growing(horizon, sample, count, longest)

    def _new_cost(self, x_ref: tuple[float, ...], u_ref: tuple[float, ...], sample: float
                  ) -> tuple[float, Array]:
        """Return the rate of the fastest mode at a target, and the cost (n_x, n_x) from there."""
        model, x = self._model, np.array(x_ref)
        A = model.drift_jacobian(x)
        fastest = fastest_rate(A)
        if u_ref:
            A = A + model.forcing_jacobian(x, np.array(u_ref))
        found = self._regulator(A, model.input_matrix(x), sample)
        # without a regulator the horizon alone counts
        return fastest, found.P if found.solved else (
            self._weights.Q * float(self._grid(sample, 0.0).lengths[-1]))

    def _regulator(self, A: Array, B: Array, sample: float) -> RiccatiSolution:
        return solve_riccati(
            A, B, self._weights.Q, self._weights.R, interval=sample,
            max_gain=self._tuning.max_gain, max_residual=self._tuning.max_riccati_residual)

    # The first guess.

    def first_guess(self, problem: PlanningProblem, memory: object) -> tuple[Array, Array]:
        """Return the plan of the sample before, one sample later, or one under a feedback."""
        match memory:
            # not of a model of another size
            case (np.ndarray() as u, np.ndarray() as x, np.ndarray() as lengths) if (
                    u.shape == (len(lengths), self._model.n_u)
                    and x.shape == (len(lengths) + 1, self._model.n_x)):
                inputs, nodes = problem.grid.shift(u, x, lengths)
                inputs = np.where(problem.free, inputs, problem.under_way)
                nodes[0] = problem.start
                return inputs, nodes
        return self._under_feedback(problem)

    def _under_feedback(self, problem: PlanningProblem) -> tuple[Array, Array]:
        """Simulate the model under the state-dependent Riccati law with its limits."""
        model, target, x, last = self._model, problem.target, problem.start, problem.previous
        inputs, nodes = [], [x]
        for length, change, free, known in zip(
                problem.grid.lengths.tolist(), problem.change, problem.free, problem.under_way,
                strict=True):
            found = feedback(model, x, target, self._weights, interval=length,
                             max_gain=self._tuning.max_gain,
                             max_residual=self._tuning.max_riccati_residual)
            u = found.u if found.solved and np.isfinite(found.u).all() else target.u
            u = np.clip(u, self._lower, self._upper)
            u = u if last is None else np.clip(u, last - change, last + change)
            last = u if last is None else np.where(free, u, last)
            u = np.where(free, u, known)
            rate = model.rate_under(u, problem.w)
            x = integrate(rate, x, length, problem.steps)
            inputs.append(u)
            nodes.append(x)
            if not (np.isfinite(x).all()
                    and model.distances(x[None])[0] < self._settings.diverged):
                # a straight line to the target is as good a guess
                N = len(problem.change)
                return np.tile(target.u, (N, 1)), np.linspace(problem.start, target.x, N + 1)
        return np.array(inputs), np.array(nodes)

    # The quadratic program.

    def improve(self, problem: PlanningProblem, u: Array, x: Array
                ) -> tuple[float, Array, Array] | Reason:
        """
        Solve the quadratic program about a plan.

        :return: the largest change of an input, and the changed plan; or why there is none.
        """
        try:
            ends, cost = roll_out(
                self._model, u, x, problem.w, problem.x_ref, problem.u_ref, problem.grid.lengths,
                problem.steps, self._weights.Q, self._weights.R)
        except np.linalg.LinAlgError:
            ends = cost = np.array(np.nan)
        if not (np.isfinite(ends).all() and np.isfinite(cost).all()):
            return reason(StatusCode.PLAN_NOT_SOLVED, flag='the trajectory is not finite')
        nodes, by_inputs, H, f = condense(
            x, problem.start, problem.end.x, ends, cost, problem.terminal)
        free = problem.free.ravel()
        if not free.all():
            by_inputs, H, f = by_inputs[..., free], H[np.ix_(free, free)], f[free]
        A, lower, upper, sense = self._constraints(problem, u, nodes, by_inputs)
        v, _, flag, _ = daqp.solve(H, f, A, upper, lower, sense)
        v = np.asarray(v, dtype=np.float64)
        change = float(np.abs(v).max())
        if flag not in _SOLVED or not math.isfinite(change):
            return reason(StatusCode.PLAN_NOT_SOLVED, flag=f'daqp returns {flag}')
        moved = np.zeros(u.size)
        moved[free] = v
        return change, u + moved.reshape(u.shape), nodes + by_inputs @ v

    def _constraints(self, problem: PlanningProblem, u: Array, nodes: Array, by_inputs: Array
                     ) -> tuple[Array, Array, Array, NDArray[np.int32]]:
        """Return A with lower <= (v, A v) <= upper for a change v, and which rows are soft."""
        last, lower, upper, free = problem.previous, self._lower, self._upper, problem.free
        limited = np.isfinite(problem.change) & free
        steps = np.diff(u, axis=0, prepend=u[:1] if last is None else last[None])
        if last is not None:
            steps[problem.begins, np.arange(u.shape[1])] = problem.commanded(u) - last
        if last is None:
            limited[0] = False
        else:
            # an input outside a range that was narrowed returns at its rate
            reach = np.cumsum(problem.change, axis=0)
            lower, upper = np.minimum(lower, last + reach), np.maximum(upper, last - reach)
        count, n_u = int(np.count_nonzero(free)), u.shape[1]
        differences = (np.eye(u.size) - np.eye(u.size, k=-n_u))[limited.ravel()][:, free.ravel()]
        change, steps = problem.change[limited], steps[limited]
        bounded = np.isfinite(self._state_lower) | np.isfinite(self._state_upper)
        states = nodes[1:, bounded].ravel()
        low, high = (np.tile(bound[bounded], len(u))
                     for bound in (self._state_lower, self._state_upper))
        lower = np.concatenate(((lower - u)[free], -change - steps, low - states))
        upper = np.concatenate(((upper - u)[free], change - steps, high - states))
        sense = np.zeros(len(lower), dtype=np.int32)
        sense[count + len(change):] = _SOFT
        return (np.concatenate((differences, by_inputs[1:, bounded].reshape(-1, count))),
                np.maximum(lower, -_INFINITY), np.minimum(upper, _INFINITY), sense)

    # The result.

    def plan(self, problem: PlanningProblem, u: Array, x: Array) -> Plan:
        """Return a plan in the units of the signals, and its active limits."""
        model, first = self._model, problem.commanded(u)
        step = np.zeros(model.n_u) if problem.previous is None else first - problem.previous
        return Plan(
            problem.grid.times * model.seconds_per_time_unit, model.states.to_physical(x),
            model.inputs.to_physical(u),
            _active(first, first, self._lower, self._upper, self._settings.at_input),
            _active(step, step, -problem.commanded(problem.change),
                    problem.commanded(problem.change), self._settings.at_input),
            _active(x[1:].min(axis=0), x[1:].max(axis=0), self._state_lower, self._state_upper,
                    self._settings.at_state))


def _active(least: Array, most: Array, lower: Array, upper: Array, tolerance: float) -> Array:
    """Return -1 where the lower limit is active, 1 where the upper one is, else 0."""
    return np.asarray(1.0 * (most >= upper - tolerance) - (least <= lower + tolerance))
