# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Memory and processor time of a process while it reads bags of any origin."""

from collections.abc import Iterator, Sequence
import contextlib
import os
from pathlib import Path
import re
import resource
import signal
import threading
import time
from types import FrameType

from koopman_ros.records.mcap_file import BagReadError

# The share of the memory that the machine has left.
_MEMORY_SHARE = 0.8
# A message takes four bytes of the disk at least, and tens of microseconds.
_SECONDS = 60.0
_SECONDS_PER_BYTE = 2e-5


class _TimeIsUpError(BaseException):
    """No exception of the bag: readers treat those as damage."""


@contextlib.contextmanager
def bounded_reading(bags: Sequence[str | os.PathLike[str]]) -> Iterator[None]:
    """
    Bound memory and processor time of this process while it reads some bags.

    A few kilobytes can grow to gigabytes, or to hours of work. The process may take a share of the
    memory that is free, and time in proportion to the size of the bags; both limits end with the
    context. Time is bounded in the main thread only, which the signal for it reaches. It is for a
    process of its own, such as that of a training.

    :raises BagReadError: when either does not suffice.
    """
    files = [file for bag in map(Path, bags)
             for file in (bag.glob('*') if bag.is_dir() else [bag]) if file.is_file()]
    seconds = _SECONDS + _SECONDS_PER_BYTE * sum(file.stat().st_size for file in files)
    used = int(Path('/proc/self/statm').read_text().split()[0]) * resource.getpagesize()
    free = re.search(r'MemAvailable:\s*(\d+) kB', Path('/proc/meminfo').read_text())
    assert free is not None
    limits = {resource.RLIMIT_AS: used + int(_MEMORY_SHARE * 1024 * int(free[1]))}
    handler = None
    if threading.current_thread() is threading.main_thread():
        handler = signal.signal(signal.SIGXCPU, _raise_time_is_up)
        limits[resource.RLIMIT_CPU] = int(time.process_time() + seconds) + 1
    before = {kind: resource.getrlimit(kind) for kind in limits}
    try:
        for kind, most in limits.items():
            soft, hard = before[kind]
            resource.setrlimit(kind, (
                min(one for one in (most, soft, hard) if one != resource.RLIM_INFINITY), hard))
        yield
    except MemoryError as error:
        raise BagReadError('memory does not suffice to read the bags: free some, or read fewer '
                           'topics') from error
    except _TimeIsUpError as error:
        raise BagReadError(f'the bags take more than {seconds:.0f} s to read, which no record of '
                           'their size does: fetch them again') from error
    finally:
        for kind, limit in before.items():
            resource.setrlimit(kind, limit)
        if handler is not None:
            signal.signal(signal.SIGXCPU, handler)


def _raise_time_is_up(number: int, frame: FrameType | None) -> None:
    raise _TimeIsUpError
