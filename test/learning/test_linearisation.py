# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Eigenvalues at operating points, and instability that a record denies."""


import numpy as np
import pytest

from koopman_ros.core.datasets import Episode
from koopman_ros.learning.identification import DriftModel, Identified
from koopman_ros.learning.linearisation import operating_points, unfounded_instability
from koopman_ros.model import LiftedModel, PolynomialObservables, Provenance
from support.known_plants import box

BOX = box([-2.0], [2.0], [-9.0], [9.0])


def model(a: float) -> LiftedModel:
    """Return the model of dx/dt = a x - x^3 + u per minute."""
    A = np.zeros((3, 3))
    A[0] = a, 0.0, -4.0  # of x / 2
    return LiftedModel(PolynomialObservables.total_degree(1, 3), A, np.array([[4.5]]),
                       BOX.states, BOX.inputs, 'min', Provenance('cubic'), readout=A[:1])


def record(*episodes: Episode) -> Identified:
    """Return a record with a linear drift, in seconds."""
    drift = DriftModel(BOX, 1, np.array([[0.0], [-1.0]]), np.ones((1, 1)))
    return Identified(drift, 'known', drift, (), np.full(1, 1e-3), episodes, ())


def moving(seconds: float) -> Episode:
    times = np.linspace(0.0, seconds, 101)
    return Episode(times, np.sin(times)[:, None], times, np.cos(times)[:, None])


def test_eigenvalues_are_those_of_the_derivative():
    points = operating_points(model(1.0), np.array([[0.5], [-0.5], [1.0], [0.2]]))
    assert [point.x[0] for point in points] == [0.0, -0.5, 1.0]
    # 1 - 3 x^2
    assert [point.growth for point in points] == pytest.approx([1.0, 0.25, -2.0], abs=1e-6)


@pytest.mark.parametrize(('growth', 'seconds', 'other', 'unfounded'), [
    (1.0, 150.0, -0.1, True),
    (-1.0, 150.0, -0.1, False),
    # it is unstable, too, or grows by less than e^2 in the record
    (1.0, 150.0, 0.1, False), (1.0, 60.0, -0.1, False)])
def test_an_unstable_model_is_rejected_where_a_stable_one_explains_the_record(
        growth, seconds, other, unfounded):
    lift = model(growth)
    said = unfounded_instability(lift, record(moving(seconds)), operating_points(
        lift, np.array([[0.1]])), {'drift of degree 1': lambda x, u: other * x + u})
    assert ('although a drift of degree 1, which is stable there' in said) == unfounded
    assert bool(said) == unfounded
