# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Structure of a drift: measured states alone, B(x), characteristics, unmeasured states."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
import time
from typing import Any

import numpy as np

from koopman_ros.core.characteristic import Characteristic
from koopman_ros.core.datasets import Array, Episode, PlantDescription
from koopman_ros.execution import Backend
from koopman_ros.learning.identification.base import IdentificationMethod
from koopman_ros.learning.identification.characteristics import (
    characteristic_of,
    identify_measured,
    NotMonotoneError,
)
from koopman_ros.learning.identification.data_split import SplitRecord
from koopman_ros.learning.identification.drift import (
    DriftModel,
    fitted_starts,
    longest_step,
    MOST_COEFFICIENTS,
    prediction_error,
    Segments,
)
from koopman_ros.learning.identification.identify import Identified, Watch
from koopman_ros.learning.identification.structure_candidates import compared
from koopman_ros.learning.identification.unmeasured_states import (
    BUDGET,
    EXPLAINED,
    identify_unmeasured,
)

MOST_UNMEASURED = 3  # states that are tried if their number is not given
_ROUNDS = 2  # of linear drifts with whose states characteristics are found
_SLIGHT = 0.01  # share of the motion; no unmeasured states are sought for a smaller error


def identify_structure(plant: PlantDescription, episodes: Sequence[Episode], *,
                       given: Collection[str] = (),
                       methods: Mapping[str, IdentificationMethod] | None = None,
                       dead_times: bool = True, seed: int = 0, watch: Watch = lambda *_: False,
                       backend: Backend | None = None) -> Identified:
    """
    Estimate a drift with as many states as free runs of the record need.

    An estimate of measured states by :func:`identify_measured` is kept if its
    simulations of the whole record err by little more than noise. Otherwise B(x) of degree 1 is
    tried, unless it has too many coefficients, and taken where free runs of the segments held out
    err less, and those of all by more than two standard errors. If the simulations then err by
    more than noise and than 1 % of the motion, the estimate competes with those of
    :func:`identify_unmeasured`.

    A characteristic that the measured states show is found again with the estimates of the others.

    :param given: inputs whose characteristic the plant has already.
    :param methods: see :func:`identify`; other arguments as for :func:`identify_unmeasured`.
    """
    def estimate(plant: PlantDescription, given: Collection[str], before: int
                 ) -> tuple[Identified, Collection[str]]:
        return identify_measured(
            plant, episodes, given=given, methods=methods, seed=seed, backend=backend,
            watch=lambda done, total, text: watch(before * total + done, 5 * total, text))

    end = time.process_time() + BUDGET
    measured, candidates = estimate(plant, given, 0)
    # of an effect that rises and falls it says so last
    doubt = measured.warnings[-1:] if (
        candidates and not measured.drift.characteristics.keys() - set(given)) else ()
    plant = replace(plant, characteristics=measured.drift.box.inputs.characteristics)
    if callable(plant.B) or plant.input_matrix_degree or _explains(
            measured, plant, episodes, 0.0):
        return measured
    n_x, n_u = len(plant.state_names), len(plant.input_names)
    if plant.B is None and not plant.disturbance_names and (
            n_x * (1 + n_x) * (1 + n_u) <= MOST_COEFFICIENTS):
        varying, _ = estimate(replace(plant, input_matrix_degree=1), plant.input_names, 1)
        (own, held_out), (other, others) = map(free_run_errors, (varying, measured))
        better, words = compared(own, other)
        better &= bool(np.mean(held_out ** 2) < np.mean(others ** 2))
        steps = *measured.steps, measured.drift.form, f'{varying.drift.form}: {words}'
        measured = replace(varying if better else measured, linear=measured.linear, steps=steps,
                           searched=('input_matrix_degree',))
    if _explains(measured, plant, episodes, _SLIGHT):
        return measured
    if candidates:
        plant = with_characteristics(plant, episodes, candidates, seed=seed, dead_times=dead_times,
                                      backend=backend)
    found = identify_unmeasured(
        plant, episodes, MOST_UNMEASURED, measured=measured, dead_times=dead_times, seed=seed,
        backend=backend, budget=max(0.0, end - time.process_time()),
        watch=lambda done, total, text: watch(2 * total + 3 * done, 5 * total, text))
    return found if found.drift.characteristics.keys() - set(given) else replace(
        found, warnings=tuple(dict.fromkeys((*found.warnings, *doubt))))


def with_characteristics(plant: PlantDescription, episodes: Sequence[Episode],
                          names: Collection[str], **options: Any) -> PlantDescription:
    """Return the plant with characteristics that linear drifts with unmeasured states show."""
    for _ in range(_ROUNDS):
        rough = identify_unmeasured(plant, episodes, MOST_UNMEASURED, highest_degree=1,
                                    networks=False, **options)
        found = dict[str, Characteristic]()
        for name in names if isinstance(rough.drift, DriftModel) else ():
            try:
                if (one := characteristic_of(rough, name)) is not None:
                    found[name] = one
            except NotMonotoneError:
                # one that was found before is kept; any other input acts linearly
                continue
        if not found:
            break
        plant = replace(plant, characteristics={**plant.characteristics, **found})
    return plant


def _explains(found: Identified, plant: PlantDescription, episodes: Sequence[Episode],
              slight: float) -> bool:
    """Return whether simulations of the record err by noise alone, or a share of the motion."""
    drift = found.drift
    record = SplitRecord(plant, episodes, 0, hidden=False)
    data = record.pieces(record.memory(drift))
    squares = prediction_error(drift.rate, data, drift.box.states.scale) ** 2
    spread = np.nanvar(np.concatenate([episode.x for episode in episodes]), axis=0)
    return bool(np.all(squares <= np.fmax(
        EXPLAINED * found.noise ** 2, slight ** 2 * spread)))


def free_run_errors(found: Identified) -> tuple[Array, Array]:
    """Return the errors (N, n_x) of free runs of all segments, and of those held out, scaled."""
    rate, scale = found.drift.rate, found.drift.box.states.scale
    data = Segments.of(found.episodes, longest_step(found.fitted))
    errors = data.errors(rate, fitted_starts(rate, data, scale)[0]).swapaxes(0, 1) / scale
    # one segment after the other
    sampled, first = data.sampled.T, len(found.fitted)
    return errors[sampled], errors[first:][sampled[first:]]
