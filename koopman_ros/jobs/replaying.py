# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A replay in a process of its own, of low priority, that ends with this one; without ROS."""

from collections.abc import Sequence
import contextlib
import os
from pathlib import Path
import signal
import subprocess

from koopman_ros.jobs.ending import see_it_end
from koopman_ros.startup import blocked_signals, command

_MODULE = 'koopman_ros.nodes.replay'
_NICE = 10
_MOST_SAID = 4000  # bytes of what it printed last


class ReplayJob:
    """
    A run of the program `replay`; to be started from the main thread, with which it ends.

    :param arguments: of the program.
    :param log: file for all that it prints.
    """

    def __init__(self, arguments: Sequence[str], log: Path) -> None:
        self._log = log
        with open(log, 'wb') as output, blocked_signals():
            self._process = subprocess.Popen(
                [*command(_MODULE, signal.SIGKILL, interrupted=130), *arguments], stdout=output,
                stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL, start_new_session=True)
        # it may have ended
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, self._process.pid, _NICE)
        # where sessions share the processors before processes do
        with contextlib.suppress(OSError):
            Path(f'/proc/{self._process.pid}/autogroup').write_text(f'{_NICE}\n')

    @property
    def running(self) -> bool:
        """Whether it has not ended."""
        return self._process.poll() is None

    @property
    def said(self) -> str:
        """What it printed last."""
        try:
            with open(self._log, 'rb') as file:
                file.seek(max(0, os.fstat(file.fileno()).st_size - _MOST_SAID))
                return file.read(_MOST_SAID).decode('utf-8', 'replace')
        except OSError:
            return ''

    def cancel(self) -> None:
        """Ask the process to end."""
        self._process.terminate()

    def close(self) -> None:
        """End the process, by force when it does not end in time."""
        self.cancel()
        see_it_end(self._process)
