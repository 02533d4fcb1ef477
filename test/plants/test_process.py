# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Tests of a plant that runs in time."""

import math

import numpy as np
import pytest

from koopman_ros.plants import (
    advance,
    IntegrationError,
    one_state_reactor,
    Process,
    scalar_example,
)

SECOND = 1_000_000_000


@pytest.fixture
def process() -> Process:
    system = one_state_reactor()
    return Process(system, 5 * SECOND, system.nominal_state - 3.0, system.nominal_input)


def test_reaches_an_instant_in_the_units_of_the_plant(process: Process) -> None:
    later = process.until(65 * SECOND)
    assert later.time_ns == 65 * SECOND
    # one minute of a plant whose time unit is the minute
    np.testing.assert_array_equal(
        later.x, advance(process.system, process.x, process.u, 1.0))


def test_seconds_and_time_units_agree_for_a_plant_in_seconds() -> None:
    system = scalar_example()
    start = Process(system, 0, np.array([0.5]), np.zeros(0))
    seconds = 1.5 / system.seconds_per_time_unit
    # xdot = x^2 has x(t) = x0 / (1 - x0 t)
    reached = start.until(round(1.5 * SECOND)).x[0]
    assert math.isclose(reached, 0.5 / (1.0 - 0.5 * seconds), rel_tol=1e-9)


def test_an_earlier_instant_changes_nothing(process: Process) -> None:
    assert process.until(4 * SECOND) is process
    assert process.until(5 * SECOND) is process


def test_a_steady_state_stays_to_the_bit_whatever_the_steps() -> None:
    system = one_state_reactor()
    process = Process(system, 0, system.nominal_state, system.nominal_input)
    for n in range(1, 11):
        process = process.until(n * SECOND)
    np.testing.assert_allclose(process.x, system.nominal_state, rtol=0.0, atol=1e-9)


def test_a_runaway_is_an_error() -> None:
    system = one_state_reactor()
    process = Process(system, 0, system.nominal_state, np.array([320.0]))
    with pytest.raises(IntegrationError, match='temperature'):
        process.until(3600 * SECOND)
