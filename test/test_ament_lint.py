# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The linters of ROS 2 that fit the project, from a sourced ROS 2 or a Debian package.

Not among them: ament_copyright knows no SPDX lines, and ament_xmllint loads its schema from the
network; `test_package.py` tests both. ament_mypy would check what `make lint` does.
"""

import os
from pathlib import Path
import shutil
import subprocess

import pytest

ROOT = Path(__file__).parent.parent
# D401 and D402 of pydocstyle take the docstring of a property for that of a method.
OPTIONS = {'ament_flake8': ['--config', 'test/ament_flake8.ini'],
           'ament_pep257': ['--add-ignore', 'D401', 'D402', '--']}


def run(linter: str, *arguments: str) -> subprocess.CompletedProcess[str] | None:
    """Run a linter outside the environment of the tests; None where it is missing."""
    if (program := shutil.which(linter)) is None:
        return None
    return subprocess.run(
        [program, *arguments], cwd=ROOT, text=True, capture_output=True, check=False,
        env={name: value for name, value in os.environ.items() if name != 'VIRTUAL_ENV'})


@pytest.mark.parametrize('linter', OPTIONS)
def test_linter_finds_nothing(linter: str, tmp_path: Path) -> None:
    works = run(linter, '--help')
    # of a ROS 2 that is not sourced, the program alone is found
    if works is None or works.returncode:
        pytest.skip(f'{linter} is not installed: source ROS 2, or sudo apt-get install '
                    f'python3-{linter.replace("_", "-")}')
    bad = tmp_path / 'bad.py'
    bad.write_text('def f():\n    """return nothing"""\n    x=1\n')
    for paths, code in ((['koopman_ros', 'examples', 'setup.py'], 0), ([str(bad)], 1)):
        found = run(linter, *OPTIONS[linter], *paths)
        assert found is not None
        assert found.returncode == code, found.stdout + found.stderr
