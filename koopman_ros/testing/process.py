# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A process that is ended in any case; the domain and folder that a run has reserved."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
import contextlib
import hashlib
import os
from pathlib import Path
import signal
import socket
import subprocess
from types import TracebackType
from typing import ClassVar

from koopman_ros import process_entry
from koopman_ros.core.paths import config_directory, LOOPBACK_PROFILE

STOP_TIMEOUT = 10.0  # s from a signal to the end of a process
_ABORT_TIMEOUT = 1.0  # s from SIGABRT, at which Python prints where it is, to SIGKILL
_DOMAINS = range(1, 102)
# Reads until the end of this process, whatever ends it, and then ends the session of the child.
_GUARD = 'read _; kill -INT -$0; kill -CONT -$0; sleep $1; kill -KILL -$0'


class NodeProcess:
    """
    A process with a log; leaving the context ends it, as does the end of this process.

    :param name: a node of this package, e.g. ``plant``; with `command`, the name of the process.
    :param parameters: values other than the node's defaults.
    :param log: file for everything that the process prints.
    :param environment: variables on top of the present ones.
    :param arguments: further ROS arguments, e.g. ``('-r', '__ns:=/unit_1')``.
    :param command: command to run instead of a node of this package.
    :ivar told_to_end: whether its end is expected, e.g. after :meth:`stop`.
    :cvar popen: starts the processes, called as `subprocess.Popen`; returns the same interface.
    """

    popen: ClassVar[Callable[..., subprocess.Popen[bytes]]] = subprocess.Popen

    def __init__(self, name: str, parameters: Mapping[str, object], log: Path,
                 environment: Mapping[str, str], arguments: tuple[str, ...] = (),
                 command: tuple[str, ...] | None = None) -> None:
        self.name = name
        self.log = log
        self.told_to_end = False
        given = [part for key, value in parameters.items()
                 for part in ('-p', f'{key}:={_as_argument(value)}')]
        program = command or process_entry.command(
            f'koopman_ros.nodes.{name}', signal.SIGINT, interrupted=0)
        waiting = contextlib.nullcontext() if command else process_entry.blocked_signals()
        with open(log, 'wb') as output, waiting:
            # a session of its own: an interrupt of the terminal is passed on by us, in order
            self.process = self.popen(
                [*program, *(('--ros-args', *given, *arguments) if given or arguments else ())],
                stdout=output, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL,
                start_new_session=True,
                env={**os.environ, 'PYTHONFAULTHANDLER': '1', **environment})
        self._guard = subprocess.Popen(
            ['sh', '-c', _GUARD, str(self.process.pid), str(STOP_TIMEOUT)],
            stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            start_new_session=True)

    @property
    def running(self) -> bool:
        """Whether the process has not ended."""
        return self.process.poll() is None

    def output(self) -> str:
        """Return the output of the process so far."""
        return self.log.read_text(errors='replace')

    def send(self, number: int) -> None:
        """Send a signal that ends the process, also when it was stopped by another one."""
        self.told_to_end = True
        if self.running:
            self.process.send_signal(number)
            self.process.send_signal(signal.SIGCONT)

    def wait(self, timeout: float | None = None) -> int:
        """
        Wait until the process ends and return its exit code; abort it when that takes long.

        A Python process that is aborted prints where it was. The code is negative after a signal
        that it did not handle; the timeout is `STOP_TIMEOUT` seconds by default.
        """
        self.told_to_end = True
        patience = STOP_TIMEOUT if timeout is None else timeout
        for seconds, next_signal in ((patience, signal.SIGABRT), (_ABORT_TIMEOUT, signal.SIGKILL)):
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(seconds)
                break
            self.process.send_signal(next_signal)
        code = self.process.wait()
        self._guard.kill()
        self._guard.communicate()
        return code

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
        return str(value).lower()
    if isinstance(value, tuple | list):
        # in quotes, or a bracket or a colon in one would be read as YAML
        items = (repr(item) if isinstance(item, str) else str(item) for item in value)
        return f'[{",".join(items)}]'
    return str(value)


