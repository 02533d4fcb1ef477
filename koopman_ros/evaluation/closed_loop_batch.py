# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Closed loops of several laws side by side on a drift, and the cost of each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import contextlib
from dataclasses import dataclass, replace
from functools import cached_property
import itertools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from koopman_ros.control.fallback import FallbackLevel
from koopman_ros.control.laws import Law, Linear, Weights
from koopman_ros.control.laws.base import Target
from koopman_ros.core.arrays import Array
from koopman_ros.core.integration import integrate
from koopman_ros.core.signals import Outputs
from koopman_ros.core.solvers import differences, solve_riccati
from koopman_ros.core.steady_state import newton_steps, steady_states_near
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.estimation import AppliedInputs, Estimate, MeasuredState, PendingInputs
from koopman_ros.evaluation.closed_loop_settings import ClosedLoopSettings, SETTINGS
from koopman_ros.execution import Notify
from koopman_ros.model import LiftedModel, NetworkObservables
from koopman_ros.model.lifted_model import NODES, WEIGHTS
from koopman_ros.tuning import InputLimits, Tuning

# dx/dt (M, n_x) of states (M, n_x) and inputs (M, n_u), in units a time unit of the model
Rate = Callable[[Array, Array], Array]
# inputs (M, n_u) of states (M, n_x), as far as these are active; NaN where there is none
_Feedback = Callable[[Array, NDArray[np.bool_]], Array]


@dataclass(frozen=True)
class LoopBatch:
    """The common settings of all loops."""

    plant: DriftPlant
    tuning: Tuning
    law: type[Law]
    interval: float  #: between samples, in time units of the model
    samples: int
    steps: int  #: of integration, in an interval
    noise: Array  #: (n_x,) standard deviation of measured states, in scaled deviations
    settings: ClosedLoopSettings = SETTINGS

    @property
    def seconds(self) -> float:
        """Between samples, in s."""
        return self.interval * self.plant.model.seconds_per_time_unit

    @cached_property
    def dead_time(self) -> Array:
        """(n_u,) of each input, in time units of the model."""
        return self.plant.model.dead_time / self.plant.model.seconds_per_time_unit

    @cached_property
    def pieces(self) -> list[tuple[float, NDArray[np.bool_]]]:
        """Parts of an interval: the length, and (n_u,) which inputs change at its beginning."""
        shifts = self.dead_time - self.interval * self.whole_samples
        edges = np.unique(np.append(shifts, 0.0))
        return [(float(end - begin), shifts == begin) for begin, end in itertools.pairwise(
            [*edges, self.interval])]

    @cached_property
    def whole_samples(self) -> NDArray[np.int64]:
        """(n_u,) of each dead time."""
        return (self.dead_time / self.interval * (1.0 + 1e-12)).astype(np.int64)

    @property
    def weights(self) -> Weights:
        """Of the cost, on the scaled deviations of the model."""
        return Weights.physical(
            self.plant.model, self.tuning.state_weight, self.tuning.input_weight)

    def within(self, limits: InputLimits) -> LoopBatch:
        """Return the loops with other limits of the inputs."""
        return replace(self, tuning=replace(self.tuning, limits=limits))

    def laws(self, targets: Array, inputs: Array) -> tuple[_Feedback, ...]:
        """Return the law, the averaged one for the true plant, and two linear ones."""
        own = self.law(self.plant.model, self.tuning, self.law.Parameters())
        return (_operated(own, targets, inputs, self.seconds), _informed(self, targets, inputs),
                *(_constant(Linear(one, self.tuning, None), targets, inputs, self.seconds)
                  for one in (self.plant.linearised, self.plant.model)))


def judge_loops(given: LoopBatch, cases: tuple[Array, Array, Array], notify: Notify
                ) -> tuple[Any, ...] | None:
    """
    Run some of the loops; None where `tell` ended them.

    :return: for each loop the cost of the law, its ratio to that of the better of two linear laws,
        whether the law had no gain, its ratio to that of a perfect model, and whether no law
        reaches the set-point.
    """
    starts, targets, inputs = cases
    limits, m = given.tuning.limits, given.plant.model.n_u
    ended = _run(given, given.laws(targets, inputs), cases, notify)
    if ended is None:
        return None
    costs, no_gain = ended
    if (hopeless := ~np.isfinite(costs).any(axis=0)).any():
        # unlimited inputs, hidden by the limits
        endless = np.full(m, np.inf)
        some = starts[hopeless], targets[hopeless], inputs[hopeless]
        free = given.within(InputLimits(-endless, endless, endless))
        ended = _run(given, free.laws(*some[1:]), some, notify)
        if ended is None:
            return None
        costs[:, hopeless], no_gain[hopeless] = ended
    own, informed, *others = costs
    ratios, excess = _cost_ratios(own, np.min(others, axis=0)), _cost_ratios(own, informed)
    # a perfect model must not win by the ends of a range, of which others cannot be as certain
    if (beaten := ~(excess <= given.settings.most_excess) & ~hopeless).any():
        some = starts[beaten], targets[beaten], inputs[beaten]
        less = given.within(_narrowed(limits, given.settings.kept))
        again = _run(given, [_informed(less, *some[1:])], some, notify, operated=False)
        if again is None:
            return None
        excess[beaten] = np.minimum(excess[beaten], _cost_ratios(own[beaten], again[0][0]))
    return own, ratios, no_gain, excess, hopeless


