# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What the run-time packages import, checked in a process that has nothing loaded."""

from pathlib import Path
import subprocess
import sys

import koopman_ros


def loaded(modules: str, absent: tuple[str, ...] = ()) -> set[str]:
    """Import modules where some packages are not installed; return all that were loaded."""
    # None in its place makes the import of a module fail
    program = (f'import sys; sys.modules.update(dict.fromkeys({absent!r}))\n'
               f'import {modules}\nprint(*(name for name in sys.modules if sys.modules[name]))')
    result = subprocess.run(
        [sys.executable, '-W', 'error', '-c', program], capture_output=True, text=True,
        timeout=240, check=False, cwd=Path(koopman_ros.__file__).parents[1])
    assert (result.returncode, result.stderr) == (0, '')
    return set(result.stdout.split())


def test_runtime_needs_neither_ros_nor_torch() -> None:
    loaded('koopman_ros.model, koopman_ros.control, koopman_ros.plants, koopman_ros.records',
           ('rclpy', 'torch', 'matplotlib', 'daqp'))


def test_the_model_loads_no_other_package_of_ours_but_core() -> None:
    ours = {name.split('.')[1] for name in loaded('koopman_ros.model')
            if name.startswith('koopman_ros.')}
    assert ours == {'core', 'model', 'model_classes'}


def test_nodes_load_nothing_large_that_they_do_not_need() -> None:
    assert not loaded('koopman_ros.nodes.controller, koopman_ros.nodes.trainer') & {
        'torch', 'matplotlib', 'pint', 'daqp', 'nicegui', 'koopman_ros.plants',
        'koopman_ros.learning'}
