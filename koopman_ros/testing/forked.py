# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Nodes that begin where their imports end: forked from a process that has imported them once."""

from __future__ import annotations

import atexit
from collections.abc import Mapping
import contextlib
import faulthandler
import gc
import importlib
import json
import os
from pathlib import Path
import select
import signal
import socket
import subprocess
import sys
import threading
from typing import Any

from koopman_ros import startup
from koopman_ros.testing.guard import guard

# Those of this list, and what they import, start no thread, which a fork would lose.
_IMPORTED = [f'koopman_ros.nodes.{name}'
             for name in ('controller', 'plant', 'trainer', 'player', 'panel')]
_LONGEST = 1 << 20  # bytes of a request

_lock = threading.Lock()
_servers: dict[int, socket.socket] = {}  # by the process that asks: a forked one has its own


class Forked:
    """
    A program of this package in a process of its own, with the methods of `subprocess.Popen`.

    It is what an exec of ``python -m`` would be but for its imports, some 0.4 s of processor time
    for each node, which the processes of one test run share; a session of its own, standard input
    from nowhere. What a library reads from the environment while it is imported is that of the
    first one.

    :param module: e.g. ``koopman_ros.nodes.plant``.
    :param arguments: of its command line.
    :param log: file for what it prints.
    :param environment: all its variables.
    """

    def __init__(self, module: str, arguments: tuple[str, ...], log: Path,
                 environment: Mapping[str, str]) -> None:
        self._code: int | None = None
        with open(log, 'wb') as output:
            self.pid = _asked({'module': module, 'arguments': arguments,
                               'environment': dict(environment)}, output.fileno())
        # whoever forked it does not wait for it before it is asked to
        self._end = os.pidfd_open(self.pid)

    def poll(self) -> int | None:
        """Return the exit code, negative after a signal; None while it runs."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.wait(0.0)
        return self._code

    def wait(self, timeout: float | None = None) -> int:
        """
        Wait for its end and return its exit code.

        :raises subprocess.TimeoutExpired: where that takes more than so many s.
        """
        if self._code is None:
            if not select.select([self._end], [], [], timeout)[0]:
                raise subprocess.TimeoutExpired(str(self.pid), timeout or 0.0)
            self._code = _asked({'ended': self.pid})
            os.close(self._end)
        return self._code

    def send_signal(self, number: int) -> None:
        """Send a signal, unless it has ended."""
        if self.poll() is None:
            signal.pidfd_send_signal(self._end, number)

    def kill(self) -> None:
        """End it at once."""
        self.send_signal(signal.SIGKILL)


def _asked(request: Mapping[str, Any], *files: int) -> int:
    """Ask the server of this process, which is started where there is none yet."""
    own = os.getpid()
    with _lock:
        if own not in _servers:
            _servers[own] = _start()
            # by which the server ends
            atexit.register(_servers[own].close)
        socket.send_fds(_servers[own], [json.dumps(request).encode()], files)
        return int(_servers[own].recv(_LONGEST))


def _start() -> socket.socket:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    # its processes inherit that, and let signals pass once they handle them
    with theirs, startup.blocked_signals():
        server = subprocess.Popen(
            [sys.executable, '-c', f'import sys; from {__name__} import main; sys.exit(main())'],
            stdin=theirs.fileno(), start_new_session=True)
    guard(server.pid)
    # it ends with the socket, and is no child to wait for
    server.returncode = 0
    return ours


def main() -> int:
    """Fork a program for each request on standard input, until its other end is closed."""
    for name in _IMPORTED:
        importlib.import_module(name)
    gc.freeze()
    with socket.socket(fileno=os.dup(0)) as requests:
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        while True:
            data, files, _, _ = socket.recv_fds(requests, _LONGEST, 1)
            if not data:
                return 0
            request = json.loads(data)
            if 'ended' in request:
                answer = os.waitstatus_to_exitcode(os.waitpid(request['ended'], 0)[1])
            elif not (answer := os.fork()):
                break
            else:
                os.close(*files)
            requests.send(str(answer).encode())
    os.setsid()
    (output,) = files
    for stream in (1, 2):
        os.dup2(output, stream)
    os.close(output)
    os.environ.clear()
    os.environ.update(request['environment'])
    faulthandler.enable()
    return startup.run_child(
        os.getppid(), signal.SIGINT, 0, request['module'], request['arguments'])
