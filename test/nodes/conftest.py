# Copyright 2026 The koopman_ros Authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Real processes over real DDS: each test in a ROS domain of its own, on loopback."""

from collections.abc import Iterator
from pathlib import Path
import warnings

from koopman_ros.demo.processes import isolated_domain
import pytest
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Temperature
from workbench import Workbench


@pytest.fixture(scope='session', autouse=True)
def type_support() -> None:
    """Load the type support once; its parser imports a module that Python deprecated."""
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', DeprecationWarning)
        serialize_message(Temperature())


@pytest.fixture
def ros(tmp_path: Path) -> Iterator[Workbench]:
    """Yield a node in a domain of its own, which starts processes and talks to them."""
    with isolated_domain() as environment, Workbench(environment, tmp_path) as bench:
        yield bench


@pytest.fixture(scope='module')
def shared_ros(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Workbench]:
    """Yield the same for tests that use one process after each other."""
    folder = tmp_path_factory.mktemp('shared')
    with isolated_domain() as environment, Workbench(environment, folder) as bench:
        yield bench
