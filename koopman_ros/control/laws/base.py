# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Control laws: the contract of a plug-in, its target and its result."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import cached_property
import math
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from koopman_ros.core.arrays import Array, frozen
from koopman_ros.core.declaration import NoParameters
from koopman_ros.core.status import Reason
from koopman_ros.estimation import Estimate
from koopman_ros.model import LiftedModel
from koopman_ros.tuning import Tuning


@dataclass(frozen=True, slots=True)
class Target:
    """A set-point with the input that holds it, in scaled deviations."""

    x: Array  #: (n_x,) reference state
    u: Array  #: (n_u,) input that balances drift and disturbance
    forcing: Array  #: (n_x,) B(x_ref) u_ref + w, added to the drift
    residual: float  #: size of the rate that no input balances; 0 where x can be held
    #: later targets with the seconds until then, as far as the law looks ahead
    later: tuple[tuple[float, Target], ...] = ()

    @classmethod
    def at(cls, model: LiftedModel, y: Array, w: Array | float = 0.0) -> Self:
        """Return the target at a state and its input, y (n_x + n_u,), under a disturbance."""
        x, u = y[:model.n_x], y[model.n_x:]
        forcing = model.forcing(x, u) + w
        return cls(x, u, forcing, math.hypot(*(model.drift(x) + forcing).tolist()))

    def after(self, seconds: float) -> Target:
        """Return the target of a later time."""
        passed = [target for until, target in self.later if until <= seconds]
        return replace(passed[-1] if passed else self, later=tuple(
            (until - seconds, target) for until, target in self.later if until > seconds))


# Weight of a rate as the input of a law, as a share of that of its integral, the command.
_RATE_SHARE = 0.1


@dataclass(frozen=True)
class Weights:
    """
    Quadratic cost on scaled deviations from the target: e' Q e + v' R v.

    :raises ValueError: naming the matrix that is not square, symmetric and definite.
    """

    Q: Array  #: (n_x, n_x) symmetric, positive semidefinite, not zero
    R: Array  #: (n_u, n_u) symmetric, positive definite

    def __post_init__(self) -> None:
        for name, least in (('Q', 'semidefinite and not zero'), ('R', 'definite')):
            shape = np.shape(getattr(self, name))
            if len(shape) != 2 or shape[0] != shape[1]:
                raise ValueError(f'incompatible {name}: expected a square matrix, got {shape}; '
                                 'Weights.physical takes one weight per signal')
            M = frozen(getattr(self, name), name, shape)
            values = np.linalg.eigvalsh(M)
            size = float(np.max(np.abs(values), initial=0.0))
            definite = np.all(values > 0.0) if name == 'R' else (
                size > 0.0 and np.all(values >= -1e-9 * size))
            if not (definite and np.allclose(M, M.T, rtol=1e-9, atol=1e-12 * size)):
                raise ValueError(f'{name} must be symmetric, positive {least}, got {M.tolist()}')
            object.__setattr__(self, name, M)

    def check(self, model: LiftedModel) -> None:
        """Raise a ValueError for weights of another number of states or inputs than a model's."""
        for name, matrix, n in (('Q', self.Q, model.n_x), ('R', self.R, model.n_u)):
            if matrix.shape != (n, n):
                raise ValueError(f'incompatible {name}: expected {(n, n)}, got {matrix.shape}')

    @classmethod
    def physical(cls, model: LiftedModel, states: ArrayLike, inputs: ArrayLike) -> Self:
        """
        Return the weights on a model's scaled deviations that weigh its signals in their units.

        The weight of an input whose command is a state is one of that state, and its rate has
        little.

        :param states: (n_x,) weights of squared state errors, per state unit squared.
        :param inputs: (n_u,) weights of squared input deviations, per input unit squared.
        :raises ValueError: for other sizes, and as the class.
        """
        Q, R = (
            np.diag(frozen(weights, f'{name} weights', (len(signals),)) * signals.scale ** 2)
            for name, weights, signals in (
                ('state', states, model.states), ('input', inputs, model.inputs)))
        for j, i in model.commanded.items():
            Q[i, i] = R[j, j] * (model.states.scale[i] / model.inputs.scale[j]) ** 2
            R[j, j] *= _RATE_SHARE
        return cls(Q, R)


class SolutionInfo(NamedTuple):
    """Figures of a law's solution; NaN and '' for those that it does not have."""

    form: str = ''  #: which form of the law was used, for the operator
    residual: float = math.nan  #: relative residual of the Riccati equation
    gain: float = math.nan  #: norm of the gain
    #: factor by which the error is predicted to change from a sample to the next
    growth: float = math.nan


NO_SOLUTION = SolutionInfo()


