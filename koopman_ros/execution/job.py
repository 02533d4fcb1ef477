# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A program in a child process: of low priority, with limits of its memory and its time."""

from __future__ import annotations

from collections.abc import Sequence
import contextlib
import os
from pathlib import Path
import queue
import resource
import signal
import subprocess
import threading
from typing import IO

from koopman_ros.process_entry import blocked_signals, command, ONE_THREAD

_PATIENCE = 5.0  # s from the request to end until the process is killed
_NICE = 10
_MEMORY = 0.8  # of the machine's, which a child may use
_TIME = 86400  # s of processor time that it may use
_LAST = 60  # s more, after which it is killed where it does not end by the signal for it
_LINES = 20  # of its standard error that are kept


class Job:
    """
    A child process that ends with this one, whose output is read line by line.

    To be started from the main thread, with which it ends.

    :param module: whose `main` it runs.
    :param arguments: of the program.
    :param task: first line of its input, which then stays open.
    :param interrupted: exit code after a signal.
    """

    def __init__(self, module: str, arguments: Sequence[str] = (), task: str = '',
                 interrupted: int = 1) -> None:
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._errors: list[str] = []
        with blocked_signals():
            # a session of its own: this process passes an interrupt of the terminal on
            self.process = subprocess.Popen(
                [*self.command(module, interrupted), *arguments], stdin=subprocess.PIPE,
                stdout=subprocess.PIPE, stderr=subprocess.PIPE, encoding='utf-8',
                errors='replace', start_new_session=True, env={**ONE_THREAD, **os.environ})
        _limit(self.process.pid)
        assert self.process.stdin is not None
        # it may have ended
        with contextlib.suppress(BrokenPipeError):
            self.process.stdin.write(task + '\n')
            self.process.stdin.flush()
        self._threads = [threading.Thread(target=read, args=(stream,), daemon=True)
                         for read, stream in ((self._read_lines, self.process.stdout),
                                              (self._read_errors, self.process.stderr))]
        for thread in self._threads:
            thread.start()

    def command(self, module: str, interrupted: int) -> Sequence[str]:
        """Return the command line of the child."""
        return command(module, signal.SIGKILL, interrupted=interrupted)

    def line(self) -> str | None:
        """
        Return the next line of its output, None after the last.

        :raises queue.Empty: when there is none yet.
        """
        return self._lines.get_nowait()

    @property
    def running(self) -> bool:
        """Whether it has not ended."""
        return self.process.poll() is None

    @property
    def errors(self) -> list[str]:
        """Last lines of its standard error, all of them once it has ended."""
        if not self.running:
            self._threads[1].join()
        return self._errors

    def cancel(self) -> None:
        """Request its end: close its input, and send SIGTERM."""
        assert self.process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self.process.stdin.close()
        self.process.terminate()

    def close(self) -> None:
        """End the process, by force when it does not end in time."""
        self.cancel()
        try:
            self.process.wait(_PATIENCE)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        for thread in self._threads:
            thread.join()
        for stream in (self.process.stdout, self.process.stderr):
            assert stream is not None
            stream.close()

    def _read_lines(self, stream: IO[str]) -> None:
        for line in stream:
            self._lines.put(line)
        self._lines.put(None)

    def _read_errors(self, stream: IO[str]) -> None:
        for line in stream:
            self._errors = [*self._errors[-_LINES:], line.strip()]


def _limit(pid: int) -> None:
    """Limit memory and processor time of a child, and lower its priority; it may have ended."""
    memory = int(_MEMORY * os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES'))
    with contextlib.suppress(OSError):
        resource.prlimit(pid, resource.RLIMIT_DATA, (memory, memory))
        resource.prlimit(pid, resource.RLIMIT_CPU, (_TIME, _TIME + _LAST))
        os.setpriority(os.PRIO_PROCESS, pid, _NICE)


class ReplayJob(Job):
    """
    A run of the program `replay`.

    :param arguments: of the program.
    """

    def __init__(self, arguments: Sequence[str]) -> None:
        super().__init__('koopman_ros.nodes.replay', arguments, interrupted=130)
        # where sessions share the processors before processes do
        with contextlib.suppress(OSError):
            Path(f'/proc/{self.process.pid}/autogroup').write_text(f'{_NICE}\n')

    @property
    def last_output(self) -> str:
        """Last lines of its standard error."""
        return '\n'.join(self.errors)
