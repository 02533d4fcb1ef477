# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Table of the C functions and the Python functions that they mirror: all of them are compared."""

from collections.abc import Iterator
import importlib
import inspect
import json
from pathlib import Path
import re
import shutil
import subprocess
import sys
from types import CodeType, FrameType
from typing import Any

import pytest

from koopman_ros.export import c_code, compiled
from koopman_ros.export.c_code import template
from koopman_ros.export.vectors import vectors
from studies.exported_loops import bundled_loops, INTERVAL, random_loop

# Those that have no counterpart of their own: products of matrices, sizes, times, places.
PLAIN = {
    'larger', 'smaller', 'within', 'copy', 'set_all', 'set_identity', 'add', 'scale', 'dot',
    'norm', 'largest', 'all_finite', 'transpose', 'make_symmetric', 'add_product', 'multiply',
    'copy_block', 'swap', 'rotate', 'input_to_deviation', 'input_to_physical', 'distance_between',
    'at_node', 'solve_by_doubling', 'to_discrete', 'over_interval', 'double_interval',
    'feedback_gain', 'missed', 'usable', 'earlier', 'advance_clock', 'since', 'is_far', 'ask_for'}
LOOPS = ('heated_line', 'quadruple_tank', 'two_state_example', 6, 11, 13, 22)
SAMPLES = 60


def mirrored() -> Iterator[tuple[str, str]]:
    """Yield the name of each static C function, and the Python function of its comment."""
    for comment, name in re.findall(
            r'((?:/\*(?:(?!\*/)[\s\S])*\*/\s*|#\w+[^\n]*\n)*)^static [\w ]+?\**(\w+)\(',
            template('controller.c'), re.MULTILINE):
        found = re.findall(r'Python: ([\w.]+)', comment)
        yield name, found[-1] if found else ''


def code_of(path: str) -> CodeType:
    """Return the code of a function of the package, by its path."""
    parts = path.split('.')
    for count in range(len(parts) - 1, 0, -1):
        name = '.'.join(('koopman_ros', *parts[:count]))
        try:
            found: Any = importlib.import_module(name)
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            found = vars(found)[part] if isinstance(found, type) else getattr(found, part)
        found = getattr(found, 'func', getattr(found, 'fget', found))
        code = getattr(inspect.unwrap(found), '__code__', None)
        assert isinstance(code, CodeType), path
        return code
    raise AssertionError(path)


def test_each_function_of_the_c_code_names_its_counterpart_or_is_plain() -> None:
    table = dict(mirrored())
    assert {name for name, path in table.items() if not path} == PLAIN
    for path in filter(None, table.values()):
        assert code_of(path)


@pytest.mark.skipif(not (shutil.which('gcc') and shutil.which('gcov')), reason='needs gcc')
def test_all_mirrored_functions_are_compared(tmp_path: Path) -> None:
    bundled = {name: (controller, interval) for name, controller, interval in bundled_loops()}
    called: set[int] = set()  # of code, whose own hash takes long
    executed: set[str] = set()

    def watch(frame: FrameType, event: str, _: object) -> None:
        if event == 'call':
            called.add(id(frame.f_code))

    for loop in LOOPS:
        controller, interval = bundled[loop] if isinstance(loop, str) else (
            random_loop(loop), INTERVAL)
        before = sys.getprofile()
        sys.setprofile(watch)
        try:
            rows = list(vectors(controller, SAMPLES, interval))
        finally:
            sys.setprofile(before)
        folder = tmp_path / str(loop)
        program = compiled(c_code(controller, interval), folder, 'gcc', ('-O0', '--coverage'))
        calls = ''.join(f'{",".join(call.row(controller))}\n' for call, _ in rows)
        subprocess.run([program], input=calls, text=True, check=True, cwd=folder,
                       stdout=subprocess.DEVNULL)
        data = next(folder.glob('*controller.gcda'))
        report = subprocess.run(['gcov', '--json-format', '--stdout', data.name], cwd=folder,
                                check=True, capture_output=True, text=True).stdout
        executed |= {function['name'] for file in json.loads(report)['files']
                     for function in file['functions'] if function['execution_count'] > 0}
    table = {name: path for name, path in mirrored() if path}
    missing = [f'{name}: {path}, in {"Python" if name in executed else "C"}'
               for name, path in table.items()
               if name not in executed or id(code_of(path)) not in called]
    assert not missing, '\n'.join(missing)
