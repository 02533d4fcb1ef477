# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Polynomials of many states, of whose terms few are needed."""

import numpy as np
import pytest

from koopman_ros.learning.identification import identify
from koopman_ros.learning.identification.term_selection import chosen_terms
from support.known_plants import KnownPlant, methods

STATES = 5
NOISE = 0.002


def chain() -> KnownPlant:
    """Return stores that pass heat on and lose it, more than in proportion to their level."""
    terms = []
    for i in range(STATES):
        own, cubed = np.zeros((2, STATES), dtype=int)
        own[i], cubed[i] = 1, 3
        terms += [(*own, i, -1.5 if i else -0.8), (*cubed, i, -0.5)]
        if i + 1 < STATES:
            terms.append((*own, i + 1, 1.0))
            after = np.roll(own, 1)
            terms.append((*after, i, 0.5))
    B = np.zeros((STATES, 2))
    B[0, 0], B[3, 1] = 1.0, 0.8
    return KnownPlant(tuple(tuple(map(int, term[:-1])) for term in terms),
                      tuple(term[-1] for term in terms), B)


def test_the_columns_that_matter_are_found_and_no_others():
    rng = np.random.default_rng(3)
    left = rng.standard_normal((800, 150))
    left /= np.linalg.norm(left, axis=0)
    true = np.zeros((150, 2))
    true[[0, 1, 40], 0], true[[1, 77, 149], 1] = (2.0, -1.0, 3.0), (1.0, 2.0, -4.0)
    noise = 0.003
    found = chosen_terms(left, left @ true + noise * rng.standard_normal((800, 2)), [0, 1])
    assert np.array_equal(found[2:] != 0.0, true[2:] != 0.0)
    # the columns have length 1 and are nearly at right angles
    assert np.max(np.abs(found - true)) < 5.0 * noise
    exact = chosen_terms(left, left @ true, [0, 1])
    assert exact == pytest.approx(true, abs=1e-10)
    assert np.count_nonzero(exact) <= np.count_nonzero(true) + 2


def test_a_chain_of_states_with_cubic_losses_is_identified():
    """Degree 3 has 280 coefficients here."""
    plant = chain()
    record = plant.excited(600, 0.2, noise=NOISE, level=2.0)
    found = identify(plant.plant, [record], degrees=(1, 3), methods=methods(10))
    drift = found.drift
    assert drift.degree == 3
    assert found.method.startswith('output error from ')
    assert np.count_nonzero(drift.coefficients) < 60 < drift.coefficients.size
    x, u = record.x, record.inputs_at(record.time)
    true = plant.rate(x, u)
    errors = np.sqrt(np.mean((drift.rate(x, u) - true) ** 2, axis=0) / np.var(true, axis=0))
    linear = np.sqrt(np.mean((found.linear.rate(x, u) - true) ** 2, axis=0) / np.var(
        true, axis=0))
    assert np.max(errors) < 0.01
    assert np.max(errors / linear) < 0.05
    # free runs err by little more than the noise
    assert min(score.rmse.max() for score in found.scores) < 1.2 * NOISE
