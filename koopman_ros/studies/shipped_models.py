# Copyright 2026 The koopman_ros Authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
Training of the models that the package ships: lifts of the one-state reactor and its linear model.

Run it as ``python -m koopman_ros.studies.shipped_models`` (needs the `train` requirements); the
seeds are fixed, so that the same machine writes the same files bit for bit.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
import sys

from koopman_ros.lifting import LiftedModel, linearised_model, Provenance, save
from koopman_ros.lifting.growth import Recipe
from koopman_ros.lifting.training import Plant, Samples, train, Trained
from koopman_ros.lifting.validation import roll_out
from koopman_ros.plants import (
    ControlAffineSystem,
    one_state_reactor,
    random_steps,
    RandomStepDesign,
    sample_derivatives,
)
from koopman_ros.studies.progress import TrainingProgress
import numpy as np

# The coolant moves the reactor through its training box from end to end, short of the fold at
# 329.37 K beyond which a coolant held warmer lets it run away.
DESIGN = RandomStepDesign(
    input_lower=281.3, input_upper=301.1, state_lower=305.0, state_upper=329.0,
    hold_time=(0.5, 5.0), sample_period=0.25)
EPISODES = 20
EPISODE_MINUTES = 15.0
SEED = 2026
STARTS = 3
LIFTED_SIZES = (3, 4)


def training_samples(system: ControlAffineSystem) -> Samples:
    """Simulate the episodes of random coolant steps that the lifts are learned from."""
    x, dxdt, u, episode = [], [], [], []
    for number in range(EPISODES):
        record = sample_derivatives(
            system, random_steps(system, DESIGN, EPISODE_MINUTES, SEED + number).trajectory)
        x.append(record.x)
        dxdt.append(record.x_dot)
        u.append(record.u)
        episode.append(np.full(len(record.x), number))
    return Samples(np.concatenate(x), np.concatenate(dxdt), np.concatenate(u),
                   np.concatenate(episode))


def describe(system: ControlAffineSystem) -> Plant:
    """Return what training may know of a plant beside its data."""
    return Plant(system.name, system.state_names, system.state_units, system.input_names,
                 system.input_units, system.time_unit, system.nominal_state,
                 system.nominal_input, system.B)


def train_lift(n_z: int, *, seed: int = SEED, starts: int = STARTS,
               progress: TrainingProgress | None = None) -> Trained:
    """
    Train the shipped lift of the one-state reactor with `n_z` coordinates.

    :param n_z: number of lifted coordinates.
    :param seed: seed of the first start; the shipped file names the seed of its winner.
    :param starts: number of starts.
    :param progress: what shows the progress.
    """
    system = one_state_reactor()
    trained = train(describe(system), training_samples(system), Recipe(n_z), seed=seed,
                    starts=starts, progress=progress)
    return replace(trained, model=_with_roll_out(trained.model, system))


def linear_model(like: LiftedModel) -> LiftedModel:
    """Return the linearisation at the nominal point, with the box of a lift."""
    system = one_state_reactor()
    model = linearised_model(
        system.drift_jacobian(system.nominal_state), system.B, like.states, like.inputs,
        system.time_unit, Provenance(system.name, package_version=like.provenance.package_version))
    return _with_roll_out(model, system)


def _with_roll_out(model: LiftedModel, system: ControlAffineSystem) -> LiftedModel:
    """Add the roll-out error, in K, over a fresh episode of random steps to the metrics."""
    design = replace(DESIGN, state_lower=model.states.lower, state_upper=model.states.upper)
    truth = random_steps(system, design, EPISODE_MINUTES, SEED - 1).trajectory
    predicted = roll_out(model, truth.states[0], truth.inputs, DESIGN.sample_period)
    error = float(np.sqrt(np.mean((predicted - truth.states) ** 2)))
    metrics = {**model.provenance.metrics, 'rollout_rmse': error}
    return replace(model, provenance=replace(model.provenance, metrics=metrics))


def main(args: list[str] | None = None) -> int:
    """Train all shipped models and write them."""
    parser = argparse.ArgumentParser(description='Train the models that the package ships.')
    parser.add_argument('--output', type=Path, default=Path('config/models'),
                        help='folder for the model files (default: %(default)s)')
    output = parser.parse_args(args).output
    output.mkdir(parents=True, exist_ok=True)
    model = None
    for n_z in LIFTED_SIZES:
        with TrainingProgress(f'reactor, n_z = {n_z}') as progress:
            trained = train_lift(n_z, progress=progress)
        model = trained.model
        save(model, output / f'reactor_nz{n_z}.safetensors')
        _report(f'reactor_nz{n_z}', model)
    assert model is not None
    linear = linear_model(model)
    save(linear, output / 'reactor_linear.safetensors')
    _report('reactor_linear', linear)
    return 0


def _report(name: str, model: LiftedModel) -> None:
    metrics = ', '.join(f'{key} {value:.2g}' for key, value in model.provenance.metrics.items())
    print(f'{name}: seed {model.provenance.seed}, {metrics} (roll-out in K)', flush=True)


if __name__ == '__main__':
    sys.exit(main())
