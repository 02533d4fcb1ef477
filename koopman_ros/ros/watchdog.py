# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Threads for a busy executor: one commands in its place, one ends the process in time."""

from collections.abc import Callable
import os
import signal
import threading

from koopman_ros.core.plugins import contained
from koopman_ros.process_entry import force_exit_after, SIGNALS

PERIOD = 0.1  # s by the wall, of the executor's own watch and of the one over it
# Looks in a row at which the executor has not come by: on a loaded machine it may be late by some.
_MISSED = 10
_PATIENCE = 5.0  # s from a signal to the end of a callback, or of the start


class Watchdog:
    """
    Acts in place of the executor's timer whenever the executor is too busy.

    It counts its own looks: time in which the whole process was suspended does not count.

    :param act: called in the thread of the watchdog with the seconds for which the executor has
        been busy; its exception is raised again in the executor, by :meth:`beat`.
    """

    def __init__(self, act: Callable[[float], None]) -> None:
        self._act = act
        self._beats = self._seen = self._missed = 0
        self._failure: Exception | None = None
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name='watchdog', daemon=True)
        self.start = self._thread.start  #: begins to look

    def beat(self) -> None:
        """Note a sign of life of the executor; called from it, every `PERIOD`."""
        self._beats += 1
        if self._failure is not None:
            raise self._failure

    def end(self) -> None:
        """Act no more once this has returned, but for an act that takes longer than 1 s."""
        self._over.set()
        self._thread.join(1.0)

    def look(self) -> None:
        """Act if the executor has been busy for too long."""
        self._missed = self._missed + 1 if self._beats == self._seen else 0
        self._seen = self._beats
        if self._missed < _MISSED:
            return
        try:
            self._act(self._missed * PERIOD)
        except BaseException as error:
            # the next look may succeed; code of one's own may raise SystemExit
            text = contained(error)
            self._failure = error if isinstance(error, Exception) else RuntimeError(text)

    def _run(self) -> None:
        while not self._over.wait(PERIOD):
            self.look()


def end_in_time(name: str) -> Callable[[], None]:
    """End the process by force if it is busy 5 s after a signal; return a cancel function."""
    # Python's handlers run in the main thread alone, between two instructions of its own; a byte
    # comes through the pipe whatever that thread is doing
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    over = threading.Event()

    def listen() -> None:
        with open(reader, 'rb', buffering=0) as numbers:
            while (number := numbers.read(1)) and number[0] not in SIGNALS:
                pass
            # the pipe stays open, for the byte of a second signal
            if number:
                disarm = force_exit_after(_PATIENCE, 1, (
                    f'{name}: still busy {_PATIENCE:g} s after a signal: the process is ended'))
                over.wait()
                disarm()

    thread = threading.Thread(target=listen, daemon=True)
    thread.start()

    def leave() -> None:
        over.set()
        signal.set_wakeup_fd(-1)
        # ends the thread, which disarms its timer before others are armed
        os.close(writer)
        thread.join(1.0)

    return leave
