# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Times of measurements, and what goes on when the executor is busy: watch and end."""

from collections.abc import Callable
import math
import os
import signal
import threading
import time

from rclpy.node import Node

from koopman_ros.startup import end_by_force, SIGNALS
from koopman_ros.time_base import Advance, TimeBase
from koopman_ros.units import NANOSECONDS

PERIOD = 0.1  # s by the wall, of the executor's own watch and of the one over it
# Looks in a row at which the executor has not come by: on a loaded machine it may be late by some.
_MISSED = 10
_PATIENCE = 5.0  # s from a signal to the end of a callback, or of the start
# Stamps further from the node's clock than this come from another clock.
_SAME_CLOCK = 3600.0  # s
_JITTER = 1.0  # s by which messages of one clock may come early or late
PAUSED = 10.0  # s by the steady clock after which a clock that stands still is reported
_CLOCK_PATIENCE = 1.0  # s from the start until somebody should publish the time


class Timing:
    """
    Progress of the measurements' stamps, and the silence since the last.

    Only a stamp that advances, or that begins a time base, ends a silence. It is timed on /clock
    where there is one, else by the steady clock.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._simulated = bool(node.get_parameter('use_sim_time').value)
        self._wall = self._begun = time.monotonic()
        self._ticked = (0, self._begun)  # last time on /clock, and when it came by the steady one
        self._sim = self._sim_now()
        self._base = TimeBase()
        self._spacing = 0.0  # s by the steady clock, between the last two stamps that advanced
        self._noted = False
        # time of the last measurement, if it was no news, by both clocks, and why
        self._ignored: tuple[float, int, Advance] | None = None
        self._spare = _JITTER  # s that the rate limit may count beyond those that have passed
        self._counted = -math.inf  # s by the steady clock, when it counted some last
        self.age = math.nan  # s, of the last measurement at its arrival
        self.answer_seconds = math.nan  # from its arrival to its command
        self.busy = False  # whether what has arrived since then waits for the node itself

    def now(self) -> tuple[float, int, int]:
        """Return the time by the steady clock in s, on /clock, or 0, and the node's, in ns."""
        simulated = self._sim_now()
        # without /clock the node's time is the system's, which Python reads itself
        return time.monotonic(), simulated, simulated if self._simulated else time.time_ns()

    def arrive(self, stamp_ns: int, at: tuple[float, int, int], window: float,
               two_sources: bool = False) -> Advance:
        """
        Take down that a measurement has arrived at a time; return what its stamp is.

        :param window: shortest time between two restarts of the stamps, in s; 0 for any.
        :param two_sources: whether two are known otherwise.
        """
        found = self._base.take(stamp_ns, at[0], window)
        if two_sources:
            found = Advance.TWO_SOURCES
        self._ignored = None
        if found in (Advance.OLD, Advance.TWO_SOURCES):
            self.ignore(at, found)
        return found

    def ignore(self, at: tuple[float, int, int], why: Advance = Advance.OLD) -> None:
        """Take down that a measurement, or a part of one, came and is no news."""
        self._ignored = (*at[:2], why)

    def note(self, stamp_ns: int, at: tuple[float, int, int]) -> None:
        """Take down that a measurement with news that arrived at a time is answered."""
        self._spacing, self._noted = at[0] - self._wall if self._noted else 0.0, True
        self._wall, self._sim, _ = at
        self.age = self._age(stamp_ns, at)

    @staticmethod
    def _age(stamp_ns: int, at: tuple[float, int, int]) -> float:
        age = (at[2] - stamp_ns) / NANOSECONDS
        # at time zero the clock has not begun
        return age if at[2] and abs(age) < _SAME_CLOCK else math.nan

    def countable(self, seconds: float, stamp_ns: int, at: tuple[float, int, int]
                  ) -> float | None:
        """
        Return how many of the seconds since the last stamp the rate limit may count, or None.

        They are those of the steady clock, where stamps are of the time of the node's clock. Of
        those that it does not count, one is kept, since messages come early and late.
        """
        passed = max(0.0, at[0] - self._counted)
        self._counted = max(self._counted, at[0])
        if self._simulated or math.isnan(self._age(stamp_ns, at)):
            return None
        counted = max(0.0, min(seconds, passed + self._spare))
        self._spare = min(passed + self._spare - counted, _JITTER)
        return counted

    def commanded(self) -> None:
        """Take down that a command without a measurement has counted the time until now."""
        self._counted = time.monotonic()

    def answered(self) -> None:
        """Take down that its command is out."""
        self.answer_seconds = time.monotonic() - self._wall

    @property
    def without_clock(self) -> bool:
        """Whether `use_sim_time` is set and nobody publishes the time."""
        waited = time.monotonic() - self._begun
        return self._simulated and self._sim_now() == 0 and waited > _CLOCK_PATIENCE

    def no_news(self, within: float) -> Advance | None:
        """Return why the last measurement was no news, if it came within so many seconds."""
        if self._ignored is None or self._since(*self._ignored[:2]) > within:
            return None
        return self._ignored[2]

    @property
    def paused(self) -> bool:
        """Whether /clock has stood still for much longer than between two measurements."""
        return self._ticked[0] > 0 and time.monotonic() - self._ticked[1] > max(
            PAUSED, 3.0 * self._spacing)

    def busy_silence(self, seconds: float) -> float:
        """Return the silence of a node that was busy so long, in which nobody read /clock."""
        return max(self.silence, seconds if self._simulated else 0.0)

    @property
    def wall_silence(self) -> float:
        """Seconds since the last measurement by the steady clock."""
        return time.monotonic() - self._wall

    @property
    def silence(self) -> float:
        """Seconds since the last measurement, in the plant's time where it is known."""
        if (now := self._sim_now()) and not 0 < self._sim <= now:
            # a clock that was set back says nothing yet
            self._sim = now
        return self._since(self._wall, self._sim)

    def _since(self, wall: float, simulated: int) -> float:
        now = self._sim_now()
        if now and simulated:
            return max(0.0, (now - simulated) / NANOSECONDS)
        return time.monotonic() - wall

    def _sim_now(self) -> int:
        now = self._node.get_clock().now().nanoseconds if self._simulated else 0
        if now != self._ticked[0]:
            self._ticked = (now, time.monotonic())
        return now


