# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Training of a lift on an estimated drift, and its acceptance on data held out of both."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from koopman_ros.arrays import Array, brief
from koopman_ros.control.law_check import check_law, LawCheck, LOOPS
from koopman_ros.identification import DriftModel, fitted_starts, Identified, longest_step, Stopped
from koopman_ros.identification.drift import prediction_error, Segments
from koopman_ros.learning import Growth, train, Trained
from koopman_ros.learning.training import Watch
from koopman_ros.learning.validation import lifted_rate
from koopman_ros.lifting import Coordinates, LiftedModel
from koopman_ros.plant_data import Episode, Plant, Samples
from koopman_ros.units import Display, display_unit

# More samples of a smooth drift tell nothing new.
_MAX_SAMPLES = 2000
# Cells a state by which samples are spread over the range; fewer where there were too many.
_CELLS = 20
# Parts among which the samples are dealt out.
_SHARES = 10
# The range is that of noisy measurements.
_SLIGHTLY_OUTSIDE = 1.1
# A search that is so far outside does not come back.
_LOST = 1e3
# An error is more than noise when it is this unlikely, and this large beside the range.
_SIGMAS = 5.0
_NOTICEABLE = 1e-3
# White errors have none; those of a fitted start stay far below.
_LEAST_AUTOCORRELATION = 0.3
# A share of the set-points' range that may be missing: noise moves the ends of a record.
_MISSING = 0.05


def drift_samples(drift: DriftModel, episodes: tuple[Episode, ...]) -> Samples:
    """
    Sample a drift along the paths that it predicts for some episodes, free of their noise.

    They are values of one smooth function, free of noise, so that training, choice and figures
    may share the range among them; the plant's own held-out segments judge the lift. Episodes
    that the drift does not follow are left out; ValueError when it follows none.
    """
    segments = Segments.of(episodes, longest_step(episodes))
    x0, squares = fitted_starts(drift.rate, segments, drift.box.states.scale)
    followed = np.all(squares < drift.box.states.scale ** 2, axis=1)
    if not np.any(followed):
        raise ValueError('the estimated drift follows none of the episodes: record longer, with '
                         'steps of the input')
    path = segments.path(drift.rate, x0)[:-1]
    inside = (segments.steps > 0.0) & followed
    # segment by segment, each in the order of its times
    x, u = (np.swapaxes(a, 0, 1)[inside.T] for a in (path, segments.u))
    kept = _spread(drift.box.states.to_deviation(x))
    x, u = x[kept], u[kept]
    return Samples(x, drift.rate(x, u), u, np.arange(len(x)) % _SHARES)


def _spread(xi: Array) -> NDArray[np.int64]:
    """
    Choose samples (N, n_x) that fill the range as evenly as they can; return rising numbers.

    A plant dwells around some states; a lift learned from all samples would know those best and
    tell its coordinates apart by the few others.
    """
    low, high = xi.min(axis=0), xi.max(axis=0)
    share = (xi - low) / (high - low)
    for count in range(_CELLS, 0, -1):
        cells = np.minimum((count * share).astype(int), count - 1)
        visited, cell = np.unique(cells, axis=0, return_inverse=True)
        if len(visited) <= _MAX_SAMPLES:
            break
    cell = cell.ravel()
    # the rank of each sample within its cell, taken evenly along the episode
    order = np.argsort(cell, kind='stable')
    sizes = np.bincount(cell)
    quota = _quota(sizes, _MAX_SAMPLES)
    chosen = []
    for rows in np.split(order, np.cumsum(sizes)[:-1]):
        take = min(len(rows), quota)
        chosen.append(rows[np.linspace(0, len(rows) - 1, take).round().astype(int)])
    return np.sort(np.concatenate(chosen))


def _quota(sizes: NDArray[np.int64], total: int) -> int:
    """Return the largest number a cell may give so that all together give at most `total`."""
    low, high = 1, int(np.max(sizes))
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if np.sum(np.minimum(sizes, middle)) <= total else (
            low, middle - 1)
    return low


