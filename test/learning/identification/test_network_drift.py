# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A small network beside a linear drift: derivatives, and how it is kept bounded."""

from dataclasses import replace

import numpy as np
import pytest

from koopman_ros.learning.identification.drift import DriftModel
from koopman_ros.learning.identification.network_drift import NetworkDrift
from support.known_plants import box

UNSTABLE = DriftModel(box([-1.0, -1.0], [1.0, 1.0], [-1.0], [1.0]), 1,
                      np.array([[0.1, 0.2], [0.3, 1.0], [0.5, -0.4]]), np.array([[1.0], [0.5]]))


def network() -> NetworkDrift:
    return NetworkDrift.beside(UNSTABLE, 3, 1, ridge=1e-4, learn_input_matrix=True)


@pytest.mark.parametrize('held', [(), ('A',), ('W1', 'b1')])
def test_rates_have_derivatives_by_the_parameters_that_are_refined(held: tuple[str, ...]) -> None:
    model, step = replace(network(), held=held), 1e-6
    xi, v = np.array([[0.3, -0.6]]), np.array([[0.4]])
    p = len(model.theta)
    slopes = model.rates(xi, v, np.zeros((1, 2, p)))[1][0]
    differences = [(model.at(model.theta + e).scaled_rate(xi, v)
                    - model.at(model.theta - e).scaled_rate(xi, v))[0] / (2.0 * step)
                   for e in step * np.eye(p)]
    np.testing.assert_allclose(slopes.T, differences, atol=1e-8)


def test_an_unbounded_network_becomes_bounded_with_a_slowest_mode() -> None:
    assert not network().bounded
    stable = network().stabilised(0.2)
    assert stable.bounded
    assert np.max(np.linalg.eigvals(stable.A).real) == pytest.approx(-0.2)
    # what is left of the linear part is up to the units
    assert len(stable.theta) == len(network().theta) - 4
