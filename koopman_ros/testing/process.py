# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A node, or another program, as a process that is ended whatever happens."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
import contextlib
import os
from pathlib import Path
import signal
import subprocess
from types import TracebackType

from koopman_ros.startup import blocked_signals, SIGNALS
from koopman_ros.startup import command as child_command
from koopman_ros.testing.guard import guard

STOP_TIMEOUT = 10.0  # s from a signal to the end of a process
_ABORT_TIMEOUT = 1.0  # s from SIGABRT, at which Python prints where it is, to SIGKILL


class NodeProcess:
    """
    A process with a log; leaving the context ends it, as does the end of this process.

    :param name: a node of this package, e.g. ``plant``; with `command`, what to call it.
    :param parameters: values other than the node's defaults.
    :param log: file for everything that the process prints.
    :param environment: variables on top of the present ones.
    :param arguments: further ROS arguments, e.g. ``('-r', '__ns:=/unit_1')``.
    :param command: what to run instead of a node of this package.

    :ivar told_to_end: whether its end is expected, e.g. after :meth:`stop`.
    """

    def __init__(self, name: str, parameters: Mapping[str, object], log: Path,
                 environment: Mapping[str, str], arguments: tuple[str, ...] = (),
                 command: tuple[str, ...] | None = None) -> None:
        self.name = name
        self.log = log
        self.told_to_end = False
        given = [part for key, value in parameters.items()
                 for part in ('-p', f'{key}:={_as_argument(value)}')]
        program = command or child_command(
            f'koopman_ros.nodes.{name}', signal.SIGINT, interrupted=0)
        waiting = contextlib.nullcontext() if command else blocked_signals()
        ros_arguments = ['--ros-args', *given, *arguments] if given or arguments else []
        with open(log, 'wb') as output, waiting:
            # a session of its own: an interrupt of the terminal is passed on by us, in order
            self.process = subprocess.Popen(
                [*program, *ros_arguments], stdout=output, stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL, start_new_session=True,
                env={**os.environ, 'PYTHONFAULTHANDLER': '1', **environment})
            guard(self.process.pid)

    @property
    def running(self) -> bool:
        """Whether the process has not ended."""
        return self.process.poll() is None

    def output(self) -> str:
        """Return what the process has printed so far."""
        return self.log.read_text(errors='replace')

    def send(self, number: int) -> None:
        """Send a signal that ends the process, also when it was stopped by another one."""
        self.told_to_end = True
        if self.running:
            self.process.send_signal(number)
            self.process.send_signal(signal.SIGCONT)

    def wait(self, timeout: float | None = None) -> int:
        """
        Wait until the process ends, by itself or after a signal; abort it when that takes long.

        A Python process that is aborted prints where it was.

        :param timeout: in s, `STOP_TIMEOUT` by default.
        :return: its exit code; negative after a signal that it did not handle.
        """
        self.told_to_end = True
        patience = STOP_TIMEOUT if timeout is None else timeout
        for seconds, next_signal in ((patience, signal.SIGABRT), (_ABORT_TIMEOUT, signal.SIGKILL)):
            try:
                return self.process.wait(seconds)
            except subprocess.TimeoutExpired:
                self.process.send_signal(next_signal)
        return self.process.wait()

    def stop(self, number: int = signal.SIGINT) -> int:
        """End the process by a signal; see :meth:`wait`."""
        self.send(number)
        return self.wait()

    def __enter__(self) -> NodeProcess:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self.stop()


def _as_argument(value: object) -> str:
    """Write a parameter value for the command line, keeping its type."""
    if isinstance(value, bool):
        return 'true' if value else 'false'
    if isinstance(value, (tuple, list)):
        return '[' + ','.join(str(item) for item in value) + ']'
    return str(value)


@contextlib.contextmanager
def deferred_interrupt() -> Iterator[Callable[[], None]]:
    """
    Let a signal raise KeyboardInterrupt where the yielded function is called, and at the end.

    One that comes while Python looks after a child leaves the child's lock taken for ever, and
    one inside the middleware's extension comes out as another error. The processes live in
    sessions of their own: without us nobody would end them.
    """
    pending: list[bool] = []

    def check() -> None:
        if pending:
            raise KeyboardInterrupt

    before = {number: signal.signal(number, lambda *_: pending.append(True))
              for number in SIGNALS}
    try:
        yield check
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    check()
