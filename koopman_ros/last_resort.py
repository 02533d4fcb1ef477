# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The end of a process that does not end by itself, even when no Python runs any more."""

from __future__ import annotations

from collections.abc import Callable
import contextlib
import ctypes
import faulthandler
import os
import sys
import threading
import time

_SIGEV_THREAD = 2  # of sigevent(3type): the function is called in a thread of its own
_LATER = 3.0  # s from the sentence, which some thread can say, to the stack
_AFTER = 0.5  # s from the stack that is printed to the end


class _Event(ctypes.Structure):
    """sigevent of timer_create(2), with room to spare."""

    _fields_ = (('value', ctypes.c_void_p), ('signal', ctypes.c_int), ('notify', ctypes.c_int),
                ('function', ctypes.c_void_p), ('rest', ctypes.c_char * 64))


def end_by_force(seconds: float, code: int = 0, sentence: str = '') -> Callable[[], None]:
    """
    End the process then, with a sentence; where no Python runs, print where it hangs and end it.

    The latter comes some seconds later, and takes no lock of the interpreter's: Python prints
    from a thread of its own, and the C library ends the process.

    :param code: its exit code.
    :param sentence: without one the latter comes at once.
    :return: takes that back.
    """
    def give_up() -> None:
        print(sentence, file=sys.stderr, flush=True)
        os._exit(code)

    said = threading.Timer(seconds, give_up)
    if sentence:
        said.daemon = True
        said.start()
        seconds += _LATER
    cancel = _exit_later(seconds + _AFTER, code)
    # where standard error is no file it says nothing
    with contextlib.suppress(OSError, ValueError, RuntimeError):
        faulthandler.dump_traceback_later(seconds, exit=cancel is None)

    def disarm() -> None:
        said.cancel()
        faulthandler.cancel_dump_traceback_later()
        if cancel is not None:
            cancel()

    return disarm


def _exit_later(seconds: float, code: int) -> Callable[[], object] | None:
    """Let the C library end the process then; return what takes it back, None where it cannot."""
    libc = ctypes.CDLL(None)
    if not hasattr(libc, 'timer_create'):
        return None
    # _exit(value)
    event = _Event(code, 0, _SIGEV_THREAD, ctypes.cast(libc._exit, ctypes.c_void_p))
    timer = ctypes.c_void_p()
    if libc.timer_create(time.CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer)):
        return None
    # the interval, and the time until the first; each in seconds and nanoseconds
    due = (ctypes.c_long * 4)(0, 0, int(seconds), int(seconds % 1.0 * 1e9))
    if libc.timer_settime(timer, 0, ctypes.byref(due), None):
        return None
    return lambda: libc.timer_delete(timer)
