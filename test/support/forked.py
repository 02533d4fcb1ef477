# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Start nodes by forking a process that has imported most of what they import, half of a start."""

from collections.abc import Mapping, Sequence
import contextlib
import faulthandler
import multiprocessing
from multiprocessing import forkserver, resource_tracker
import os
import signal
import subprocess
import sys
from typing import Any, BinaryIO
from unittest import mock

from koopman_ros import process_entry

_CHILD = process_entry.command('', signal.SIGINT, 0)[:3]
_CONTEXT = multiprocessing.get_context('forkserver')
# Not rclpy: its import starts threads of the middleware, which a fork would not have.
_CONTEXT.set_forkserver_preload([
    'rosidl_generator_py', 'yaml', 'asyncio', *(f'koopman_ros.{name}' for name in (
        'control', 'evaluation', 'event_log.run', 'parameters.controller', 'parameters.player',
        'parameters.trainer', 'parameters.model_checks', 'plants.catalogue', 'records'))])


class ForkedProcess:
    """A node's process, with what is used of `subprocess.Popen`."""

    def __init__(self, command: Sequence[str], log: str, environment: Mapping[str, str]) -> None:
        self._process = _CONTEXT.Process(
            target=_run, args=(command, log, dict(environment), os.getcwd()), daemon=True)
        self._process.start()
        self.pid = self._process.pid

    def poll(self) -> int | None:
        return self._process.exitcode

    def wait(self, timeout: float | None = None) -> int:
        self._process.join(timeout)
        code = self.poll()
        if code is None:
            raise subprocess.TimeoutExpired('node', timeout or 0.0)
        return code

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


def start(command: Sequence[str], *, stdout: BinaryIO, env: Mapping[str, str], **others: Any
          ) -> subprocess.Popen[bytes] | ForkedProcess:
    """Start a process as `subprocess.Popen`: a node by a fork, any other program by itself."""
    if tuple(command[:3]) != _CHILD:
        return subprocess.Popen(command, stdout=stdout, env=env, **others)
    resource_tracker.ensure_running()
    # signals are blocked in each process that is forked from the server until it handles them, and
    # its BLAS has one thread, as that of a node
    with process_entry.blocked_signals(), mock.patch.dict(os.environ, process_entry.ONE_THREAD):
        forkserver.ensure_running()
    return ForkedProcess(command, stdout.name, env)


def _run(command: Sequence[str], log: str, environment: Mapping[str, str], folder: str) -> None:
    """Be the process that the command would have started."""
    os.setsid()
    output = os.open(log, os.O_WRONLY | os.O_APPEND)
    os.dup2(output, 1)
    os.dup2(output, 2)
    os.close(output)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    sys.path.insert(0, folder)
    faulthandler.enable()
    sys.argv = list(command[2:])
    sys.exit(process_entry.main())
