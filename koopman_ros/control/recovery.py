# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Recovery from the safe input, where that keeps the plant outside the training data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from koopman_ros.core.arrays import Array
from koopman_ros.core.solvers import decaying
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.model import LiftedModel
from koopman_ros.model.steady_state import resting_state


@dataclass(frozen=True)
class ReturnSettings:
    """When a plant under the safe input rests, and how the input leads it back."""

    #: share of the way from the safe input to the nominal one by which the input is ahead of the
    #: plant; a frozen sensor moves it no further
    lead: float = 0.25
    #: change of the distance from the middle of the training box, as a share of it, that counts
    #: as a motion
    moved: float = 0.03
    rest: float = 3.0  #: recovery times without a motion after which the plant rests


@dataclass(frozen=True, slots=True)
class SafeStateRecovery:
    """
    How far a plant under the safe input has come back, by its distance from the training data.

    Where the safe input itself keeps the plant outside, no law may act, and waiting does not
    help. The input then moves towards the nominal one: by `lead`, and by the share of the
    distance that the plant has left behind already. No model is asked how the plant moves out
    there. One that does not follow, or a sensor that does not, stops the input where it is.
    """

    farthest: float  #: where it rested under the safe input, in half-ranges of the training box
    nearest: float  #: smallest distance since then
    since_ns: int  #: from when it has rested
    led: bool = False  #: whether the input has begun to move
    settings: ClassVar[ReturnSettings] = ReturnSettings()

    def moved(self, outside: float, time_ns: int, recovery_time: float, dead_time: float
              ) -> SafeStateRecovery | None:
        """
        Take a distance in half-ranges into account; None where the safe input led it back.

        A plant that still moves under the safe input is waited for; one that moves further out
        than where the way began starts it again. Whether it moves is not seen before the input
        acts, after a dead time in s, which may be twice as long as known.
        """
        if not (outside > 0.0 or self.led):
            return None
        change, still = (
            outside - self.farthest, self.settings.moved * (1.0 + self.farthest))
        if change > still or (change < -still and not self.led):
            return SafeStateRecovery(outside, outside, time_ns)
        led = self.led or (time_ns - self.since_ns) / NANOSECONDS >= (
            self.settings.rest * recovery_time + 2.0 * dead_time)
        return SafeStateRecovery(self.farthest, min(self.nearest, outside), self.since_ns, led)

    @property
    def share(self) -> float:
        """The share of the nominal input in the command, from 0 to 1."""
        return min(1.0, self.settings.lead + 1.0 - self.nearest / self.farthest) if (
            self.led) else 0.0


def moves_toward_nominal(model: LiftedModel, x: Array, safe: Array, nominal: Array) -> bool:
    """
    Whether the nominal input drives a state towards the nominal one, compared with the safe input.

    On the other side, as that of a runaway, it is the safe input that does. State (n_x,) and
    inputs (n_u,) are in their units.
    """
    difference = model.inputs.to_deviation(nominal) - model.inputs.to_deviation(safe)
    deviation = model.states.to_deviation(x)
    return bool(deviation @ model.forcing(deviation, difference) < 0.0)


@dataclass(frozen=True)
class RestState:
    """Where the safe input leads the plant, according to its model."""

    #: (n_x,) in state units; where it leaves what the model knows, a linear extrapolation from
    #: there, and NaN where that does not come to rest
    x: Array
    outside: float  #: its distance from the training data in half-ranges; NaN if x is NaN
    #: (n_u,) input that would keep the plant where it leaves what the model knows, in input units;
    #: None where it comes to rest before
    holding: Array | None = None


def rest_under(model: LiftedModel, u: Array, known: float, *, halvings: int = 20) -> RestState:
    """
    Find where an input leads the model from its nominal state, by the steady states on the way.

    :param u: (n_u,) in input units.
    :param known: distance outside the training data, in half-ranges, up to which the model holds.
    :param halvings: of the way from the nominal input, to the last one that keeps it there.
    """
    v = model.inputs.to_deviation(u)
    reached, beyond, x = 0.0, 1.0, np.zeros(model.n_x)
    try:
        with np.errstate(all='ignore'):
            share = 1.0
            for _ in range(1 + halvings):
                found = resting_state(model, share * v, 0.0, x)
                if found is not None and model.distance(model.states.to_physical(found)) <= known:
                    reached, x = share, found
                    if share == 1.0:
                        place = model.states.to_physical(x)
                        return RestState(place, model.distance(place))
                else:
                    beyond = share
                share = 0.5 * (reached + beyond)
            return _beyond(model, x, v, reached)
    except np.linalg.LinAlgError:
        # a model that gives no finite numbers also fails in the loop
        return RestState(np.full(model.n_x, np.nan), np.nan)


def _beyond(model: LiftedModel, x: Array, u: Array, reached: float) -> RestState:
    """Extrapolate from a state (n_x,) held by a share of an input (n_u,), all scaled."""
    slope = model.drift_jacobian(x) + model.forcing_jacobian(x, u)
    place, outside = np.full(model.n_x, np.nan), np.nan
    if np.all(np.isfinite(slope)) and decaying(np.linalg.eigvals(slope)).all():
        place = model.states.to_physical(x - np.linalg.solve(slope, model.rate_under(u)(x)))
        outside = model.distance(place)
    return RestState(place, outside, model.inputs.to_physical(reached * u))
