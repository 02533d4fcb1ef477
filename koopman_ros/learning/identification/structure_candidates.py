# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Models with different structures, compared by simulations of a record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from koopman_ros.core.datasets import Array
from koopman_ros.learning.identification.chance import SIGMAS
from koopman_ros.learning.identification.data_split import SplitRecord
from koopman_ros.learning.identification.degree_choice import LOST, NEARLY
from koopman_ros.learning.identification.drift import Drift, DriftModel, Segments
from koopman_ros.learning.identification.identify import OUTPUT_ERROR, Score
from koopman_ros.learning.identification.innovations_form import Predictor, SETTLING
from koopman_ros.learning.identification.network_drift import NetworkDrift
from koopman_ros.learning.identification.output_error import Refinable, Refined

_MOST = 2.0  # times the least squared error that a smaller model may have


@dataclass(frozen=True)
class StructureCandidate:
    """A model, and how far its simulations are from measurements."""

    model: Refinable
    start: Predictor[DriftModel]  #: where its search began, in the same coordinates
    record: SplitRecord  #: of the plant
    #: (N, n_y) in deviations, of simulations by models that were not fitted there, or from starts
    #: that are fitted to the first samples where those err more
    errors: Array
    starts: Array  #: of its simulations, in deviations of where its search began

    @property
    def hidden(self) -> int:
        """Number of unmeasured states."""
        return len(self.start.gain) - self.errors.shape[1]

    @property
    def late(self) -> tuple[int, ...]:
        """Dead times (n_u,) of the inputs in samples, where there are any."""
        return self.record.late

    @property
    def gain(self) -> Array:
        """Gain (n_x, n_y) of the filter with which it began, in deviations."""
        return self.start.gain

    @property
    def label(self) -> str:
        """The kind of model."""
        drift = self.model.drift
        network = f' of a {drift.form}' if isinstance(drift, NetworkDrift) else ''
        return f'{OUTPUT_ERROR}{network}, {not_measured(self.hidden)}'

    @property
    def score(self) -> Score:
        """Its errors, as others' are compared."""
        drift = self.model.drift
        scale = drift.box.states.scale[:self.errors.shape[1]]
        squares = np.mean(self.errors ** 2, axis=0)
        return Score(self.label, drift.degree if isinstance(drift, DriftModel) else None,
                     scale * np.sqrt(squares), float(np.mean(squares)))

    @property
    def text(self) -> str:
        """Structure and error."""
        drift = self.model.drift
        form = 'linear drift' if isinstance(drift, DriftModel) and drift.degree == 1 else (
            drift.form)
        more = ', an offset of each episode' * self.record.offsets
        if self.late:
            more += f', dead times of {", ".join(map(str, self.late))} samples'
        return f'{form} with {not_measured(self.hidden)}{more}: ' + ', '.join(
            f'{error:.4g} {unit}' for error, unit in zip(
                self.score.rmse, drift.box.states.units, strict=False))


def not_measured(count: int) -> str:
    """Return a number of unmeasured states in words."""
    return f'{count} {"state" if count == 1 else "states"} not measured'


class Choice:
    """
    The candidates so far, each compared with the best before it.

    :ivar steps: of the search, in words, after those before it.
    """

    def __init__(self, steps: Sequence[str]) -> None:
        self.candidates: list[StructureCandidate] = []
        self.steps = [*steps]

    def gains(self, one: StructureCandidate | None, name: str = '') -> bool:
        """
        Add a candidate; return whether it errs less than those before, not by chance.

        :param name: of one that would have been added, but diverges.
        """
        if one is None:
            self.steps += [f'{name}: diverges'] * bool(name)
            return False
        before = self.candidates
        self.candidates = [*before, one]
        if not before:
            self.steps.append(one.text)
            return True
        better, words = compared(one.errors, smallest_adequate(before).errors)
        self.steps.append(f'{one.text}; {words}')
        return better

    def explained(self, square: float) -> bool:
        """Return whether a candidate errs by no more than this mean square."""
        return any(np.mean(one.errors ** 2) <= square for one in self.candidates)

    def ended(self, best: StructureCandidate) -> tuple[str, ...]:
        """Return the steps with the result."""
        return (*self.steps, f'selected: {best.text}')


def candidate_of(refined: Refined[Any], start: Predictor[DriftModel], data: Segments,
                 record: SplitRecord) -> StructureCandidate | None:
    """Return the candidate of a model; None where it diverges or hangs on a few samples."""
    if not np.isfinite(refined.cost):
        return None
    with np.errstate(all='ignore'):
        try:
            errors = refined.left_out(SETTLING)
        except np.linalg.LinAlgError:
            # a few samples decide alone about some direction of the parameters
            return None
        # a state that the first samples do not tell is of no use
        free = Predictor(refined.model.drift, 0.0 * start.gain)
        others = free.along(data, free.starts(data, refined.starts)).innovations
        errors = np.where(np.mean(errors ** 2, axis=0) > np.mean(others ** 2, axis=0),
                          errors, others)
    return StructureCandidate(refined.model, start, record, errors, refined.starts) if (
        np.all(np.abs(errors) < LOST)) else None


def equals(best: StructureCandidate, able: Sequence[StructureCandidate]
           ) -> list[Predictor[Drift]]:
    """Return the others with as many states that err about as little as the best ones."""
    most = NEARLY * min(one.score.cost for one in able)
    return [Predictor(one.model.drift, one.gain) for one in able
            if one is not best and one.hidden == best.hidden and one.record is best.record
            and one.score.cost <= most]


def smallest_adequate(candidates: Sequence[StructureCandidate]) -> StructureCandidate:
    """Return the smallest whose squared errors are not clearly above the least."""
    squares = _blocks([one.errors for one in candidates])
    least = min(squares, key=np.mean)

    def worse(own: Array) -> bool:
        more, deviation = _excess(own, least)
        # of a model that errs wildly in a few blocks the scatter says nothing
        return more > min(SIGMAS * deviation, _MOST - 1.0)

    able = [(len(one.model.theta) + np.count_nonzero(one.late), float(np.mean(own)), i)
            for i, (one, own) in enumerate(zip(candidates, squares, strict=True))
            if not worse(own)]
    return candidates[min(able)[-1]]


def compared(own: Array, other: Array) -> tuple[bool, str]:
    """Return whether errors (N, n_y) are less than others, not by chance, and how much."""
    more, deviation = _excess(*_blocks([own, other]))
    return more < -SIGMAS * deviation, (
        f'mean square {100.0 * abs(more):.3g} % {"more" if more > 0.0 else "less"} than with the '
        f'best before (standard error {100.0 * deviation:.2g} %)')


def _blocks(candidates: Sequence[Array]) -> list[Array]:
    """Return the mean squares (k,) of errors (N, n_y) in blocks, all outputs alike."""
    scale = np.min([np.mean(errors ** 2, axis=0) for errors in candidates], axis=0)
    # errors of a simulation last: in blocks they are independent
    return [np.array([np.mean(block ** 2 / scale) for block in np.array_split(
        errors, max(2, len(errors) // SETTLING))]) for errors in candidates]


def _excess(own: Array, other: Array) -> tuple[float, float]:
    """Return by which share squared errors (k,) are above others, and its standard error."""
    excess = (own - other) / np.mean(other)
    return float(np.mean(excess)), float(np.std(excess) / np.sqrt(len(excess)))
