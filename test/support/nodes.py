# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Of tests with nodes: fixtures, messages and statuses, programs and processes, pipes."""

from collections.abc import Callable, Iterable, Iterator, Mapping
import contextlib
import errno
import gc
import os
from pathlib import Path
import time
from types import ModuleType
from typing import Any, BinaryIO
import warnings

from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
import pytest
from rcl_interfaces.msg import Parameter, ParameterValue, SetParametersResult
from rcl_interfaces.srv import GetParameters, SetParametersAtomically
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Temperature

from koopman_ros.core.units import NANOSECONDS
from koopman_ros.ros.managed import ManagedNode
from koopman_ros.ros.time_conversion import stamp_message, stamp_nanoseconds
from koopman_ros.testing import Harness, isolated_domain

RunNode = Callable[..., ManagedNode]
# In s; a test that waits this long has failed, on a busy machine, too, where a process of low
# priority gets a fiftieth of a core.
TIMEOUT = 500.0


def temperature(celsius: float, seconds: float = 0.0) -> Temperature:
    message = Temperature(temperature=celsius)
    message.header.stamp = stamp_message(round(seconds * NANOSECONDS))
    return message


def seconds(message: Any) -> float:
    return stamp_nanoseconds(message.header.stamp) / NANOSECONDS


def value(status: DiagnosticStatus, key: str) -> str:
    return next(item.value for item in status.values if item.key == key)


@pytest.fixture(scope='session', autouse=True)
def type_support() -> None:
    """Load the type support once; its parser imports a module that Python deprecated."""
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', DeprecationWarning)
        serialize_message(Temperature())


@pytest.fixture
def ros(tmp_path: Path) -> Iterator[Harness]:
    """Yield a node in a domain of its own, which starts processes and talks to them."""
    with Harness(tmp_path, timeout=TIMEOUT) as bench:
        yield bench


