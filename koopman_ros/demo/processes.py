# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Nodes as processes of their own, in a ROS domain of their own, ended whatever happens."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import contextlib
import hashlib
import os
from pathlib import Path
import signal
import socket
import subprocess
from types import TracebackType

from koopman_ros.nodes.exposure import LOOPBACK_PROFILE
from koopman_ros.nodes.shipped import config_directory
from koopman_ros.startup import blocked_signals
from koopman_ros.startup import command as child_command

_DOMAINS = range(1, 102)
STOP_TIMEOUT = 10.0  # s from a signal to the end of a process


@contextlib.contextmanager
def isolated_domain() -> Iterator[dict[str, str]]:
    """
    Reserve a ROS domain on loopback that no other run on this machine uses.

    Yields the environment variables of the run, which hold for this process, too, until the end.
    A middleware that RMW_IMPLEMENTATION names stays, else it is Fast DDS, whose profile keeps
    everything on 127.0.0.1 and says what else it is for.

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
        before = {name: os.environ.get(name) for name in environment}
        os.environ.update(environment)
        try:
            yield environment
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
        with _reservation(f'domain_{domain}') as mine:
            if mine:
                yield domain
                return
    raise RuntimeError('all ROS domains are taken by other runs: wait until one ends')


@contextlib.contextmanager
def reserved_output(wanted: Path) -> Iterator[Path]:
    """
    Reserve a folder for the results of a run.

    It is the one wanted or, while another run on this machine writes there, the first of demo-2,
    demo-3, ... that is free.

    :param wanted: the folder, which need not exist.
    """
    folder, number = wanted, 1
    while True:
        # a name of a socket has little room
        digest = hashlib.sha256(os.fsencode(folder.resolve())).hexdigest()[:32]
        with _reservation(f'output_{digest}') as mine:
            if mine:
                yield folder
                return
        number += 1
        folder = wanted.with_name(f'{wanted.name}-{number}')


@contextlib.contextmanager
def _reservation(name: str) -> Iterator[bool]:
    """Hold a name on this machine; yields whether nobody else holds it."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as held:
        mine = True
        try:
            # an abstract name: whoever's process holds it, it goes when the process ends
            held.bind(f'\0koopman_ros_{name}')
        except OSError:
            mine = False
        yield mine


class NodeProcess:
    """
    One node running as a process; leaving the context ends it, as does the end of this process.

    :param name: ``plant``, ``controller`` or ``trainer``.
    :param parameters: values other than the node's defaults.
    :param log: file for everything the process prints.
    :param environment: variables on top of the present ones.
    :param arguments: further ROS arguments, e.g. ``('-r', '__ns:=/unit_1')``.
    :param command: what to run instead of the module of this package.
    """

    def __init__(self, name: str, parameters: Mapping[str, object], log: Path,
                 environment: Mapping[str, str], arguments: tuple[str, ...] = (),
                 command: tuple[str, ...] | None = None) -> None:
        self.name = name
        self.log = log
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
                stdin=subprocess.DEVNULL, env={**os.environ, **environment},
                start_new_session=True)

    @property
    def running(self) -> bool:
        """Whether the process has not ended."""
        return self.process.poll() is None

    def output(self) -> str:
        """Return what the process has printed so far."""
        return self.log.read_text(errors='replace')

    def stop(self, number: int = signal.SIGINT) -> int:
        """
        End the process by a signal, and by SIGKILL if it does not end in time.

        :return: its exit code; negative after a signal that it did not handle.
        """
        if self.running:
            self.process.send_signal(number)
        try:
            return self.process.wait(STOP_TIMEOUT)
        except subprocess.TimeoutExpired:
            self.process.kill()
            return self.process.wait()

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
