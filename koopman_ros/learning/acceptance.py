# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The acceptance test of a model, on the part of the record that it was not learned from."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from koopman_ros.control.usable import unusable
from koopman_ros.core.arrays import Array, short_repr
from koopman_ros.core.datasets import sample_interval
from koopman_ros.core.units import (
    Display,
    display_unit,
    SECONDS_PER_TIME_UNIT,
)
from koopman_ros.evaluation.closed_loop_test import (
    ClosedLoopTest,
    evaluate_closed_loops,
    LOOPS,
    Rate,
    statement,
)
from koopman_ros.execution import Backend
from koopman_ros.learning.causes import likely_causes
from koopman_ros.learning.ensemble import disagreement, inconsistency
from koopman_ros.learning.identification import (
    Drift,
    DriftModel,
    Identified,
    longest_step,
    Stopped,
)
from koopman_ros.learning.identification.drift import (
    autocorrelation,
    prediction_error,
    Segments,
)
from koopman_ros.learning.identification.input_functions import NonAffineDrift
from koopman_ros.learning.lift.metrics import lifted_rate, LiftMetrics
from koopman_ros.learning.lift.training import Trained
from koopman_ros.learning.linearisation import (
    operating_points,
    OperatingPoint,
    unfounded_instability,
)
from koopman_ros.learning.model_selection import ClassComparison
from koopman_ros.model import Coordinates, LiftedModel, PolynomialObservables
from koopman_ros.model_classes import BEST, LINEAR

# An error is more than noise if it is this unlikely, and this large relative to the range.
_SIGMAS = 5.0
_NOTICEABLE = 1e-3
# White errors have none; those of a fitted start stay far below.
_LEAST_AUTOCORRELATION = 0.3
# Of the drifts that explain a record as well as the chosen one.
_MOST_ALTERNATIVES = 5
# Rounds of closed loops, at least, from which the share of failures is stated.
_ROUNDS = 4
# A share of the set-points' range that may be missing: noise moves the ends of a record.
_MISSING = 0.05


