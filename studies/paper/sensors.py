# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Lifts of sensor data: sampled, noisy, of a plant that drifted, of half the state."""

from dataclasses import replace

import numpy as np

from koopman_ros import plants
from koopman_ros.control import Controller, InputLimits, SetpointRequest, Tuning
from koopman_ros.control import experiment as experiments
from koopman_ros.core.arrays import Array
from koopman_ros.core.datasets import Episode
from koopman_ros.evaluation import at, run_loop
from koopman_ros.learning import (
    AcceptanceResult,
    evaluate_model,
    learn_lift,
    Thresholds,
    Trained,
    TrainingFailed,
)
from koopman_ros.learning.identification import DriftModel, Identified, identify
from koopman_ros.model import Box, LiftedModel, linearised_model, Provenance
from koopman_ros.plants import ControlAffineSystem, describe, RandomStepDesign
from studies.campaign import Metrics, Models
from studies.paper.reactor import SETPOINT, SYSTEM

NOISE = 0.1  # K
MINUTES = 60.0
PERIOD = 1.0 / 60.0  # min
HEAT_TRANSFER_LEFT = 0.8
N_Z = 3
STARTS = 3
# Coolant and reactor in K, times in min.
DESIGN = RandomStepDesign(
    input_lower=281.33, input_upper=300.55, state_lower=305.0, state_upper=327.0,
    hold_time=(0.5, 2.0), sample_period=PERIOD, rtol=1e-9)
FOULED_DESIGN = replace(DESIGN, input_lower=275.4, input_upper=293.9)
# Around the stable point of the reactor whose concentration moves.
TWO_STATE_DESIGN = replace(DESIGN, input_lower=294.0, input_upper=302.0, state_lower=[0.0, 305.0],
                           state_upper=[1.0, 340.0])
_TESTS = 4
_TEST_MINUTES = 15.0
_NS = 1_000_000_000


def run_noisy(seed: int, noise: float = NOISE) -> tuple[Metrics, Models]:
    """
    Learn from an hour of a noisy sensor, B unknown.

    :return: `rollout_kelvin` (root mean square over an hour of fresh random steps without
        noise), `input_gain_error` (relative), `rw`, `cond`, `degree`,
        `noise_kelvin` as estimated.
    """
    found, learned = _learn(_measured(_drive(SYSTEM, DESIGN, seed), noise, seed), _like(), seed)
    fitted = learned.figures.fit
    assert isinstance(found.drift, DriftModel)
    return {
        'rollout_kelvin': _roll_out_error(learned.model, SYSTEM, DESIGN, seed),
        'input_gain_error': _gain_error(found, SYSTEM),
        'rw': fitted.rw, 'cond': fitted.cond, 'degree': float(found.drift.degree),
        'noise_kelvin': float(found.noise[0]),
    }, {'new': learned.model}


def run_noise_free(seed: int) -> tuple[Metrics, Models]:
    """Learn from the same hour without noise; figures as in :func:`run_noisy`."""
    return run_noisy(seed, 0.0)


def run_drifted(seed: int) -> tuple[Metrics, Models]:
    """
    Retrain on a reactor whose cooling jacket has fouled, from its own loop and an experiment.

    The present lift comes from an hour of noisy data of the clean reactor. The record is ten
    minutes of the loop under that lift and fifty of an experiment.

    :return: `offset_before_kelvin`, `offset_after_kelvin` (of the true temperature from the
        set-point, mean over the last five minutes), `offset_ratio`, `accepted`,
        `rollout_kelvin`, `input_gain_error`.
    """
    _, present = _learn(_measured(_drive(SYSTEM, DESIGN, seed), NOISE, seed), _like(), seed)
    clean = plants.ReactorParameters()
    fouled = plants.one_state_reactor(replace(
        clean, heat_transfer_coefficient=HEAT_TRANSFER_LEFT * clean.heat_transfer_coefficient),
        nominal_state=[314.0])
    before, _ = _controlled(fouled, present.model, SYSTEM.nominal_state, 15.0, seed)
    loop, record = _controlled(fouled, present.model, SYSTEM.nominal_state, 10.0, seed + 1)
    plan = experiments.Experiment(
        duration=3000.0, names=fouled.input_names, lower=np.array([276.0]),
        upper=np.array([293.6]), rate=np.ones(1), home=np.array([286.0]), hold_shortest=30.0,
        hold_longest=150.0, measured=fouled.state_names, measured_lower=np.array([300.0]),
        measured_upper=np.array([328.0]), seed=seed)
    driven = _experiment(fouled, plan, loop[-1], seed + 2)
    found, learned = _learn([record, driven], present.model, seed)
    decision = evaluate_model(found, learned, present.model, Thresholds())
    after, _ = _controlled(fouled, learned.model, before[-1], 15.0, seed)
    offsets = [abs(float(np.mean(x[-300:, 0])) - SETPOINT) for x in (before, after)]
    return {
        'offset_before_kelvin': offsets[0], 'offset_after_kelvin': offsets[1],
        'offset_ratio': offsets[1] / offsets[0], 'accepted': decision.accepted,
        'rollout_kelvin': _roll_out_error(learned.model, fouled, FOULED_DESIGN, seed),
        'input_gain_error': _gain_error(found, fouled),
    }, {'present': present.model, 'new': learned.model}


