# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The set-points that a model can hold with its inputs within their range."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from koopman_ros.core.arrays import Array, short_repr
from koopman_ros.core.steady_state import steady_state
from koopman_ros.evaluation.closed_loop_batch import DriftPlant
from koopman_ros.learning.acceptance.settings import DEFAULTS, Thresholds
from koopman_ros.learning.lift.metrics import lifted_rate
from koopman_ros.model import LiftedModel


@dataclass(frozen=True)
class HeldShares:
    """Shares of values of single states that a model can hold in a steady state."""

    names: tuple[str, ...]  #: of the measured states
    recorded: Array  #: (n_y,) of the recorded range of each
    #: (n_y,) of the steady states of plausible plants where the data are
    steady: Array
    requested: Mapping[str, float]  #: of the range of requested set-points, by state

    __repr__ = short_repr

    def reason(self, least: float) -> str:
        """Say that the model holds too little, or nothing."""
        for name, share in self.requested.items():
            if share < least:
                return (f'it can hold {100.0 * share:.0f} % of the requested set-points of {name} '
                        f'with the inputs in their range, must be at least {100.0 * least:.0f} %: '
                        'record steady states there, or narrow setpoint_min and setpoint_max')
        if len(self.steady) and np.max(self.steady) < least:
            best = int(np.argmax(self.steady))
            return (f'it can hold {100.0 * self.steady[best]:.0f} % of the values of '
                    f'{self.names[best]} at which the plant can be steady, must be at least '
                    f'{100.0 * least:.0f} %: record longer steps of the inputs')
        return ''


def held_shares(model: LiftedModel, recorded: Array, setpoints: Array,
                requested: Mapping[str, Sequence[float]], manipulated: NDArray[np.bool_],
                measured: int, settings: Thresholds = DEFAULTS) -> HeldShares:
    """
    Return the shares of values of single states that a model can hold.

    :param recorded: (N, n_x) states of the record.
    :param setpoints: (M, n_x) steady states of plausible plants.
    :param requested: lowest and highest set-point of some states by name.
    :param manipulated: (n_u,) inputs that may move; the others keep their nominal values.
    :param measured: number of the first states, which are measured.
    """
    names = model.states.names[:measured]
    trim, points = settings.trimmed, settings.held_points
    low, high = np.quantile(recorded[:, :measured], [trim, 1.0 - trim], axis=0)
    some = setpoints[np.linspace(0, len(setpoints) - 1, min(points, len(setpoints))).astype(int)]

    def share(i: int, values: Array) -> float:
        return float(np.mean(_held(model, i, values, manipulated))) if len(values) else 0.0

    return HeldShares(
        names, np.array([share(i, np.linspace(low[i], high[i], points))
                         for i in range(measured)]),
        np.array([share(i, some[:, i]) for i in range(measured)]) if len(some) else np.zeros(0),
        {name: share(names.index(name), np.linspace(ends[0], ends[1], points))
         for name, ends in requested.items() if name in names})


def _held(model: LiftedModel, i: int, values: Array, manipulated: NDArray[np.bool_]
          ) -> NDArray[np.bool_]:
    """Return at which values (N,) of a state the model has a steady state."""
    plant = DriftPlant(model, lifted_rate(model, model.seconds_per_time_unit))
    n, states, inputs = model.n_x, model.states, model.inputs
    nominal = np.zeros(model.n_u)
    bounds = [np.concatenate((states.to_deviation(x), np.where(
        manipulated, inputs.to_deviation(u), nominal)))
        for x, u in ((states.lower, inputs.lower), (states.upper, inputs.upper))]
    lower, upper = np.minimum(*bounds), np.maximum(*bounds)

    def rate(y: Array) -> Array:
        return plant.rate(y[None, :n], y[None, n:])[0]

    def slope(y: Array) -> Array:
        return plant.slope(y[None, :n], y[None, n:])[0]

    found, y = [], np.zeros(n + model.n_u)
    for value in ((values - states.center[i]) / states.scale[i]).tolist():
        at = np.arange(len(y)) == i
        with np.errstate(all='ignore'):
            # from the steady state before, as a set-point moves
            place = steady_state(rate, slope, np.where(at, value, y), np.where(at, value, lower),
                                 np.where(at, value, upper), anchor=y)
        found.append(place is not None)
        y = y if place is None else place
    return np.array(found)
