# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The share of the range of states and inputs that records visit."""

import numpy as np
import pytest

from koopman_ros.plant_data import Episode
from koopman_ros.retraining.task import CELLS, coverage, visited_cells
from support.known_plants import box

BOX = box([0.0], [10.0], [100.0], [200.0])


def record(x, u):
    times = np.arange(float(len(x)))
    return Episode(times, np.array(x)[:, None], times, np.array(u)[:, None])


def test_cells_are_counted_once():
    cells = visited_cells([record([0.0, 0.5, 9.9, 10.0], [100.0, 105.0, 199.0, 200.0]),
                           record([0.2, 5.0], [101.0, 150.0])], BOX)
    assert cells.tolist() == [[0, 0], [5, 5], [9, 9]]


def test_outside_counts_for_the_border():
    assert visited_cells([record([-3.0, 40.0], [90.0, 150.0])], BOX).tolist() == [[0, 0], [9, 5]]


def test_share_of_all_cells():
    centres = np.arange(0.5, CELLS)
    x, u = (a.ravel() for a in np.meshgrid(centres, 100.0 + 10.0 * centres))
    assert coverage([record(x, u)], BOX) == 1.0
    assert coverage([record(x[:37], u[:37])], BOX) == pytest.approx(0.37)


def test_inputs_are_those_that_held():
    held = Episode(np.arange(3.0), np.full((3, 1), 0.5), np.array([-1.0, 0.5]),
                  np.array([[105.0], [195.0]]))
    assert visited_cells([held], BOX).tolist() == [[0, 0], [0, 9]]


def test_cells_of_two_states():
    unit = box([0.0, 0.0], [1.0, 1.0], [0.0], [1.0])
    path = Episode(np.arange(2.0), np.array([[0.05, 0.95], [0.55, 0.45]]), np.zeros(1),
                  np.array([[0.35]]))
    assert visited_cells([path], unit).tolist() == [[0, 9, 3], [5, 4, 3]]
    assert coverage([path], unit) == pytest.approx(2e-3)
