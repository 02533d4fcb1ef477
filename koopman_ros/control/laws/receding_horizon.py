# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Model predictive control on the model's drift, by real-time iteration."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
import importlib
import math
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from koopman_ros.arrays import Array
from koopman_ros.control.laws.base import Law, LawResult, Plan, SolutionInfo, Target
from koopman_ros.control.laws.intervals import Intervals, Reach
from koopman_ros.control.laws.riccati import feedback, StateDependentRiccati
from koopman_ros.control.laws.shooting import Horizon, program, slope_at
from koopman_ros.declaration import NO_LOWER, NO_UPPER, parameter, UNBOUNDED, value_column
from koopman_ros.estimation import Estimate
from koopman_ros.reasons import Code, Reason, reason
from koopman_ros.solvers import RiccatiStatus, runge_kutta_step, solve_riccati
from koopman_ros.tuning import InputLimits

PACKAGE = 'daqp'  # the solver of quadratic programs

_INTERVALS = 30  # of the horizon, at most, each with one input that is held
_FEWEST = 3  # likewise, at least
# The horizon is so many time constants of the closed loop, unless the plant is unstable: over more
# than this many of its time constants the effect of an input is too large to compute with.
_CLOSED_LOOP, _UNSTABLE = 6.0, 8.0
# A step of the integration is no longer than this share of the drift's fastest time constant.
# Intervals grow to so many steps at the nominal point, and are never given more than the last.
_STEP, _STEPS, _MOST_STEPS = 0.7, 6, 32
# A plan is solved again until it changes by less than this, in scaled inputs.
_STILL, _MOST_ITERATIONS = 1e-4, 12
# What still changes by more after the last iteration has not converged.
_MOVING = 0.05
_LOOK = 3  # every third node, and the last, is held to the training data
_EDGE = 1e-9  # of an input's scale; so near a limit it is reached
_TOUCH = 1e-6  # likewise of a state's, which follows from all inputs
_UNLIMITED = 1e30  # what the solver takes for infinite
_SOLVED = (1, 2)  # its flags; in the second case a soft limit is violated
_SOFT = 8  # its mark of a limit that may be violated
# Half widths of the training box beyond which a course that is rolled out is worth nothing.
_ASTRAY = 2.0


@dataclass(frozen=True)
class MPCParameters:
    """Soft limits of the states, and the time limit of the solver."""

    lower: Array = value_column(
        'states', -UNBOUNDED, 'Soft lower limit of this state.', name='min', none=NO_LOWER)
    upper: Array = value_column(
        'states', UNBOUNDED, 'Soft upper limit of this state.', name='max', none=NO_UPPER)
    time_limit: float = parameter(
        0.0, 'Time that a plan may take, after which the next level acts; 0: any.', 's', 0.0,
        3600.0)


def finite(value: Array) -> bool:
    """Return whether all numbers are finite."""
    return bool(np.isfinite(value).all())


