# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The install tree that colcon builds, as `ros2 run` finds it, and processes started from it."""

from __future__ import annotations

from pathlib import Path
import shutil
import subprocess
import sys

import pytest

from koopman_ros.testing import Harness, isolated_domain

ROOT = Path(__file__).parents[2]
NAMES = ('plant', 'controller', 'trainer', 'player', 'replay')


@pytest.fixture(scope='module')
def install_tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the package in a workspace of its own; return the workspace's install folder."""
    workspace = tmp_path_factory.mktemp('workspace')
    source = workspace / 'src' / 'koopman_ros'
    source.mkdir(parents=True)
    for name in ('package.xml', 'setup.py', 'setup.cfg', 'resource', 'config', 'koopman_ros'):
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, source / name,
                            ignore=shutil.ignore_patterns('__pycache__'))
        else:
            shutil.copy(ROOT / name, source / name)
    built = subprocess.run(
        [sys.executable, '-m', 'colcon', 'build', '--event-handlers', 'console_direct+'],
        cwd=workspace, capture_output=True, text=True, timeout=240, check=False)
    assert built.returncode == 0, built.stdout + built.stderr
    return workspace / 'install'


def test_the_tree_is_what_ros2_run_looks_for(install_tree: Path) -> None:
    prefix = install_tree / 'koopman_ros'
    for name in NAMES:
        executable = prefix / 'lib' / 'koopman_ros' / name
        assert executable.is_file()
        assert executable.stat().st_mode & 0o111
    share = prefix / 'share'
    assert (share / 'ament_index/resource_index/packages/koopman_ros').is_file()
    assert (share / 'koopman_ros/package.xml').is_file()
    shipped = {path.relative_to(ROOT / 'config') for path in (ROOT / 'config').rglob('*.*')}
    installed = {path.relative_to(share / 'koopman_ros/config')
                 for path in (share / 'koopman_ros/config').rglob('*.*')}
    assert installed == shipped
    assert Path('models/reactor_nz4.safetensors') in installed


def test_the_sourced_tree_is_what_python_imports(install_tree: Path) -> None:
    program = ('import koopman_ros; from koopman_ros.nodes.shipped import config_directory; '
               'print(koopman_ros.__file__); print(config_directory())')
    printed = subprocess.run(
        ['bash', '-c', f'. {install_tree}/setup.bash && "$0" -c "$1"', sys.executable, program],
        cwd=install_tree, capture_output=True, text=True, timeout=240, check=True).stdout.split()
    prefix = install_tree / 'koopman_ros'
    assert prefix in Path(printed[0]).parents
    assert Path(printed[1]) == prefix / 'share' / 'koopman_ros' / 'config'


def test_a_node_of_the_tree_starts_and_ends(ros: Harness, install_tree: Path) -> None:
    executable = install_tree / 'koopman_ros' / 'lib' / 'koopman_ros' / 'controller'
    program = f'. {install_tree}/setup.bash && exec {executable} "$@"'
    process = ros.start('controller', command=('bash', '-c', program))
    ros.wait_for_status('controller: control', lambda status: True)
    assert process.stop() == 0


def test_a_tool_of_the_tree_reads_its_parameters(install_tree: Path) -> None:
    executable = install_tree / 'koopman_ros' / 'lib' / 'koopman_ros' / 'player'
    with isolated_domain():
        ended = subprocess.run(
            ['bash', '-c', f'. {install_tree}/setup.bash && exec {executable} "$@"', 'player',
             '--ros-args', '-p', 'bag:=none'],
            cwd=install_tree, capture_output=True, text=True, timeout=240, check=False)
    assert ended.returncode == 1
    assert ended.stderr.strip() == (
        "player: cannot start: bag 'none' does not exist: check the path")
