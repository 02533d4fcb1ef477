# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Drifts with unmeasured states in the coordinates of another one."""

from typing import Any

import numpy as np
import pytest

from koopman_ros.learning.identification import DriftModel, Identified
from koopman_ros.learning.identification.alternatives import in_coordinates_of, TransformedDrift
from koopman_ros.learning.identification.episode_offsets import without_episode_inputs
from koopman_ros.learning.identification.innovations_form import Predictor
from support.known_plants import box

BOX = box([-1.0, -2.0], [3.0, 2.0], [-1.0], [1.0])
# of the hidden state, by all states
MAP, SHIFT = np.array([[1.0, 0.0], [0.4, -1.5]]), np.array([0.0, 0.3])


def predictor(coefficients: Any, B: Any) -> Predictor[DriftModel]:
    return Predictor(DriftModel(BOX, 1, np.array(coefficients), np.array(B)), np.zeros((2, 1)))


class Estimates:
    """A record of which each predictor has its estimates."""

    def __init__(self, *pairs: Any) -> None:
        self._pairs = pairs

    def estimates(self, of: object) -> Any:
        found = next(xi for one, xi in self._pairs if one is of)
        if found is None:
            raise ValueError('diverges')
        return found


def test_a_drift_in_other_coordinates_has_the_same_motion() -> None:
    own = predictor([[0.1, 0.2], [-0.5, 0.3], [0.7, -0.2]], [[0.4], [0.8]])
    other, lost, bent = (predictor([[0.0, 0.0], [0.2, 0.1], [0.1, 0.3]], [[1.0], [0.5]])
                         for _ in range(3))
    xi = np.random.default_rng(0).uniform(-1.0, 1.0, (60, 2))
    theirs = xi @ MAP.T + SHIFT
    # with a part that the other's states do not determine
    unlike = theirs + np.array([0.0, 0.3]) * np.sin(7.0 * xi[:, :1])
    record: Any = Estimates((own, xi), (other, theirs), (lost, None), (bent, unlike))
    (found,) = in_coordinates_of(own, [other, lost, bent], record)
    v = np.linspace(-1.0, 1.0, 60)[:, None]
    # d(T xi + shift)/dt is the rate of the other
    assert found.scaled_rate(xi, v) @ MAP.T == pytest.approx(
        other.drift.scaled_rate(theirs, v), abs=1e-12)
    step = 1e-6 * np.eye(2)
    for j in range(2):
        beside = (found.scaled_rate(xi + step[j], v) - found.scaled_rate(xi - step[j], v)) / 2e-6
        assert found.scaled_slope(xi, v)[..., j] == pytest.approx(beside, abs=1e-8)
    assert MAP @ found.scaled_input_matrix(xi) == pytest.approx(other.drift.B)
    assert (found.form, found.varying_input_matrix) == ('drift of degree 1', False)


def test_alternatives_lose_the_offsets_of_the_episodes_like_the_drift() -> None:
    both = box([-1.0, -2.0], [3.0, 2.0], [-1.0, -1.0], [1.0, 1.0])
    drift = DriftModel(both, 1, np.ones((3, 2)), np.array([[0.4, 0.3], [0.8, 0.5]]))
    found = without_episode_inputs(Identified(
        drift, '', drift, (), np.zeros(1), (), (), 1,
        alternatives=(TransformedDrift(both, drift, MAP, SHIFT),)), 1)
    xi, v = np.linspace(-1.0, 1.0, 10).reshape(5, 2), np.linspace(-1.0, 1.0, 5)[:, None]
    assert found.offsets == pytest.approx(np.outer([1.0, -1.0], drift.input_matrix[:, 1]))
    assert found.alternatives[0].scaled_rate(xi, v) == pytest.approx(
        TransformedDrift(both, drift, MAP, SHIFT).scaled_rate(xi, np.pad(v, ((0, 0), (0, 1)))))
