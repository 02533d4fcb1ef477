# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Eigenvalues of a model at its operating points, and instability that the record denies."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from koopman_ros.core.arrays import Array
from koopman_ros.core.datasets import Episode
from koopman_ros.core.units import SECONDS_PER_TIME_UNIT
from koopman_ros.evaluation.closed_loop_batch import DriftPlant, Rate
from koopman_ros.learning.identification import Identified
from koopman_ros.learning.lift.metrics import lifted_rate
from koopman_ros.model import LiftedModel

# A mode is unstable if it grows by this power of e in the longest segment of the record.
_GROWTH = 2.0
# No noise is so small that a plant would stay where it grows by this power of e.
_STILL = 20.0
# A plant rests while it stays within so many standard deviations of the noise, or within this
# share of the range, and its inputs change by less than this share of theirs.
_SIGMAS, _SHARE, _INPUT_SHARE = 4.0, 1e-3, 1e-6


@dataclass(frozen=True)
class OperatingPoint:
    """A steady state in the range of operation, and the modes of a model there."""

    x: Array  #: (n_x,) in state units
    #: (n_x,) in 1/time unit of the model, the fastest growing mode first
    eigenvalues: NDArray[np.complex128]

    @property
    def growth(self) -> float:
        """Rate of the fastest growing mode, in 1/time unit of the model."""
        return float(self.eigenvalues[0].real)


def operating_points(model: LiftedModel, setpoints: Array) -> tuple[OperatingPoint, ...]:
    """
    Return the nominal point, and of each state its lowest and highest set-point.

    :param setpoints: (N, n_x) in state units.
    """
    x = model.states.to_deviation(np.vstack([model.states.center, setpoints]))
    rows = dict.fromkeys([0, *(1 + np.concatenate([
        np.argmin(x[1:], axis=0), np.argmax(x[1:], axis=0)])).tolist()] if len(setpoints) else [0])
    x = x[list(rows)]
    modes = _modes(model, lifted_rate(model, model.seconds_per_time_unit), x)
    return tuple(OperatingPoint(*pair) for pair in zip(
        model.states.to_physical(x), modes, strict=True))


def _modes(model: LiftedModel, rate: Rate, x: Array, v: Array | None = None
           ) -> NDArray[np.complex128]:
    """
    Return the eigenvalues (M, n_x) of a rate at states (M, n_x), in deviations.

    :param v: (M, n_u) inputs there; by default those that hold the states as well as they can.
    """
    plant, n = DriftPlant(model, rate), model.n_x
    if v is None:
        v = plant.holding(x, np.zeros((len(x), model.n_u)))
    slope = plant.slope(x, v)[..., :n]
    values = np.linalg.eigvals(np.where(np.isfinite(slope), slope, 0.0)).astype(np.complex128)
    return np.take_along_axis(values, np.argsort(-values.real, axis=1, kind='stable'), axis=1)


def unfounded_instability(model: LiftedModel, found: Identified,
                          points: Sequence[OperatingPoint], others: Mapping[str, Rate],
                          advice: str = '') -> str:
    """
    Say where a model is unstable although the record shows that the plant is not, or nothing.

    :param others: rates by name, per time unit of the drift, that explain the held-out part of the
        record at least as well as the model.
    :param advice: to be followed by another one.
    """
    factor = SECONDS_PER_TIME_UNIT[found.drift.box.time_unit] / model.seconds_per_time_unit
    episodes = found.episodes
    longest = factor * max(float(one.time[-1] - one.time[0]) for one in episodes)

    def unstable(point: OperatingPoint) -> str:
        return (f'it is unstable at {model.states.text(point.x, ".4g")} (a mode grows by '
                f'{point.growth:.3g} per {model.time_unit})')

    for point in points:
        if point.growth * longest <= _GROWTH:
            continue
        x = model.states.to_deviation(point.x)[None]
        for name, rate in others.items():
            other = float(_modes(model, rate, x)[0, 0].real) / factor
            if other * longest <= 0.0:
                return (f'{unstable(point)}, although a {name}, which is stable there, explains '
                        f'the held-out data at least as well: {advice}record around that state')
    for x, u, duration in _resting(found, episodes):
        modes = _modes(model, lifted_rate(model, model.seconds_per_time_unit),
                       model.states.to_deviation(x[None]), model.inputs.to_deviation(u[None]))
        point = OperatingPoint(x, modes[0])
        if point.growth * factor * duration > _STILL:
            return (f'{unstable(point)}, where the plant rested in the record under a constant '
                    f'input: {advice}record with steps of the input around that state')
    return ''


def _resting(found: Identified, episodes: Sequence[Episode]
             ) -> Iterator[tuple[Array, Array, float]]:
    """Yield states (n_x,) where the plant rested, their inputs (n_u,), and for how long."""
    box = found.drift.box
    near = _SIGMAS * np.nan_to_num(found.noise) + _SHARE * box.states.scale
    for episode in episodes:
        x, u = episode.interpolated(), episode.inputs_at(episode.time)
        changed = (np.abs(np.diff(u, axis=0)) > _INPUT_SHARE * box.inputs.scale).any(axis=1)
        for rows in np.split(np.arange(len(x)), 1 + np.flatnonzero(changed)):
            # after it has settled
            rest = rows[len(rows) // 2:]
            center = np.mean(x[rest], axis=0)
            if len(rest) > 1 and (np.abs(x[rest] - center) <= near).all():
                yield center, u[rest[0]], float(episode.time[rest[-1]] - episode.time[rest[0]])
