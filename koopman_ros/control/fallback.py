# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The control levels with a law: each a law and an estimator on one model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
import itertools
import math
from types import NoneType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from koopman_ros.control.bumpless import limit
from koopman_ros.control.laws import LAWS
from koopman_ros.control.laws.base import (
    LaterInputs,
    Law,
    LawResult,
    Plan,
    SolutionInfo,
    Target,
)
from koopman_ros.control.steady_state import steady_state_target
from koopman_ros.core.arrays import Array, differ
from koopman_ros.core.plugins import contained, plug_in
from koopman_ros.core.signals import numbers, Outputs
from koopman_ros.core.status import Reason, reason, StatusCode
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.estimation import Estimate, Estimator, ESTIMATORS, PendingInputs
from koopman_ros.model import Coordinates, LiftedModel
from koopman_ros.tuning import InputLimits, Tuning


@dataclass(frozen=True)
class PredictionSettings:
    """The prediction of a state over the dead times of the inputs."""

    #: evaluations of a law between the shortest dead time and the longest one, at most
    evaluations: int = 20
    #: inputs that act for a shorter time, in time constants of the fastest mode, are averaged
    step: float = 0.1
    steps: int = 10  #: of these that an estimator takes at once, at most
    #: longest prediction, in time constants of the fastest mode: a longer one takes seconds
    longest: float = 1000.0


class _NotPredictedError(Exception):
    """The model cannot predict the state over the dead time."""


