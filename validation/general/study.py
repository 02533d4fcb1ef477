# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Each case from a seed: models of all classes, what they predict and what their laws cost."""

from functools import partial

import numpy as np

from koopman_ros.learning import evaluate
from koopman_ros.lifting.bounds import MAX_COORDINATES
from validation.general.learners import Learned, LEARNERS
from validation.general.loops import judged, known, loops, STARTS
from validation.general.systems import Case, CASES
from validation.paper.campaign import Experiment
from validation.paper.datasets import describe, Metrics, Models

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
    samples = case.samples(seed)
    for label, learn in LEARNERS.items():
        learned = learn(describe(case.system), samples, seed)
        found[label] = predicted(case, learned, seed)
        if learned.model.n_z <= MAX_COORDINATES:
            found[label] |= judged(loops(case, learned.model, starts), beside)
    return {f'{label}/{figure}': value for label, figures in found.items()
            for figure, value in figures.items()}, {}


def predicted(case: Case, learned: Learned, seed: int) -> Metrics:
    """
    Judge a model on held-out episodes.

    :return: `rw`, `rx`; `rollout`, the root mean square error over an episode of the worst state,
        in half widths of the box; `seconds` of learning; `accepted`, None where nothing decides.
    """
    figures = evaluate(learned.model, case.samples(1000 + seed, _HELD_OUT))
    rollout = None if figures.rollout_rmse is None else float(np.max(
        figures.rollout_rmse / case.units[0]))
    return {'rw': figures.fit.rw, 'rx': figures.fit.rx, 'rollout': rollout,
            'seconds': learned.seconds,
            'accepted': None if learned.refused is None else not learned.refused}


EXPERIMENTS: dict[str, Experiment] = {name: partial(run, name) for name in CASES}