def steady_point(drift: DriftModel, x: Array, u: Array) -> tuple[Array, Array]:
    """
    Find a state and an input near given ones under which the drift stands still.

    With as many inputs as states the state stays what it is; otherwise both move as little as
    they can, in units of their range. ValueError when there is none nearby.

    :param x: (n_x,) in state units.
    :param u: (n_u,) in input units.
    """
    box = drift.box
    xi, v = box.states.to_deviation(x), box.inputs.to_deviation(u)
    n_x = len(xi)
    held = np.linalg.matrix_rank(drift.scaled_input_matrix(xi)) == n_x
    for _ in range(50):
        rate = drift.scaled_rate(xi, v)
        slope, B = drift.scaled_slope(xi, v), drift.scaled_input_matrix(xi)
        change = -np.linalg.pinv(np.hstack([0.0 * slope if held else slope, B])) @ rate
        xi, v = xi + change[:n_x], v + change[n_x:]
        # far outside, the polynomial means nothing and overflows at last
        if np.max(np.abs(change)) < 1e-13 or np.max(np.abs(xi)) > _LOST:
            break
    near = np.all(np.abs(xi) <= _SLIGHTLY_OUTSIDE)
    if not (near and np.all(np.abs(drift.scaled_rate(xi, v)) < 1e-9)):
        raise ValueError('no steady state was found within the range of the episodes: record '
                         'around a state that the plant can hold')
    return box.states.to_physical(xi), box.inputs.to_physical(v)


def learn_lift(found: Identified, plant: Plant, n_z: int, *, seed: int, starts: int,
               watch: Watch | None = None) -> Trained:
    """
    Learn a lift of an estimated drift; the arguments are those of :func:`learning.train`.

    :param plant: names, units and the nominal point. Where it is not known, or the episodes do not
        surround it, a steady state in the middle of their range is taken.
    :raises NoUsefulLift: when no lift is better than a linear model.
    :raises ValueError: when the episodes hold no steady state.
    """
    samples = drift_samples(found.drift, found.fitted)
    lower, upper = samples.x.min(axis=0), samples.x.max(axis=0)
    within = (plant.nominal_state > lower) & (plant.nominal_state < upper)
    x, u = steady_point(found.drift,
                        np.where(within, plant.nominal_state, 0.5 * (lower + upper)),
                        np.where(np.isfinite(plant.nominal_input), plant.nominal_input,
                                 found.drift.box.inputs.center))
    drift = found.drift
    known = replace(plant, nominal_state=x, nominal_input=u, input_matrix_degree=0,
                    B=drift.input_matrix_at if drift.input_degree else drift.input_matrix)
    return train(known, samples, Growth(n_z), seed=seed, starts=starts, watch=watch,
                 loops=0)


@dataclass(frozen=True)
class Thresholds:
    """Thresholds that a lift has to reach."""

    #: by this share its held-out error must be smaller than those of the present lift, where
    #: there is one, and of the best linear model
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
    current_rmse: Array | None  #: (n_x,) the same of the present lift, None without one
    linear_rmse: Array  #: (n_x,) the same of the best linear model
    noise: Array  #: (n_x,) standard deviation of the measurements from sample to sample
    law_check: LawCheck  #: closed loops on the estimated drift

    __repr__ = brief

    @property
    def accepted(self) -> bool:
        """Whether the lift may be used."""
        return not self.reasons


def decide(found: Identified, trained: Trained, current: LiftedModel | None,
           thresholds: Thresholds, *, loops: int = LOOPS,
           watch: Callable[[float], bool] = lambda _: False) -> Decision:
    """
    Compare a new lift with the present and a linear one, held out, and close its loop.

    :param loops: see :func:`~koopman_ros.control.law_check.check_law`, as for `watch`.
    :raises Stopped: when `watch` ended it.
    """
    model, scale = trained.model, found.drift.box.states.scale
    unit = model.seconds_per_time_unit
    held_out = Segments.of(found.held_out, longest_step(found.held_out))
    rmse, drift_rmse, linear_rmse = (
        prediction_error(rate, held_out, scale)
        for rate in (lifted_rate(model, unit), found.drift.rate, found.linear.rate))
    current_rmse = None if current is None else prediction_error(
        lifted_rate(current, unit), held_out, scale)
    reasons = []
    own = _size(rmse, scale)
    for name, other in (('the present lift', current_rmse),
                        ('the best linear model', linear_rmse)):
        if other is None:
            continue
        if not np.isfinite(own) or own > (1.0 - thresholds.margin) * _size(other, scale):
            reasons.append(
                f'its error on held-out records, {_text(rmse, model)}, is not '
                f'{100.0 * thresholds.margin:.0f} % below that of {name}, {_text(other, model)}')
    cond = trained.figures.fit.cond
    if not cond <= thresholds.condition:
        reasons.append(f'the condition number of its coordinates, {cond:.3g}, is above '
                       f'{thresholds.condition:.3g}: use fewer coordinates')
    # as it was measured, as far as that matters
    period = float(np.median(np.concatenate([np.diff(part.time) for part in found.held_out])))
    law_check = check_law(model, found.drift.rate, interval=period * unit, loops=loops,
                          watch=watch)
    if law_check is None:
        raise Stopped
    if not law_check.accepted:
        reasons.append(f'it is no controller of the estimated drift: {law_check}')
    warnings = _warnings(found, model, drift_rmse, _autocorrelation(found.drift, held_out))
    return Decision(tuple(reasons), warnings, rmse, drift_rmse, current_rmse, linear_rmse,
                    found.noise, law_check)


