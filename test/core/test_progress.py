# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The progress line is one line on a terminal, and nothing elsewhere."""

import io
import sys

import pytest

from koopman_ros.core import progress


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize('stream', [Terminal(), io.StringIO()])
def test_progress_is_shown_on_a_terminal_alone(
        stream: io.StringIO, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, 'stderr', stream)
    monkeypatch.setattr(progress, '_PERIOD', 0.0)
    with progress.progress_line() as report:
        report(0.0, 'reading')
        report(0.5, 'learning')
    shown = stream.getvalue()
    assert '\n' not in shown
    # each in the place of the last, and removed at the end
    assert [line.partition('| ')[2] for line in shown.split('\r\x1b[K')] == (
        ['', '  0 % reading', ' 50 % learning', ''] if stream.isatty() else [''])
