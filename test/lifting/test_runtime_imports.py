# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What the run-time packages pull in, checked in a process that has nothing loaded."""

from pathlib import Path
import subprocess
import sys

import koopman_ros

RUNTIME = ('lifting', 'control', 'plants', 'bags', 'solvers')
FOREIGN = ('rclpy', 'torch', 'matplotlib')

PROGRAM = """
import sys
# None in its place makes the import of a module fail
sys.modules.update(dict.fromkeys({foreign!r}))
{statements}
loaded = [name for name in sys.modules if name.split('.')[0] in {foreign!r}]
assert loaded == list({foreign!r}), loaded
"""


def run(statements):
    program = PROGRAM.format(foreign=FOREIGN, statements=statements)
    return subprocess.run(
        [sys.executable, '-W', 'error', '-c', program], capture_output=True, text=True,
        timeout=240, check=False, cwd=Path(koopman_ros.__file__).parents[1])


def test_runtime_needs_neither_ros_nor_torch():
    result = run('import ' + ', '.join(f'koopman_ros.{name}' for name in RUNTIME))
    assert (result.returncode, result.stdout, result.stderr) == (0, '', '')


def test_learning_does_need_torch():
    """The check above can tell: what imports torch fails in the same process."""
    result = run('import koopman_ros.learning')
    assert result.returncode == 1
    assert 'import of torch halted; None in sys.modules' in result.stderr


def test_packages_that_stand_alone():
    """Neither loads another package of ours: data of plants and units are modules beside them."""
    for name in ('lifting', 'plants', 'solvers'):
        result = run(f"""
import koopman_ros.{name}
ours = {{module.split('.')[1] for module in sys.modules if module.startswith('koopman_ros.')}}
assert ours <= {{{name!r}, 'arrays', 'plant_data', 'units'}}, ours
""")
        assert (result.returncode, result.stderr) == (0, '')
