# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0


"""Choice of a drift model: by every method and degree, judged on stretches that were held out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import contextlib
from dataclasses import dataclass
import math

import numpy as np

from koopman_ros.identification.drift import Box, DriftModel, scaled_input_matrix
from koopman_ros.identification.output_error import output_error
from koopman_ros.identification.records import Array, cut, Record
from koopman_ros.identification.stretches import longest_step, prediction_error, Stretches
from koopman_ros.identification.total_variation import noise_level, total_variation
from koopman_ros.identification.weak_form import weak_form

WINDOWS = (10, 20, 40, 80)
DEGREES = (1, 2, 3, 4, 5, 6)
TOTAL_VARIATION = 'total variation'
WEAK_FORM = 'weak form'
OUTPUT_ERROR = 'output error'

_STRETCH_SAMPLES = (20, 240)
_STRETCHES = 15
# For two states and an input, six of them may hold the extremes.
_FEWEST = 8
# Mean squared errors this close count as equal: on a few stretches that hold one estimate against
# another, chance alone makes such a difference.
_NEARLY = 1.1

# Called with (steps done, steps in all, what is done now); True ends the estimation.
Watch = Callable[[int, int, str], bool]


class Stopped(Exception):  # noqa: N818
    """Whoever watched asked to stop."""


@dataclass(frozen=True)
class Score:
    """
    How well one estimate predicts the stretches that were held out for the choice.

    :param method: its name, e.g. ``'weak form, 40 samples'``.
    :param degree: of the drift.
    :param rmse: (n_x,) root mean square error, in state units; infinite when it diverges.
    :param cost: mean squared error in units of the states' scale, by which estimates compare.
    """

    method: str
    degree: int
    rmse: Array
    cost: float


@dataclass(frozen=True)
class Identified:
    """
    An estimated drift and what it was chosen from.

    :param drift: the estimate.
    :param method: how it was found.
    :param linear: the best linear model of the same records, by output error.
    :param scores: of all estimates, in the order of their making.
    :param noise: (n_x,) standard deviation of the measurement noise, from sample to sample.
    :param fitted: the stretches that it was fitted to.
    :param held_out: stretches that neither fit nor choice has seen.
    """

    drift: DriftModel
    method: str
    linear: DriftModel
    scores: tuple[Score, ...]
    noise: Array
    fitted: tuple[Record, ...]
    held_out: tuple[Record, ...]


def identify(records: Sequence[Record], *, B: Array | None = None,
             degrees: Sequence[int] = DEGREES, windows: Sequence[int] = WINDOWS, seed: int = 0,
             watch: Watch = lambda *_: False) -> Identified:
    """
    Estimate dx/dt = f(x) + B u from sampled, noisy measurements.

    For each degree of f, derivatives by total variation and the weak form with several windows
    each give an estimate; the best on stretches held out for the choice is refined by output
    error, where that pays. Of the degrees that predict about as well as the best, the one with
    the least Bayesian information criterion (Schwarz 1978) over the fitted stretches is taken,
    which reach further than the others, and refitted to all but those held out for good.

    :param records: what was recorded.
    :param B: (n_x, n_u) input matrix in units, or None to learn it.
    :param degrees: of f that are tried, rising, the first one 1.
    :param windows: samples of the weak form's windows.
    :param seed: of the split.
    :param watch: sees the progress and can end it.
    :raises ValueError: when the records are too short, or nothing fits.
    :raises Stopped: when `watch` asked for it.
    """
    parts = _stretches(records)
    box = Box.of(parts)
    fit, choose, held_out = _split(parts, seed)
    step = longest_step(parts)
    chooser, fitter = Stretches.of(choose, step), Stretches.of(fit, step)
    known = None if B is None else scaled_input_matrix(box, B)
    scores: list[Score] = []
    best: dict[int, tuple[DriftModel, Score]] = {}

    def progress(step: int, text: str) -> Callable[..., bool]:
        def tell(*_: object) -> bool:
            if watch(step, len(degrees) + 1, text):
                raise Stopped
            return False

        return tell

    for number, degree in enumerate(degrees):
        tell = progress(number, f'drift of degree {degree}')
        tell()
        found = _estimates(fit, box, degree, known, windows)
        rated = [(model, _score(model, chooser, method)) for method, model in found]
        model, score = min(rated, key=lambda pair: pair[1].cost, default=(None, None))
        if model is None or score is None:
            continue
        best[degree] = model, score
        if not math.isfinite(score.cost):
            continue
        refined = output_error(model, fitter, learn_input_matrix=known is None, monitor=tell)
        polished = _score(refined, chooser, f'{OUTPUT_ERROR} from {score.method}')
        scores += [*(score for _, score in rated), polished]
        # the better estimate in theory needs no proof, only that it does no harm
        if polished.cost <= _NEARLY * score.cost:
            best[degree] = refined, polished
    least = min((score.cost for _, score in best.values()), default=math.inf)
    if not math.isfinite(least):
        raise ValueError('no drift fits the records: record longer, with steps of the input')
    good = [d for d, (_, score) in best.items() if score.cost <= _NEARLY * least]
    degree = min(good, key=lambda d: _information(best[d][0], fitter, known is None))
    tell = progress(len(degrees), f'drift of degree {degree} on all records')
    tell()
    everything = Stretches.of([*fit, *choose], step)
    finished = {}
    for d in {degree, degrees[0]} & set(best):
        model, score = best[d]
        finished[d] = output_error(model, everything, learn_input_matrix=known is None,
                                   monitor=tell) if OUTPUT_ERROR in score.method else model
    return Identified(finished[degree], best[degree][1].method, finished[min(finished)],
                      tuple(scores), noise_level(parts, finished[degree]),
                      (*fit, *choose), tuple(held_out))


def _stretches(records: Sequence[Record]) -> list[Record]:
    low, high = _STRETCH_SAMPLES
    total = sum(len(record) for record in records)
    if total < _FEWEST * low:
        raise ValueError(f'{total} samples are too few to learn from and to judge by: record at '
                         f'least {_FEWEST * low}, better some thousand')
    parts = cut(records, min(high, max(low, total // _STRETCHES)))
    kept = [part for part in parts if len(part) >= low // 2]
    if len(kept) < _FEWEST:
        raise ValueError(f'the records have {len(kept)} uninterrupted stretches of {low // 2} '
                         f'samples, at least {_FEWEST} are needed: record longer without gaps')
    return kept


def _split(parts: list[Record], seed: int) -> tuple[list[Record], list[Record], list[Record]]:
    """
    Return the stretches to fit to, to choose by and to hold out: three, one and one fifth.

    Those that reach furthest are fitted to: the range should be known, not extrapolated to.
    """
    lows = np.array([np.concatenate((part.x.min(axis=0), part.u.min(axis=0))) for part in parts])
    highs = np.array([np.concatenate((part.x.max(axis=0), part.u.max(axis=0))) for part in parts])
    furthest = {*lows.argmin(axis=0).tolist(), *highs.argmax(axis=0).tolist()}
    free = [i for i in np.random.default_rng(seed).permutation(len(parts)).tolist()
            if i not in furthest]
    if len(free) < 2:
        raise ValueError(f'all but {len(free)} of {len(parts)} stretches hold the lowest or the '
                         'highest of a state or an input, none is left to judge by: record longer')
    fifth = min(max(1, len(parts) // 5), len(free) // 2)
    choose, held_out = free[:fifth], free[fifth:2 * fifth]
    fit = furthest.union(free[2 * fifth:])
    return ([parts[i] for i in sorted(fit)], [parts[i] for i in sorted(choose)],
            [parts[i] for i in sorted(held_out)])


def _estimates(records: Sequence[Record], box: Box, degree: int, B: Array | None,
               windows: Sequence[int]) -> list[tuple[str, DriftModel]]:
    """Return what each method finds; a method that cannot is left out."""
    found: list[tuple[str, DriftModel]] = []
    for window in windows:
        with contextlib.suppress(ValueError, np.linalg.LinAlgError):
            found.append((f'{WEAK_FORM}, {window} samples',
                          weak_form(records, box, degree, B, window)))
    with contextlib.suppress(ValueError, np.linalg.LinAlgError, IndexError):
        # the widest window knows B best
        assumed = B if B is not None else found[-1][1].B
        found.append((TOTAL_VARIATION, total_variation(records, box, degree, B, assumed)))
    return found


def _information(model: DriftModel, stretches: Stretches, learned_B: bool) -> float:
    """Return the Bayesian information criterion, but for a constant."""
    scale = model.box.state_scale
    # an error below rounding tells nothing
    rmse = np.maximum(prediction_error(model.rate, stretches, scale) / scale, 1e-12)
    count = int(np.sum(stretches.measured))
    size = model.coefficients.size + learned_B * model.B.size
    return 2.0 * count * float(np.sum(np.log(rmse))) + size * math.log(count)


def _score(model: DriftModel, stretches: Stretches, method: str) -> Score:
    scale = model.box.state_scale
    rmse = prediction_error(model.rate, stretches, scale)
    return Score(method, model.degree, rmse, float(np.mean((rmse / scale) ** 2)))