class RecedingHorizon(Law):
    """
    Plan the inputs of a while ahead at each sample, and give the first.

    The least of the integral of e' Q e + v' R v over the horizon, and of what the sampled
    regulator costs from its end on, is found on the model's drift under the estimated disturbance:
    the course of the plan before is linearised, its deviation solves a quadratic program, and so
    on until the plan stands still. Range and rate of the inputs are limits; those of the states
    may be violated where they must be.

    Multiple shooting by Runge-Kutta steps with their derivatives, condensed to the inputs; see
    M. Diehl, H. G. Bock, J. P. Schloeder, "A real-time iteration scheme for nonlinear optimization
    in optimal feedback control", SIAM J. Control Optim. 43 (2005).
    """

    Parameters = MPCParameters
    parameters: MPCParameters

    @cached_property
    def _solve(self) -> Any:
        """The solver; None where it is not installed."""
        try:
            return importlib.import_module(PACKAGE).solve
        except ImportError:
            return None

    def unusable(self) -> Reason | None:
        """Return that its solver is not installed."""
        return None if self._solve is not None else reason(
            Code.PACKAGE_MISSING, package=PACKAGE)

    @cached_property
    def _riccati(self) -> StateDependentRiccati:
        return StateDependentRiccati(self.model, self.tuning, None)

    def compute(self, estimate: Estimate, target: Target, memory: object, interval: float,
                previous: Array | None) -> LawResult:
        """
        Find the input for an estimate; see :class:`~koopman_ros.control.laws.base.Law`.

        At the first sample, of which nobody knows for how long its input will be held, it is that
        of the Riccati equation.
        """
        if self._solve is None:
            return LawResult(None, self.unusable())
        if not interval > 0.0:
            return self._riccati.compute(estimate, target, None, interval, previous)
        limits, deadline = self.tuning.limits, self.parameters.time_limit or math.inf
        began = time.perf_counter()
        try:
            problem = _Problem(self, estimate, target, limits, interval, previous)
            u, x = problem.begin(memory)
            for iteration in range(1, _MOST_ITERATIONS + 1):
                found = problem.improve(u, x)
                if isinstance(found, Reason):
                    return LawResult(None, found, passing=True)
                change, u, x = found
                spent = time.perf_counter() - began
                if iteration == 1 and spent > deadline:
                    return LawResult(None, reason(
                        Code.TOO_LATE, seconds=spent, deadline=deadline), passing=True)
                if change <= _STILL or spent * (iteration + 1) / iteration > deadline:
                    break
        except np.linalg.LinAlgError as error:
            return LawResult(None, reason(Code.SINGULAR, matrix=str(error)))
        if not change <= _MOVING:
            return LawResult(None, reason(Code.PLAN_MOVES, iterations=iteration), passing=True)
        # from outside, the way back is no reason
        here, *ahead = self.model.distances(np.concatenate((x[:-1:_LOOK], x[-1:]))).tolist()
        outside = max(ahead)
        if outside > max(self.margin, here):
            return LawResult(None, reason(
                Code.PLAN_OUTSIDE, outside=outside, margin=self.margin))
        wanted = self.model.inputs.to_physical(u[0])
        if not finite(wanted):
            return LawResult(None, reason(Code.COMMAND_NOT_FINITE))
        within = limits.within(wanted)
        edge = _EDGE * self.model.inputs.scale
        clipped = bool(np.any((within <= limits.lower + edge) | (within >= limits.upper - edge)))
        return LawResult(within, None, SolutionInfo('planned'), (u, x, problem.intervals.lengths),
                         problem.plan(u, x), clipped=clipped)

    def lengths(self, interval: float) -> Array:
        """
        Return the intervals (N,) of the horizon, the first that of a sample, in time units.

        The others grow by a factor until the horizon is reached.

        :param interval: between samples, in the model's time unit.
        """
        return self.intervals(interval).lengths

    def intervals(self, interval: float) -> Intervals:
        """Return the same with what follows from it."""
        return self._intervals(interval)

    @cached_property
    def _intervals(self) -> Any:
        @lru_cache(maxsize=8)
        def of(interval: float) -> Intervals:
            A, weights = self._slope, self.weights
            found = solve_riccati(A, self.model.B, weights.Q, weights.R,
                              interval=interval, max_gain=self.tuning.max_gain,
                              max_residual=self.tuning.max_riccati_residual)
            horizon = _INTERVALS * interval
            closed = np.linalg.eigvals(A - self.model.B @ found.K).real
            if found.status is RiccatiStatus.SOLVED and np.all(closed < 0.0):
                horizon = _CLOSED_LOOP / float(np.min(-closed))
            growing = float(np.max(np.linalg.eigvals(A).real))
            if growing > 0.0:
                horizon = min(horizon, _UNSTABLE / growing)
            count = int(min(max(math.ceil(horizon / interval), _FEWEST), _INTERVALS))
            # where there are faster modes than those that make it long, it ends sooner
            longest = max(interval, _STEPS * _STEP / self.fastest if self.fastest else math.inf)
            return Intervals.reaching(horizon, interval, count, longest)

        return of

    def at_target(self, target: Target, interval: float) -> tuple[float, Array]:
        """
        Return the rate of the fastest mode at a target, and what is to be paid from there on.

        The latter is P (n_x, n_x), what the sampled regulator costs from the end of the horizon.

        :param interval: between samples, in the model's time unit.
        :raises numpy.linalg.LinAlgError: where the drift has no slope.
        """
        # the input counts where it changes the slope
        return self._at_target(target.x.tobytes(), interval, b'' if (
            self.model.input_terms is None) else target.u.tobytes())

    @cached_property
    def _at_target(self) -> Any:
        @lru_cache(maxsize=8)
        def of(state: bytes, interval: float, inputs: bytes) -> tuple[float, Array]:
            model, tuning, weights = self.model, self.tuning, self.weights
            x = np.frombuffer(state)
            A = slope_at(model, x)
            fastest = _fastest(A)
            if inputs:
                A = A + model.forcing_jacobian(x, np.frombuffer(inputs))
            found = solve_riccati(A, model.input_matrix(x), weights.Q,
                              weights.R, interval=interval, max_gain=tuning.max_gain,
                              max_residual=tuning.max_riccati_residual)
            # where the regulator has none, the horizon alone counts
            return fastest, found.P if found.status is RiccatiStatus.SOLVED else (
                weights.Q * float(self.lengths(interval)[-1]))

        return of

    @cached_property
    def _slope(self) -> Array:
        """The slope of the drift (n_x, n_x) at the nominal point."""
        return self.model.drift_jacobian(np.zeros(self.model.n_x))

    @cached_property
    def fastest(self) -> float:
        """Rate of the fastest mode of the drift at the nominal point, in 1/time unit."""
        return _fastest(self._slope)

    def reach(self, interval: float, limits: InputLimits) -> Reach:
        """Return what limits the inputs of a plan, at samples so far apart in time units."""
        return self._reach(interval, *(
            side.tobytes() for side in (limits.lower, limits.upper, limits.rate)))

    @cached_property
    def _reach(self) -> Any:
        @lru_cache(maxsize=8)
        def of(interval: float, *limits: bytes) -> Reach:
            inputs, (lower, upper, rate) = self.model.inputs, map(np.frombuffer, limits)
            return Reach(np.maximum(inputs.to_deviation(lower), -_UNLIMITED),
                          np.minimum(inputs.to_deviation(upper), _UNLIMITED),
                          self.intervals(interval).before * (
                              rate * self.model.seconds_per_time_unit / inputs.scale))

        return of

    @cached_property
    def bounds(self) -> tuple[Array, Array, list[tuple[int, float, float]]]:
        """Lowest and highest states (n_x,), and both of each one that has any, by its place."""
        lowest, highest = map(self.model.states.to_deviation, (
            self.parameters.lower, self.parameters.upper))
        return lowest, highest, [
            (i, low, high) for i, (low, high) in enumerate(zip(
                lowest.tolist(), highest.tolist(), strict=True))
            if math.isfinite(low) or math.isfinite(high)]


