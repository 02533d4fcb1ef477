# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Acceptance of a new lift, on data held out of its estimation and training."""

from dataclasses import dataclass
import itertools

import numpy as np

from koopman_ros.arrays import Array
from koopman_ros.control import run_closed_loop, Weights
from koopman_ros.identification import DriftModel, Identified
from koopman_ros.identification.drift import longest_step, prediction_error, Rate, Segments
from koopman_ros.learning import Trained
from koopman_ros.learning.validation import settling_time
from koopman_ros.lifting import LiftedModel, linearised_model, Provenance

# A closed loop has arrived when it ends this close to the set-point, in units of the scale.
_ARRIVED = 0.05
# Set-points at these places between the corners of the box.
_PLACES = (0.1, 0.5, 0.9)
_MAX_EVALUATIONS = 5000
# A prediction this far from the nominal point, in units of the scale, has diverged.
_DIVERGED = 1e6
# An error is more than noise when it is this unlikely, and this large beside the range.
_SIGMAS = 5.0
_NOTICEABLE = 1e-3


@dataclass(frozen=True)
class Thresholds:
    """Thresholds that a lift has to reach."""

    #: by this share its held-out error must be smaller than those of the present lift and of the
    #: best linear model
    margin: float = 0.1
    condition: float = 1e4  #: largest condition number of E[z z']

    def __post_init__(self) -> None:
        if not 0.0 <= self.margin < 1.0:
            raise ValueError(f'margin = {self.margin} must be in [0, 1)')
        if not self.condition > 1.0:
            raise ValueError(f'condition = {self.condition} must be above 1')


@dataclass(frozen=True)
class Decision:
    """Acceptance or refusal of a lift, with its figures on held-out segments."""

    reasons: tuple[str, ...]  #: why it is refused; empty when it is accepted
    warnings: tuple[str, ...]  #: for the user, in either case
    rmse: Array  #: (n_x,) error of its predictions of the measurements, in state units
    drift_rmse: Array  #: (n_x,) the same of the drift that it was learned from
    current_rmse: Array  #: (n_x,) the same of the present lift
    linear_rmse: Array  #: (n_x,) the same of the best linear model
    noise: Array  #: (n_x,) standard deviation of the measurements from sample to sample
    loops: int  #: number of closed loops on the estimated drift that were tried
    arrived: int  #: number of those that reached their set-point

    @property
    def accepted(self) -> bool:
        """Whether the lift may be used."""
        return not self.reasons


def lifted_rate(model: LiftedModel, time_unit_seconds: float) -> Rate:
    """
    Return dx/dt of a lift's projected drift, in units and per a time unit of so many seconds.

    It is NaN for states that have diverged: their pseudo-inverse does not exist.
    """
    factor = time_unit_seconds / model.seconds_per_time_unit

    def rate(x: Array, u: Array) -> Array:
        xi = model.states.to_deviation(x)
        followed = np.all(np.abs(xi) < _DIVERGED, axis=-1, keepdims=True)
        drift = np.where(followed, model.drift(np.where(followed, xi, 0.0)), np.nan)
        forcing = model.inputs.to_deviation(u) @ model.B.T
        scaled: Array = factor * model.states.scale * (drift + forcing)
        return scaled

    return rate


def decide(found: Identified, trained: Trained, current: LiftedModel, thresholds: Thresholds
          ) -> Decision:
    """Compare a new lift with the present and a linear one, held out, and close its loop."""
    model, scale = trained.model, found.drift.box.states.scale
    unit = model.seconds_per_time_unit
    held_out = Segments.of(found.held_out, longest_step(found.held_out))
    rmse, drift_rmse, current_rmse, linear_rmse = (
        prediction_error(rate, held_out, scale)
        for rate in (lifted_rate(model, unit), found.drift.rate, lifted_rate(current, unit),
                     found.linear.rate))
    reasons = []
    own = _size(rmse, scale)
    for name, other in (('the present lift', current_rmse),
                        ('the best linear model', linear_rmse)):
        if not np.isfinite(own) or own > (1.0 - thresholds.margin) * _size(other, scale):
            reasons.append(
                f'its error on held-out records, {_text(rmse, model)}, is not '
                f'{100.0 * thresholds.margin:.0f} % below that of {name}, {_text(other, model)}')
    cond = trained.figures.fit.cond
    if not cond <= thresholds.condition:
        reasons.append(f'the condition number of its coordinates, {cond:.3g}, is above '
                       f'{thresholds.condition:.3g}: use fewer coordinates')
    loops, arrived = _closed_loops(model, found.drift)
    if arrived < loops:
        reasons.append(f'its controller brings the estimated drift to the set-point in {arrived} '
                       f'of {loops} closed loops over its box')
    return Decision(tuple(reasons), _warnings(found, model, drift_rmse), rmse, drift_rmse,
                   current_rmse, linear_rmse, found.noise, loops, arrived)


def _warnings(found: Identified, model: LiftedModel, error: Array) -> tuple[str, ...]:
    """Say where the best drift errs by more than the noise explains."""
    warnings = []
    count = sum(len(episode) for episode in found.held_out)
    for i, (name, unit) in enumerate(zip(model.states.names, model.states.units, strict=True)):
        noise = found.noise[i]
        excess = float(np.sqrt(max(0.0, error[i] ** 2 - noise ** 2)))
        # the mean square of `count` white errors strays by this share
        chance = noise * (_SIGMAS * np.sqrt(2.0 / count)) ** 0.5
        if excess > max(chance, _NOTICEABLE * found.drift.box.states.scale[i]):
            warnings.append(
                f'the best drift errs by {error[i]:.3g} {unit} in {name}, of which {excess:.3g} '
                f'{unit} is not noise ({noise:.3g} {unit} from sample to sample): something that '
                'is not measured acts too, such as another state or a disturbance, and no lift '
                'of what is measured can know it')
    return tuple(warnings)


def _closed_loops(model: LiftedModel, drift: DriftModel) -> tuple[int, int]:
    """Control the estimated drift from the corners and the middle of the box to set-points."""
    lower, upper = model.states.lower, model.states.upper
    corners = [np.where(bits, upper, lower)
               for bits in itertools.product((False, True), repeat=model.n_x)]
    starts = [*corners, 0.5 * (lower + upper)]
    weights = Weights(np.eye(model.n_x), np.eye(model.n_u))
    loops = arrived = 0
    for place in _PLACES:
        x_ref = lower + place * (upper - lower)
        duration = settling_time(
            linearised_model(drift.slope(x_ref), drift.input_matrix, model.states, model.inputs,
                             model.time_unit, Provenance(model.provenance.plant)), weights)
        for x0 in starts:
            loops += 1
            # a loop that runs away ends as a failure, whatever overflows meanwhile
            with np.errstate(all='ignore'):
                run = run_closed_loop(model, drift.rate, x0, x_ref, weights, duration, samples=2,
                                      rtol=1e-6, max_evaluations=_MAX_EVALUATIONS)
            miss = np.abs(run.states[-1] - x_ref) / model.states.scale
            arrived += int(not run.failure and bool(np.all(miss < _ARRIVED)))
    return loops, arrived


def _size(rmse: Array, scale: Array) -> float:
    return float(np.sqrt(np.mean((rmse / scale) ** 2)))


def _text(rmse: Array, model: LiftedModel) -> str:
    return ', '.join(f'{value:.4g} {unit}'
                     for value, unit in zip(rmse, model.states.units, strict=True))
