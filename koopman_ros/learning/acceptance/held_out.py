# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Requirements on a model on the part of the record that it was not learned from."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from koopman_ros.control.usable import unusable
from koopman_ros.core.arrays import Array
from koopman_ros.core.datasets import sample_interval
from koopman_ros.core.units import difference_text, SECONDS_PER_TIME_UNIT
from koopman_ros.evaluation.closed_loop_test import ClosedLoopTest, evaluate_closed_loops, Rate
from koopman_ros.execution import Backend
from koopman_ros.learning.acceptance.plant_test import LoopConditions, PlantTest, run_plants
from koopman_ros.learning.acceptance.settings import Thresholds
from koopman_ros.learning.identification import Identified, longest_step, Segments, Stopped
from koopman_ros.learning.identification.drift import prediction_error
from koopman_ros.learning.lift.metrics import lifted_rate, LiftMetrics
from koopman_ros.model import LiftedModel, PolynomialObservables
from koopman_ros.model_classes import BEST


class HeldOut:
    """
    The held-out part of a record, and the requirements on a model there.

    :param compared: whether all classes of models compete.
    :ivar other_class: advice to compare them; empty if they compete.
    """

    def __init__(self, found: Identified, thresholds: Thresholds, compared: bool) -> None:
        self._found, self._thresholds = found, thresholds
        self.other_class = '' if compared else f'set model_class to {BEST}, or '
        self.segments = Segments.of(found.held_out, longest_step(found.held_out))
        self.scale = found.drift.box.states.scale
        self.count = sum(len(episode) for episode in found.held_out)
        self.linear_rmse = self.rmse(found.linear.rate)
        self._seconds = SECONDS_PER_TIME_UNIT[found.drift.box.time_unit]

    def rmse(self, rate: Rate) -> Array:
        """Return the error (n_x,) of a drift's predictions of the measurements."""
        return prediction_error(rate, self.segments, self.scale)

    def rmse_of(self, model: LiftedModel) -> Array:
        """Return that of a model's drift."""
        return self.rmse(lifted_rate(model, self._seconds))

    def law_check(self, model: LiftedModel, loops: int, watch: Callable[[float], bool],
                  backend: Backend | None = None) -> ClosedLoopTest:
        """Close a model's loop on the estimated drift; Stopped where `watch` ended it."""
        conditions = self._conditions
        found = evaluate_closed_loops(
            self._delayed(model), self._found.drift.rate, loops=loops, watch=watch,
            interval=conditions.interval, noise=conditions.noise, backend=backend,
            disturbances=conditions.disturbances)
        if found is None:
            raise Stopped
        return found

    @property
    def _conditions(self) -> LoopConditions:
        found = self._found
        return LoopConditions(sample_interval(found.held_out) * self._seconds,
                              np.nan_to_num(found.noise), found.disturbances)

    def _delayed(self, model: LiftedModel) -> LiftedModel:
        return replace(model, dead_time=self._seconds * self._found.dead_time)

    def plant_test(self, model: LiftedModel, rates: Sequence[Rate], watch: Callable[[float], bool],
                   backend: Backend | None) -> PlantTest:
        """
        Close the loop on plants that the record cannot distinguish; see :func:`run_plants`.

        Every second one has constant disturbances: the offsets of an episode and of the one most
        unlike it, measured disturbances at their lower and upper ends.
        """
        ends = self._displacements(model)
        return run_plants(
            self._delayed(model), [
                partial(_displaced, rate, *ends[k // 2 % 2]) if ends and k % 2 else rate
                for k, rate in enumerate(rates)],
            self._conditions, self._thresholds, watch=watch, backend=backend)

    def _displacements(self, model: LiftedModel) -> list[tuple[Array, Array]]:
        """Return changes of the inputs (n_u,) and of the rates (n_x,) at two ends; or none."""
        inputs, offsets = self._found.drift.box.inputs, self._found.offsets
        measured = np.isin(inputs.names, self._found.disturbances)
        if not (measured.any() or len(offsets)):
            return []
        rates = np.zeros((2, len(self.scale)))
        if len(offsets):
            scaled = offsets / self.scale
            first = int(np.argmax(np.sum(scaled ** 2, axis=1)))
            rates = offsets[[first, int(np.argmin(scaled @ scaled[first]))]]
        return [(np.where(measured, end - model.inputs.center, 0.0), rate)
                for end, rate in zip((inputs.lower, inputs.upper), rates, strict=True)]

    def better(self, rmse: Array) -> dict[str, Rate]:
        """Return the drifts by form that do not err more than a model that errs so (n_x,)."""
        drifts = [self._found.drift, self._found.linear, *self._found.alternatives]
        return {drift.form: drift.rate for drift in drifts
                if _size(self.rmse(drift.rate), self.scale) <= _size(rmse, self.scale)}

    def without_effect(self, model: LiftedModel) -> str:
        """
        Say that inputs do not explain the record by the Bayesian criterion, or nothing.

        A model of noise errs a little less on its own data than under constant inputs.
        """
        episodes = self._found.episodes
        segments = Segments.of(episodes, longest_step(episodes))
        rate, mean = lifted_rate(model, self._seconds), np.mean(segments.u, axis=(0, 1))
        own, constant = (prediction_error(one, segments, self.scale) for one in (
            rate, lambda x, u: rate(x, np.broadcast_to(mean, np.shape(u)))))
        samples = np.sum(segments.measured, axis=(0, 1))
        parameters = model.n_x * (model.n_x + len(mean))
        # a model that diverges has a reason of its own
        if not np.all(np.isfinite(own)) or not (
                samples @ np.log((constant / own) ** 2) <= parameters * np.log(samples.sum())):
            return ''
        return (f'the inputs explain nothing of the record: its error, {_text(own, model)}, is '
                f'{_text(constant, model)} under constant inputs: record larger steps of the '
                'inputs, held longer, or the inputs that act')

    def exceeded(self, model: LiftedModel, name: str, rmse: Array, other: Array, remedy: str
                 ) -> str:
        """Say that an error is not clearly below another one, or nothing."""
        own, margin = _size(rmse, self.scale), self._thresholds.margin
        if np.isfinite(own) and own <= (1.0 - margin) * _size(other, self.scale):
            return ''
        return (f'its error on held-out data, {_text(rmse, model)}, is not {100.0 * margin:.0f} % '
                f'below that of {name}, {_text(other, model)}: {remedy}')

    def reasons(self, model: LiftedModel, rmse: Array, figures: LiftMetrics,
                law_check: ClosedLoopTest, linear: bool) -> tuple[str, ...]:
        """
        Say why a model must not be used, even without a current one.

        :param rmse: (n_x,) error of its predictions, in state units.
        :param linear: whether it is a linear one itself, which need not be better than that.
        """
        reasons = [unusable(model)]
        if not linear:
            reasons.append(self.exceeded(model, 'the best linear model', rmse, self.linear_rmse,
                                         'set model_class to linear'))
        elif not np.all(np.isfinite(rmse)):
            reasons.append('its predictions of held-out data diverge: record steps of the inputs '
                           'that do not depend on the states')
        reasons.append(self.without_effect(model))
        cond, most = figures.fit.cond, self._thresholds.condition * figures.fit.cond_of_states
        # monomials depend on each other on most data, and only learned coordinates collapse
        if not (cond <= most or isinstance(model.observables, PolynomialObservables)):
            reasons.append(f'the condition number of its coordinates, {cond:.3g}, is above '
                           f'{most:.3g}: {self.other_class}reduce lifted_dimension')
        if not law_check.accepted:
            reasons.append(f'its law does not control the estimated drift: {law_check}; '
                           f'{self.other_class}record more in that range')
        return tuple(filter(None, reasons))


def _displaced(rate: Rate, inputs: Array, offset: Array, x: Array, u: Array) -> Array:
    """Evaluate a rate (M, n_x) with constant additions to its inputs and to itself."""
    return rate(x, u + inputs) + offset


def _size(rmse: Array, scale: Array) -> float:
    return float(np.sqrt(np.mean((rmse / scale) ** 2)))


def _text(rmse: Array, model: LiftedModel) -> str:
    names, units = model.states.names, model.states.units
    return ', '.join(difference_text(value, unit) + (f' in {name}' if len(names) > 1 else '')
                     for value, unit, name in zip(rmse, units, names, strict=True))
