# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The one-state reactor: lifts of 2 to 5 coordinates, baselines, and Algorithm 1."""

import numpy as np
from scipy.integrate import solve_ivp

from koopman_ros import learning
from koopman_ros.control import steady_state_target, Weights
from koopman_ros.core.datasets import DriftSamples
from koopman_ros.evaluation import ClosedLoop, run_closed_loop
from koopman_ros.model import LiftedModel
from koopman_ros.plants import (
    box_episodes,
    describe,
    equilibrium_input,
    one_state_reactor,
    random_steps,
    RandomStepDesign,
    sample_derivatives,
)
from studies.campaign import Metrics, Models
from studies.paper.optimal_control import scalar_optimal_cost

SYSTEM = one_state_reactor()
START = float(SYSTEM.nominal_state[0])
SETPOINT = START - 10.0
UNIT = 10.0  # K, in which deviations of temperature and coolant are weighed
INPUT_WEIGHT = 1.0
HORIZON = 30.0  # min
LIFTED_SIZES = (2, 3, 4, 5)
STARTS = 4
# Coolant and reactor in K, times in min. The coolant moves the reactor through the box from end
# to end, short of the fold at 329.37 K beyond which a coolant held warmer lets it run away.
TRAINING = RandomStepDesign(
    input_lower=281.3, input_upper=301.1, state_lower=305.0, state_upper=327.0,
    hold_time=(0.5, 1.0), sample_period=0.25)
IN_RANGE = RandomStepDesign(
    input_lower=281.3, input_upper=300.9, state_lower=305.0, state_upper=327.0,
    hold_time=(2.0, 10.0), sample_period=0.25)
OUT_OF_RANGE = RandomStepDesign(
    input_lower=270.0, input_upper=301.1, state_lower=293.0, state_upper=329.3,
    hold_time=(2.0, 10.0), sample_period=0.25)
RECIPE = learning.IncrementalTraining(max(LIFTED_SIZES), max_iterations=600)
EDMD_DEGREE = 5


def training_samples(seed: int) -> DriftSamples:
    """Simulate 240 episodes of 1 min under random coolant steps from anywhere in the box."""
    return box_episodes(SYSTEM, TRAINING, 240, 1.0, seed)


def random_steps_of(design: RandomStepDesign, episodes: int, duration: float, seed: int
                    ) -> DriftSamples:
    """Simulate random coolant steps from T_ss, with episodes of this length in min, and rates."""
    return sample_derivatives(SYSTEM, [
        random_steps(SYSTEM, design, duration, seed + number) for number in range(episodes)])


def close_loop(model: LiftedModel) -> ClosedLoop:
    """
    Move the true reactor from T_ss to T_ss - 10 K with the model's controller.

    The cost is the integral of e^2 + v^2, e and v the deviations from the set-point and from
    the coolant that really holds it, in units of 10 K.
    """
    weights = Weights.physical(model, [1.0 / UNIT ** 2], [INPUT_WEIGHT / UNIT ** 2])
    return run_closed_loop(
        model, SYSTEM.derivative, np.array([START]), np.array([SETPOINT]), weights, HORIZON,
        u_ref=equilibrium_input(SYSTEM, [SETPOINT]))


def feed_forward_offset(model: LiftedModel) -> float:
    """Return where the reactor settles under the model's steady-state coolant alone, in K."""
    target = steady_state_target(model, model.states.to_deviation(np.array([SETPOINT])))
    assert target is not None
    coolant = model.inputs.to_physical(target.u)
    end = solve_ivp(lambda _, x: SYSTEM.derivative(x, coolant), (0.0, 60.0), [START],
                    method='DOP853', rtol=1e-10, atol=1e-10).y[0, -1]
    return abs(float(end) - SETPOINT)


def judged(model: LiftedModel, held_out: DriftSamples, inside: DriftSamples,
           outside: DriftSamples) -> Metrics:
    """
    Judge a model on fresh episodes and on the task of the paper.

    :param held_out: episodes made like those of the training.
    :param inside: longer ones within the range.
    :param outside: longer ones that leave it.
    :return: `rw`, `cond`; `rollout_rmse_in_kelvin` and `rollout_rmse_out_kelvin` (None when
        it diverges); `tracking_offset_kelvin`, `cost_ratio_to_optimum` (over 30 min, R = 1)
        and `feed_forward_offset_kelvin`.
    """
    found = learning.fit(model, held_out.x, held_out.dxdt, held_out.u)
    loop = close_loop(model)
    optimum = scalar_optimal_cost(SYSTEM, START, SETPOINT, INPUT_WEIGHT, UNIT)
    errors = (learning.rollout_rmse(model, samples) for samples in (inside, outside))
    inner, outer = (None if error is None or not np.isfinite(error[0]) else float(error[0])
                    for error in errors)
    return {
        'rw': found.rw, 'cond': found.cond, 'rollout_rmse_in_kelvin': inner,
        'rollout_rmse_out_kelvin': outer,
        'tracking_offset_kelvin': (
            None if loop.failure else abs(float(loop.states[-1, 0]) - SETPOINT)),
        'cost_ratio_to_optimum': None if loop.failure else loop.cost / optimum,
        'feed_forward_offset_kelvin': feed_forward_offset(model)}


def run(seed: int) -> tuple[Metrics, Models]:
    """
    Grow lifts of 2 to 5 coordinates and compare them with the baselines.

    :return: figures named ``nz=<n>/<figure>``, ``linear/<figure>`` and ``edmd/<figure>``.
    """
    samples, plant = training_samples(seed), describe(SYSTEM)
    models = {f'nz={model.n_z}': model for model in learning.train(
        plant, samples, RECIPE, seed=seed, starts=STARTS, reject=False).path}
    models['linear'] = learning.Linearisation(SYSTEM.drift_jacobian(SYSTEM.nominal_state)).learn(
        plant, samples)
    models['edmd'] = learning.Edmd(EDMD_DEGREE).learn(plant, samples)
    return _all_judged(models, seed), models


def run_paper(seed: int) -> tuple[Metrics, Models]:
    """
    Run Algorithm 1 once for each size, with a free lift and its decoder.

    :return: as :func:`run`; the figures of a degenerate lift are missing.
    """
    samples, models = training_samples(seed), {}
    for n_z in LIFTED_SIZES:
        try:
            models[f'nz={n_z}'] = learning.train(
                describe(SYSTEM), samples, learning.Algorithm1(n_z, max_iterations=100), seed=seed,
                starts=1, reject=False).model
        except learning.TrainingFailed:
            continue
    return _all_judged(models, seed), {f'paper_{name}': model for name, model in models.items()}


def _all_judged(models: dict[str, LiftedModel], seed: int) -> Metrics:
    fresh = (training_samples(1000 + seed), *(
        random_steps_of(design, 10, 30.0, 10_000 * seed + 5_000)
        for design in (IN_RANGE, OUT_OF_RANGE)))
    return {f'{name}/{figure}': value for name, model in models.items()
            for figure, value in judged(model, *fresh).items()}
