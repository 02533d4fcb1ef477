# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The benefit of the linear coordinates of a lift, and model classes on noisy data."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
from scipy.integrate import solve_ivp

from koopman_ros.control import averaged, recentred
from koopman_ros.core.arrays import Array
from koopman_ros.core.datasets import DriftSamples
from koopman_ros.learning import rollout_rmse, train, TrainingFailed
from koopman_ros.learning.lift.metrics import drift_error
from koopman_ros.model import LiftedModel
from koopman_ros.plants import describe
from studies.campaign import Experiment, Metrics, Models
from studies.general.learners import LEARNERS, RECIPES
from studies.general.loops import judged, known, loops, STARTS
from studies.general.systems import CASES

PLACE = 'coordinates'  # of its figures in the summary
SEEDS = 3  # as many of those of the study
NOISE = 0.03  # of the derivatives, beside their root mean square
_HELD_OUT = 40
_POLYNOMIALS = ('EDMD-3', 'EDMD-5')
LIFTS = ('identity lift', 'free lift')
_FAR = 1e3  # half-ranges, beyond which a prediction has diverged


def noisy(samples: DriftSamples, seed: int) -> DriftSamples:
    """Return samples whose derivatives are measured with noise."""
    rng = np.random.default_rng(seed)
    size = NOISE * np.sqrt(np.mean(samples.dxdt ** 2, axis=0))
    return replace(samples, dxdt=samples.dxdt + size * rng.normal(size=samples.dxdt.shape))


CONDITIONS: Mapping[str, Callable[[DriftSamples, int], DriftSamples]] = {
    'rx': lambda samples, seed: samples, 'rx_noisy': noisy}


def rolled_in_z(model: LiftedModel, samples: DriftSamples) -> Array:
    """
    Predict every episode by dz/dt = A z + J(x) B u alone, x the first coordinates of z.

    :return: (n_x,) root mean square errors in state units; infinite where one diverges.
    """
    n, squares, count = model.n_x, np.zeros(model.n_x), 0
    x, v = model.states.to_deviation(samples.x), model.inputs.to_deviation(samples.u)
    assert samples.time is not None
    for number in np.unique(samples.episode):
        rows = np.flatnonzero(samples.episode == number)
        z = model.lift(x[rows[0]])
        for k, following in pairwise(rows):
            def rate(_: float, z: Array, u: Array = v[k]) -> Array:
                return model.A @ z + model.jacobian(z[:n]) @ model.forcing(z[:n], u)

            with np.errstate(all='ignore'):
                found = solve_ivp(rate, (0.0, samples.time[following] - samples.time[k]), z,
                                  rtol=1e-6, atol=1e-9, method='DOP853')
                z = found.y[:, -1]
            if not found.success or not np.all(np.abs(z) < _FAR):
                return np.full(n, np.inf)
            squares += (model.states.scale * (z[:n] - x[following])) ** 2
            count += 1
    return np.sqrt(squares / count)


def run(name: str, seed: int, starts: int = STARTS) -> tuple[Metrics, Models]:
    """
    Learn a case by several classes from good and noisy data, and use each model's parts.

    :return: figures named ``<class>/<figure>``: relative errors of the drift `rx` and `rx_noisy`
        on the same exact held-out data; `rollout` by the
        drift, for lifts `rollout_z` by the linear coordinates; for lifts ``averaged`` and
        ``recentred``, the largest cost of each law over that of the better law that knows the
        plant, with ``..._missed`` as in :func:`judged`.
    """
    case = CASES[name]
    samples, held_out = case.samples(seed), case.samples(1000 + seed, _HELD_OUT)
    plant = describe(case.system)
    found: dict[str, Metrics] = {}
    for label in (*_POLYNOMIALS, *RECIPES):
        figures: Metrics = {}
        found[label] = figures
        for figure, change in CONDITIONS.items():
            given = change(samples, seed)
            try:
                model = LEARNERS[label](plant, given, seed).model if label in _POLYNOMIALS else (
                    train(plant, given, RECIPES[label](case.system.n_x), seed=seed, starts=1,
                          reject=False).model)
            except TrainingFailed:
                figures[figure] = None
                continue
            figures[figure] = drift_error(model, held_out)
            if figure == 'rx':
                figures |= _used(name, model, held_out, label in LIFTS, starts)
    return {f'{label}/{figure}': value for label, figures in found.items()
            for figure, value in figures.items()}, {}


def _used(name: str, model: LiftedModel, held_out: DriftSamples, lift: bool, starts: int
          ) -> Metrics:
    """Judge a model of good data by its use."""
    case = CASES[name]
    error = rollout_rmse(model, held_out)
    found: Metrics = {
        'rollout': None if error is None else float(np.max(error / case.units[0]))}
    if not lift:
        return found
    if model.identity:
        found['rollout_z'] = float(np.max(rolled_in_z(model, held_out) / case.units[0]))
    for law in (averaged, recentred):
        figures = judged(loops(case, model, starts, law), known(name, starts))
        found |= {law.__name__: figures['ratio_worst'],
                  f'{law.__name__}_missed': figures['missed']}
    return found


EXPERIMENTS: dict[str, Experiment] = {
    f'{PLACE}/{name}': partial(run, name) for name in CASES}
