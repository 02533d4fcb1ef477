# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Candidates of linear and polynomial drifts, from realisations and from filters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from koopman_ros.learning.identification.data_split import SplitRecord
from koopman_ros.learning.identification.drift import DriftModel
from koopman_ros.learning.identification.innovations_form import (
    Predictor,
    SETTLING,
    standardised,
)
from koopman_ros.learning.identification.output_error import (
    fitted_by_simulation,
    innovations_form,
    PolynomialCoefficients,
)
from koopman_ros.learning.identification.realisation import realised
from koopman_ros.learning.identification.structure_candidates import (
    candidate_of,
    Choice,
    compared,
    not_measured,
    StructureCandidate,
)
from koopman_ros.model import Box

UNIT = '1'  # of a state that is not measured: any other scale would do as well
# Initial filter gains of outputs, of their rates and of the accelerations, over powers
# of the interval between samples (alpha, beta and gamma of tracking filters).
_GAINS = ((0.5, 0.1, 0.01), (0.2, 0.02, 0.001), (0.8, 0.4, 0.1))
_SAMPLES = 20  # between samples, in which rates are counted at first

_Polynomial = Predictor[DriftModel]


class PolynomialSearch:
    """
    Candidates of polynomial drifts.

    :ivar deviation: (n_y,) standard deviations of the innovations of the last filter.
    :ivar samples: longest piece that is simulated; 0 until a model shows the plant's memory.
    """

    def __init__(self, record: SplitRecord, samples: int = 0) -> None:
        self.record, self._plant, self.samples = record, record.plant, samples
        self.deviation = np.ones(len(self._plant.state_names))
        self.learn_B = self._plant.B is None

    def rising(self, counts: Sequence[int], choice: Choice,
               stage: Callable[[str], Callable[..., bool]]) -> list[StructureCandidate]:
        """Add linear models with numbers of unmeasured states, until one errs no less."""
        found: list[StructureCandidate] = []
        for count in counts:
            name = f'drift of degree 1 with {not_measured(count)}'
            monitor = stage(name)
            if found and monitor():
                break
            one = self.linear(count, monitor)
            choice.gains(one, name)
            if one is None:
                continue
            found.append(one)
            if found[:-1] and not compared(one.errors, found[-2].errors)[0]:
                break
        return found

    def linear(self, hidden: int, monitor: Callable[..., bool]) -> StructureCandidate | None:
        """Return the linear model of an order; None where simulations diverge."""
        samples = self.samples
        for begin in (self._realised, self.from_filters):
            start = begin(hidden, monitor)
            found = None if start is None else self.simulated(start, monitor)
            # an unstable plant in a closed loop has no realisation of its own
            if found is not None and (begin == self.from_filters
                                      or found.model.drift.growth_rate < 0.0):
                assert isinstance(found.model, PolynomialCoefficients)
                moved = self._standardised(Predictor(found.model.drift, found.gain))
                return found if moved is None or not hidden else replace(
                    found, model=replace(found.model, drift=moved.drift), start=moved)
            self.samples = samples
        return None

    def _standardised(self, start: _Polynomial) -> _Polynomial | None:
        """Return the same with hidden states between -1 and 1 in the record, None if constant."""
        if len(start.gain) == len(self.deviation):
            return start
        try:
            return standardised(start, self.record.estimates(start))
        except (ValueError, np.linalg.LinAlgError):
            return None

    def simulated(self, start: _Polynomial, monitor: Callable[..., bool]
                  ) -> StructureCandidate | None:
        """Return the candidate whose simulations err least; None where they diverge."""
        pieces = 0
        # a realisation or a filter may forget faster than the plant
        for samples in [self.samples] if self.samples else [self.record.memory(start.drift), 0]:
            try:
                data, starts = self.record.simulated(start, samples or self.samples)
            except ValueError:
                return None
            if len(starts) == pieces:
                break
            refined = fitted_by_simulation(
                PolynomialCoefficients(start.drift, self.learn_B), data, starts,
                monitor=monitor)
            if not np.isfinite(refined.cost):
                return None
            pieces = len(starts)
            self.samples = self.samples or self.record.memory(refined.model.drift)
        return candidate_of(refined, start, data, self.record)

    def extended(self, linear: StructureCandidate) -> _Polynomial:
        """Return a linear model with further inputs of the record, which do nothing yet."""
        drift = linear.model.drift
        assert isinstance(drift, DriftModel)
        inputs = self._shape(0).box.inputs
        B = np.hstack((drift.B, np.zeros((len(drift.B), len(inputs) - drift.B.shape[1]))))
        return Predictor(replace(drift, B=B, box=replace(drift.box, inputs=inputs)), linear.gain)

    def filtered(self, start: _Polynomial, monitor: Callable[..., bool]) -> _Polynomial | None:
        """Return a filter that predicts the record better; None if there is none."""
        try:
            found, _ = self._refined(start, monitor)
            self.deviation = np.std(self.record.innovations(found), axis=0)
            return standardised(found, self.record.estimates(found))
        except (ValueError, np.linalg.LinAlgError):
            return None

    def _realised(self, hidden: int, monitor: Callable[..., bool]) -> _Polynomial | None:
        """Return a stable linear model of the outputs, with a filter that corrects nothing."""
        shape = self._shape(hidden)
        (states, inputs), n_y = (shape.box.states, shape.box.inputs), len(self.deviation)
        measured = states.only(states.names[:n_y])
        monitor()
        found = realised([replace(one, x=measured.to_deviation(one.x), u=inputs.to_deviation(
            one.u)) for one in self.record.episodes], self.record.period, n_y + hidden
            ) if self.learn_B else None
        if found is None:
            return None
        A, B, c = found
        return self._standardised(Predictor(replace(shape, coefficients=np.vstack((c, A.T)), B=B),
                                            np.zeros((n_y + hidden, n_y))))

    def from_filters(self, hidden: int, monitor: Callable[..., bool]) -> _Polynomial | None:
        """Return the best filter of a linear drift; it is stable where the plant is not."""
        try:
            tried = [self._refined(self._start(hidden, gains), monitor) for gains in _GAINS]
        except ValueError:
            return None
        return self.filtered(min(tried, key=lambda pair: pair[1])[0], monitor)

    def _refined(self, start: _Polynomial, monitor: Callable[..., bool]
                 ) -> tuple[_Polynomial, float]:
        record, parts = self.record, self.record.fit
        shortest = min(len(record.parts[i]) for i in parts)
        found = innovations_form(
            PolynomialCoefficients(start.drift, self.learn_B), start.gain,
            *record.simulated(start, parts=parts), self.deviation,
            settling=min(SETTLING, shortest // 3), monitor=monitor)
        return Predictor(found.model.drift, found.gain), found.cost

    def _shape(self, hidden: int) -> DriftModel:
        """Return a linear drift of nothing, with the box of the record."""
        plant, parts = self._plant, self.record.parts
        n_x = len(plant.state_names) + hidden
        names = tuple(f'hidden_{i + 1}' for i in range(hidden))
        y = np.concatenate([part.interpolated() for part in parts])
        rows = np.linspace(-1.0, 1.0, len(y))[:, None] * np.ones(hidden)
        B = None if plant.B is None else np.vstack([np.asarray(plant.B), np.zeros((hidden, len(
            plant.input_names)))])
        whole = replace(plant, state_names=(*plant.state_names, *names),
                        state_units=(*plant.state_units, *[UNIT] * hidden),
                        nominal_state=np.concatenate((plant.nominal_state, np.zeros(hidden))), B=B)
        box = Box.of(whole, np.hstack([y, rows]), np.concatenate([p.u for p in parts]),
                     nominal=False)
        return DriftModel(box, 1, np.zeros((1 + n_x, n_x)), np.zeros((n_x, len(box.inputs))) if (
            B is None) else box.input_matrix(B))

    def _start(self, hidden: int, gains: Sequence[float]) -> _Polynomial:
        """Return a filter of outputs that move by themselves, each at a rate of its own."""
        shape = self._shape(hidden)
        n_y = len(self._plant.state_names)
        n_x = n_y + hidden
        gain = np.zeros((n_x, n_y))
        for i in range(n_x):
            layer = min(i // n_y, len(gains) - 1)
            gain[i, i % n_y] = gains[layer] * _SAMPLES ** layer
            if i >= n_y:
                shape.coefficients[1 + i, i - n_y] = 1.0 / (_SAMPLES * self.record.period)
        return Predictor(shape, gain)