def _autocorrelation(drift: DriftModel, segments: Segments) -> Array:
    """Return the autocorrelation (n_x,) of a drift's errors from one measurement to the next."""
    starts = fitted_starts(drift.rate, segments, drift.box.states.scale)[0]
    errors = segments.errors(drift.rate, starts)
    products, squares = np.zeros((2, errors.shape[2]))
    for j in range(errors.shape[1]):
        own = errors[segments.measured[:, j], j]
        products += np.sum(own[1:] * own[:-1], axis=0)
        squares += 0.5 * np.sum(own[1:] ** 2 + own[:-1] ** 2, axis=0)
    return products / np.where(squares > 0.0, squares, 1.0)


def _warnings(found: Identified, model: LiftedModel, error: Array, autocorrelation: Array
              ) -> tuple[str, ...]:
    """Say where the best drift errs by more than white noise explains."""
    warnings = []
    count = sum(len(episode) for episode in found.held_out)
    for i, (name, unit) in enumerate(zip(model.states.names, model.states.units, strict=True)):
        noticeable, r = _NOTICEABLE * found.drift.box.states.scale[i], autocorrelation[i]
        if error[i] > noticeable and r > max(_LEAST_AUTOCORRELATION, _SIGMAS / np.sqrt(count)):
            warnings.append(
                f'the noise of {name} is coloured (autocorrelation {r:.2f} from sample to sample '
                'of what the best drift leaves): a filter before the record does that, or what '
                f'is not measured; it tells as much as {100.0 * (1.0 - r) / (1.0 + r):.0f} % of '
                'the samples would with white noise, so record longer, or without the filter')
        noise = found.noise[i]
        excess = float(np.sqrt(max(0.0, error[i] ** 2 - noise ** 2)))
        # the mean square of `count` white errors strays by this share
        chance = noise * (_SIGMAS * np.sqrt(2.0 / count)) ** 0.5
        if excess > max(chance, noticeable):
            warnings.append(
                f'the best drift errs by {error[i]:.3g} {unit} in {name}, of which {excess:.3g} '
                f'{unit} is not noise ({noise:.3g} {unit} from sample to sample): something that '
                'is not measured acts too, such as another state or a disturbance, and no lift '
                'of what is measured can know it')
    return tuple(warnings)


def shortfalls(states: Coordinates, wanted: Mapping[str, Sequence[float]]) -> tuple[str, ...]:
    """
    Say which set-points that are wanted a trained range leaves out.

    :param wanted: lowest and highest set-point of some of the states by name, in their units.
    """
    found = []
    for name, (low, high) in wanted.items():
        i = states.names.index(name)
        lower, upper = states.lower[i], states.upper[i]
        if max(lower - low, high - upper) > _MISSING * (high - low):
            unit = Display(states.units[i], display_unit(states.units[i]), '.4g')
            found.append(
                f'{name} was trained from {unit.text(lower)} to {unit.text(upper)}, set-points '
                f'are wanted from {unit.text(low)} to {unit.text(high)}: those outside will be '
                'refused, record what is missing or narrow setpoint_min and setpoint_max')
    return tuple(found)


def _size(rmse: Array, scale: Array) -> float:
    return float(np.sqrt(np.mean((rmse / scale) ** 2)))


def _text(rmse: Array, model: LiftedModel) -> str:
    names, units = model.states.names, model.states.units
    return ', '.join(f'{value:.4g} {unit}' + (f' in {name}' if len(names) > 1 else '')
                     for value, unit, name in zip(rmse, units, names, strict=True))