@dataclass(frozen=True)
class FallbackLevel:
    """One level."""

    name: str  #: of its law
    law: Law  #: with its model
    estimator: Estimator  #: on the same model
    controlled: tuple[str, ...]  #: (n_c,) names of the states with a set-point
    #: whether it moves commands that are states of the model by itself, instead of the plant
    integrates: bool = field(default=True, kw_only=True)
    prediction: PredictionSettings = field(default=PredictionSettings(), kw_only=True)

    @cached_property
    def model(self) -> LiftedModel:
        """The model of law and estimator."""
        return self.law.model

    @cached_property
    def limits(self) -> InputLimits:
        """Range and rate of the inputs."""
        return self.law.tuning.limits

    @cached_property
    def unusable(self) -> Reason | None:
        """Why its law can never act; None where it can."""
        try:
            return self.law.unusable()
        except BaseException as error:
            return reason(StatusCode.LAW_RAISED, error=contained(error))

    @cached_property
    def controls_all(self) -> bool:
        """Whether every state has a set-point."""
        return len(self.controlled) == self.model.n_x

    @cached_property
    def controlled_states(self) -> Coordinates:
        """The states with a set-point."""
        return self.model.states.only(self.controlled)

    @cached_property
    def indices(self) -> NDArray[np.intp]:
        """Indices (n_c,) of the states with a set-point."""
        return np.array([self.model.states.names.index(name) for name in self.controlled],
                        dtype=np.intp)

    @cached_property
    def input_range(self) -> tuple[Array, Array]:
        """Lower and upper ends (n_u,) of the inputs, in scaled deviations."""
        inputs = self.model.inputs
        return inputs.to_deviation(self.limits.lower), inputs.to_deviation(self.limits.upper)

    def target(self, setpoint: Array, w: Array, start: Array | None) -> Target | None:
        """
        Find the steady state of a set-point (n_c,), in state units, under a disturbance (n_x,).

        :param start: (n_x + n_u,) where a steady state is looked for, in units; the nominal point
            by default.
        :return: None where there is no steady state.
        """
        model, inputs, n = self.model, self.model.inputs, self.model.n_x
        goal = self.controlled_states.to_deviation(setpoint)
        if self.law.model_free:
            x = np.zeros(n)
            x[self.indices] = goal
            return Target(x, np.zeros(model.n_u), np.zeros(n), 0.0)
        return steady_state_target(
            model, goal, w, controlled=self.indices, limits=self.input_range,
            start=None if start is None else np.concatenate((
                model.states.to_deviation(start[:n]), inputs.to_deviation(start[n:]))))

    def compute(self, setpoint: Array, estimate: Estimate, memory: object, interval: float,
                start: Array | None, previous: Array | None, pending: PendingInputs | None = None,
                ahead: Callable[[float], list[tuple[float, Array]]] | None = None
                ) -> tuple[Target | None, LawResult]:
        """
        Evaluate the law towards a target, see :meth:`target`, for an estimate of its model.

        With inputs under way it acts on the state that is predicted for the time at which its
        command acts.

        Here alone exceptions and invalid results of a law become a failure with a reason.

        :param ahead: returns the set-points within a horizon in s, with the time until each; None
            where none is scheduled.
        """
        target = None
        try:
            target = self.target(setpoint, estimate.w, start)
            if target is None:
                return None, LawResult(None, reason(StatusCode.NO_STEADY_STATE))
            if ahead is not None and interval > 0.0 and (
                    horizon := self.law.horizon(interval)) > 0.0:
                horizon += max(pending.dead_ns) / NANOSECONDS if pending else 0.0
                target = replace(target, later=tuple(
                    (seconds, found)
                    for seconds, later in ahead(horizon)
                    if (found := self.target(later, estimate.w, start)) is not None))
            if pending is not None and any(pending.dead_ns) and pending.applied.values:
                return target, self._ahead(estimate, target, memory, interval, previous, pending)
            return target, self._checked(
                self.law.compute(estimate, target, memory, interval, previous), estimate, interval)
        except _NotPredictedError as error:
            return target, LawResult(None, reason(
                StatusCode.NOT_PREDICTED, seconds=error.args[0]))
        except BaseException as error:
            return target, LawResult(None, reason(StatusCode.LAW_RAISED, error=contained(error)))

    def _ahead(self, estimate: Estimate, target: Target, memory: object, interval: float,
               previous: Array | None, pending: PendingInputs) -> LawResult:
        """
        Evaluate the law for each input at the state predicted for the time at which it acts.

        Until a slower input acts the faster ones are assumed to follow the law. With a correct
        model each input then equals, at the time it acts, the value of the law for the state of
        that time: the loop is the one without dead time. Held at their last commands instead, the
        faster inputs would enter the prediction with a gain that grows with the difference of the
        dead times, and make the loop unstable.
        """
        dead_ns = np.array(pending.dead_ns)
        shortest, longest = int(dead_ns.min()), int(dead_ns.max())
        estimate = self._predicted(estimate, pending.between(0, shortest))
        target = target.after(shortest / NANOSECONDS)
        planned = None if shortest == longest else self.law.compute_later(
            estimate, target, memory, interval, previous, LaterInputs(
                (dead_ns - shortest) / NANOSECONDS, pending.between(shortest, longest)))
        first = result = self._checked(planned or self.law.compute(
            estimate, target, memory, interval, previous), estimate, interval)
        if first.plan is not None:
            first = replace(first, plan=replace(
                first.plan, times=first.plan.times + shortest / NANOSECONDS))
        # a law without a model moves from its last command, not from the state
        if first.u is None or shortest == longest or planned or self.law.model_free:
            return first
        u, held = first.u.copy(), first.u
        count = min(self.prediction.evaluations, math.ceil(
            (longest - shortest) / NANOSECONDS / interval) if interval > 0.0 else 1)
        edges = sorted({*np.linspace(shortest, longest, count + 1).round().astype(int).tolist(),
                        *pending.dead_ns})
        for begin, end in itertools.pairwise(edges):
            acts = dead_ns <= begin
            estimate = self._predicted(estimate, [
                (seconds, np.where(acts, held, known))
                for seconds, known in pending.between(begin, end)])
            seconds = (end - begin) / NANOSECONDS
            result = self._checked(self.law.compute(
                estimate, target, result.memory, seconds, held), estimate, seconds)
            if result.u is None:
                return result
            held = limit(self.limits, self.model.inputs.scale, result.u, held, seconds)[0]
            u[dead_ns == end] = result.u[dead_ns == end]
        return replace(first, u=u)

    def _predicted(self, estimate: Estimate, pieces: list[tuple[float, Array]]) -> Estimate:
        """Predict an estimate under inputs (n_u,), each with the seconds for which it acts."""
        model, ahead, gathered, impulse = self.model, 0.0, 0.0, np.zeros(self.model.n_u)
        settings, rate = self.prediction, model.linearised.fastest_rate / (
            model.seconds_per_time_unit)
        step = settings.step / rate if rate > 0.0 else math.inf
        if not sum(seconds for seconds, _ in pieces) * rate <= settings.longest:
            raise _NotPredictedError(settings.longest / rate)
        for k, (seconds, u) in enumerate(pieces, 1):
            # the mean of short pieces has the same effect as one after the other
            gathered, impulse = gathered + seconds, impulse + seconds * u
            if gathered < step and k < len(pieces):
                continue
            count = max(1, math.ceil(gathered / (settings.steps * step)))
            v = model.inputs.to_deviation(impulse / gathered)
            for _ in range(count):
                found = self.estimator.advance(estimate, v, gathered / count,
                                               covariance=self.law.reads_covariance)
                ahead += gathered / count
                if found is None or not found.finite:
                    raise _NotPredictedError(ahead)
                estimate = found
            gathered, impulse = 0.0, np.zeros(model.n_u)
        return estimate

    def _checked(self, result: Any, estimate: Estimate, seconds: float) -> LawResult:
        """Return a law's result within the range if its input, or its failure, can be used."""
        for value, kind in ((result, LawResult), (result.info, SolutionInfo),
                            (result.plan, (Plan, NoneType)), (result.failure, (Reason, NoneType))):
            if not isinstance(value, kind):
                raise TypeError(f'it returned {type(value).__name__}, where {kind} is expected')
        if result.failure is not None:
            return replace(result, u=None)
        u = numbers('input of the law', result.u, self.model.inputs.names)
        if not all(map(math.isfinite, u.tolist())):
            return LawResult(None, reason(StatusCode.COMMAND_NOT_FINITE), result.info)
        if self.integrates and self.model.commanded and not self.law.model_free:
            u = self._moved(u, estimate, seconds)
        within = self.limits.within(u)
        clipped = result.clipped or (
            bool((within != u).any()) and differ(within, u, self.model.inputs.scale))
        return LawResult(within, None, result.info, result.memory, result.plan, clipped,
                         result.passing)

    def _moved(self, u: Array, estimate: Estimate, seconds: float) -> Array:
        """Return the commands after so long, of which a law sets the rates (u - command) / lag."""
        u, now = u.copy(), self.model.states.to_physical(estimate.x)
        for j, i in self.model.commanded.items():
            u[j] = now[i] - math.expm1(-seconds / self.model.lag[j]) * (u[j] - now[i])
        return u


def build_levels(model: LiftedModel, outputs: Outputs, tuning: Tuning) -> dict[str, FallbackLevel]:
    """
    Build the levels that a tuning names, best first.

    :raises ValueError: for an unknown law or estimator, or one for which the measured signals do
        not suffice.
    """
    name = tuning.estimator or (
        'extended_kalman_filter' if not outputs.determine(model.lagged.values()) else
        'disturbance_observer' if tuning.observer_bandwidth > 0.0 else 'measured_state')
    levels = {}
    for law_name in tuning.fallback_order:
        law = plug_in(law_name, 'law', LAWS, Law, model, tuning)
        estimator = plug_in(name, 'estimator', ESTIMATORS, Estimator, law.model, outputs, tuning)
        levels[law_name] = FallbackLevel(law_name, law, estimator, tuning.controlled)
    return levels
