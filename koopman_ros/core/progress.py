# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Progress of long calculations on a terminal."""

from collections.abc import Callable, Generator
import contextlib
import math
import sys
import time

_BAR_WIDTH = 30
_PERIOD = 0.1  # s between two updates
_CLEAR = '\r\x1b[K'


def show_bar(share: float, text: str, end: str = '') -> None:
    """Replace the last line of standard error by a bar, the percentage and a text."""
    full = round(_BAR_WIDTH * share)
    print(f'{_CLEAR}|{"#" * full}{"-" * (_BAR_WIDTH - full)}| {100.0 * share:3.0f} % {text}',
          end=end, file=sys.stderr, flush=True)


@contextlib.contextmanager
def progress_line() -> Generator[Callable[[float, str], None]]:
    """
    Yield a function of a share in [0, 1] and a text that shows both.

    They are one line of standard error if that is a terminal, which is removed at the end; nothing
    is written otherwise.
    """
    last = -math.inf

    def report(share: float, text: str) -> None:
        nonlocal last
        if sys.stderr.isatty() and time.monotonic() - last >= _PERIOD:
            last = time.monotonic()
            show_bar(share, text)

    try:
        yield report
    finally:
        if last > -math.inf:
            print(_CLEAR, end='', file=sys.stderr, flush=True)
