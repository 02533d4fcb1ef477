# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
A process that ends those which another one has started when that one ends, however it ends.

A signal at the parent's death (prctl) is not enough: it comes when the thread ends that started
the child, and neither a stopped process nor one that hangs in the middleware ends by it.
"""

import contextlib
import os
import select
import signal
import sys
import threading
import time

PATIENCE = 10.0  # s from the interrupt to SIGKILL
_LOOK_PERIOD = 1.0  # s

# by the process that writes there: one that was forked has none of its own yet
_pipes: dict[int, int] = {}
_lock = threading.Lock()


def guard(pid: int) -> None:
    """End a child, which leads a session and was not waited for yet, with this process."""
    own = os.getpid()
    with _lock:
        if own not in _pipes:
            _pipes[own] = _start(own)
        os.write(_pipes[own], f'{pid}\n'.encode())


def _start(parent: int) -> int:
    """Start the guard of this process and return where it reads."""
    reader, writer = os.pipe()
    # no site packages, which need ten times as long; a signal of the terminal is none for it
    command = [sys.executable, '-I', '-S', __file__, str(parent), str(PATIENCE)]
    os.posix_spawn(
        sys.executable, command, os.environ,
        file_actions=[(os.POSIX_SPAWN_DUP2, reader, 0),
                      (os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0),
                      (os.POSIX_SPAWN_DUP2, 1, 2)],
        setsid=True, setsigmask=())
    os.close(reader)
    return writer


def main() -> None:
    """Guard what standard input names until the process ends that writes there."""
    parent = int(sys.argv[1])
    guarded: dict[int, int] = {}  # process by the file that stands for it
    text, alive = b'', True
    while alive:
        # one that was forked without our knowing may hold the pipe open
        alive = os.getppid() == parent
        while select.select([0], [], [], _LOOK_PERIOD if alive else 0.0)[0]:
            if not (part := os.read(0, 4096)):
                alive = False
                break
            *lines, text = (text + part).split(b'\n')
            for line in lines:
                # it may have ended
                with contextlib.suppress(ProcessLookupError):
                    guarded[os.pidfd_open(int(line))] = int(line)
            for file in _ended(guarded, 0.0):
                os.close(file)
                del guarded[file]
    _end(guarded, float(sys.argv[2]))


def _ended(guarded: dict[int, int], seconds: float) -> list[int]:
    """Return those of some processes that end within a time."""
    poll = select.poll()
    for file in guarded:
        poll.register(file, select.POLLIN)
    return [file for file, _ in poll.poll(1000.0 * seconds)]


def _end(guarded: dict[int, int], patience: float) -> None:
    for file in _ended(guarded, 0.0):
        del guarded[file]
    # one that is stopped does not see the interrupt otherwise
    _send(guarded, signal.SIGINT)
    _send(guarded, signal.SIGCONT)
    deadline = time.monotonic() + patience
    while guarded and (left := deadline - time.monotonic()) > 0.0:
        for file in _ended(guarded, left):
            del guarded[file]
    _send(guarded, signal.SIGKILL)


def _send(guarded: dict[int, int], number: int) -> None:
    for pid in guarded.values():
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(pid, number)


if __name__ == '__main__':
    main()
