# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Closed loops on several plants: the bound of the share, the early end, and set-points held."""

import numpy as np
import pytest

from koopman_ros.learning.acceptance import Thresholds
from koopman_ros.learning.acceptance.held_range import held_shares
from koopman_ros.learning.acceptance.plant_test import LoopConditions, run_plants, share_bound
from koopman_ros.learning.acceptance.words import statement
from koopman_ros.learning.identification import Stopped
from koopman_ros.model import Coordinates, linearised_model, Provenance

STATE = Coordinates.spanning(('level',), ('m',), -2.0 * np.ones(1), 2.0 * np.ones(1))
INPUT = Coordinates.spanning(('flow',), ('m/s',), -np.ones(1), np.ones(1))
# dx/dt = -x + u in units
MODEL = linearised_model(-np.eye(1), np.eye(1), STATE, INPUT, 's', Provenance('a'))
CONDITIONS = LoopConditions(0.1, np.zeros(1))


def plant(gain):
    return lambda x, u: -x + gain * u


def test_bound_of_no_failed_loop_is_that_of_clopper_and_pearson():
    mean, most = share_bound([0] * 30, [16] * 30, 0.95)
    assert (mean, most) == (0.0, pytest.approx(1.0 - 0.05 ** (1.0 / 480)))
    assert share_bound([16] * 30, [16] * 30, 0.95) == (1.0, 1.0)


def test_bound_counts_the_spread_between_plants():
    """Three of 30 plants lose all loops: one more plant may, too, by 5 % at most."""
    together = share_bound([0] * 27 + [16] * 3, [16] * 30, 0.95)
    alike = share_bound([1, 2] * 15 + [1] * 2, [16] * 32, 0.95)
    assert together[0] == pytest.approx(0.1)
    assert together[1] > 0.5 > 0.13 > alike[1] > alike[0]


def test_bound_holds_for_shares_of_a_beta_distribution():
    """In 95 % of the cases the share of one more plant is below it."""
    rng, covered = np.random.default_rng(0), 0
    for _ in range(200):
        shares = rng.beta(0.5, 5.0, 31)
        covered += shares[30] <= share_bound(rng.binomial(16, shares[:30]), [16] * 30, 0.95)[1]
    assert 0.90 <= covered / 200.0 <= 0.985


def test_a_good_law_is_accepted_on_plants_that_differ_little():
    settings = Thresholds(plants=6, plant_loops=8, most_failing=0.1)
    found = run_plants(MODEL, [plant(g) for g in (0.95, 1.0, 1.05, 1.0, 0.98, 1.02)], CONDITIONS,
                       settings)
    assert found.failed.tolist() == [0] * 6
    assert found.accepted
    assert found.setpoints.shape == (found.loops.sum(), 1)
    said = statement(found, np.array([0.123]), STATE, 's')
    assert 'On 6 plants' in said
    assert 'up to 0.12 m/s' in said
    assert f'at most {100.0 * found.share[1]:.2g} %' in said


def test_a_test_ends_when_enough_plants_are_lost():
    settings = Thresholds(plant_loops=4, lost_plants=2)
    found = run_plants(MODEL, [plant(1.0), plant(-9.0), plant(-9.0), plant(1.0)], CONDITIONS,
                       settings)
    assert (found.failed > 0).tolist() == [False, True, True]
    assert found.lost == 2
    assert not found.accepted


def test_a_plant_that_no_input_moves_is_lost():
    found = run_plants(MODEL, [lambda x, u: x + 0.0 * u], CONDITIONS, Thresholds(plant_loops=4))
    assert found.lost == 1
    assert found.share == (1.0, 1.0)


def test_a_test_stops_when_it_is_asked_to():
    shares = []
    with pytest.raises(Stopped):
        run_plants(MODEL, [plant(1.0)] * 3, CONDITIONS, Thresholds(plant_loops=4),
                   watch=lambda share: shares.append(share) or share > 0.4)
    assert shares == sorted(shares)
    assert 0.4 < shares[-1] < 0.99


def test_set_points_that_the_inputs_hold():
    """A level from -1 to 1 of a recorded range from -2 to 2: 11 of 21 values."""
    recorded = np.linspace(-2.0, 2.0, 4001)[:, None]
    settings = Thresholds(trimmed=0.0)
    found = held_shares(MODEL, recorded, np.array([[0.5], [0.9], [1.5]]), {'level': (-1.0, 3.0)},
                        np.array([True]), 1, settings)
    assert found.recorded == pytest.approx([11.0 / 21.0])
    assert found.steady == pytest.approx([2.0 / 3.0])
    assert found.requested == {'level': pytest.approx(11.0 / 21.0)}
    assert found.reason(0.5) == ''
    reason = found.reason(0.6)
    assert 'requested set-points of level' in reason
    held = held_shares(MODEL, recorded, np.array([[0.5]]), {}, np.array([False]), 1, settings)
    assert held.recorded == pytest.approx([1.0 / 21.0])
    assert '0 % of the values of level' in held.reason(0.5)