@dataclass(frozen=True)
class Thresholds:
    """Thresholds that a lift has to reach."""

    #: by this share its held-out error must be smaller than those of the current model, where
    #: there is one, and of the best linear model
    margin: float = 0.1
    #: largest condition number of E[z z'], over that of the states among the coordinates
    condition: float = 1e4

    def __post_init__(self) -> None:
        if not 0.0 <= self.margin < 1.0:
            raise ValueError(f'margin = {self.margin} must be in [0, 1)')
        if not self.condition > 1.0:
            raise ValueError(f'condition = {self.condition} must be above 1')


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
                  backend: Backend | None = None, *, rate: Rate | None = None, seed: int = 0
                  ) -> ClosedLoopTest:
        """
        Close a model's loop on the estimated drift; Stopped where `watch` ended it.

        :param rate: that to take instead.
        """
        # as it was measured, as far as that matters
        period = sample_interval(self._found.held_out)
        model = replace(model, dead_time=self._seconds * self._found.dead_time)
        found = evaluate_closed_loops(
            model, rate or self._found.drift.rate, loops=loops, seed=seed, watch=watch,
            interval=period * self._seconds, noise=np.nan_to_num(self._found.noise),
            backend=backend, disturbances=self._found.disturbances)
        if found is None:
            raise Stopped
        return found

    def further_checks(self, model: LiftedModel, loops: int, watch: Callable[[float], bool],
                       backend: Backend | None
                       ) -> tuple[tuple[Drift, ClosedLoopTest, str], ...]:
        """
        Close the loop from other starts, on this drift and on each alternative.

        Every second round has constant disturbances: the offsets of an episode and of the one
        most unlike it, measured disturbances at their lower and upper ends.

        :return: the drifts, the loops, and the disturbances in words.
        """
        drifts = [self._found.drift, *self._found.alternatives[:_MOST_ALTERNATIVES]]
        drifts += [self._found.drift] * (_ROUNDS - len(drifts))
        displaced = self._displacements(model)

        def checked(k: int) -> tuple[Drift, ClosedLoopTest, str]:
            drift, rate, words = drifts[k], drifts[k].rate, ''
            if displaced and k % 2:
                rate = partial(_displaced, drift, *displaced[k // 2 % 2])
                words = ' with its disturbances at the ends of their ranges'
            return drift, self.law_check(model, loops, lambda share: watch(
                (k + share) / len(drifts)), backend, rate=rate, seed=1 + k), words

        return tuple(checked(k) for k in range(len(drifts)))

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
            reasons.append(self.uncontrolled('the estimated drift', law_check))
        return tuple(filter(None, reasons))

    def uncontrolled(self, drift: str, check: ClosedLoopTest, remedy: str = '') -> str:
        """Say that a law does not control a drift, and what to try."""
        return (f'its law does not control {drift}: {check}; '
                + (remedy or f'{self.other_class}record more in that range'))


def _displaced(drift: Drift, inputs: Array, offset: Array, x: Array, u: Array) -> Array:
    """Evaluate the rate (M, n_x) of a drift with constant additions to its inputs and rates."""
    return drift.rate(x, u + inputs) + offset


@dataclass(frozen=True)
class AcceptanceResult:
    """Acceptance or rejection of a lift, with its figures on held-out segments."""

    reasons: tuple[str, ...]  #: why it is rejected; empty when it is accepted
    warnings: tuple[str, ...]  #: for the user, in either case
    rmse: Array  #: (n_x,) error of its predictions of the measurements, in state units
    drift_rmse: Array  #: (n_x,) the same of the drift that it was learned from
    current_rmse: Array | None  #: (n_x,) the same of the current model, None without one
    linear_rmse: Array  #: (n_x,) the same of the best linear model
    noise: Array  #: (n_x,) standard deviation of the measurements from sample to sample
    law_check: ClosedLoopTest  #: closed loops on the estimated drift
    #: more of them, of which none took part in a choice, on this and alternative drifts, with the
    #: disturbances in words; none of a model that is rejected without them
    further_checks: tuple[tuple[Drift, ClosedLoopTest, str], ...] = ()
    operating_points: tuple[OperatingPoint, ...] = ()  #: with the eigenvalues of the model

    __repr__ = short_repr

    @property
    def statement(self) -> str:
        """The share of failed loops on all drifts, with its confidence."""
        checks = [check for _, check, _ in self.further_checks] or [self.law_check]
        return statement(checks, len({id(drift) for drift, *_ in self.further_checks}))

    @property
    def accepted(self) -> bool:
        """Whether the lift may be used."""
        return not self.reasons


def evaluate_model(found: Identified, learned: Trained | ClassComparison,
                   current: LiftedModel | None, thresholds: Thresholds, *, loops: int = LOOPS,
                   watch: Callable[[float], bool] = lambda _: False,
                   backend: Backend | None = None) -> AcceptanceResult:
    """
    Compare a new model with the current and a linear one on held-out data, and close its loop.

    :param learned: the trained model, or the comparison by :func:`compare_classes`, of which the
        chosen model is judged, and whose closed loops are not run again.
    :param loops: like `backend` as for :func:`evaluate_closed_loops`; on each drift.
    :param watch: called with the share that is done of further loops; True ends.
    :raises Stopped: when `watch` requested it.
    """
    model, drift = learned.model, found.drift
    held_out = HeldOut(found, thresholds, isinstance(learned, ClassComparison) and (
        len(learned.contenders) > 1 or (isinstance(drift, DriftModel) and drift.linear)))
    rmse, drift_rmse = held_out.rmse_of(model), held_out.rmse(found.drift.rate)
    current_rmse = None if current is None else held_out.rmse_of(current)
    chosen = learned.chosen if isinstance(learned, ClassComparison) else None
    law_check = chosen.law_check if chosen and chosen.excess is not None else None
    if law_check is None:
        law_check = held_out.law_check(model, loops, lambda _: False, backend)
    reasons = held_out.reasons(model, rmse, learned.figures, law_check,
                               chosen is not None and chosen.name == LINEAR)
    if current_rmse is not None:
        worse = held_out.exceeded(model, 'the current model', rmse, current_rmse,
                                   'keep that one, or reduce acceptance_margin')
        reasons = (*filter(None, [worse]), *reasons)
    further = () if reasons else held_out.further_checks(model, loops, watch, backend)
    reasons = (*reasons, *dict.fromkeys(
        held_out.uncontrolled(f'a {drift.form} that explains the record better{words}', check,
                              drift.remedy) if isinstance(drift, NonAffineDrift) else
        held_out.uncontrolled(f'a {drift.form} that explains the record equally well{words}',
                              check)
        for drift, check, words in further if check.loops and not check.accepted))
    points = operating_points(model, np.vstack([
        law_check.setpoints, *(check.setpoints for _, check, _ in further)]))
    reasons = (*reasons, *filter(None, [unfounded_instability(
        model, found, points, held_out.better(rmse), held_out.other_class)]))
    warnings = _warnings(found, model, drift_rmse,
                         autocorrelation(found.drift, held_out.segments))
    return AcceptanceResult(reasons, warnings, rmse, drift_rmse, current_rmse,
                            held_out.linear_rmse, found.noise, law_check, further, points)


def _warnings(found: Identified, model: LiftedModel, error: Array, autocorrelation: Array
              ) -> tuple[str, ...]:
    """Say where the best drift errs by more than white noise explains."""
    warnings = [*found.warnings, *filter(None, [disagreement(found), inconsistency(found)])]
    count = sum(len(episode) for episode in found.held_out)
    measured = len(model.states) - found.hidden
    for i, (name, unit) in enumerate(zip(model.states.names[:measured], model.states.units,
                                         strict=False)):
        noticeable, r = _NOTICEABLE * found.drift.box.states.scale[i], autocorrelation[i]
        if error[i] > noticeable and r > max(_LEAST_AUTOCORRELATION, _SIGMAS / np.sqrt(count)):
            warnings.append(
                f'the noise of {name} is coloured (autocorrelation {r:.2f} from sample to sample '
                'in the residuals of the best drift), because of a filter before the recording or '
                'an unmeasured quantity. The record is equivalent to '
                f'{100.0 * (1.0 - r) / (1.0 + r):.0f} % of its samples with white noise: record '
                'longer, or without the filter')
        noise = np.fmin(found.noise[i], error[i])
        excess = float(np.sqrt(max(0.0, error[i] ** 2 - noise ** 2)))
        # the mean square of `count` white errors strays by this share
        chance = noise * (_SIGMAS * np.sqrt(2.0 / count)) ** 0.5
        if excess > max(chance, noticeable):
            warnings.append(
                f'the best drift predicts {name} with an error of {error[i]:.3g} {unit}, of which '
                f'{excess:.3g} {unit} is not noise ({noise:.3g} {unit} from sample to sample): '
                + _remedy(found, i))
    return tuple(warnings)


def _remedy(found: Identified, i: int) -> str:
    """Name the parameters to try for a measured state, likeliest first."""
    causes = likely_causes(found, i)
    if not causes:
        states = 'set unmeasured_states, or ' * ('unmeasured_states' not in found.searched)
        return f'the inputs do not explain it: {states}record a disturbance as another input'
    return 'change ' + ', or '.join(
        f'{name} (explains {100.0 * share:.0f} % of its square)' for share, name in causes)


def uncovered_setpoints(states: Coordinates, targets: Mapping[str, Sequence[float]]
                        ) -> tuple[str, ...]:
    """
    Say which set-points that are wanted a trained range leaves out.

    :param wanted: lowest and highest set-point of some of the states by name, in their units.
    """
    found = []
    for name, (low, high) in targets.items():
        i = states.names.index(name)
        lower, upper = states.lower[i], states.upper[i]
        if max(lower - low, high - upper) > _MISSING * (high - low):
            unit = Display(states.units[i], display_unit(states.units[i]), '.4g')
            found.append(
                f'{name} was trained from {unit.text(lower)} to {unit.text(upper)}, set-points '
                f'range from {unit.text(low)} to {unit.text(high)}: those outside will be '
                'rejected; record the missing range, or narrow setpoint_min and setpoint_max')
    return tuple(found)


def _size(rmse: Array, scale: Array) -> float:
    return float(np.sqrt(np.mean((rmse / scale) ** 2)))


def _text(rmse: Array, model: LiftedModel) -> str:
    names, units = model.states.names, model.states.units
    return ', '.join(f'{value:.4g} {unit}' + (f' in {name}' if len(names) > 1 else '')
                     for value, unit, name in zip(rmse, units, names, strict=True))
