# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Real processes over real DDS: each test in a ROS domain of its own, on loopback."""

import fcntl
import os
from pathlib import Path

import pytest

from koopman_ros.demo.loop import run_loop, Scenario
from support.ros_fixtures import ros, shared_ros, type_support

__all__ = ['ros', 'shared_ros', 'type_support']


@pytest.fixture(scope='session')
def scenario() -> Scenario:
    """Return a minute of a loop with a step, a noisy two-state reactor and a slow coolant."""
    return Scenario('reactor_nz4', 315.15, step_time=20.0, duration=60.0,
                    plant={'reactor': 'two_state', 'noise': 0.05, 'seed': 3,
                           'command_delay': 1.0, 'coolant_lag': 2.0})


@pytest.fixture(scope='session')
def recorded_loop(tmp_path_factory: pytest.TempPathFactory, scenario: Scenario) -> Path:
    """Record the scenario, once for all workers."""
    folder = tmp_path_factory.getbasetemp()
    if 'PYTEST_XDIST_WORKER' in os.environ:
        folder = folder.parent
    (folder / 'recorded').mkdir(exist_ok=True)
    bag = folder / 'recorded' / 'loop.mcap'
    with (folder / 'recorded' / 'lock').open('w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not bag.exists():
            run_loop(scenario, bag, bag.parent)
    return bag
