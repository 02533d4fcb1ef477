# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The paper's two-state example: learned on a wide box, on narrow boxes, and by Algorithm 1."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.integrate import solve_ivp

from koopman_ros import learning
from koopman_ros.control import averaged, Feedback, recentred, Target, Weights
from koopman_ros.core.arrays import Array
from koopman_ros.core.datasets import DriftSamples
from koopman_ros.evaluation import ClosedLoop, run_closed_loop
from koopman_ros.model import LiftedModel
from koopman_ros.plants import box_episodes, describe, RandomStepDesign, two_state_example
from studies.campaign import Metrics, Models
from studies.paper.optimal_control import (
    exact_two_state_cost,
    exact_two_state_gain,
    exact_two_state_model,
)


@dataclass(frozen=True)
class StateRange:
    """A training box."""

    lower: tuple[float, float]  #: lower corner in (x1, x2)
    upper: tuple[float, float]  #: upper corner
    inputs: tuple[float, float]  #: lowest and highest input of the random steps


START = np.array([5.0, 5.0])
# Weights of u^2 against x1^2 + x2^2; the paper does not say which it used.
INPUT_WEIGHTS = (1.0, 0.1, 0.001)
# of the law within the horizon: some ten times what a smooth loop takes
_MAX_EVALUATIONS = {1.0: 4_000, 0.1: 6_000, 0.001: 15_000}
HORIZON = 80.0  # s, in which x1 decays to 0.002
# Lower and upper corner in (x1, x2). The wide box holds the whole path from (5, 5) to the
# origin, the narrow ones only its beginning.
WIDE = StateRange((-6.0, -6.0), (6.0, 8.0), (-20.0, 60.0))
NARROW = {
    '[2,6]x[2,8]': StateRange((2.0, 2.0), (6.0, 8.0), (0.0, 40.0)),
    '[3,6]x[3,8]': StateRange((3.0, 3.0), (6.0, 8.0), (0.0, 40.0)),
    '[4,5.5]x[4,5.5]': StateRange((4.0, 4.0), (5.5, 5.5), (5.0, 35.0)),
}
WIDE_RECIPE = learning.IncrementalTraining(3, hidden_first=16, max_iterations=600)
NARROW_RECIPE = learning.IncrementalTraining(3)
PAPER_RECIPE = learning.Algorithm1(3, identity=True, hidden=16, max_iterations=100)
STARTS = 2
SYSTEM = two_state_example()


def samples(box: StateRange, seed: int, episodes: int = 40, duration: float = 1.0) -> DriftSamples:
    """Simulate random steps of the input from states in a box, which they do not leave; in s."""
    design = RandomStepDesign(
        input_lower=box.inputs[0], input_upper=box.inputs[1], state_lower=box.lower,
        state_upper=box.upper, hold_time=(0.05, 0.1), sample_period=0.05,
        max_redraws=20, rtol=1e-9)
    return box_episodes(SYSTEM, design, episodes, duration, seed)


def _law(model: LiftedModel, x: Array, target: Target, weights: Weights) -> Feedback:
    """Evaluate the paper's law, or the averaged one where its Riccati equation has no answer."""
    found = recentred(model, x, target, weights)
    return found if found.solved else averaged(model, x, target, weights)


def close_loop(model: LiftedModel, R: float, law: Callable[..., Feedback] = _law) -> ClosedLoop:
    """
    Regulate the true system from (5, 5) to the origin, by the paper's law by default.

    The cost is the integral of x1^2 + x2^2 + R u^2.
    """
    weights = Weights.physical(model, [1.0, 1.0], [R])
    return run_closed_loop(model, SYSTEM.derivative, START, np.zeros(2), weights, HORIZON,
                           law=law, escape=100.0, samples=1601,
                           max_evaluations=_MAX_EVALUATIONS[R])


@cache
def exact_loop(R: float) -> ClosedLoop:
    """Regulate the system from (5, 5) by the linear-quadratic law of its exact lift."""
    lift = exact_two_state_model()
    K = exact_two_state_gain(R)
    times = np.linspace(0.0, HORIZON, 1601)

    def act(x: Array) -> Array:
        return -K @ lift.lift(x)

    path = solve_ivp(lambda _, x: SYSTEM.derivative(x, act(x)), (0.0, HORIZON), START,
                     method='DOP853', t_eval=times, rtol=1e-9, atol=1e-12).y.T
    return ClosedLoop(times, path, np.array([act(x) for x in path]),
                      exact_two_state_cost(START, R))


