# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Each case from a seed: models of all classes, their predictions and the costs of their laws."""

from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
from scipy.integrate import solve_ivp

from koopman_ros.control import averaged, recentred
from koopman_ros.core.arrays import Array
from koopman_ros.core.datasets import DriftSamples
from koopman_ros.learning import fit, rollout_rmse, TrainingFailed
from koopman_ros.learning.lift.metrics import drift_error
from koopman_ros.model import LiftedModel
from koopman_ros.model.model_file import MAX_COORDINATES
from koopman_ros.plants import describe
from studies.campaign import Experiment, Metrics, Models
from studies.general.learners import Learned, learned, LEARNERS, LIFTS, POLYNOMIALS
from studies.general.loops import judged, known, loops, STARTS
from studies.general.systems import CASES, Regulation

NOISE = 0.03  # of the derivatives, beside their root mean square
PARTS_SEEDS = 3  # from which models of noisy data and the parts of the lifts are judged, too
_HELD_OUT = 40  # episodes that no training has seen
LQR, SDRE = 'LQR on the truth', 'natural SDRE on the truth'
_FAR = 1e3  # half-ranges, beyond which a prediction has diverged


def run(name: str, seed: int, starts: int = STARTS) -> tuple[Metrics, Models]:
    """
    Learn a case by all classes and regulate the true plant by the law on each model.

    :return: figures named ``<class>/<figure>``: those of :func:`predicted` and, with no more
        coordinates than a controller takes, of :func:`judged`, those of the laws that know the
        plant, too. From the first seeds also `rx_noisy`, the error on the same held-out data of a
        model of noisy data (None where there is none), and of lifts the figures of
        :func:`by_parts`.
    """
    case, beside = CASES[name], known(name, starts)
    found = {LQR: judged(beside.lqr, beside), SDRE: judged(beside.sdre, beside)}
    samples, held_out = case.samples(seed), case.samples(1000 + seed, _HELD_OUT)
    plant = describe(case.system)
    for label, learn in LEARNERS.items():
        one = learned(learn, plant, samples, seed)
        found[label] = predicted(case, one, held_out)
        if label in POLYNOMIALS:
            found[label]['accepted'] = None
        if one.model.n_z <= MAX_COORDINATES:
            found[label] |= judged(loops(case, one.model, starts), beside)
        if seed >= PARTS_SEEDS:
            continue
        try:
            found[label]['rx_noisy'] = drift_error(
                learn(plant, noisy(samples, seed), seed, False), held_out)
        except TrainingFailed:
            found[label]['rx_noisy'] = None
        if label in LIFTS:
            found[label] |= by_parts(name, one.model, held_out, starts)
    return {f'{label}/{figure}': value for label, figures in found.items()
            for figure, value in figures.items()}, {}


def predicted(case: Regulation, one: Learned, held_out: DriftSamples) -> Metrics:
    """
    Judge a model on held-out episodes.

    :return: `rw`, `rx`; `rollout`, the root mean square error over an episode of the worst state,
        in half-ranges of the box, None of a drift that is no better than none; `seconds` of
        learning; `accepted`.
    """
    found = fit(one.model, held_out.x, held_out.dxdt, held_out.u)
    error = rollout_rmse(one.model, held_out) if found.rx < 1.0 else None
    return {'rw': found.rw, 'rx': found.rx,
            'rollout': None if error is None else float(np.max(error / case.units[0])),
            'seconds': one.seconds, 'accepted': not one.rejected}


def noisy(samples: DriftSamples, seed: int) -> DriftSamples:
    """Return samples whose derivatives are measured with noise."""
    rng = np.random.default_rng(seed)
    size = NOISE * np.sqrt(np.mean(samples.dxdt ** 2, axis=0))
    return replace(samples, dxdt=samples.dxdt + size * rng.normal(size=samples.dxdt.shape))


def by_parts(name: str, model: LiftedModel, held_out: DriftSamples, starts: int) -> Metrics:
    """
    Use the linear coordinates of a lift alone, and each of its laws.

    :return: `rollout_z` by the linear coordinates; ``averaged`` and ``recentred``, the largest
        cost of each law over that of the better law that knows the plant, with ``..._missed`` as
        in :func:`judged`.
    """
    case = CASES[name]
    found: Metrics = {}
    if model.identity:
        found['rollout_z'] = float(np.max(rolled_in_z(model, held_out) / case.units[0]))
    for law in (averaged, recentred):
        figures = judged(loops(case, model, starts, law),
                         known(name, starts))
        found |= {law.__name__: figures['ratio_worst'],
                  f'{law.__name__}_missed': figures['missed']}
    return found


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


EXPERIMENTS: dict[str, Experiment] = {name: partial(run, name) for name in CASES}
