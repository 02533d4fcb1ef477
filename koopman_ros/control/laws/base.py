# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What a law is: a plug that turns an estimate and a target into an input."""

from dataclasses import dataclass
import math
from typing import Protocol

from koopman_ros.arrays import Array
from koopman_ros.control.limits import InputLimits
from koopman_ros.control.target import Target
from koopman_ros.estimation import Estimate
from koopman_ros.lifting import LiftedModel
from koopman_ros.reasons import Reason


@dataclass(frozen=True)
class Weights:
    """Quadratic cost on scaled deviations from the target: e' Q e + v' R v."""

    Q: Array  #: (n_x, n_x) symmetric, positive semidefinite, not zero
    R: Array  #: (n_u, n_u) symmetric, positive definite


@dataclass(frozen=True)
class Tuning:
    """What every law is built from, beside its model."""

    weights: Weights  #: the cost
    max_gain: float = 1e6  #: bound on the spectral norm of a gain in scaled coordinates
    max_residual: float = 1e-8  #: bound on the relative residual of a Riccati equation


@dataclass(frozen=True)
class Figures:
    """What a law says of its solution; NaN and '' for what it does not have."""

    form: str = ''  #: which form of the law was used, for the operator
    residual: float = math.nan  #: relative residual of the Riccati equation
    gain: float = math.nan  #: norm of the gain
    #: factor by which the error is predicted to change from a sample to the next
    growth: float = math.nan


NO_FIGURES = Figures()


@dataclass(frozen=True)
class LawResult:
    """What a law gives, or why it gives nothing."""

    u: Array | None  #: (n_u,) in input units, within the range of the limits; None with a failure
    failure: Reason | None = None  #: why it may not be used; None when it may
    figures: Figures = NO_FIGURES  #: of the solution, as far as there is one
    memory: object = None  #: what the law wants to be given at the next sample
    clipped: bool = False  #: whether the range cut it


class Law(Protocol):
    """
    A control law on a model; pure, what it remembers goes out and comes in.

    To add one: write a class like :class:`~koopman_ros.control.laws.linear.Linear` in any module,
    whose constructor takes the lift and a :class:`Tuning`, and name it in the levels of the
    settings as module:class.
    """

    @property
    def model(self) -> LiftedModel:
        """The model in whose terms estimate and target are, in the units of the lift."""
        ...

    def compute(self, estimate: Estimate, target: Target, limits: InputLimits, memory: object,
                interval: float, deadline: float = math.inf) -> LawResult:
        """
        Find the input for an estimate.

        :param estimate: in terms of :attr:`model`.
        :param target: likewise.
        :param limits: of the inputs; the command is brought within them afterwards anyhow.
        :param memory: of the result before, None at first and after another law.
        :param interval: seconds between samples; 0 when they are not known.
        :param deadline: seconds that it may take; a law that iterates returns its best by then.
        """
        ...
