# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Bumpless transfer: exact, whatever the samples, and without an end."""

import numpy as np
import pytest

from koopman_ros.control.limits import Transfer


def faded(seconds: float, constant: float) -> float:
    return (1.0 + seconds / constant) * float(np.exp(-seconds / constant))


@pytest.mark.parametrize('steps', [[10.0], [1.0] * 10, [0.3, 4.7, 5.0]])
def test_it_fades_by_its_formula_however_it_is_sampled(steps):
    transfer = Transfer(np.array([3.0]), np.array([3.0]))
    for step in steps:
        transfer = transfer.after(step, 30.0)
    np.testing.assert_allclose(transfer.offset, [3.0 * faded(10.0, 30.0)], rtol=1e-12)


def test_it_is_flat_at_first():
    transfer = Transfer(np.array([5.0]), np.array([5.0])).after(1.0, 30.0)
    assert 5.0 - transfer.offset[0] == pytest.approx(5.0 / 1800.0, rel=0.05)


def test_steps_add_up():
    transfer = Transfer(np.array([2.0]), np.array([2.0])).after(10.0, 30.0)
    transfer = transfer.shifted(np.array([-1.0])).after(20.0, 30.0)
    expected = 2.0 * faded(30.0, 30.0) - faded(20.0, 30.0)
    np.testing.assert_allclose(transfer.offset, [expected], rtol=1e-12)


def test_it_ends():
    transfer, seconds = Transfer(np.array([5.0]), np.array([5.0])), 0
    while transfer is not None:
        transfer, seconds = transfer.after(1.0, 30.0), seconds + 1
    assert 500 < seconds < 1000
    assert Transfer(np.array([5.0]), np.array([5.0])).after(1e9, 30.0) is None


@pytest.mark.parametrize(('seconds', 'left'), [(0.0, 5.0), (1e-9, 0.0)])
def test_without_a_time_constant_it_ends_with_the_next_sample(seconds, left):
    transfer = Transfer(np.array([5.0]), np.array([5.0])).after(seconds, 0.0)
    assert (0.0 if transfer is None else transfer.offset[0]) == left