def run(seed: int) -> tuple[Metrics, Models]:
    """
    Learn on the wide box.

    :return: as :func:`judged`, and for each weight `linear_cost_ratio`; for R = 1
        `edmd_cost_ratio` of the averaged law.
    """
    data, plant = samples(WIDE, seed), describe(SYSTEM)
    model = _learned(data, WIDE_RECIPE, seed, STARTS)
    linear = learning.Linearisation(SYSTEM.drift_jacobian(np.zeros(2))).learn(plant, data)
    edmd = learning.Edmd(degree=2).learn(plant, data)
    return {**judged(model, seed), 'linear_cost_ratio': {
        f'R={R:g}': _ratio(close_loop(linear, R), R) for R in INPUT_WEIGHTS},
        'edmd_cost_ratio': {'R=1': _ratio(close_loop(edmd, 1.0, averaged), 1.0)},
    }, {'wide': model, 'linear': linear}


def run_narrow(seed: int) -> tuple[Metrics, Models]:
    """
    Learn on narrow boxes and regulate from (5, 5) out of them, with R = 1.

    :return: for each box and figure, named ``<box>/<figure>``: `rw_in` within the box,
        `cost_ratio_to_exact` (None when the state escapes), `left_box`, and
        `final_distance`, |x| at the end.
    """
    metrics: Metrics = {}
    models = {}
    for name, box in NARROW.items():
        test = samples(box, 1000 + seed)
        model = models[name] = _learned(samples(box, seed), NARROW_RECIPE, seed)
        loop = close_loop(model, 1.0)
        end = None if loop.failure else float(np.linalg.norm(loop.states[-1]))
        metrics.update({
            f'{name}/rw_in': learning.fit(model, test.x, test.dxdt, test.u).rw,
            f'{name}/cost_ratio_to_exact': _ratio(loop, 1.0),
            f'{name}/left_box': loop.distance(model) > 0.0, f'{name}/final_distance': end})
    return metrics, models


def run_paper(seed: int) -> tuple[Metrics, Models]:
    """Run Algorithm 1 once on the wide box; all figures are None when the lift is degenerate."""
    try:
        model = _learned(samples(WIDE, seed), PAPER_RECIPE, seed)
    except learning.TrainingFailed:
        return {'rw': None, 'rx': None, 'cond': None, 'eigenvalue_error': None,
                'cost_ratio_to_exact': {f'R={R:g}': None for R in INPUT_WEIGHTS},
                'left_box': None}, {}
    return judged(model, seed), {'paper_two_state': model}


def _learned(data: DriftSamples, recipe: learning.IncrementalTraining | learning.Algorithm1,
             seed: int, starts: int = 1) -> LiftedModel:
    return learning.train(describe(SYSTEM), data, recipe, seed=seed, starts=starts,
                          reject=False).model


def judged(model: LiftedModel, seed: int) -> Metrics:
    """
    Judge a lift of the wide box on fresh samples and by its closed loops.

    :return: `rw`, `rx`, `cond`; `eigenvalue_error`, the largest of the three; for each weight
        `cost_ratio_to_exact`; `left_box`.
    """
    test = samples(WIDE, 1000 + seed)
    found = learning.fit(model, test.x, test.dxdt, test.u)
    exact = np.sort(np.linalg.eigvals(exact_two_state_model().A).real)
    error = np.abs(np.sort_complex(model.eigenvalues) - exact)
    loops = {R: close_loop(model, R) for R in INPUT_WEIGHTS}
    return {'rw': found.rw, 'rx': found.rx, 'cond': found.cond,
            'eigenvalue_error': float(np.max(error)),
            'cost_ratio_to_exact': {f'R={R:g}': _ratio(loop, R) for R, loop in loops.items()},
            'left_box': any(loop.distance(model) > 0.0 for loop in loops.values())}


def _ratio(loop: ClosedLoop, R: float) -> float | None:
    return None if loop.failure else loop.cost / exact_two_state_cost(START, R)
