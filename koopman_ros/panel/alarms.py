# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Alarms by ISA-18.2: delays, acknowledgement, shelving, and a journal of 24 hours."""

from collections import deque
from collections.abc import Iterable, Iterator
import contextlib
from dataclasses import dataclass
from enum import Enum
import math
import threading

from koopman_ros.panel.files import sanitize_text

MAX_TEXT = 500  # characters
MAX_WHO = 64
MAX_ALARMS = 1000  #: of these, the oldest that have returned make room for others
_FOUND_AGAIN = 10.0  # s after a restart until the conditions are reported again


class Priority(Enum):
    """Urgency of an alarm, ordered by value."""

    LOW = 1
    MEDIUM = 2
    HIGH = 3

    @property
    def word(self) -> str:
        """For people."""
        return self.name.lower()


class AlarmState(Enum):
    """State of an alarm; the value is the word for people."""

    NORMAL = 'normal'
    UNACKNOWLEDGED = 'unacknowledged'
    ACKNOWLEDGED = 'acknowledged'
    RETURNED = 'returned, not acknowledged'


@dataclass(frozen=True)
class Alarm:
    """An alarm."""

    key: str  #: of its condition
    text: str
    priority: Priority
    state: AlarmState
    since: float  #: wall time at which it was raised last
    shelved_until: float | None = None  #: wall time
    acknowledged_by: str = ''

    @property
    def source(self) -> str:
        """The node of its condition, or process."""
        return self.key.partition(':')[0].removeprefix('silence of ').partition(',')[0]


@dataclass(frozen=True)
class AlarmLogEntry:
    """Entry of the journal."""

    time: float  #: wall time
    key: str
    priority: Priority
    text: str
    what: str  #: 'raised', 'returned', 'acknowledged', 'shelved' or 'unshelved'
    who: str = ''  #: operator, or empty


class _Record:
    """
    A condition with its shown and its reported rank: the value of a priority, 0 for none.

    The shown rank follows the reported one after that was higher for `delay_on`, or lower for
    `delay_off`: to the nearest of the ranks reported meanwhile, so that no change between two of
    the others passes sooner.
    """

    def __init__(self, key: str, priority: Priority) -> None:
        self.key, self.text, self.priority = key, '', priority
        self.state = AlarmState.NORMAL
        self.since = 0.0
        self.shelved_until: float | None = None
        self.acknowledged_by = ''
        self.shown = self.reported = self.nearest = 0
        self.delay: float | None = None  # s of its own before it is raised
        self.changed = 0.0  # when the reported rank left the shown one

    @property
    def pending(self) -> bool:
        return self.reported != self.shown

    @property
    def idle(self) -> bool:
        """Whether the record can be deleted."""
        return (self.state is AlarmState.NORMAL and not self.pending
                and self.shelved_until is None)

    def report(self, rank: int, now: float) -> None:
        """Take the reported rank; `shown` is up to date."""
        side = (rank > self.shown) - (rank < self.shown)
        if side != (self.reported > self.shown) - (self.reported < self.shown):
            self.changed, self.nearest = now, rank
        elif side:
            self.nearest = (min if side > 0 else max)(self.nearest, rank)
        self.reported = rank

    def alarm(self) -> Alarm:
        return Alarm(self.key, self.text, self.priority, self.state, self.since,
                     self.shelved_until, self.acknowledged_by)


