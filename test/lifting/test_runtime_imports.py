# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What the run-time packages pull in, checked in a process that has nothing loaded."""

from pathlib import Path
import subprocess
import sys

import koopman_ros

FOREIGN = ('rclpy', 'torch', 'matplotlib')
PROGRAM = """
import sys
# None in its place makes the import of a module fail
sys.modules.update(dict.fromkeys({foreign!r}))
import {modules}
loaded = [name for name in sys.modules if name.split('.')[0] in {foreign!r}]
assert loaded == list({foreign!r}), loaded
print(*sorted({{name.split('.')[1] for name in sys.modules if name.startswith('koopman_ros.')}}))
"""


def run(*packages):
    modules = ', '.join(f'koopman_ros.{name}' for name in packages)
    return subprocess.run(
        [sys.executable, '-W', 'error', '-c', PROGRAM.format(foreign=FOREIGN, modules=modules)],
        capture_output=True, text=True, timeout=240, check=False,
        cwd=Path(koopman_ros.__file__).parents[1])


def test_runtime_needs_neither_ros_nor_torch_but_learning_does():
    result = run('lifting', 'control', 'plants', 'bags', 'solvers')
    assert (result.returncode, result.stderr) == (0, '')
    result = run('learning')
    assert result.returncode == 1
    assert 'import of torch halted; None in sys.modules' in result.stderr


def test_packages_that_stand_alone():
    """Neither loads another package of ours: what they share is a module beside them."""
    for name, beside in (('lifting', ()), ('plants', ('solvers',)), ('solvers', ())):
        result = run(name)
        assert (result.returncode, result.stderr) == (0, '')
        assert set(result.stdout.split()) <= {
            name, *beside, 'arrays', 'model_classes', 'plant_data', 'plugs', 'units'}


def test_nodes_load_nothing_large_that_they_do_not_need():
    """It costs each start its time, and each process its memory."""
    # numpy before 2.3 loads its random numbers by itself
    program = ('import sys, numpy\n'
               'before = {*sys.modules}\n'
               'import koopman_ros.nodes.controller, koopman_ros.nodes.trainer\n'
               'print(*{*sys.modules} - before)')
    result = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True,
                            timeout=240, check=True, cwd=Path(koopman_ros.__file__).parents[1])
    loaded = set(result.stdout.split())
    assert {'scipy.linalg', 'rclpy'} < loaded
    large = {'scipy.optimize', 'scipy.special', 'torch', 'matplotlib', 'pint', 'numba', 'daqp',
             'nicegui', 'asyncio', 'multiprocessing', 'ssl', 'koopman_ros.plants',
             'koopman_ros.compiled', 'koopman_ros.learning'}
    assert not loaded & large