def _fastest(slope: Array) -> float:
    """Return the rate of the fastest mode of a slope (n_x, n_x) of the drift."""
    if not finite(slope.ravel()):
        raise np.linalg.LinAlgError('the drift has no slope here')
    return float(np.max(np.abs(np.linalg.eigvals(slope))))


class _Problem:
    """The quadratic programs of one sample; all in scaled deviations and the model's time unit."""

    def __init__(self, law: RecedingHorizon, estimate: Estimate, target: Target,
                 limits: InputLimits, interval: float, last: Array | None) -> None:
        model = law.model
        self._law, self._model, self._target = law, model, target
        self._x, self._w = estimate.x, estimate.w
        self._sample = interval / model.seconds_per_time_unit
        self.intervals = law.intervals(self._sample)
        lengths = self.intervals.lengths
        at_target, terminal = law.at_target(target, self._sample)
        rate = max(law.fastest, at_target, _fastest(slope_at(model, estimate.x)))
        self._steps = min(max(math.ceil(lengths[-1] * rate / _STEP), 1), _MOST_STEPS)
        weights = law.weights
        self._horizon = Horizon(estimate.x, estimate.w, target.x, target.u, lengths,
                                self._steps, weights.Q, weights.R, terminal)
        self._last = None if last is None else model.inputs.to_deviation(last)
        self._reach = law.reach(self._sample, limits)
        # at first nothing was commanded
        self._rows, self._chosen = self._reach.differences(last is None)

    # Where to begin.

    def begin(self, memory: object) -> tuple[Array, Array]:
        """Return inputs (N, n_u) and nodes (N + 1, n_x): of the plan before, or of a feedback."""
        match memory:
            # not of a model of another size
            case (np.ndarray() as u, np.ndarray() as x, np.ndarray() as lengths) if (
                    u.shape == (len(lengths), self._model.n_u)
                    and x.shape == (len(lengths) + 1, self._model.n_x)):
                inputs, nodes = self.intervals.shifted(u, x, lengths)
                nodes[0] = self._x
                return inputs, nodes
        return self._rolled_out()

    def _rolled_out(self) -> tuple[Array, Array]:
        """Follow the model under the law of the Riccati equation, limited."""
        model, target, tuning, reach = (
            self._model, self._target, self._law.tuning, self._reach)
        x, last, inputs, nodes = self._x, self._last, [], [self._x]
        for length, change in zip(self.intervals.lengths.tolist(), reach.change, strict=True):
            found = feedback(model, x, target, self._law.weights, interval=length,
                             max_gain=tuning.max_gain, max_residual=tuning.max_riccati_residual)
            u = found.u if found.solved and finite(found.u) else target.u
            u = np.minimum(np.maximum(u, reach.lower), reach.upper)
            if last is not None:
                u = np.minimum(np.maximum(u, last - change), last + change)
            last, rate = u, model.rate_under(u, self._w)
            for _ in range(self._steps):
                x = runge_kutta_step(rate, x, length / self._steps)
            inputs.append(u)
            nodes.append(x)
            if not (finite(x) and float(model.distances(x[None])[0]) < _ASTRAY):
                # the straight way is as good a guess
                share = np.linspace(0.0, 1.0, len(reach.change) + 1)[:, None]
                return (np.tile(target.u, (len(reach.change), 1)),
                        self._x + share * (target.x - self._x))
        return np.array(inputs), np.array(nodes)

    # The course, its quadratic program, and the next one.

    def improve(self, u: Array, x: Array) -> tuple[float, Array, Array] | Reason:
        """
        Solve the program about a course of inputs (N, n_u) and nodes (N + 1, n_x).

        :return: by how much an input changes at most, inputs and nodes; or why there are none.
        """
        found = program(self._model, self._horizon, u, x)
        if found is None:
            return reason(Code.PLAN_NOT_SOLVED, flag='its course is not finite')
        nodes, by_inputs = found.nodes, found.by_inputs
        rows, lower, upper, sense = self._limits(u, nodes, by_inputs)
        v, _, flag, _ = self._law._solve(found.H, found.f, rows, upper, lower, sense)
        v = np.asarray(v, dtype=np.float64)
        change = float(np.abs(v).max())
        if flag not in _SOLVED or not math.isfinite(change):
            return reason(Code.PLAN_NOT_SOLVED, flag=f'the solver says {flag}')
        moved = by_inputs.reshape(-1, len(v)).dot(v)
        return change, u + v.reshape(u.shape), nodes + moved.reshape(nodes.shape)

    def plan(self, u: Array, x: Array) -> Plan:
        """Return inputs (N, n_u) and nodes (N + 1, n_x) in their units, and what limits them."""
        model, reach, first, none = self._model, self._reach, u[0], np.zeros(len(u[0]))
        lowest, highest, bounded = self._law.bounds
        step = none if self._last is None else first - self._last
        fastest = reach.change[0] - _EDGE
        return Plan(
            self.intervals.times * model.seconds_per_time_unit, model.states.to_physical(x),
            model.inputs.to_physical(u),
            _side(first, first, reach.lower + _EDGE, reach.upper - _EDGE),
            _side(step, step, -fastest, fastest) if len(self._chosen) else none,
            _side(np.minimum.reduce(x[1:]), np.maximum.reduce(x[1:]), lowest + _TOUCH,
                  highest - _TOUCH) if bounded else np.zeros(len(lowest)))

    def _limits(self, u: Array, nodes: Array, by_inputs: Array
                ) -> tuple[Array, Array, Array, NDArray[np.int32]]:
        """Return rows A with lower <= (v, A v) <= upper, and what of that is soft."""
        last, lower, upper = self._last, self._reach.lower, self._reach.upper
        limited = len(self._chosen) > 0
        if last is not None and limited:
            # what a range that was tightened since has left outside comes back at its rate
            reach = np.cumsum(self._reach.change, axis=0)
            lower = np.minimum(lower, last + reach)
            upper = np.maximum(upper, last - reach)
        rows, low, high = [self._rows], [(lower - u).ravel()], [(upper - u).ravel()]
        if limited:
            step = u.copy()
            step[1:] -= u[:-1]
            step[0] -= u[0] if last is None else last
            step, change = step.ravel()[self._chosen], self._reach.change.ravel()[self._chosen]
            low.append(-change - step)
            high.append(change - step)
        hard = u.size + len(self._chosen)
        for i, least, most in self._law.bounds[2]:
            rows.append(by_inputs[1:, i])
            low.append(np.maximum(least - nodes[1:, i], -_UNLIMITED))
            high.append(np.minimum(most - nodes[1:, i], _UNLIMITED))
        sense = np.zeros(sum(map(len, low)), dtype=np.int32)
        sense[hard:] = _SOFT
        return np.concatenate(rows), np.concatenate(low), np.concatenate(high), sense


def _side(least: Array, most: Array, lower: Array, upper: Array) -> Array:
    """Return -1 where the lower limit is active, 1 where the upper one is, else 0."""
    # in plain numbers, as numpy takes longer for so few
    return np.array([float(b >= high) - (a <= low) for a, b, low, high in zip(
        least.tolist(), most.tolist(), lower.tolist(), upper.tolist(), strict=True)])
