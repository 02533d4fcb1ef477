# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Range and rate limits of the inputs, and the offset that makes a change of law bumpless."""

import numpy as np
import pytest

from koopman_ros.control import InputLimits, limit
from koopman_ros.control.limits import Transfer


@pytest.mark.parametrize(('previous', 'wanted', 'seconds', 'rate', 'u', 'at_range', 'at_rate'), [
    # the first command has no rate
    (None, 0.0, 0.0, 2.0, 0.0, False, False), (None, 5.0, 0.0, 2.0, 5.0, False, False),
    (None, 5.1, 0.0, 2.0, 5.0, True, False), (None, -9.0, 0.0, 2.0, -1.0, True, False),
    (None, 1e308, 0.0, 2.0, 5.0, True, False), (None, np.inf, 0.0, 2.0, 5.0, True, False),
    # the rate counts from the last one
    (1.0, 3.0, 1.0, 2.0, 3.0, False, False), (1.0, 3.5, 1.0, 2.0, 3.0, False, True),
    (1.0, -0.9, 0.5, 2.0, 0.0, False, True), (1.0, 9.0, 1.0, 2.0, 3.0, True, True),
    (1.0, 9.0, 10.0, 2.0, 5.0, True, False), (1.0, 3.0, 0.0, 2.0, 1.0, False, True),
    (1.0, 1.0, 0.0, 2.0, 1.0, False, False),
    # a range that was tightened is reached at the rate
    (8.0, 3.0, 0.1, 2.0, 7.8, False, True), (8.0, 9.0, 0.1, 2.0, 7.8, True, True),
    # no rate limit, but none without elapsed time either
    (-1.0, 4.0, 1e-9, np.inf, 4.0, False, False), (-1.0, 4.0, 0.0, np.inf, -1.0, False, True)])
def test_limits(previous, wanted, seconds, rate, u, at_range, at_rate):
    bounds = InputLimits(np.array([-1.0]), np.array([5.0]), np.array([rate]))
    limited = limit(bounds, np.array([wanted]), None if previous is None else np.array([previous]),
                    seconds)
    assert (limited.u[0], limited.at_range, limited.at_rate) == (
        pytest.approx(u, rel=1e-15), at_range, at_rate)


def test_each_input_has_its_own_limits():
    both = InputLimits(np.array([0.0, -5.0]), np.array([1.0, 5.0]), np.array([9.0, 0.5]))
    limited = limit(both, np.array([3.0, 3.0]), np.array([0.5, 0.0]), 1.0)
    np.testing.assert_array_equal(limited.u, [1.0, 0.5])
    assert limited.at_range
    assert limited.at_rate


def step(size: float) -> Transfer:
    return Transfer(np.array([size]), np.array([size]))


def faded(seconds: float, constant: float) -> float:
    return (1.0 + seconds / constant) * float(np.exp(-seconds / constant))


@pytest.mark.parametrize('steps', [[10.0], [1.0] * 10, [0.3, 4.7, 5.0]])
def test_an_offset_fades_by_its_formula_however_it_is_sampled(steps):
    transfer = step(3.0)
    for seconds in steps:
        transfer = transfer.after(seconds, 30.0)
    np.testing.assert_allclose(transfer.offset, [3.0 * faded(10.0, 30.0)], rtol=1e-12)


def test_offsets_add_up():
    transfer = step(2.0).after(10.0, 30.0).shifted(np.array([-1.0])).after(20.0, 30.0)
    expected = 2.0 * faded(30.0, 30.0) - faded(20.0, 30.0)
    np.testing.assert_allclose(transfer.offset, [expected], rtol=1e-12)


def test_an_offset_ends():
    transfer, seconds = step(5.0), 0
    while transfer is not None:
        transfer, seconds = transfer.after(1.0, 30.0), seconds + 1
    assert 500 < seconds < 1000
    assert step(5.0).after(1e9, 30.0) is None
    # without a time constant, with the next sample
    assert step(5.0).after(0.0, 0.0).offset[0] == 5.0
    assert step(5.0).after(1e-9, 0.0) is None