def _cost_ratios(cost: Array, other: Array) -> Array:
    """Return ratios (M,) of costs; 0 where the other is infinite."""
    finite = np.isfinite(other)
    return np.where(finite, cost / np.where(finite, other, 1.0), 0.0)


@dataclass(frozen=True)
class DriftPlant:
    """A drift in the scaled deviations of a model; rows are states or inputs side by side."""

    model: LiftedModel  #: whose names and scaling
    physical: Rate  #: in units

    def rate(self, x: Array, v: Array) -> Array:
        """Return the scaled rates (M, n_x)."""
        states = self.model.states
        scaled: Array = self.physical(states.to_physical(x), self.model.inputs.to_physical(v)
                                      ) / states.scale
        return scaled

    def slope(self, x: Array, v: Array) -> Array:
        """Return the derivatives (M, n_x, n_x + n_u) of the rate by state and input."""
        n, both = x.shape[1], np.hstack([x, v])

        def rate(y: Array) -> Array:
            rows = y.reshape(-1, y.shape[-1])
            return self.rate(rows[:, :n], rows[:, n:]).reshape(*y.shape[:-1], n)

        return differences(rate, both, np.ones(both.shape[1]))

    def holding(self, x: Array, v: Array) -> Array:
        """Return the inputs (M, n_u) nearest to `v` that hold the states (M, n_x) best."""
        return v + newton_steps(
            self.rate(x, v), np.nan_to_num(self.slope(x, v)[..., x.shape[1]:]))

    def steady_states(self, x: Array, v: Array) -> tuple[Array, Array]:
        """
        Return steady states and inputs near given ones; those without one are left out.

        Each begins at the inputs that hold the state best.
        """
        n = x.shape[1]

        def parts(y: Array) -> tuple[Array, Array]:
            return y[:, :n], y[:, n:]

        with np.errstate(all='ignore'):
            found = steady_states_near(
                lambda y: self.rate(*parts(y)), lambda y: self.slope(*parts(y)),
                np.hstack([x, self.holding(x, v)]))
        return parts(found)

    @property
    def linearised(self) -> LiftedModel:
        """The linear model of the plant at the model's nominal point."""
        model, n = self.model, self.model.n_x
        slope = self.slope(np.zeros((1, n)), np.zeros((1, model.n_u)))[0]
        itself = NetworkObservables.linear(n)
        return replace(model, observables=itself, A=slope[:, :n], B=slope[:, n:],
                       readout=None, input_terms=None, pre_feedback=None, verified_loops=None)


def _operated(law: Law, setpoints: Array, inputs: Array, seconds: float) -> _Feedback:
    """Return a law's inputs as a controller finds them, from sample to sample of each loop."""
    model, states = law.model, law.model.states
    outputs = Outputs(states.names, states.units, np.eye(model.n_x))
    level = FallbackLevel('', law, MeasuredState(model, outputs, law.tuning, None), states.names,
                          integrates=False)
    dead_ns = tuple(round(NANOSECONDS * one) for one in law.tuning.dead_times(model).tolist())
    # the input that holds the set-point was applied at all times before
    queues = [AppliedInputs().corrected(u) for u in model.inputs.to_physical(inputs)]
    memory: list[object] = [None] * len(inputs)
    goals, period, now = states.to_physical(setpoints), round(NANOSECONDS * seconds), 0
    with np.errstate(all='ignore'):
        w = [-model.rate_under(v)(x) for x, v in zip(setpoints, inputs, strict=True)]

    def act(x: Array, active: NDArray[np.bool_]) -> Array:
        nonlocal now
        v = np.full(inputs.shape, np.nan)
        for k in np.flatnonzero(active):
            found = level.compute(goals[k], Estimate(x[k], w[k]), memory[k], seconds, None, None,
                                  PendingInputs(queues[k], now, dead_ns))[1]
            memory[k] = found.memory
            if found.u is not None:
                queues[k] = queues[k].followed_by(now, found.u, dead_ns)
                v[k] = model.inputs.to_deviation(found.u)
        now += period
        return v

    return act


def _constant(law: Linear, setpoints: Array, inputs: Array, seconds: float) -> _Feedback:
    """Return the inputs of a law with one gain, identified from its inputs without limits."""
    model, limits, n = law.model, law.tuning.limits, setpoints.shape[1]
    endless = np.full(model.n_u, np.inf)
    free = Linear(model, replace(law.tuning, limits=InputLimits(-endless, endless, endless)), None)
    gain = np.full((model.n_u, n), np.nan)
    with contextlib.suppress(np.linalg.LinAlgError):
        target = Target.at(model, np.zeros(n + model.n_u))
        for k, x in enumerate(np.eye(n)):
            u = free.compute(Estimate(x, np.zeros(n)), target, None, seconds, None).u
            if u is not None:
                gain[:, k] = model.inputs.to_deviation(u)

    def act(x: Array, active: NDArray[np.bool_]) -> Array:
        u = model.inputs.to_physical(inputs + (x - setpoints) @ gain.T)
        return model.inputs.to_deviation(limits.within(u))

    return act


