# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Cost of a law on the true plant, relative to laws that know the plant."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
import math

import numpy as np

from koopman_ros.control import Feedback, feedback, Form, Target, Weights
from koopman_ros.core.arrays import Array
from koopman_ros.core.solvers import solve_riccati
from koopman_ros.evaluation import run_closed_loop
from koopman_ros.model import LiftedModel
from studies.campaign import Metrics
from studies.general.systems import CASES, Regulation

STARTS = 20
ARRIVED = 0.1  # distance from the nominal state, in half-ranges of the box
HELD_TO = 1.05  # most that a law may cost, over the better of those that know the plant
_MAX_EVALUATIONS = 5000  # of a law; what needs more chatters


@dataclass(frozen=True)
class LoopEnd:
    """How a loop ended."""

    cost: float  #: infinite where the plant did not arrive
    no_gain: bool = False  #: whether the law had none somewhere on the way


@dataclass(frozen=True)
class Known:
    """Results of laws that know the plant, by start."""

    lqr: tuple[LoopEnd, ...]  #: with the linear-quadratic gain of the nominal state
    #: with that of the true drift as :meth:`Regulation.factorised` factorises it
    sdre: tuple[LoopEnd, ...]

    @property
    def better(self) -> tuple[float, ...]:
        """The smaller cost of the two at each start."""
        return tuple(min(one.cost, other.cost)
                     for one, other in zip(self.lqr, self.sdre, strict=True))


@cache
def known(name: str, starts: int) -> Known:
    """Return the reference results: the same for all seeds and models of a case."""
    case = CASES[name]

    def natural(model: LiftedModel, x: Array, target: Target, weights: Weights) -> Feedback:
        scale = model.states.scale
        A = case.factorised(model.states.to_physical(x)) * scale / scale[:, None]
        found = solve_riccati(A, model.B, weights.Q, weights.R)
        return Feedback(target.u - found.K @ (x - target.x), Form.AVERAGED, found, found.loop)

    return Known(tuple(loops(case, case.truth, starts)),
                 tuple(loops(case, case.truth, starts, natural)))


def loops(case: Regulation, model: LiftedModel, starts: int,
          law: Callable[..., Feedback] = feedback) -> list[LoopEnd]:
    """Regulate the true plant by a law on a model, in continuous time, from the first starts."""
    nominal, ends = case.system.nominal_state, []
    for x0 in case.starts(starts):
        solved: list[bool] = []

        def watched(*state: object, solved: list[bool] = solved) -> Feedback:
            found = law(*state)
            solved.append(found.solved)
            return found

        loop = run_closed_loop(
            model, case.system.derivative, x0, nominal, case.weights(model), case.horizon,
            law=watched, u_ref=case.system.nominal_input, samples=2, rtol=1e-4,
            max_evaluations=_MAX_EVALUATIONS)
        away = float(np.max(np.abs(loop.states[-1] - nominal) / case.units[0]))
        ends.append(LoopEnd(loop.cost if away < ARRIVED else math.inf, not all(solved)))
    return ends


def judged(ends: Sequence[LoopEnd], beside: Known) -> Metrics:
    """
    Count and compare how loops ended, start by start.

    :return: `no_gain` and `not_arrived`, numbers of starts; `missed`, the number from which the
        law did not arrive or cost more than HELD_TO times the better law that knows the plant;
        `ratio` and `ratio_worst`, that cost ratio at the median and the largest, over starts
        from which it arrived.
    """
    costs, better = np.array([end.cost for end in ends]), np.array(beside.better)
    arrived = np.isfinite(costs)

    both = arrived & np.isfinite(better)
    ratios = costs[both] / better[both]
    return {'no_gain': sum(end.no_gain for end in ends), 'not_arrived': int(np.sum(~arrived)),
            'missed': int(np.sum(~(arrived & (costs <= HELD_TO * better)))),
            'ratio': float(np.median(ratios)) if len(ratios) else None,
            'ratio_worst': float(np.max(ratios)) if len(ratios) else None}
