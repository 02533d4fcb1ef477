# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What goes on when the executor's thread does not: the watch over silence, and the end."""

from collections.abc import Callable
import os
import signal
import threading

from koopman_ros.startup import end_by_force

PERIOD = 0.1  # s by the wall, of the executor's own watch and of the one over it
# Looks in a row at which the executor has not come by: on a loaded machine it may be late by some.
_MISSED = 10
_PATIENCE = 5.0  # s from a signal to the end of a callback, or of the start


class Watchdog:
    """
    A thread that does what the executor's timer would, whenever the executor does not come to it.

    It counts its own looks, so that time in which the whole process stood still is not held
    against the executor. What it can do while others compute depends on Python's interpreter lock:
    it waits for library calls that keep it.

    :param act: called from that thread with the seconds for which the executor has been busy;
        what it raises is raised again in the executor, by :meth:`beat`.
    """

    def __init__(self, act: Callable[[float], None]) -> None:
        self._act = act
        self._beats = 0
        self._failure: Exception | None = None
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> None:
        """Begin to look."""
        self._thread.start()

    def beat(self) -> None:
        """Note that the executor has come by; called from it, every `PERIOD`."""
        self._beats += 1
        if self._failure is not None:
            raise self._failure

    def end(self) -> None:
        """Look no more, and act no more once this has returned, but for what takes longer."""
        self._over.set()
        if self._thread.is_alive():
            self._thread.join(1.0)

    def _run(self) -> None:
        seen, missed = self._beats, 0
        while not self._over.wait(PERIOD):
            missed = missed + 1 if self._beats == seen else 0
            seen = self._beats
            if missed < _MISSED:
                continue
            try:
                self._act(missed * PERIOD)
            except Exception as error:
                # the next look may succeed, which a dead thread would never have
                self._failure = error


def end_in_time(name: str) -> Callable[[], None]:
    """
    End the process by force when it is still in a callback, or starting, 5 s after a signal.

    Python's handlers run in the main thread alone, between two instructions of its own. A byte
    comes through the pipe whatever that thread is doing.

    :param name: word that starts the line which says so.
    :return: to be called when callbacks are over; what comes then is bounded elsewhere.
    """
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    over = threading.Event()

    def listen() -> None:
        with open(reader, 'rb', buffering=0) as numbers:
            while (number := numbers.read(1)) and number[0] not in (
                    signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                pass
            # the pipe stays open, for the byte of a second signal
            if number:
                disarm = end_by_force(_PATIENCE, 1, (
                    f'{name}: busy for {_PATIENCE:g} s after a signal: ended by force'))
                over.wait()
                disarm()

    thread = threading.Thread(target=listen, daemon=True)
    thread.start()

    def leave() -> None:
        over.set()
        signal.set_wakeup_fd(-1)
        # ends the thread, which takes back what it has armed before others are
        os.close(writer)
        thread.join(1.0)

    return leave