class Alarms:
    """
    All alarms, from the conditions that are reported; several threads may use it.

    An alarm is raised after its condition was active for `delay_on`, and returns after the
    condition was inactive for `delay_off`. Changes of the priority have the same delays; a higher
    priority needs a new acknowledgement. All times are wall times in s.

    >>> alarms = Alarms(delay_on=1.0)
    >>> alarms.report('level', True, Priority.HIGH, 'level above 2 m', 100.0)
    >>> alarms.advance(101.0)
    >>> [alarm.text for alarm in alarms.standing]
    ['level above 2 m']

    :param delay_on: s from the condition to its alarm.
    :param delay_off: s from the end of the condition to the return.
    :param kept: largest number of entries in the journal.
    :param day: s for which the journal keeps its entries.
    """

    def __init__(self, *, delay_on: float = 1.0, delay_off: float = 5.0, kept: int = 10_000,
                 day: float = 86_400.0) -> None:
        self._delay_on, self._delay_off, self._day = delay_on, delay_off, day
        self._records: dict[str, _Record] = {}
        # keys whose delay or shelving runs
        self._running: set[str] = set()
        self._journal: deque[AlarmLogEntry] = deque(maxlen=kept)
        self._last = -math.inf
        self._lock = threading.Lock()
        self.noted = 0  #: number of all entries of the journal so far

    def report(self, key: str, active: bool, priority: Priority, text: str, now: float,
               delay: float | None = None) -> None:
        """
        Report whether a condition is active, at any rate.

        :param key: of the condition.
        :param now: if it jumps back, delays and shelving keep their remaining time.
        :param delay: s from the condition to its alarm instead of `delay_on`.
        """
        with self._lock:
            self._advance(now)
            record = self._records.get(key)
            if record is None:
                if not active:
                    return
                self._make_room()
                record = self._records[key] = _Record(key, priority)
            if active:
                record.text, record.delay = sanitize_text(text, MAX_TEXT), delay
            record.report(priority.value if active else 0, now)
            self._settle(record, now)
            self._tidy(record)

    def advance(self, now: float) -> None:
        """Let delays and shelving run out; to be called a few times per second."""
        with self._lock:
            self._advance(now)

    def acknowledge(self, key: str, who: str, now: float) -> bool:
        """Acknowledge an active alarm; return whether that was possible."""
        with self._acting(key, now) as record:
            if record is None or record.state is AlarmState.ACKNOWLEDGED:
                return False
            back = record.state is AlarmState.RETURNED
            record.state = AlarmState.NORMAL if back else AlarmState.ACKNOWLEDGED
            record.acknowledged_by = '' if back else sanitize_text(who, MAX_WHO)
            self._note(now, record, 'acknowledged', who)
        return True

    def shelve(self, key: str, seconds: float, who: str, now: float) -> bool:
        """Hide an active alarm for some seconds; return whether that was possible."""
        with self._acting(key, now, shelved=True) as record:
            if record is None:
                return False
            record.shelved_until = now + seconds
            self._note(now, record, 'shelved', who)
        return True

    def unshelve(self, key: str, who: str, now: float) -> bool:
        """Show a shelved alarm again; return whether that was possible."""
        with self._acting(key, now, shelved=True) as record:
            if record is None or record.shelved_until is None:
                return False
            record.shelved_until = None
            self._note(now, record, 'unshelved', who)
        return True

    @property
    def standing(self) -> tuple[Alarm, ...]:
        """
        Active alarms that are not shelved.

        The unacknowledged come first, of these the highest priority, of these the newest.
        """
        with self._lock:
            found = [record.alarm() for record in self._records.values()
                     if record.state is not AlarmState.NORMAL and record.shelved_until is None]
        return tuple(sorted(found, key=lambda alarm: (
            alarm.state is AlarmState.ACKNOWLEDGED, -alarm.priority.value, -alarm.since,
            alarm.key)))

    @property
    def shelved(self) -> tuple[Alarm, ...]:
        """Shelved alarms, active or not; the one whose shelving ends first comes first."""
        with self._lock:
            found = [record.alarm() for record in self._records.values()
                     if record.shelved_until is not None]
        return tuple(sorted(found, key=lambda alarm: (alarm.shelved_until or 0.0, alarm.key)))

    @property
    def all(self) -> tuple[Alarm, ...]:
        """Active and shelved alarms."""
        with self._lock:
            return tuple(record.alarm() for record in self._records.values() if (
                record.state is not AlarmState.NORMAL or record.shelved_until is not None))

    def restore(self, alarms: Iterable[Alarm], journal: Iterable[AlarmLogEntry],
                now: float) -> None:
        """
        Replace all alarms by those before a restart.

        An active alarm stays active until its condition has not been reported for a while.

        :param alarms: from :attr:`all`.
        :param journal: the oldest entry first.
        """
        with self._lock:
            self._records.clear()
            self._running.clear()
            self._journal.clear()
            self._journal.extend(journal)
            for alarm in alarms:
                record = self._records[alarm.key] = _Record(alarm.key, alarm.priority)
                record.text, record.state, record.since = alarm.text, alarm.state, alarm.since
                record.shelved_until = alarm.shelved_until
                record.acknowledged_by = alarm.acknowledged_by
                if alarm.state in (AlarmState.UNACKNOWLEDGED, AlarmState.ACKNOWLEDGED):
                    record.shown = record.reported = alarm.priority.value
                    record.report(0, now + _FOUND_AGAIN)
                self._tidy(record)
            self._advance(now)

    def journal(self, since: float) -> tuple[AlarmLogEntry, ...]:
        """Return the entries since a time, the newest first."""
        with self._lock:
            return tuple(entry for entry in reversed(self._journal) if entry.time >= since)

    @contextlib.contextmanager
    def _acting(self, key: str, now: float, shelved: bool = False) -> Iterator[_Record | None]:
        """Return an active alarm, or also a shelved one, to be changed; None for another."""
        with self._lock:
            self._advance(now)
            record = self._records.get(key)
            if record is None or (record.state is AlarmState.NORMAL
                                  and not (shelved and record.shelved_until is not None)):
                yield None
            else:
                yield record
                self._tidy(record)

    def _advance(self, now: float) -> None:
        running = [self._records[key] for key in self._running]
        if now < self._last:
            # the clock was set back
            for record in running:
                record.changed -= self._last - now
                if record.shelved_until is not None:
                    record.shelved_until -= self._last - now
        self._last = now
        for record in sorted(running, key=self._due):
            self._settle(record, now)
            if record.shelved_until is not None and record.shelved_until <= now:
                ended, record.shelved_until = record.shelved_until, None
                self._note(ended, record, 'unshelved')
            self._tidy(record)
        while self._journal and self._journal[0].time < now - self._day:
            self._journal.popleft()

    def _due(self, record: _Record) -> float:
        """Return when the shown rank follows the reported one."""
        if not record.pending:
            return math.inf
        rises = record.reported > record.shown
        on = self._delay_on if record.delay is None else record.delay
        return record.changed + (on if rises else self._delay_off)

    def _settle(self, record: _Record, now: float) -> None:
        while (due := self._due(record)) <= now:
            self._show(record, record.nearest, due)
            # a further change has a delay of its own
            record.changed, record.nearest = due, record.reported

    def _show(self, record: _Record, rank: int, time: float) -> None:
        before, record.shown = record.shown, rank
        if rank:
            record.priority = Priority(rank)
        if rank > before:
            record.state, record.acknowledged_by = AlarmState.UNACKNOWLEDGED, ''
            record.since = time
            self._note(time, record, 'raised')
        elif rank == 0:
            acknowledged = record.state is AlarmState.ACKNOWLEDGED
            record.state = AlarmState.NORMAL if acknowledged else AlarmState.RETURNED
            record.acknowledged_by = ''
            self._note(time, record, 'returned')

    def _make_room(self) -> None:
        """Drop the oldest alarm that has returned: texts may differ without end."""
        if len(self._records) >= MAX_ALARMS:
            gone = min((one for one in self._records.values()
                        if one.state is AlarmState.RETURNED and one.shelved_until is None),
                       key=lambda one: one.since, default=None)
            if gone is not None:
                self._running.discard(gone.key)
                del self._records[gone.key]

    def _tidy(self, record: _Record) -> None:
        """Keep track of running delays, and delete an idle record."""
        if record.pending or record.shelved_until is not None:
            self._running.add(record.key)
        else:
            self._running.discard(record.key)
        if record.idle:
            self._records.pop(record.key, None)

    def _note(self, time: float, record: _Record, what: str, who: str = '') -> None:
        self.noted += 1
        self._journal.append(AlarmLogEntry(time, record.key, record.priority, record.text, what,
                                           sanitize_text(who, MAX_WHO)))
