# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Drifts that explain a record, or halves of it, equally well, and by how much they differ."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from koopman_ros.core.arrays import Array
from koopman_ros.core.datasets import Episode
from koopman_ros.learning.identification import (
    Drift,
    DriftModel,
    fitted_starts,
    Identified,
    longest_step,
    Segments,
)
from koopman_ros.learning.identification.chance import clearly_positive
from koopman_ros.learning.identification.drift import autocorrelation
from koopman_ros.learning.identification.network_drift import NetworkDrift
from koopman_ros.learning.identification.output_error import (
    fitted_by_simulation,
    PolynomialCoefficients,
)

# They differ where their rates do by more than these shares of the motion: in the mean square,
# and at most.
_DIFFERENT, _SCATTER = 0.1, 0.05
_STEPS = 10  # of a fit to half of a record, which begins from that to all of it
# Segments of each half that the other half explains if the plant is the same: their states and
# inputs are at most by this share outside its ranges.
_FEWEST, _OUTSIDE = 3, 0.1
# The plant changed if the squared errors of drifts in the other half are so many times those in
# their own, where these are white, and by this share of the half-range.
_CHANGED, _NOTICEABLE = 2.5, 0.01


def disagreement(found: Identified) -> str:
    """Say by how much, and where most, drifts that explain the record equally well differ."""
    if not found.alternatives:
        return ''
    x, u = _samples([*found.fitted, *found.held_out])
    count = 1 + len(found.alternatives)
    return _differing(
        f'{count} drifts that explain the record equally well', found.drift,
        [(one.rate(x, u) - found.drift.rate(x, u)) for one in found.alternatives], x, u)


def inconsistency(found: Identified) -> str:
    """
    Say that drifts that are fitted to the first and to the second half of a record differ.

    They are compared where both halves have states and inputs, of plants without unmeasured
    states: half of their difference is about the error of the drift of the whole record.
    """
    drift = found.drift
    # offsets say already that its episodes differ
    if found.hidden or found.constants or len(found.offsets) or (
            not isinstance(drift, DriftModel | NetworkDrift)):
        return ''
    segments = sorted([*found.fitted, *found.held_out], key=lambda one: float(one.time[0]))
    halves = segments[:len(segments) // 2], segments[len(segments) // 2:]
    shared = [[one for one in half if _within(*_samples([one]), *_samples(other)).all()]
              for half, other in zip(halves, halves[::-1], strict=True)]
    if min(map(len, shared)) < _FEWEST:
        return ''
    drifts = [_fitted(drift, half) for half in halves]
    own, other = (np.concatenate([_squares(one, part) for one, part in zip(
        some, shared, strict=True)]) for some in (drifts, drifts[::-1]))
    # coloured errors are equivalent to fewer white ones
    r = float(np.clip(np.max([autocorrelation(one, _segments(part)) for one, part in zip(
        drifts, shared, strict=True)]), 0.0, 0.99))
    least = max(_CHANGED * np.mean(own) * np.sqrt((1.0 + r) / (1.0 - r)), _NOTICEABLE ** 2)
    if least < np.mean(other) < np.inf and clearly_positive(other - own):
        ratio = float(np.sqrt(np.mean(other) / np.mean(own)))
        return ('the plant changed during the record: drifts fitted to one half of it err '
                f'{ratio:.2g} times as much in the other half: train from its last part, or '
                'record again')
    x, u = _samples([*shared[0], *shared[1]])
    warning = _differing('drifts fitted to the first and to the second half of the record', drift,
                         [0.5 * (drifts[1].rate(x, u) - drifts[0].rate(x, u))], x, u, largest=True)
    return warning and (
        f'{warning}; if the plant changed during the record, train from its last part')


def _fitted(drift: DriftModel | NetworkDrift, episodes: Sequence[Episode]) -> Drift:
    model = drift if isinstance(drift, NetworkDrift) else PolynomialCoefficients(drift, True)
    return fitted_by_simulation(model, _segments(episodes), iterations=_STEPS).model.drift


def _squares(drift: Drift, episodes: Sequence[Episode]) -> Array:
    """Return the mean squared errors (M,) of segments, in half-ranges."""
    scale = drift.box.states.scale
    return np.mean(
        fitted_starts(drift.rate, _segments(episodes), scale)[1] / scale ** 2, axis=1)


def _segments(episodes: Sequence[Episode]) -> Segments:
    return Segments.of(episodes, longest_step(episodes))


def _samples(episodes: Sequence[Episode]) -> tuple[Array, Array]:
    """Return the states (N, n_x) and inputs (N, n_u) of episodes."""
    return (np.concatenate([one.interpolated() for one in episodes]),
            np.concatenate([one.inputs_at(one.time) for one in episodes]))


def _within(x: Array, u: Array, states: Array, inputs: Array) -> NDArray[np.bool_]:
    """Return which samples (N,) are in the ranges of others."""
    own, other = np.hstack((x, u)), np.hstack((states, inputs))
    low, high = other.min(axis=0), other.max(axis=0)
    edge = _OUTSIDE * (high - low)
    return np.all((own >= low - edge) & (own <= high + edge), axis=1)


def _differing(text: str, drift: Drift, differences: Sequence[Array], x: Array, u: Array, *,
               largest: bool = False) -> str:
    """
    Say by how much rates (N, n_x) differ at samples; nothing for little.

    :param largest: whether the largest difference counts, in place of the root mean square.
    """
    scale = drift.box.states.scale
    squares = np.sum((np.array(differences) / scale) ** 2, axis=2)
    motion = np.mean(np.sum((drift.rate(x, u) / scale) ** 2, axis=1))
    size = np.max(squares if largest else np.mean(squares, axis=1))
    share = float(np.sqrt(size / motion))
    if share <= (_SCATTER if largest else _DIFFERENT):
        return ''
    worst = drift.box.states.text(x[int(np.argmax(np.max(squares, axis=0)))])
    return (f'{text} differ by {100.0 * share:.0f} % of the motion, most at {worst}: record '
            'longer, with steps of the input around that state')
