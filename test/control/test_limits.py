# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Range and rate limits of the inputs."""

import numpy as np
import pytest

from koopman_ros.control import InputLimits, limit


def limits(rate=2.0):
    return InputLimits(np.array([-1.0]), np.array([5.0]), np.array([rate]))


@pytest.mark.parametrize(('wanted', 'u', 'at_range'), [
    (0.0, 0.0, False), (5.0, 5.0, False), (-1.0, -1.0, False), (5.1, 5.0, True),
    (-9.0, -1.0, True), (1e308, 5.0, True), (np.inf, 5.0, True)])
def test_the_first_command_has_no_rate(wanted, u, at_range):
    limited = limit(limits(), np.array([wanted]), None, 0.0)
    assert (limited.u[0], limited.at_range, limited.at_rate) == (u, at_range, False)


@pytest.mark.parametrize(('wanted', 'seconds', 'u', 'at_range', 'at_rate'), [
    (1.5, 1.0, 1.5, False, False),
    (3.0, 1.0, 3.0, False, False),
    (3.5, 1.0, 3.0, False, True),
    (-0.9, 0.5, 0.0, False, True),
    (9.0, 1.0, 3.0, True, True),
    (9.0, 10.0, 5.0, True, False),
    (3.0, 0.0, 1.0, False, True),
    (1.0, 0.0, 1.0, False, False),
])
def test_the_rate_counts_from_the_last_command(wanted, seconds, u, at_range, at_rate):
    limited = limit(limits(), np.array([wanted]), np.array([1.0]), seconds)
    assert (limited.u[0], limited.at_range, limited.at_rate) == (u, at_range, at_rate)


@pytest.mark.parametrize(('wanted', 'u'), [(3.0, 7.8), (9.0, 7.8), (7.0, 7.8)])
def test_a_range_that_was_tightened_is_reached_at_the_rate(wanted, u):
    limited = limit(limits(), np.array([wanted]), np.array([8.0]), 0.1)
    assert limited.u[0] == pytest.approx(u)


def test_no_rate_limit():
    assert limit(limits(np.inf), np.array([4.0]), np.array([-1.0]), 1e-9).u[0] == 4.0


def test_no_rate_limit_without_elapsed_time():
    limited = limit(limits(np.inf), np.array([4.0]), np.array([-1.0]), 0.0)
    assert (limited.u[0], limited.at_rate) == (-1.0, True)


def test_each_input_has_its_own_limits():
    both = InputLimits(np.array([0.0, -5.0]), np.array([1.0, 5.0]), np.array([9.0, 0.5]))
    limited = limit(both, np.array([3.0, 3.0]), np.array([0.5, 0.0]), 1.0)
    np.testing.assert_array_equal(limited.u, [1.0, 0.5])
    assert limited.at_range
    assert limited.at_rate
