# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The static characteristic of an input and its inverse."""

import numpy as np
import pytest

from koopman_ros.core.characteristic import Characteristic

VALVE = Characteristic.of([0.0, 40.0, 60.0, 100.0], [0.0, 0.1, 0.1, 1.0])  # %, flow in m3/h


def test_it_is_inverted_also_beyond_its_ends():
    u = np.linspace(-50.0, 150.0, 41).reshape(1, -1)
    assert VALVE.value(VALVE.effect(u)) == pytest.approx(u, abs=1e-9)
    # the effect has the unit and the ends of the input
    assert VALVE.effect(np.array([0.0, 50.0, 100.0, 110.0, np.inf])) == pytest.approx(
        [0.0, 10.0, 100.0, 110.0, np.inf], abs=0.05)


def test_a_dead_zone_is_crossed_at_once():
    below, above = VALVE.value(np.array([9.9, 10.2]))
    assert (below, above) == pytest.approx((40.0, 60.0), abs=1.0)


@pytest.mark.parametrize(('values', 'effects'), [
    ([0.0, 1.0, 2.0], [0.0, 1.0, 0.5]), ([0.0, 1.0], [1.0, 1.0]), ([0.0, 0.0], [0.0, 1.0]),
    ([0.0], [0.0]), ([], []), ([0.0, 1.0], [0.0]), ([0.0, np.nan], [0.0, 1.0])])
def test_one_that_does_not_rise_is_rejected(values, effects):
    with pytest.raises(ValueError, match='characteristic'):
        Characteristic.of(values, effects)
