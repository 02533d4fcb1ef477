# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Without Chromium its tests are skipped with a hint; continuous integration requires them."""

from pathlib import Path

import pytest

from support import INSTALL_CHROMIUM

pytest_plugins = ['pytester']
TESTS = """
from support.browser import opened_browser
def test_one():
    with opened_browser():
        pass
test_another = test_one
"""


@pytest.mark.parametrize(('ci', 'code'), [('', 0), ('true', 1)])
def test_tests_with_a_browser_are_skipped_without_one_but_not_in_continuous_integration(
        pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch, ci: str, code: int) -> None:
    pytester.makeconftest((Path(__file__).parent / 'conftest.py').read_text())
    pytester.makepyfile(TESTS)
    for name, value in (('PATH', str(pytester.path)), ('CI', ci),
                        ('PYTEST_DISABLE_PLUGIN_AUTOLOAD', '1')):
        monkeypatch.setenv(name, value)
    found = pytester.runpytest_inprocess('-q', '-ra')
    assert found.ret == code
    text = found.stdout.str()
    assert INSTALL_CHROMIUM in text
    if ci:
        assert 'CI=true requires every test' in text
    else:
        *_, hint, last = text.strip().splitlines()
        assert INSTALL_CHROMIUM in hint
        assert hint.startswith('2 tests')
        assert '2 skipped' in last