class Watchdog:
    """
    Does what the executor's timer would, whenever the executor does not come to it.

    It counts its own looks: time in which the whole process stood still does not count. One
    thread looks for all watchdogs of a process; each acts in a thread of its own, as one may be
    kept by what keeps the executor.

    :param act: called from that thread with the seconds for which the executor has been busy;
        what it raises is raised again in the executor, by :meth:`beat`.
    """

    def __init__(self, act: Callable[[float], None]) -> None:
        self._act = act
        self._beats = self._seen = self._missed = 0
        self._failure: Exception | None = None
        self._over = False
        self._acting: threading.Thread | None = None

    def start(self) -> None:
        """Begin to look."""
        _LOOKS.add(self)

    def beat(self) -> None:
        """Note that the executor has come by; called from it, every `PERIOD`."""
        self._beats += 1
        if self._failure is not None:
            raise self._failure

    def end(self) -> None:
        """Look no more, and act no more once this has returned, but for what takes longer."""
        self._over = True
        _LOOKS.remove(self)
        if self._acting is not None:
            self._acting.join(1.0)

    def look(self) -> None:
        """Act if the executor has been busy for too long, and no act is under way."""
        self._missed = self._missed + 1 if self._beats == self._seen else 0
        self._seen = self._beats
        if self._missed < _MISSED or (self._acting is not None and self._acting.is_alive()):
            return
        self._acting = threading.Thread(
            target=self._stand_in, args=[self._missed * PERIOD], daemon=True)
        self._acting.start()

    def _stand_in(self, seconds: float) -> None:
        if self._over:
            return
        try:
            self._act(seconds)
        except Exception as error:
            # the next look may succeed
            self._failure = error


class _Looks:
    """The thread that looks, while there are watchdogs."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._watchdogs: list[Watchdog] = []
        self._over = threading.Event()
        self._thread = threading.Thread()

    def add(self, watchdog: Watchdog) -> None:
        """Look for one more."""
        with self._lock:
            self._watchdogs.append(watchdog)
            if len(self._watchdogs) > 1:
                return
            self._over = threading.Event()
            self._thread = threading.Thread(
                target=self._run, args=[self._over], name='watchdogs', daemon=True)
            self._thread.start()

    def remove(self, watchdog: Watchdog) -> None:
        """Look for one less; it need not be among them."""
        with self._lock:
            if watchdog not in self._watchdogs:
                return
            self._watchdogs.remove(watchdog)
            if self._watchdogs:
                return
            self._over.set()
            thread = self._thread
        thread.join(1.0)

    def _run(self, over: threading.Event) -> None:
        while not over.wait(PERIOD):
            with self._lock:
                watchdogs = list(self._watchdogs)
            for watchdog in watchdogs:
                watchdog.look()


_LOOKS = _Looks()


def end_in_time(name: str) -> Callable[[], None]:
    """End the process by force when it is busy 5 s after a signal; return what takes it back."""
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