@dataclass(frozen=True, slots=True)
class Plan:
    """
    The plan of a law with a horizon, in units of states and inputs, and its active limits.

    A limit is -1 if the lower one is active, 1 for the upper one, and 0 for none.
    """

    times: Array  #: (N + 1,) of the nodes in s, from 0, when the plan was made
    states: Array  #: (N + 1, n_x) at the nodes
    inputs: Array  #: (N, n_u) each held from a node to the next
    at_range: Array  #: (n_u,) whether the first input is at the end of its range
    at_rate: Array  #: (n_u,) whether it falls (-1) or rises (1) as fast as it may
    at_state: Array  #: (n_x,) whether a node is at a limit of the state, or beyond


@dataclass(frozen=True, slots=True)
class LawResult:
    """The result of a law: an input, or the reason of its failure."""

    #: (n_u,) in input units, which the controller brings within the limits; None with a failure
    u: Array | None
    failure: Reason | None = None  #: why it may not be used; None when it may
    info: SolutionInfo = NO_SOLUTION  #: about the solution, as far as there is one
    memory: object = None  #: passed to the law at the next sample
    plan: Plan | None = None  #: of a law with a horizon
    clipped: bool = False  #: whether the range cut it
    #: whether a failure is of this sample alone, so that the law acts again at the next
    passing: bool = False


@dataclass(frozen=True, slots=True)
class LaterInputs:
    """Commands of some inputs act later than those of others; until then earlier ones act."""

    seconds: Array  #: (n_u,) until a command of now acts; 0 for the first that does
    #: durations in s and inputs (n_u,), in their units, that act one after another until then
    pieces: list[tuple[float, Array]]


class Law(ABC):
    """
    A control law on a model: from an estimate and a target to an input.

    To add one, derive a class in any module and name it in `fallback_order` as ``module:Class``.
    It is constructed when the controller is configured, and then called at each sample. Its memory
    is returned as `memory` and passed in at the next sample; the law itself has no state, so a
    replay gives the same commands. An exception is a failure: the next level acts.

    Example::

        @dataclass(frozen=True)
        class Gain:
            gain: float = parameter(2.0, 'Proportional gain.', '', 0.0, 100.0)

        class Proportional(Law):
            Parameters = Gain

            def compute(self, estimate, target, memory, interval, previous):
                u = target.u - self.parameters.gain * (estimate.x - target.x)
                return LawResult(self.model.inputs.to_physical(u))

    It is tuned by the parameter ``Proportional.gain``.
    """

    #: frozen dataclass of its own parameters, see :mod:`koopman_ros.core.declaration`
    Parameters: ClassVar[type[Any]] = NoParameters
    #: whether it tracks the set-point without the model's steady state
    model_free: ClassVar[bool] = False
    #: whether it acts up to `linear_model_margin`, in place of `learned_model_margin`
    extrapolates: ClassVar[bool] = False
    #: whether it reads the covariance of an estimate, predicted over a dead time only if so
    reads_covariance: ClassVar[bool] = False

    def __init__(self, model: LiftedModel, tuning: Tuning, parameters: Any) -> None:
        """
        Prepare the law; a ValueError rejects the configuration.

        :param model: the lift.
        :param tuning: with one number for each signal of the model.
        :param parameters: its own, of the class :attr:`Parameters`.
        """
        #: model in whose scaled deviations estimates and targets are given
        self.model = model
        self.tuning = tuning
        self.parameters = parameters

    def __reduce__(self) -> tuple[Any, ...]:
        # without state it is what it was constructed from; a cache need not be pickled
        return type(self), (self.model, self.tuning, self.parameters)

    @cached_property
    def weights(self) -> Weights:
        """The cost on scaled deviations."""
        return Weights.physical(self.model, self.tuning.state_weight, self.tuning.input_weight)

    @property
    def margin(self) -> float:
        """The distance outside the training data, in half-ranges, up to which it acts."""
        tuning, data = self.tuning, self.model.training_states
        given = tuning.linear_model_margin if self.extrapolates else tuning.learned_model_margin
        # training states of several dimensions are farther apart than a margin of one
        return given if data is None else max(given, data.fill_distance)

    def unusable(self) -> Reason | None:
        """Return why it can never act, as for a missing package; None where it can."""
        return None

    def horizon(self, interval: float) -> float:
        """Return its horizon in s, at samples every `interval` s; 0 by default."""
        return 0.0

    @abstractmethod
    def compute(self, estimate: Estimate, target: Target, memory: object, interval: float,
                previous: Array | None) -> LawResult:
        """
        Find the input for an estimate.

        :param estimate: in scaled deviations of :attr:`model`, as the target.
        :param memory: of its result before; None at first and after another law.
        :param interval: seconds between samples; 0 when they are not known.
        :param previous: (n_u,) the command before, in input units, as far as it was the law's;
            None at first.
        """

    def compute_later(self, estimate: Estimate, target: Target, memory: object, interval: float,
                      previous: Array | None, later: LaterInputs) -> LawResult | None:
        """
        Find the input where some inputs act later than the others.

        A law that plans ahead does so; of another one, which returns None, each input is computed
        for the state that is predicted for the time at which it acts.

        :param estimate: when the first input acts; otherwise as in :meth:`compute`.
        """
        return None
