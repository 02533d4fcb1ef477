# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Training of the models that the package ships: lifts of the one-state reactor and its linear model.

Run it as ``python -m validation.paper.shipped_models`` (needs the `train` requirements); the
seeds are fixed, so that the same machine writes the same files bit for bit.
"""

import argparse
from dataclasses import replace
from pathlib import Path
import sys

import numpy as np

from koopman_ros.learning import Growth, roll_out, train
from koopman_ros.learning.progress import training_progress
from koopman_ros.learning.training import Watch
from koopman_ros.lifting import LiftedModel, linearised_model, Provenance, save
from koopman_ros.plants import random_steps
from validation.paper.datasets import describe
from validation.paper.reactor import SYSTEM, TRAINING, training_samples

SEED = 2026
STARTS = 3
LIFTED_SIZES = (3, 4)


def train_lifts(progress: Watch | None = None, starts: int = STARTS) -> dict[int, LiftedModel]:
    """Train the shipped lifts, by n_z; the larger is grown from the smaller."""
    # a fixed number of steps: where they end depends least on how a processor rounds
    trained = train(describe(SYSTEM), training_samples(SEED),
                    Growth(max(LIFTED_SIZES), tolerance=0.0), seed=SEED, starts=starts,
                    watch=progress)
    return {model.n_z: _with_roll_out(model) for model in trained.path
            if model.n_z in LIFTED_SIZES}


def linear_model(like: LiftedModel) -> LiftedModel:
    """Return the linearisation at the nominal point, with the box of a lift."""
    provenance = Provenance(SYSTEM.name, package_version=like.provenance.package_version)
    return _with_roll_out(linearised_model(
        SYSTEM.drift_jacobian(SYSTEM.nominal_state), SYSTEM.B, like.states, like.inputs,
        SYSTEM.time_unit, provenance))


def _with_roll_out(model: LiftedModel) -> LiftedModel:
    """Add the roll-out error, in K, over a fresh episode of random steps to the metrics."""
    truth = random_steps(SYSTEM, TRAINING, 15.0, SEED - 1)
    predicted = roll_out(model, truth.x[0], truth.u, TRAINING.sample_period)
    error = float(np.sqrt(np.mean((predicted - truth.x) ** 2)))
    metrics = {**model.provenance.metrics, 'rollout_rmse': error}
    return replace(model, provenance=replace(model.provenance, metrics=metrics))


def main(args: list[str] | None = None) -> int:
    """Train all shipped models and write them."""
    parser = argparse.ArgumentParser(description='Train the models that the package ships.')
    parser.add_argument('--output', type=Path, default=Path('config/models'),
                        help='folder for the model files (default: %(default)s)')
    output = parser.parse_args(args).output
    output.mkdir(parents=True, exist_ok=True)
    with training_progress('reactor') as progress:
        lifts = train_lifts(progress)
    models = {f'reactor_nz{n_z}': model for n_z, model in lifts.items()}
    models['reactor_linear'] = linear_model(lifts[max(lifts)])
    for name, model in models.items():
        save(model, output / f'{name}.safetensors')
        metrics = ', '.join(f'{key} {value:.2g}'
                            for key, value in model.provenance.metrics.items())
        print(f'{name}: seed {model.provenance.seed}, {metrics} (roll-out in K)', flush=True)
    return 0


if __name__ == '__main__':
    sys.exit(main())
