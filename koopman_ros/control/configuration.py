# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The configuration of a control loop: a model, its tuning, and values derived from both."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from koopman_ros.control.estimates import StateEstimation
from koopman_ros.control.fallback import build_levels, FallbackLevel
from koopman_ros.control.supervisor import FallbackOrder
from koopman_ros.core.arrays import Array, expect, read_only, short_repr
from koopman_ros.core.signals import Outputs
from koopman_ros.model import Coordinates, LiftedModel
from koopman_ros.tuning import Tuning


@dataclass(frozen=True)
class Configuration:
    """
    A model with its tuning.

    :raises ValueError: when the tuning does not fit the model's signals, or the measured signals
        do not suffice for the estimator.
    """

    model: LiftedModel  #: the lift
    tuning: Tuning  #: with one number for each signal
    #: measured outputs; by default the states that were measured in the model's training record
    outputs: Outputs | None = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        expect(model=(self.model, LiftedModel), tuning=(self.tuning, Tuning))
        object.__setattr__(self, 'tuning', self.tuning.for_signals(
            self.model, self.measured.names))
        # reject now if a part cannot be built, and keep the built parts
        assert self.order

    @cached_property
    def measured(self) -> Outputs:
        """The measured outputs: y = C x."""
        states, rows = self.model.states, self.model.measured
        own = states.only([states.names[i] for i in rows])
        return self.outputs or Outputs(own.names, own.units, np.eye(len(states))[rows])

    @cached_property
    def levels(self) -> dict[str, FallbackLevel]:
        """The levels with a law, by name, best first."""
        return build_levels(self.model, self.measured, self.tuning)

    @cached_property
    def order(self) -> FallbackOrder:
        """The order of all levels."""
        return FallbackOrder(
            tuple(self.levels), tuple(level.law.margin for level in self.levels.values()),
            self.tuning.hold_timeout, self.tuning.recovery_time, self.tuning.safe_latch)

    @cached_property
    def best(self) -> FallbackLevel:
        """The first level."""
        return next(iter(self.levels.values()))

    @property
    def controlled(self) -> Coordinates:
        """The states with a set-point."""
        return self.best.controlled_states

    @cached_property
    def estimation(self) -> StateEstimation:
        """The estimators of the levels."""
        return StateEstimation(self.model, self.measured, self.tuning, self.levels)

    @cached_property
    def safe_input(self) -> Array:
        """The safe input (n_u,), commanded when no law can act, in input units."""
        return read_only(self.tuning.limits.within(self.tuning.safe_value))

    @cached_property
    def nominal_input(self) -> Array:
        """The nominal input (n_u,) within its limits, in input units."""
        return read_only(self.tuning.limits.within(self.model.inputs.center))

    @cached_property
    def ranges(self) -> tuple[tuple[str, float, float], ...]:
        """(name, lower, upper) of the states' trained ranges."""
        states = self.model.states
        return tuple(zip(states.names, states.lower.tolist(), states.upper.tolist(), strict=True))
