# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Names that one run on this machine reserves: its ROS domain, its folder for results."""

from collections.abc import Iterator
import contextlib
import hashlib
import os
from pathlib import Path
import socket

from koopman_ros.resources import config_directory, LOOPBACK_PROFILE

_DOMAINS = range(1, 102)


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
