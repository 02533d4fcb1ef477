# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""From an estimate to a law: what each gives, and which one may act."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from koopman_ros.control.estimation import Estimator
from koopman_ros.control.ladder import Need, Rung, Standing
from koopman_ros.control.laws import Feedback, feedback, Weights
from koopman_ros.control.limits import finite
from koopman_ros.control.observer import Estimate
from koopman_ros.control.sensor import Verdict
from koopman_ros.control.state import State
from koopman_ros.control.target import balance, Reference, reference, Target

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Attempt:
    """
    What a law gives, or why it gives nothing.

    :param u: (n_u,) in input units, within the range; None with a problem.
    :param target: where it goes.
    :param found: the Riccati solution, when there is one.
    :param growth: of the error within a sample, see :meth:`Feedback.growth`.
    :param problem: in words; empty when `u` may be used.
    :param clipped: whether the range cut it.
    """

    u: Array | None
    target: Target
    found: Feedback | None = None
    growth: float = np.nan
    problem: str = ''
    clipped: bool = False


@dataclass(frozen=True)
class LawChoice:
    """
    The laws on the ladder.

    :param estimator: with model and settings.
    """

    estimator: Estimator
    _references: dict[bool, Reference] = field(default_factory=dict, init=False, compare=False)

    @cached_property
    def weights(self) -> Weights:
        """The cost in the model's scaled deviations."""
        model, settings = self.estimator.model, self.estimator.settings
        return Weights(np.diag(settings.state_weight * model.states.scale ** 2),
                       np.diag(settings.input_weight * model.inputs.scale ** 2))

    def choose(self, state: State, verdict: Verdict, outside: float, time_ns: int,
               spacing: float) -> tuple[Standing, Attempt | None]:
        """
        Find the rung to stand on, and what its law gives.

        :param state: with the estimate of now.
        :param verdict: on the measurement.
        :param outside: its distance from the training data.
        :param time_ns: now.
        :param spacing: seconds between samples; 0 when they are not known.
        :return: the standing, and the last law that was tried, if any.
        """
        ladder = self.estimator.settings.ladder
        if verdict.fault:
            need = Need(Rung.HOLD, verdict.fault, passing=True)
        else:
            need = state.standing.allowed(ladder, outside, self._where_outside)
        attempt = None
        while True:
            standing = state.standing.at(ladder, need, time_ns)
            if standing.rung not in (Rung.LEARNED, Rung.LINEAR) or state.estimate is None:
                return standing, attempt
            estimate = self.estimator.rebase(
                state.estimate, state.linear, standing.rung is Rung.LINEAR)
            assert estimate is not None
            attempt = self.attempt(state, standing.rung, estimate, spacing)
            if not attempt.problem:
                return standing, attempt
            below = Rung.LINEAR if standing.rung is Rung.LEARNED else Rung.HOLD
            need = Need(below, f'the {standing.rung.value} fails: {attempt.problem}')

    def attempt(self, state: State, rung: Rung, estimate: Estimate, spacing: float = 0.0
                ) -> Attempt:
        """
        Evaluate a law.

        :param state: with the set-point that is tracked.
        :param rung: whose law.
        :param estimate: in terms of that law's model.
        :param spacing: seconds between samples; 0 when they are not known.
        """
        settings, linear = self.estimator.settings, rung is Rung.LINEAR
        model = self.estimator.observer(linear).model
        assert state.setpoint.active is not None
        x_ref = model.states.to_deviation(state.setpoint.active)
        known = self._references.get(linear)
        if known is None or not (known.x == x_ref).all():
            # a memory of the last set-point only; what comes out does not depend on it
            known = self._references[linear] = reference(model, x_ref)
        target = balance(model, known, estimate.w)
        try:
            found = feedback(model, estimate.x, target, self.weights,
                             max_gain=settings.max_gain, max_residual=settings.max_residual)
            growth = found.growth(spacing / model.seconds_per_time_unit) if (
                found.solved) else np.nan
        except np.linalg.LinAlgError as error:
            return Attempt(None, target, problem=f'{error}')
        if not found.solved:
            return Attempt(None, target, found,
                           problem=f'no feedback gain: {found.riccati.status.value}')
        if not growth < 1.0:
            return Attempt(None, target, found, growth, (
                f'the closed loop is predicted unstable at a sample every {spacing:.3g} s: raise '
                'the input weight, or measure more often'))
        u = model.inputs.to_physical(found.u)
        if not finite(u):
            return Attempt(None, target, found, growth, 'its command is not finite')
        within = settings.limits.within(u)
        return Attempt(within, target, found, growth, clipped=bool((within != u).any()))

    @cached_property
    def _where_outside(self) -> str:
        """What lies outside the training box, in words."""
        states, show = self.estimator.model.states, self.estimator.show
        ranges = ', '.join(
            f'{name} {show(lower, unit)} to {show(upper, unit)}'
            for name, unit, lower, upper in zip(states.names, states.units, states.lower,
                                                states.upper, strict=True))
        return f'outside the trained range ({ranges})'
