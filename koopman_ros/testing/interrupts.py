# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Signals to a program that looks after processes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import signal

from koopman_ros.startup import SIGNALS


@contextlib.contextmanager
def deferred_interrupt() -> Iterator[Callable[[], None]]:
    """
    Let a signal raise KeyboardInterrupt where the yielded function is called, and at the end.

    One that comes while Python looks after a child leaves the child's lock taken for ever, and
    one inside the middleware's extension comes out as another error. The processes live in
    sessions of their own: without us nobody would end them.
    """
    pending: list[bool] = []

    def check() -> None:
        if pending:
            raise KeyboardInterrupt

    before = {number: signal.signal(number, lambda *_: pending.append(True))
              for number in SIGNALS}
    try:
        yield check
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    check()
