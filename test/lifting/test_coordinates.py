# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Boxes of states and inputs, from the range of samples."""

from dataclasses import replace

import numpy as np
import pytest

from koopman_ros.learning.scaled import deviations
from koopman_ros.lifting import Box
from koopman_ros.plant_data import Plant
from support.small_plants import BENT, bent_samples


def test_box_scales_by_half_the_range_from_the_nominal_point():
    samples = bent_samples()
    box = Box.of(BENT, samples.x, samples.u)
    np.testing.assert_array_equal(box.states.center, [3.0])
    np.testing.assert_array_equal(box.inputs.center, [0.5])
    np.testing.assert_array_equal(box.states.lower, samples.x.min(axis=0))
    np.testing.assert_array_equal(box.states.upper, samples.x.max(axis=0))
    np.testing.assert_array_equal(box.states.scale, np.ptp(samples.x, axis=0) / 2.0)
    assert (box.states.names, box.inputs.units, box.time_unit) == (
        ('level',), ('m/s',), 's')
    # the equation holds in deviations, too
    x, rate, u = deviations(box, samples)
    np.testing.assert_allclose(
        rate, (-x - 0.3 * box.states.scale * x * x) + u @ box.input_matrix(BENT.B).T,
        rtol=0, atol=1e-14)


def test_box_without_inputs():
    plant = Plant('free', ('x',), ('1',), (), (), 's', np.zeros(1), np.zeros(0), np.zeros((1, 0)))
    samples = replace(bent_samples(), u=np.zeros((180, 0)))
    box = Box.of(plant, samples.x, samples.u)
    assert len(box.inputs) == 0
    assert box.input_matrix(plant.B).shape == (1, 0)
    assert deviations(box, samples)[2].shape == (180, 0)


@pytest.mark.parametrize(('name', 'value', 'message'), [
    ('u', 0.5, r'flow never moves from 0\.5 m/s: excite the plant'),
    ('x', 3.0, r'level never moves from 3\.0 m: excite the plant')])
def test_what_never_moves(name, value, message):
    still = replace(bent_samples(), **{name: np.full((180, 1), value)})
    with pytest.raises(ValueError, match=message):
        Box.of(BENT, still.x, still.u)


def test_a_plant_of_another_size():
    with pytest.raises(ValueError, match='there are values of 2 signals for 1 names: flow'):
        Box.of(BENT, bent_samples().x, np.zeros((180, 2)))
    with pytest.raises(ValueError, match=r'incompatible B: expected \(1, 1\), got \(2, 1\)'):
        Box.of(BENT, bent_samples().x, bent_samples().u).input_matrix(np.ones((2, 1)))