def run_two_state(seed: int) -> tuple[Metrics, Models]:
    """
    Learn a lift of the temperature alone of a reactor whose concentration moves, too.

    :return: `heldout_kelvin` (of the measurements, noise included), `noise_kelvin` as estimated,
        `linear_kelvin` (of the best linear model), `rollout_kelvin`, `warned` (whether the report
        says that something is not measured), `accepted`.
    """
    system = plants.two_state_reactor()
    path = _drive(system, TWO_STATE_DESIGN, seed)
    like = _like()
    found = identify(like.plant, _measured(path, NOISE, seed, state=1), seed=seed)
    try:
        trained = learn_lift(found, like.plant, N_Z, seed=seed, starts=STARTS)
    except TrainingFailed:
        return {'accepted': False, 'noise_kelvin': float(found.noise[0])}, {}
    decision: AcceptanceResult = evaluate_model(found, trained, like, Thresholds())
    return {
        'heldout_kelvin': float(decision.rmse[0]), 'noise_kelvin': float(decision.noise[0]),
        'linear_kelvin': float(decision.linear_rmse[0]),
        'rollout_kelvin': _roll_out_error(trained.model, system, TWO_STATE_DESIGN, seed, state=1),
        'warned': bool(decision.warnings), 'accepted': decision.accepted,
    }, {'new': trained.model}


def _like() -> LiftedModel:
    """Return a model with the names, units and nominal point of the reactor."""
    plant = describe(SYSTEM)
    box = Box.of(plant, np.array([[305.0], [327.0]]), np.array([[281.3], [301.1]]))
    return linearised_model(
        SYSTEM.drift_jacobian(SYSTEM.nominal_state), SYSTEM.input_matrix(SYSTEM.nominal_state),
        box.states, box.inputs, SYSTEM.time_unit, Provenance(SYSTEM.name))


def _drive(system: ControlAffineSystem, design: RandomStepDesign, seed: int,
           minutes: float = MINUTES) -> Episode:
    episode = plants.random_steps(system, design, minutes, seed)
    return _recorded(episode.x, np.vstack([episode.u, episode.u[-1:]]))


def _measured(path: Episode, noise: float, seed: int, state: int = 0) -> list[Episode]:
    rng = np.random.default_rng([seed, 1])
    x = path.x[:, [state]] + noise * rng.standard_normal((len(path), 1))
    return [replace(path, x=x)]


def _learn(episodes: list[Episode], like: LiftedModel, seed: int) -> tuple[Identified, Trained]:
    found = identify(like.plant, episodes, seed=seed)
    return found, learn_lift(found, like.plant, N_Z, seed=seed, starts=STARTS)


def _gain_error(found: Identified, system: ControlAffineSystem) -> float:
    b = system.input_matrix(system.nominal_state)[0, 0]
    return abs(float(found.drift.input_matrix[0, 0] / b) - 1.0)


def _roll_out_error(model: LiftedModel, system: ControlAffineSystem, design: RandomStepDesign,
                    seed: int, state: int = 0) -> float:
    """Return the root mean square error, in K, over an hour of fresh steps without noise."""
    errors = []
    for number in range(_TESTS):
        truth = _drive(system, design, 10_000 * (seed + 1) + number, _TEST_MINUTES)
        predicted = model.predict(truth.x[0, [state]], truth.u[:-1], PERIOD)
        errors.append(predicted - truth.x[:, [state]])
    return float(np.sqrt(np.mean(np.square(errors))))


def _controlled(system: ControlAffineSystem, model: LiftedModel, x0: Array, minutes: float,
                seed: int) -> tuple[Array, Episode]:
    """Run the control step once a second; return the true path (N, n_x) and the noisy record."""
    controller = Controller(model, Tuning.for_model(
        model, state_weight=np.ones(1), input_weight=np.ones(1),
        limits=InputLimits(np.array([278.15]), np.array([305.15]), np.ones(1)),
        bumpless_transfer_time=30.0))
    rng = np.random.default_rng([seed, 2])
    run = run_loop(
        controller, plants.Process(system, 0, np.asarray(x0), system.nominal_input),
        [at(0.0, SetpointRequest(0, np.array([SETPOINT])))], duration=60.0 * minutes - 1.0,
        sensor=lambda x, _: x + NOISE * rng.standard_normal(len(x)))
    return run.states, _recorded(run.measured, run.commands)


def _experiment(system: ControlAffineSystem, plan: experiments.Experiment, x0: Array, seed: int
                ) -> Episode:
    """Run an experiment as the trainer does; return its noisy record."""
    progress, rng = experiments.begin(plan, _NS), np.random.default_rng([seed, 2])
    process = plants.Process(system, _NS, np.asarray(x0), system.nominal_input)
    measured, inputs = [], []
    for number in range(round(plan.duration)):
        process = process.until((number + 1) * _NS)
        measured.append(process.x + NOISE * rng.standard_normal(system.n_x))
        progress = experiments.advance(plan, progress, measured[-1], process.time_ns)
        inputs.append(progress.command)
        process = replace(process, u=inputs[-1])
    return _recorded(np.array(measured), np.array(inputs))


def _recorded(x: Array, u: Array) -> Episode:
    """Return states (N, n_x) and inputs (N, n_u) held from each of them on, one a second."""
    time = PERIOD * np.arange(len(x), dtype=np.float64)
    return Episode(time, x, time, u)