class SharedHarness(Harness):
    """Remembers parameters of shared processes, and own endpoints, from before each test."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, timeout=TIMEOUT)
        self._before: dict[str, dict[str, ParameterValue]] = {}
        self.remember_endpoints()

    def remember_endpoints(self) -> None:
        """Remember the publishers and subscriptions that the tests to come share."""
        self._publishers = set(self.node.publishers)
        self._subscriptions = set(self.node.subscriptions)

    def set_parameters(self, node: str, **values: Any) -> list[SetParametersResult]:
        before = self._values(node, values)
        results = super().set_parameters(node, **values)
        self._remember(node, before, [result.successful for result in results])
        return results

    def set_parameters_atomically(self, node: str, **values: Any) -> SetParametersResult:
        before = self._values(node, values)
        result = super().set_parameters_atomically(node, **values)
        self._remember(node, before, [result.successful] * len(values))
        return result

    def _values(self, node: str, names: Iterable[str]) -> dict[str, ParameterValue]:
        found = self.call(GetParameters, f'{node}/get_parameters',
                          GetParameters.Request(names=list(names))).values
        # none where the node does not know one of the names
        return dict(zip(names, found, strict=False))

    def _remember(self, node: str, values: dict[str, ParameterValue], changed: list[bool]) -> None:
        first = self._before.setdefault(node, {})
        for (name, value), is_changed in zip(values.items(), changed, strict=False):
            if is_changed:
                first.setdefault(name, value)

    def restore(self) -> None:
        """Set all parameters back, and destroy endpoints that a test has made."""
        for publisher in set(self.node.publishers) - self._publishers:
            self.node.destroy_publisher(publisher)
        for subscription in set(self.node.subscriptions) - self._subscriptions:
            self.node.destroy_subscription(subscription)
        before, self._before = self._before, {}
        for node, values in before.items():
            # a node that a test has ended is gone
            if not any(process.running for process in self.processes):
                continue
            request = SetParametersAtomically.Request(parameters=[
                Parameter(name=name, value=value) for name, value in values.items()])
            result = until_read(lambda node=node, request=request: self.call(
                SetParametersAtomically, f'{node}/set_parameters_atomically', request).result)
            assert result.successful, f'{node} keeps what a test has set: {result.reason}'


def until_read(change: Callable[[], SetParametersResult]) -> SetParametersResult:
    """Change parameters, again if the machine is too busy to read a model in the moment."""
    while 'still being read' in (result := change()).reason:
        pass
    return result


@pytest.fixture(scope='module')
def shared_ros(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SharedHarness]:
    """Yield the same for tests that use one process after each other."""
    folder = tmp_path_factory.mktemp('shared')
    with SharedHarness(folder) as bench:
        yield bench


@pytest.fixture(autouse=True)
def left_as_found(request: pytest.FixtureRequest) -> Iterator[None]:
    """Set back what a test changed of shared processes, also after one that failed."""
    if 'shared_ros' not in request.fixturenames:
        yield
        return
    shared = request.getfixturevalue('shared_ros')
    shared.remember_endpoints()
    yield
    shared.restore()


@contextlib.contextmanager
def running(ros: Harness, create: Callable[..., ManagedNode], parameters: Mapping[str, object],
            *arguments: str) -> Iterator[ManagedNode]:
    """Run a node in the thread of the test, where an error of the node is raised."""
    given = [part for name, value in parameters.items() for part in (
        '-p', f'{name}:={str(value).lower() if isinstance(value, bool) else value}')]
    node = create(context=ros.node.context, cli_args=['--ros-args', *given, *arguments])
    try:
        node.start()
        ros.node.executor.add_node(node)
        yield node
        node.complete()
    finally:
        node.destroy_node()


@pytest.fixture
def run_node(ros: Harness) -> Iterator[RunNode]:
    """Yield a function that runs a node in the thread of the test, until the end."""
    with contextlib.ExitStack() as stack:
        yield lambda *given: stack.enter_context(running(ros, *given))


def change(ros: Harness, node: str, label: str = '', number: int = 0) -> bool:
    """Ask for a transition by its label, or as managers do by its number."""
    return bool(ros.call(ChangeState, f'{node}/change_state', ChangeState.Request(
        transition=Transition(label=label, id=number))).success)


def run_here(program: ModuleType, *arguments: str, **parameters: object) -> int:
    """Run a program with ROS arguments after its parameters; return its exit code."""
    given = [part for name, value in parameters.items() for part in ('-p', f'{name}:={value}')]
    # a node that could not start before may still be there, whose name would be taken
    gc.collect()
    with isolated_domain():
        return int(program.main(['program', '--ros-args', *given, *arguments]))


def complaint(capfd: pytest.CaptureFixture[str]) -> str:
    """Return the one line in which a program said what is wrong."""
    (line,) = [line for line in capfd.readouterr().err.splitlines() if '[INFO]' not in line]
    return line


def _stat(pid: int) -> list[str]:
    """Return the state of a process, its parent and more; nothing when there is no process."""
    try:
        return Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    except (FileNotFoundError, ProcessLookupError):
        return []


def children(pid: int) -> list[int]:
    return [int(path.name) for path in Path('/proc').glob('[0-9]*')
            if _stat(int(path.name))[1:2] == [str(pid)]]


def ended(pid: int) -> bool:
    """Tell whether a process has ended, even if nobody is there who waits for it."""
    return _stat(pid)[:1] in ([], ['Z'])


def wait_until_ended(pid: int) -> None:
    deadline = time.monotonic() + TIMEOUT
    while not ended(pid):
        assert time.monotonic() < deadline
        time.sleep(0.01)


def opened(ros: Harness, pipe: Path) -> BinaryIO:
    """Wait until somebody reads from a named pipe, as from a slow disk; return where to write."""
    def end() -> BinaryIO | None:
        try:
            return os.fdopen(os.open(pipe, os.O_WRONLY | os.O_NONBLOCK), 'wb')
        except OSError as error:
            if error.errno != errno.ENXIO:
                raise
            # nobody reads yet
            return None

    found = ros.wait_until(end)
    assert found is not None
    return found
