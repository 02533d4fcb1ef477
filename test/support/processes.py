# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Programs in the test's own process, processes that others started, and pipes that they read."""

import errno
import os
from pathlib import Path
import time
from types import ModuleType
from typing import BinaryIO

import pytest

from koopman_ros.testing import Harness, isolated_domain
from support.messages import TIMEOUT


def run_here(program: ModuleType, *arguments: str, **parameters: object) -> int:
    """Run a program with ROS arguments after its parameters; return its exit code."""
    given = [part for name, value in parameters.items() for part in ('-p', f'{name}:={value}')]
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
    """Return the processes that a process has started."""
    return [int(path.name) for path in Path('/proc').glob('[0-9]*')
            if _stat(int(path.name))[1:2] == [str(pid)]]


def ended(pid: int) -> bool:
    """Tell whether a process has ended, even if nobody is there who waits for it."""
    return _stat(pid)[:1] in ([], ['Z'])


def wait_until_ended(pid: int) -> None:
    """Wait for that."""
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
