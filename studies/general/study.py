# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Each case from a seed: models of all classes, their predictions and the costs of their laws."""

from functools import partial

import numpy as np

from koopman_ros.core.datasets import DriftSamples
from koopman_ros.learning import fit, rollout_rmse
from koopman_ros.model.model_file import MAX_COORDINATES
from koopman_ros.plants import describe
from studies.campaign import Experiment, Metrics, Models
from studies.general.learners import Learned, LEARNERS
from studies.general.loops import judged, known, loops, STARTS
from studies.general.systems import CASES, Regulation

_HELD_OUT = 40  # episodes that no training has seen
LQR, SDRE = 'LQR on the truth', 'natural SDRE on the truth'


def run(name: str, seed: int, starts: int = STARTS) -> tuple[Metrics, Models]:
    """
    Learn a case by all classes and regulate the true plant by the law on each model.

    :return: figures named ``<class>/<figure>``: those of :func:`predicted` and, with no more
        coordinates than a controller takes, of :func:`judged`, those of the laws that know the
        plant, too.
    """
    case, beside = CASES[name], known(name, starts)
    found = {LQR: judged(beside.lqr, beside), SDRE: judged(beside.sdre, beside)}
    samples, held_out = case.samples(seed), case.samples(1000 + seed, _HELD_OUT)
    for label, learn in LEARNERS.items():
        learned = learn(describe(case.system), samples, seed)
        found[label] = predicted(case, learned, held_out)
        if learned.model.n_z <= MAX_COORDINATES:
            found[label] |= judged(loops(case, learned.model, starts), beside)
    return {f'{label}/{figure}': value for label, figures in found.items()
            for figure, value in figures.items()}, {}


def predicted(case: Regulation, learned: Learned, held_out: DriftSamples) -> Metrics:
    """
    Judge a model on held-out episodes.

    :return: `rw`, `rx`; `rollout`, the root mean square error over an episode of the worst state,
        in half-ranges of the box, None of a drift that is no better than none; `seconds` of
        learning; `accepted`, None where nothing decides.
    """
    found = fit(learned.model, held_out.x, held_out.dxdt, held_out.u)
    error = rollout_rmse(learned.model, held_out) if found.rx < 1.0 else None
    return {'rw': found.rw, 'rx': found.rx,
            'rollout': None if error is None else float(np.max(error / case.units[0])),
            'seconds': learned.seconds,
            'accepted': None if learned.rejected is None else not learned.rejected}


EXPERIMENTS: dict[str, Experiment] = {name: partial(run, name) for name in CASES}
