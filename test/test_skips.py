# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Without Chromium its tests are skipped with a hint; continuous integration requires them."""

import os
from pathlib import Path
import subprocess
import sys

import pytest

from support import INSTALL_CHROMIUM

FILE = 'test/panel/test_server.py'


@pytest.mark.parametrize(('ci', 'code'), [('', 0), ('true', 1)])
def test_tests_with_a_browser_are_skipped_without_one_but_not_in_continuous_integration(
        tmp_path: Path, ci: str, code: int) -> None:
    root = Path(__file__).parent.parent
    found = subprocess.run(
        [sys.executable, '-m', 'pytest', '-q', '-p', 'no:cacheprovider', FILE, '-k',
         'outside_runs or narrow_window'], cwd=root, text=True, capture_output=True, check=False,
        env={**os.environ, 'PATH': str(tmp_path), 'CI': ci})
    assert found.returncode == code, found.stdout
    if ci:
        assert 'CI=true requires every test' in found.stdout
        assert INSTALL_CHROMIUM in found.stdout
    else:
        *_, hint, last = found.stdout.strip().splitlines()
        assert INSTALL_CHROMIUM in hint
        assert hint.startswith('2 tests')
        assert '2 skipped' in last