@contextlib.contextmanager
def deferred_interrupt() -> Iterator[Callable[[], None]]:
    """
    Let a signal raise KeyboardInterrupt where the yielded function is called, and at the end.

    One that comes while Python looks after a child leaves the child's lock taken for ever, and
    one inside the middleware's extension comes out as another error.
    """
    pending: list[bool] = []

    def check() -> None:
        if pending:
            raise KeyboardInterrupt

    before = {number: signal.signal(number, lambda *_: pending.append(True))
              for number in process_entry.SIGNALS}
    try:
        yield check
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    check()


@contextlib.contextmanager
def isolated_domain() -> Iterator[dict[str, str]]:
    """
    Reserve a ROS domain on loopback that no other run on this machine uses.

    Yields the environment variables of the run, which hold for this process, too, until the end. A
    middleware that RMW_IMPLEMENTATION names stays, else it is Fast DDS, whose profile keeps all
    traffic on 127.0.0.1 and lists its other purposes.

    :raises RuntimeError: when all domains are taken.
    """
    middleware = os.environ.get('RMW_IMPLEMENTATION') or 'rmw_fastrtps_cpp'
    with _reserved_domain() as domain:
        environment = {
            'ROS_DOMAIN_ID': str(domain),
            'RMW_IMPLEMENTATION': middleware,
            # the profile alone says where to look; others do not read it
            'ROS_AUTOMATIC_DISCOVERY_RANGE': (
                'SYSTEM_DEFAULT' if 'fastrtps' in middleware else 'LOCALHOST'),
            'FASTRTPS_DEFAULT_PROFILES_FILE': str(config_directory() / LOOPBACK_PROFILE),
        }
        with _variables(environment):
            yield environment


@contextlib.contextmanager
def given_domain(domain: str) -> Iterator[dict[str, str]]:
    """Work in a ROS domain, on this machine alone unless the environment says otherwise."""
    if not (domain.isdecimal() and int(domain) <= 232):
        raise ValueError(f'ROS_DOMAIN_ID is {domain!r}, must be a whole number from 0 to 232, '
                         'best up to 101')
    environment = {'ROS_DOMAIN_ID': domain, 'ROS_AUTOMATIC_DISCOVERY_RANGE': (
        os.environ.get('ROS_AUTOMATIC_DISCOVERY_RANGE') or 'LOCALHOST')}
    with _variables(environment):
        yield environment


@contextlib.contextmanager
def _variables(environment: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables of this process until the end."""
    before = {name: os.environ.get(name) for name in environment}
    os.environ.update(environment)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name)
            if value is not None:
                os.environ[name] = value


@contextlib.contextmanager
def _reserved_domain() -> Iterator[int]:
    # runs side by side start looking at different places
    offset = os.getpid() % len(_DOMAINS)
    for domain in (*_DOMAINS[offset:], *_DOMAINS[:offset]):
        with _reservation(f'domain_{domain}') as reserved:
            if reserved:
                yield domain
                return
    raise RuntimeError('all ROS domains are taken by other runs: wait until one ends')


@contextlib.contextmanager
def reserved_output(wanted: Path) -> Iterator[Path]:
    """
    Reserve a folder for the results of a run.

    It is the one wanted or, while another run on this machine writes there, the first of demo-2,
    demo-3, ... that is free.
    """
    folder, number = wanted, 1
    while True:
        # a name of a socket has little room
        digest = hashlib.sha256(os.fsencode(folder.resolve())).hexdigest()[:32]
        with _reservation(f'output_{digest}') as reserved:
            if reserved:
                yield folder
                return
        number += 1
        folder = wanted.with_name(f'{wanted.name}-{number}')


@contextlib.contextmanager
def _reservation(name: str) -> Iterator[bool]:
    """Hold a name on this machine; yields whether it was free."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as held:
        reserved = True
        try:
            # an abstract name, which disappears with the process that holds it
            held.bind(f'\0koopman_ros_{name}')
        except OSError:
            reserved = False
        yield reserved
