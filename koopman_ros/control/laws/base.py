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
    """
    Quadratic cost on scaled deviations from the target: e' Q e + v' R v.

    :param Q: (n_x, n_x) symmetric, positive semidefinite, not zero.
    :param R: (n_u, n_u) symmetric, positive definite.
    """

    Q: Array
    R: Array


@dataclass(frozen=True)
class Tuning:
    """
    What every law is built from, beside its model.

    :param weights: the cost.
    :param max_gain: bound on the spectral norm of a gain in scaled coordinates.
    :param max_residual: bound on the relative residual of a Riccati equation.
    """

    weights: Weights
    max_gain: float = 1e6
    max_residual: float = 1e-8


@dataclass(frozen=True)
class Figures:
    """
    What a law says of its solution; NaN and '' for what it does not have.

    :param form: which form of the law was used, for the operator.
    :param residual: relative residual of the Riccati equation.
    :param gain: norm of the gain.
    :param growth: factor by which the error is predicted to change from a sample to the next.
    """

    form: str = ''
    residual: float = math.nan
    gain: float = math.nan
    growth: float = math.nan


NO_FIGURES = Figures()


@dataclass(frozen=True)
class LawResult:
    """
    What a law gives, or why it gives nothing.

    :param u: (n_u,) in input units, within the range of the limits; None with a failure.
    :param failure: why it may not be used; None when it may.
    :param figures: of the solution, as far as there is one.
    :param memory: what the law wants to be given at the next sample.
    :param clipped: whether the range cut it.
    """

    u: Array | None
    failure: Reason | None = None
    figures: Figures = NO_FIGURES
    memory: object = None
    clipped: bool = False


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
