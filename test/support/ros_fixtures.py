# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Fixtures of tests over real DDS: each in a ROS domain of its own, on loopback."""

from collections.abc import Iterator
from pathlib import Path
import warnings

import pytest
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Temperature

from koopman_ros.testing import Harness


@pytest.fixture(scope='session', autouse=True)
def type_support() -> None:
    """Load the type support once; its parser imports a module that Python deprecated."""
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', DeprecationWarning)
        serialize_message(Temperature())


@pytest.fixture
def ros(tmp_path: Path) -> Iterator[Harness]:
    """Yield a node in a domain of its own, which starts processes and talks to them."""
    with Harness(tmp_path) as bench:
        yield bench


@pytest.fixture(scope='module')
def shared_ros(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Harness]:
    """Yield the same for tests that use one process after each other."""
    folder = tmp_path_factory.mktemp('shared')
    with Harness(folder) as bench:
        yield bench
