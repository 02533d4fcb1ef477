# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The receding-horizon law; the solver is loaded when it is constructed."""

from __future__ import annotations

from dataclasses import dataclass
import math
import time
from typing import ClassVar, TYPE_CHECKING

import numpy as np

from koopman_ros.control.laws.base import LaterInputs, Law, LawResult, SolutionInfo, Target
from koopman_ros.control.laws.riccati import StateDependentRiccati
from koopman_ros.control.mpc.grid import PlanningSettings
from koopman_ros.core.arrays import Array
from koopman_ros.core.declaration import (
    NO_LOWER,
    NO_UPPER,
    parameter,
    Settings,
    UNBOUNDED,
    value_column,
)
from koopman_ros.core.status import Reason, reason, StatusCode
from koopman_ros.estimation import Estimate
from koopman_ros.model import LiftedModel
from koopman_ros.tuning import Tuning

if TYPE_CHECKING:
    from koopman_ros.control.mpc.planner import Planner

_PACKAGE = 'daqp'


@dataclass(frozen=True)
class MPCParameters(Settings):
    """Soft limits of the states, and the time limit of a plan."""

    lower: Array = value_column(
        'states', -UNBOUNDED, 'Soft lower limit of this state.', name='min', none=NO_LOWER)
    upper: Array = value_column(
        'states', UNBOUNDED, 'Soft upper limit of this state.', name='max', none=NO_UPPER)
    time_limit: float = parameter(
        0.0, 'Computing time of a plan above which the next law takes over; 0: no '
             'limit.', 's', 0.0, 3600.0)


class RecedingHorizon(Law):
    """
    Plan the inputs over a horizon at each sample, and command the first.

    The plan minimises the integral of e'Q e + v'R v over the horizon plus the cost of the sampled
    regulator from its end on, for the model's drift under the estimated disturbance. The plan of
    the sample before is linearised, a quadratic program gives its change, and so on until that is
    negligible. Range and rate of the inputs are constraints, the limits of the states are soft.

    Direct multiple shooting by Runge-Kutta steps with their sensitivities, condensed to the
    inputs; see M. Diehl, H. G. Bock, J. P. Schloeder, "A real-time iteration scheme for nonlinear
    optimization in optimal feedback control", SIAM J. Control Optim. 43 (2005).
    """

    Parameters = MPCParameters
    parameters: MPCParameters
    settings: ClassVar[PlanningSettings] = PlanningSettings()

    def __init__(self, model: LiftedModel, tuning: Tuning, parameters: MPCParameters) -> None:
        super().__init__(model, tuning, parameters)
        if not np.all(parameters.lower < parameters.upper):
            raise ValueError('state limits must be min < max, got '
                             f'{np.asarray(parameters.lower).tolist()} and '
                             f'{np.asarray(parameters.upper).tolist()}')
        self._riccati = StateDependentRiccati(model, tuning, None)
        #: computes the plans; None where it cannot be loaded
        self.planner: Planner | None = None
        self._unusable: Reason | None = None
        try:
            import koopman_ros.control.mpc.planner as planner
        except ImportError:
            self._unusable = reason(StatusCode.PACKAGE_MISSING, package=_PACKAGE)
            return
        self.planner = planner.Planner(model, tuning, self.weights, self.settings, *(
            np.broadcast_to(bound, model.n_x) for bound in (parameters.lower, parameters.upper)))

    def unusable(self) -> Reason | None:
        """Return that its package is not installed."""
        return self._unusable

    def horizon(self, interval: float) -> float:
        """Return the length of a plan, which tracks scheduled set-points."""
        return 0.0 if self.planner is None else (
            float(self.planner.grid(interval).times[-1]) * self.model.seconds_per_time_unit)

    def compute(self, estimate: Estimate, target: Target, memory: object, interval: float,
                previous: Array | None) -> LawResult:
        """
        Find the input for an estimate; see :class:`~koopman_ros.control.laws.base.Law`.

        At the first sample, whose interval is not known, it is that of the Riccati equation.
        """
        return self._planned(estimate, target, memory, interval, previous, None)

    def compute_later(self, estimate: Estimate, target: Target, memory: object, interval: float,
                      previous: Array | None, later: LaterInputs) -> LawResult | None:
        """Plan each input from the time on at which its command acts."""
        return None if previous is None or not interval > 0.0 else (
            self._planned(estimate, target, memory, interval, previous, later))

    def _planned(self, estimate: Estimate, target: Target, memory: object, interval: float,
                 previous: Array | None, later: LaterInputs | None) -> LawResult:
        planner = self.planner
        if planner is None:
            return LawResult(None, self._unusable)
        if not interval > 0.0:
            return self._riccati.compute(estimate, target, None, interval, previous)
        began, limit = time.perf_counter(), self.parameters.time_limit or math.inf
        settings = self.settings
        try:
            problem = planner.problem(estimate, target, interval, previous, later)
            u, x = planner.first_guess(problem, memory)
            for iteration in range(1, settings.iterations + 1):
                found = planner.improve(problem, u, x)
                if isinstance(found, Reason):
                    return LawResult(None, found, passing=True)
                change, u, x = found
                spent = time.perf_counter() - began
                if iteration == 1 and spent > limit:
                    return LawResult(None, reason(
                        StatusCode.TOO_LATE, seconds=spent, deadline=limit), passing=True)
                if change <= settings.converged or spent * (iteration + 1) / iteration > limit:
                    break
        except np.linalg.LinAlgError as error:
            return LawResult(None, reason(StatusCode.SINGULAR, matrix=str(error)))
        if not change <= settings.usable:
            return LawResult(None, reason(StatusCode.PLAN_MOVES, iterations=iteration),
                             passing=True)
        # a state outside the training data may return from there
        here, *ahead = self.model.distances(np.concatenate((
            x[:-1:settings.checked], x[-1:]))).tolist()
        if max(ahead) > max(self.margin, here) + settings.rounding:
            return LawResult(None, reason(
                StatusCode.PLAN_OUTSIDE, outside=max(ahead), margin=self.margin))
        plan = planner.plan(problem, u, x)
        return LawResult(
            self.model.inputs.to_physical(problem.commanded(u)), info=SolutionInfo('planned'),
            memory=(u, x, problem.grid.lengths), plan=plan, clipped=bool(plan.at_range.any()))
