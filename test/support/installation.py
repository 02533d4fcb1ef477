# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The package as colcon installs it, and processes started from there."""

from dataclasses import dataclass
import os
from pathlib import Path
import shlex
import shutil
import subprocess
import sys

import pytest

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class Installation:
    executables: Path  #: folder of the nodes
    share: Path  #: folder of manifest and configuration
    package: Path  #: folder of the package
    before: str  #: what a shell does before it starts a process
    python: Path  #: the interpreter
    notes: Path  #: names the files of the repository that its processes opened

    def opened(self) -> str:
        """Return the files of the repository that were opened so far, a line each."""
        return self.notes.read_text() if self.notes.exists() else ''

    def command(self, *command: str) -> tuple[str, ...]:
        """Return a command that runs another in this installation, in a folder beside it."""
        program = f'cd {self.notes.parent} && {self.before} && exec "$0" "$@"'
        return ('bash', '-c', program, *command)


def sources(folder: Path) -> Path:
    """Copy what the package is built from, but none of its builds."""
    wanted = {'package.xml', 'setup.py', 'setup.cfg', 'resource', 'config', 'examples',
              'koopman_ros'}
    return shutil.copytree(ROOT, folder, ignore=lambda path, names: {'__pycache__'} | (
        {*names} - wanted if Path(path) == ROOT else set()))


def run(command: tuple[str, ...], **options: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, capture_output=True, text=True, timeout=240, check=False,
                          **options)  # type: ignore[call-overload]


def underlay() -> str:
    """Return a command of a shell that keeps a sourced ROS 2, but no workspace of this package."""
    kept = (f'{variable}=' + os.pathsep.join(
        name for name in os.environ.get(variable, '').split(os.pathsep)
        if name and not any((Path(name) / mark).exists() for mark in marks))
        for variable, marks in (('PYTHONPATH', ('koopman_ros', 'koopman-ros.egg-link')),
                                ('AMENT_PREFIX_PATH', ('share/koopman_ros',))))
    return 'export ' + ' '.join(map(shlex.quote, kept))


@pytest.fixture(scope='session')
def colcon(tmp_path_factory: pytest.TempPathFactory) -> Installation:
    """Build the package in a workspace of its own."""
    folder = tmp_path_factory.mktemp('workspace')
    sources(folder / 'src' / 'koopman_ros')
    built = run((sys.executable, '-m', 'colcon', 'build', '--event-handlers', 'console_direct+'),
                cwd=folder)
    assert built.returncode == 0, built.stdout + built.stderr
    prefix = folder / 'install' / 'koopman_ros'
    (site,) = prefix.glob('lib/python*/site-packages')
    return Installation(
        prefix / 'lib' / 'koopman_ros', prefix / 'share' / 'koopman_ros', site / 'koopman_ros',
        f'. {folder}/install/setup.bash', Path(sys.executable), folder / 'notes')