def _narrowed(limits: InputLimits, share: float) -> InputLimits:
    """Reduce a range by a share at either end."""
    bounded = np.isfinite(limits.lower) & np.isfinite(limits.upper)
    margin = np.zeros(len(bounded))
    margin[bounded] = share * (limits.upper - limits.lower)[bounded]
    return replace(limits, lower=limits.lower + margin, upper=limits.upper - margin)


def _informed(given: LoopBatch, setpoints: Array, inputs: Array) -> _Feedback:
    """Return the averaged law for the true plant: no better model gives a better law."""
    plant, tuning, weights = given.plant, given.tuning, given.weights

    def act(x: Array, active: NDArray[np.bool_]) -> Array:
        v = np.full(inputs.shape, np.nan)
        rows = np.flatnonzero(active)
        e, n = x[rows] - setpoints[rows], x.shape[1]
        points = setpoints[rows] + NODES[:, None, None] * e
        along = plant.slope(points.reshape(-1, n), np.tile(inputs[rows], (len(NODES), 1)))
        A = np.tensordot(WEIGHTS, along[..., :n].reshape(len(NODES), -1, n, n), 1)
        B = plant.slope(x[rows], inputs[rows])[..., n:]
        for i, k in enumerate(rows):
            found = solve_riccati(A[i], B[i], weights.Q, weights.R,
                                  interval=given.interval, max_gain=tuning.max_gain,
                                  max_residual=tuning.max_riccati_residual)
            if found.solved:
                u = plant.model.inputs.to_physical(inputs[k] - found.K @ e[i])
                v[k] = plant.model.inputs.to_deviation(tuning.limits.within(u))
        return v

    return act


def _run(given: LoopBatch, feedbacks: Sequence[_Feedback], cases: tuple[Array, Array, Array],
         watch: Callable[[float], bool], *, operated: bool = True
         ) -> tuple[Array, NDArray[np.bool_]] | None:
    """
    Run M loops under each of F laws; None where `watch` ended it.

    If the first law is operated, its commands act after the dead time of each input. The other
    laws predict perfectly: each of their inputs follows the state of the time at which it acts.

    :return: costs (F, M), infinite where a loop does not reach the set-point, and whether (M,) the
        first law had no gain on the way.
    """
    plant, weights, samples, settings = (
        given.plant, given.weights, given.samples, given.settings)
    starts, setpoints, inputs = cases
    n, (M, m) = starts.shape[1], inputs.shape
    y = np.tile(np.hstack([starts, np.zeros((M, 1))]), (len(feedbacks), 1, 1))
    no_gain = np.zeros(M, dtype=bool)
    rng = np.random.default_rng(0)
    v = np.tile(inputs, (len(feedbacks), 1, 1))
    commands: list[Array] = []  # of the first law

    def arrived() -> NDArray[np.bool_]:
        return np.all(np.abs(y[..., :n] - setpoints) < settings.arrived, axis=-1)

    def flow(y: Array, v: Array) -> Array:
        x = y[..., :n]
        e, u = x - setpoints, v - inputs
        cost = np.einsum('...i,ij,...j->...', e, weights.Q, e) + np.einsum(
            '...i,ij,...j->...', u, weights.R, u)
        rate = plant.rate(x.reshape(-1, n), v.reshape(-1, m)).reshape(x.shape)
        return np.concatenate([rate, cost[..., None]], axis=-1)

    # a loop that runs away ends as one that failed, whatever overflows meanwhile
    with np.errstate(all='ignore'):
        for number in range(settings.patience * samples):
            # the share of the usual time
            if watch(min(number, samples - 1) / samples):
                return None
            active = (np.abs(y[..., :n]) < settings.escaped).all(axis=-1)
            y[~active] = np.nan
            if number >= samples:
                # where one law has arrived the others may, too; all of them get the same time
                at_target = arrived()
                active &= at_target.any(axis=0) & (active & ~at_target).any(axis=0)
                if not active.any():
                    break
            noise = given.noise * rng.standard_normal((M, n))
            if operated:
                commands.append(feedbacks[0](y[0, :, :n] + noise, active[0]))
                no_gain |= active[0] & ~np.isfinite(commands[-1]).all(axis=-1)
            for length, changed in given.pieces:
                now = np.flatnonzero(changed & (number >= given.whole_samples))
                for k, act in enumerate(feedbacks if len(now) else ()):
                    if operated and k == 0:
                        for j in now:
                            v[0, :, j] = commands[number - given.whole_samples[j]][:, j]
                    else:
                        v[k][:, now] = act(y[k, :, :n] + noise, active[k])[:, now]
                steps = math.ceil(given.steps * (length / given.interval))
                ahead = integrate(lambda y: flow(y, v), y, length, steps)
                y = np.where(active[..., None], ahead, y)
        at_target = arrived()
    return np.where(at_target & np.isfinite(y[..., n]), y[..., n], np.inf), no_gain
