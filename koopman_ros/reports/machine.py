# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The machine and the versions that figures were measured with."""

from importlib.metadata import PackageNotFoundError, version
import os
from pathlib import Path
import platform
from typing import Any

from koopman_ros import __version__


def machine(*packages: str) -> dict[str, Any]:
    """Return processor, system and load of this machine, and the versions of some packages."""
    return {'processor': _processor(), 'cpu_count': os.cpu_count(),
            'system': platform.platform(), 'python': platform.python_version(),
            **{name: _version(name) for name in packages},
            'load_at_start': os.getloadavg()[0]}


def headline(*packages: str) -> str:
    """Return one line with the versions of this package and others, and the machine."""
    found = machine(*packages)
    versions = ''.join(f', {name} {found[name]}' for name in packages if found[name])
    return (f'koopman_ros {__version__}, Python {found["python"]}{versions}; '
            f'{found["processor"]}, {found["cpu_count"]} processors, load '
            f'{found["load_at_start"]:.1f}')


def _processor() -> str:
    try:
        lines = Path('/proc/cpuinfo').read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.partition(':')[2].strip() for line in lines
                 if line.startswith('model name')), platform.processor())


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None
