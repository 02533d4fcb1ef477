# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The decision on a model, with its figures."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from koopman_ros.core.arrays import Array, short_repr
from koopman_ros.evaluation.closed_loop_test import ClosedLoopTest, LOOPS
from koopman_ros.execution import Backend
from koopman_ros.learning.acceptance.corrections import (
    correction_posterior,
    CorrectionPosterior,
    OwnTerms,
)
from koopman_ros.learning.acceptance.held_out import HeldOut
from koopman_ros.learning.acceptance.held_range import held_shares, HeldShares
from koopman_ros.learning.acceptance.missing_structure import missing_structure
from koopman_ros.learning.acceptance.plant_test import PlantTest
from koopman_ros.learning.acceptance.rate_band import rate_band
from koopman_ros.learning.acceptance.settings import Thresholds
from koopman_ros.learning.acceptance.warnings import record_warnings
from koopman_ros.learning.acceptance.words import statement
from koopman_ros.learning.identification import Drift, DriftModel, Identified, LaggedDrift
from koopman_ros.learning.identification.alternatives import TransformedDrift
from koopman_ros.learning.identification.drift import autocorrelation
from koopman_ros.learning.lift.training import Trained
from koopman_ros.learning.linearisation import (
    operating_points,
    OperatingPoint,
    unfounded_instability,
)
from koopman_ros.learning.model_selection import ClassComparison
from koopman_ros.model import LiftedModel, RateBand
from koopman_ros.model_classes import LINEAR


@dataclass(frozen=True)
class PlantAcceptance:
    """Result of the closed loops on plausible plants, with the reasons of a rejection."""

    test: PlantTest  #: closed loops on plausible plants
    band: RateBand  #: of the drift that they span
    held: HeldShares  #: set-points that the model can hold
    causes: Mapping[str, float]  #: size of the corrections by group, as shares of the motion
    statement: str  #: the result in a sentence
    reasons: tuple[str, ...]  #: why the model is rejected

    __repr__ = short_repr


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
    #: plants that the record cannot distinguish; None of a model that is rejected without them
    plant: PlantAcceptance | None = None
    operating_points: tuple[OperatingPoint, ...] = ()  #: with the eigenvalues of the model

    __repr__ = short_repr

    @property
    def statement(self) -> str:
        """The share of loops that fail on the plant, and the error of its rate; or nothing."""
        return '' if self.plant is None else self.plant.statement

    @property
    def accepted(self) -> bool:
        """Whether the lift may be used."""
        return not self.reasons


def evaluate_model(found: Identified, learned: Trained | ClassComparison,
                   current: LiftedModel | None, thresholds: Thresholds, *, loops: int = LOOPS,
                   watch: Callable[[float], bool] = lambda _: False,
                   backend: Backend | None = None,
                   setpoints: Mapping[str, Sequence[float]] = MappingProxyType({})
                   ) -> AcceptanceResult:
    """
    Compare a new model with the current and a linear one on held-out data, and close its loops.

    :param learned: the trained model, or the comparison by :func:`compare_classes`, of which the
        chosen model is judged, and whose closed loops are not run again.
    :param loops: like `backend` as for :func:`evaluate_closed_loops`; on the estimated drift.
    :param watch: called with the share that is done of the loops on other plants; True ends.
    :param setpoints: lowest and highest set-point that are wanted, of some states by name.
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
    plant = None
    if not reasons:
        try:
            posterior = correction_posterior(drift, _own_terms(drift), found.episodes, thresholds)
        except (ValueError, np.linalg.LinAlgError) as error:
            reasons = (f'the plants that the record allows cannot be found: {error}',)
        else:
            plant = _plant_acceptance(held_out, found, model, posterior, setpoints, watch,
                                      backend)
            reasons = plant.reasons
    points = operating_points(model, law_check.setpoints if plant is None else np.vstack([
        law_check.setpoints, plant.test.setpoints]))
    reasons = (*reasons, *filter(None, [unfounded_instability(
        model, found, points, held_out.better(rmse), held_out.other_class)]))
    warnings = record_warnings(found, model, drift_rmse,
                               autocorrelation(found.drift, held_out.segments), thresholds)
    return AcceptanceResult(reasons, warnings, rmse, drift_rmse, current_rmse,
                            held_out.linear_rmse, found.noise, law_check, plant, points)


def _plant_acceptance(held_out: HeldOut, found: Identified, model: LiftedModel,
                      posterior: CorrectionPosterior, setpoints: Mapping[str, Sequence[float]],
                      watch: Callable[[float], bool], backend: Backend | None) -> PlantAcceptance:
    """Judge a model by the plants that the record cannot distinguish from the estimated one."""
    drift, episodes, settings = found.drift, found.episodes, posterior.settings
    plants = posterior.draw(settings.plants)
    # other drifts of the identification are plausible plants, too
    others = found.alternatives[:settings.alternatives]
    rates = [*(one.rate for one in others), *(one.rate for one in plants)]
    test = held_out.plant_test(model, rates[:settings.plants], watch, backend)
    x = np.concatenate([one.interpolated() for one in episodes])
    u = np.concatenate([one.inputs_at(one.time) for one in episodes])
    band = rate_band(drift, plants, x, u, model.states, settings)
    measured = len(model.states) - found.hidden
    held = held_shares(model, x, test.setpoints, setpoints,
                       ~np.isin(model.inputs.names, found.disturbances), measured, settings)
    missing = missing_structure(posterior)
    names = model.states.names[:measured]
    text = statement(test, (model.states.scale * band.error)[:measured], model.states.only(names),
                     model.time_unit)
    reasons = [] if test.accepted else [
        f'{text}: ' + (missing.text if missing else f'{held_out.other_class}record longer, with '
                       'steps of the inputs in the whole range')]
    if posterior.used < settings.fewest_used:
        reasons.append(f'the estimated drift follows {100.0 * posterior.used:.0f} % of the record '
                       f'in free runs, must be at least {100.0 * settings.fewest_used:.0f} %: '
                       'record an input or a state that is missing')
    reasons += filter(None, [held.reason(settings.least_held)])
    return PlantAcceptance(test, band, held, posterior.shares(), text, tuple(reasons))


def _own_terms(drift: Drift) -> OwnTerms:
    """Return the terms of a drift, whose uncertainty is that of its fit."""
    if isinstance(drift, TransformedDrift):
        return _own_terms(drift.drift)
    if isinstance(drift, LaggedDrift):
        degree, input_degree = _own_terms(drift.drift)
        # applied inputs are states, and their commands have no effect but by these
        return OwnTerms(max(degree, 1 + input_degree),
                        input_degree if np.any(drift.lag == 0.0) else -1)
    return OwnTerms(drift.degree, drift.input_degree) if isinstance(drift, DriftModel) else (
        OwnTerms(1, 0))
