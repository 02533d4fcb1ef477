# Copyright 2026 The koopman_ros Authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The end of a process in which no Python runs any more."""

from __future__ import annotations

import ctypes
import time

_SIGEV_THREAD = 2  # of sigevent(3type): the function is called in a thread of its own


class _Event(ctypes.Structure):
    """sigevent of timer_create(2), with room to spare."""

    _fields_ = (('value', ctypes.c_void_p), ('signal', ctypes.c_int), ('notify', ctypes.c_int),
                ('function', ctypes.c_void_p), ('rest', ctypes.c_char * 64))


def exit_later(seconds: float) -> bool:
    """
    Let the C library end the process with code 0 then, which takes no lock of the interpreter's.

    :return: whether it will.
    """
    libc = ctypes.CDLL(None)
    if not hasattr(libc, 'timer_create'):
        return False
    # _exit(value)
    event = _Event(None, 0, _SIGEV_THREAD, ctypes.cast(libc._exit, ctypes.c_void_p))
    timer = ctypes.c_void_p()
    if libc.timer_create(time.CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer)):
        return False
    # the interval, and the time until the first; each in seconds and nanoseconds
    due = (ctypes.c_long * 4)(0, 0, int(seconds), int(seconds % 1.0 * 1e9))
    return not libc.timer_settime(timer, 0, ctypes.byref(due), None)
