# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Candidates whose inputs act late."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from koopman_ros.learning.identification.data_split import SplitRecord
from koopman_ros.learning.identification.dead_time import LinearModels, LONGEST, Sampled, SHARE
from koopman_ros.learning.identification.output_error import (
    fitted_by_simulation,
    Refinable,
    Refined,
)
from koopman_ros.learning.identification.polynomial_candidates import PolynomialSearch
from koopman_ros.learning.identification.structure_candidates import (
    candidate_of,
    StructureCandidate,
)

_FEW_STEPS = 15  # of the fit with each dead time
_SHIFTS = (8, 4, 2, 1)  # samples by which dead times are moved
_LESS = 1e-3  # share by which a shift must lower the squared error


def late_linear(search: PolynomialSearch, linear: StructureCandidate, manipulated: Sequence[bool],
                monitor: Callable[..., bool]) -> StructureCandidate | None:
    """Return the linear model of the same order with the best dead times; None for none."""
    tried = []
    for late in _dead_times(search.record, linear, manipulated, monitor):
        if monitor():
            break
        tried.append(PolynomialSearch(search.record.later(late), search.samples).linear(
            linear.hidden, monitor))
    return min(filter(None, tried), key=lambda one: one.score.cost, default=None)


def _dead_times(record: SplitRecord, linear: StructureCandidate, manipulated: Sequence[bool],
                monitor: Callable[..., bool]) -> list[tuple[int, ...]]:
    """Return those, in samples, with which single outputs err least, and their neighbours."""
    n_y, longest = linear.errors.shape[1], _longest(record)
    data = [Sampled.of(one, record.period, longest) for one in record.episodes
            if len(one) > 2 * longest]
    if not data:
        return []
    best = LinearModels(data, -(-len(linear.gain) // n_y), n_y).best(
        tuple(longest * own for own in manipulated), monitor)
    neighbours = [tuple(np.add(best, sign * row).tolist())
              for row in np.eye(len(manipulated), dtype=int)[list(manipulated)]
              for sign in (1, -1)]
    return [late for late in (best, *neighbours) if any(late) and min(late) >= 0]


def late_as_suits(one: StructureCandidate, manipulated: Sequence[bool], samples: int,
                  monitor: Callable[..., bool]) -> StructureCandidate | None:
    """
    Return a candidate with the dead times near its own that suit it best; None for the same.

    :param samples: longest piece that is simulated.
    """
    record = one.record
    longest = _longest(record)
    current = own = one.late or (0,) * len(record.plant.input_names)
    found = dict[tuple[int, ...], Refined[Refinable]]()

    def cost(late: tuple[int, ...]) -> float:
        if late not in found:
            near = found.get(current)
            found[late] = fitted_by_simulation(
                near.model if near else one.model, record.later(late).pieces(samples),
                near.starts if near else one.starts, iterations=_FEW_STEPS, monitor=monitor)
        return found[late].cost

    cost(own)
    for j in np.flatnonzero(manipulated).tolist():
        for shift in (sign * size for size in _SHIFTS for sign in (1, -1)):
            while not monitor():
                late = (*current[:j], current[j] + shift, *current[j + 1:])
                if not (0 <= late[j] <= longest and cost(late) < (1.0 - _LESS) * cost(current)):
                    break
                current = late
    if current == own:
        return None
    moved, best = record.later(current), found[current]
    data = moved.pieces(samples)
    return candidate_of(
        fitted_by_simulation(best.model, data, best.starts, monitor=monitor), one.start, data,
        moved)


def _longest(record: SplitRecord) -> int:
    return min(LONGEST, max(map(len, record.episodes)) // SHARE)
