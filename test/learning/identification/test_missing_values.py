# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Records in which states are missing now and then, or measured rarely."""

from dataclasses import replace
import sys

import numpy as np
import pytest

from koopman_ros.core.datasets import Episode, PlantDescription
from koopman_ros.learning.identification import DriftModel, identify, Segments
from koopman_ros.learning.identification.drift import box_of
from koopman_ros.learning.identification.output_error import (
    innovations_form,
    PolynomialCoefficients,
)
from support.sampling import sampled

A, B, PERIOD, NOISE = np.array([[-0.5, 0.3], [0.2, -1.0]]), np.array([[1.0], [0.5]]), 0.1, 0.01
PLANT = PlantDescription('tanks', ('low', 'high'), ('m', 'm'), ('pump',), ('V',), 's',
                         np.zeros(2), np.zeros(1), None)


def record(count=800, seed=0):
    """Return a run of a linear plant under random steps, solved exactly."""
    rng = np.random.default_rng(seed)
    step, gain = sampled(A, B, PERIOD)
    u = np.repeat(rng.uniform(-1.0, 1.0, count // 10), 10)[:, None]
    x = [np.zeros(2)]
    for value in u[:-1]:
        x.append(step @ x[-1] + gain @ value)
    time = PERIOD * np.arange(count)
    return Episode(time, x + NOISE * rng.standard_normal((count, 2)), time, u)


def missing(episode, column, keep):
    x = episode.x.copy()
    x[~keep, column] = np.nan
    return replace(episode, x=x)


def rough(box):
    return PolynomialCoefficients(
        DriftModel(box, 1, np.array([[0.0, 0.0], [-0.4, 0.1], [0.2, -0.8]]),
                   0.5 * np.ones((2, 1))), learn_input_matrix=True)


@pytest.mark.parametrize('every', ['now and then', 'rarely'])
def test_a_state_that_is_missing_leaves_the_other_usable(every):
    whole = record()
    keep = (np.random.default_rng(1).random(len(whole)) > 0.2 if every == 'now and then'
            else np.arange(len(whole)) % 20 == 0)
    found = identify(PLANT, [missing(whole, 1, keep)], degrees=(1,))
    assert found.drift.slope(found.drift.box.states.center) == pytest.approx(A, abs=0.06)
    assert found.drift.input_matrix == pytest.approx(B, abs=0.03)


def test_missing_values_do_not_count(monkeypatch):
    # of a gap in the second state only its interpolation changes, which no estimate sees
    episode = missing(record(200), 1, np.arange(200) % 3 == 0)
    box = box_of(PLANT, [episode])
    start = rough(box)

    def refined(segments):
        return innovations_form(start, np.zeros((2, 2)), segments, np.zeros((1, 2)), np.ones(2),
                                smooth=True, tolerance=1e-9, iterations=100)

    data = Segments.of([episode], 0.2)
    changed = replace(data, x=np.where(data.measured, data.x, 7.0))
    expected = refined(data).model.theta
    assert refined(changed).model.theta == pytest.approx(expected, abs=1e-9)
    # nor do the blocks in which derivatives are evaluated, of which the last has a row alone
    monkeypatch.setattr(sys.modules[innovations_form.__module__], '_BLOCK',
                        199 * 2 * (1 + len(expected) + 2))
    assert refined(data).model.theta == pytest.approx(expected, abs=1e-9)
