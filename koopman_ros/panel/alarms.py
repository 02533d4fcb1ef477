# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Alarms in the sense of ISA-18.2: delays, acknowledgement, shelving, and a journal of the day."""

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import Enum
import hashlib
import math
import threading

from koopman_ros.panel.texts import plain

SHORTEST_SHELVING = 60.0  # s
LONGEST_SHELVING = 8 * 3600.0  # s
MAX_ALARMS = 500
MAX_KEY = 200  # characters
MAX_TEXT = 500
MAX_WHO = 64
OVERFLOW = 'alarms'  #: key of the alarm that says that there are too many
_FOUND_AGAIN = 10.0  # s in which what reported an alarm before a restart is heard again


class Priority(Enum):
    """How soon somebody must act; ordered by value."""

    LOW = 1
    MEDIUM = 2
    HIGH = 3

    @property
    def word(self) -> str:
        """For people."""
        return self.name.lower()


class AlarmState(Enum):
    """Where an alarm stands; the value is the word for people."""

    NORMAL = 'normal'
    UNACKNOWLEDGED = 'unacknowledged'
    ACKNOWLEDGED = 'acknowledged'
    RETURNED = 'returned, not acknowledged'

    @property
    def word(self) -> str:
        """For people."""
        return self.value


@dataclass(frozen=True)
class Alarm:
    """An alarm as it stands."""

    key: str  #: names it, and nothing else
    text: str
    priority: Priority
    state: AlarmState
    since: float  #: when it was raised last, s of Unix time
    shelved_until: float | None = None  #: s of Unix time
    acknowledged_by: str = ''


@dataclass(frozen=True)
class Entry:
    """What happened to an alarm, in the journal."""

    time: float  #: s of Unix time
    key: str
    priority: Priority
    text: str
    what: str  #: 'raised', 'returned', 'acknowledged', 'shelved' or 'unshelved'
    who: str = ''  #: the operator; nobody where it came by itself


class _Record:
    """
    A condition, how urgent it is shown, and how urgent it is reported; 0 where it is not there.

    What is shown follows what is reported when that was higher for the delay to rise, or lower
    for the delay to fall: to the nearest of what was reported meanwhile, so that no change
    between two of the others gets through any sooner.
    """

    def __init__(self, key: str, priority: Priority) -> None:
        self.key, self.text, self.priority = key, '', priority
        self.state = AlarmState.NORMAL
        self.since = 0.0
        self.shelved_until: float | None = None
        self.acknowledged_by = ''
        self.shown = self.reported = self.nearest = 0
        self.changed = 0.0  # when what is reported left what is shown

    @property
    def pending(self) -> bool:
        return self.reported != self.shown

    @property
    def idle(self) -> bool:
        """Whether there is nothing to remember."""
        return (self.state is AlarmState.NORMAL and not self.pending
                and self.shelved_until is None)

    def report(self, rank: int, now: float) -> None:
        """Take note of what is reported; `shown` is up to date."""
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
    All alarms, from conditions that are reported; several threads may use it.

    An alarm is raised after its condition was there for `delay_on`, and returns after it was away
    for `delay_off`. A priority that rises or falls takes the same delays, and one that rises needs
    a new acknowledgement. Past :data:`MAX_ALARMS` the less urgent ones give way, and an alarm
    of the key :data:`OVERFLOW` says so.

    :param delay_on: in s, from the condition to its alarm.
    :param delay_off: in s, from the end of the condition to the return.
    :param kept: entries of the journal at most.
    :param day: s for which the journal keeps its entries.
    :raises ValueError: for a delay that is negative or a bound that is not positive.
    """

    def __init__(self, *, delay_on: float = 1.0, delay_off: float = 5.0, kept: int = 10_000,
                 day: float = 86_400.0) -> None:
        for name, value in (('delay_on', delay_on), ('delay_off', delay_off)):
            if not 0.0 <= value < math.inf:
                raise ValueError(f'{name} must be at least 0 s and finite, got {value}')
        if kept < 1 or not day > 0.0:
            raise ValueError(f'kept and day must be positive, got {kept} and {day} s')
        self._delay_on, self._delay_off, self._day = delay_on, delay_off, day
        self._records: dict[str, _Record] = {}
        # those whose delay or shelving runs
        self._running: set[str] = set()
        self._journal: deque[Entry] = deque(maxlen=kept)
        self._last = -math.inf
        self._lock = threading.Lock()
        self.noted = 0  #: entries that were ever made in the journal

    def report(self, key: str, active: bool, priority: Priority, text: str, now: float) -> None:
        """
        Take note of whether a condition is there; as often as one likes.

        :param key: of the condition; a long one is shown with its end replaced by a digest.
        :param now: s of Unix time. Where it jumps back, what runs keeps its remaining time.
        :raises ValueError: for a time that is not finite.
        """
        key, text = _short(key), plain(text, MAX_TEXT)
        with self._lock:
            self._advance(now)
            if key == OVERFLOW:
                return
            record = self._records.get(key)
            if record is None:
                if not active or not self._make_room(priority, now):
                    return
                record = self._records[key] = _Record(key, priority)
            if active:
                record.text = text
            self._take(record, priority.value if active else 0, now)

    def advance(self, now: float) -> None:
        """Let delays and shelving run out; a few times a second will do."""
        with self._lock:
            self._advance(now)

    def acknowledge(self, key: str, who: str, now: float) -> str:
        """Acknowledge an alarm; return '' or why not."""
        def act(record: _Record) -> str:
            if record.state is AlarmState.ACKNOWLEDGED:
                return f'it was acknowledged already, by {record.acknowledged_by}'
            back = record.state is AlarmState.RETURNED
            record.state = AlarmState.NORMAL if back else AlarmState.ACKNOWLEDGED
            record.acknowledged_by = '' if back else plain(who, MAX_WHO)
            self._note(now, record, 'acknowledged', who)
            return ''

        return self._act(key, 'acknowledge', now, act)

    def shelve(self, key: str, seconds: float, who: str, now: float) -> str:
        """Take an alarm out of sight for a while, 1 min to 8 h; return '' or why not."""
        if not SHORTEST_SHELVING <= seconds <= LONGEST_SHELVING:
            return 'an alarm can be shelved for 1 min to 8 h'

        def act(record: _Record) -> str:
            record.shelved_until = now + seconds
            self._note(now, record, 'shelved', who)
            return ''

        return self._act(key, 'shelve', now, act, shelved=True)

    def unshelve(self, key: str, who: str, now: float) -> str:
        """Show an alarm that was shelved; return '' or why not."""
        def act(record: _Record) -> str:
            if record.shelved_until is None:
                return 'it is not shelved'
            record.shelved_until = None
            self._note(now, record, 'unshelved', who)
            return ''

        return self._act(key, 'unshelve', now, act, shelved=True)

    @property
    def standing(self) -> tuple[Alarm, ...]:
        """
        What is neither normal nor shelved.

        What is not acknowledged first, of these the highest priority, of these the newest.
        """
        with self._lock:
            found = [record.alarm() for record in self._records.values()
                     if record.state is not AlarmState.NORMAL and record.shelved_until is None]
        return tuple(sorted(found, key=lambda alarm: (
            alarm.state is AlarmState.ACKNOWLEDGED, -alarm.priority.value, -alarm.since,
            alarm.key)))

    @property
    def shelved(self) -> tuple[Alarm, ...]:
        """What is shelved, also where it is normal meanwhile; what ends first comes first."""
        with self._lock:
            found = [record.alarm() for record in self._records.values()
                     if record.shelved_until is not None]
        return tuple(sorted(found, key=lambda alarm: (alarm.shelved_until or 0.0, alarm.key)))

    @property
    def all(self) -> tuple[Alarm, ...]:
        """What is not normal, or is shelved."""
        with self._lock:
            return tuple(record.alarm() for record in self._records.values() if (
                record.state is not AlarmState.NORMAL or record.shelved_until is not None))

    def recall(self, alarms: Iterable[Alarm], journal: Iterable[Entry], now: float) -> None:
        """
        Go on from what there was before a restart, in place of what there is.

        What stood then stands until it is clear that it does not any more.

        :param alarms: as :attr:`all` gave them.
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

    def journal(self, since: float) -> tuple[Entry, ...]:
        """Return what happened from then on, the newest first."""
        with self._lock:
            return tuple(entry for entry in reversed(self._journal) if entry.time >= since)

    def _act(self, key: str, what: str, now: float, act: Callable[[_Record], str],
             shelved: bool = False) -> str:
        """Do what an operator asks of an alarm that is not normal, or shelved where that does."""
        key = _short(key)
        with self._lock:
            self._advance(now)
            record = self._records.get(key)
            if record is None or (record.state is AlarmState.NORMAL
                                  and not (shelved and record.shelved_until is not None)):
                return f'there is no such alarm to {what}'
            refused = act(record)
            self._tidy(record)
            return refused

    def _advance(self, now: float) -> None:
        if not math.isfinite(now):
            raise ValueError(f'the time must be finite, got {now}')
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
        overflow = self._records.get(OVERFLOW)
        if overflow is not None and len(self._records) <= MAX_ALARMS:
            self._take(overflow, 0, now)
        while self._journal and self._journal[0].time < now - self._day:
            self._journal.popleft()

    def _take(self, record: _Record, rank: int, now: float) -> None:
        record.report(rank, now)
        self._settle(record, now)
        self._tidy(record)

    def _due(self, record: _Record) -> float:
        """Return when what is shown follows what is reported."""
        if not record.pending:
            return math.inf
        rises = record.reported > record.shown
        return record.changed + (self._delay_on if rises else self._delay_off)

    def _settle(self, record: _Record, now: float) -> None:
        while (due := self._due(record)) <= now:
            self._show(record, record.nearest, due)
            # what is still left of the way starts anew
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

    def _tidy(self, record: _Record) -> None:
        """Remember what runs, and forget what is over."""
        if record.pending or record.shelved_until is not None:
            self._running.add(record.key)
        else:
            self._running.discard(record.key)
        if record.idle:
            self._records.pop(record.key, None)

    def _make_room(self, priority: Priority, now: float) -> bool:
        """Return whether there is room for a new alarm; a less urgent one gives way to it."""
        if len(self._records) - (OVERFLOW in self._records) < MAX_ALARMS:
            return True
        overflow = self._records.setdefault(OVERFLOW, _Record(OVERFLOW, Priority.HIGH))
        overflow.text = f'more than {MAX_ALARMS} alarms at once: the less urgent are not shown'
        self._take(overflow, Priority.HIGH.value, now)
        least = min((record for record in self._records.values() if record is not overflow),
                    key=lambda record: (max(record.shown, record.reported), record.since))
        if max(least.shown, least.reported) >= priority.value:
            return False
        del self._records[least.key]
        self._running.discard(least.key)
        return True

    def _note(self, time: float, record: _Record, what: str, who: str = '') -> None:
        self.noted += 1
        self._journal.append(Entry(time, record.key, record.priority, record.text, what,
                                   plain(who, MAX_WHO)))


class Side(Enum):
    """Where a number is of its limits."""

    BELOW = -1
    INSIDE = 0
    ABOVE = 1


class Deadband:
    """
    Where a number is of its limits, with a hysteresis: out beyond a limit, in again by a band.

    :param low: limit, -inf where there is none.
    :param high: limit, inf where there is none.
    :param band: how far inside a limit a number must be to have returned.
    :raises ValueError: for limits in the wrong order, or a band as wide as what is between them.
    """

    def __init__(self, low: float = -math.inf, high: float = math.inf, band: float = 0.0) -> None:
        if not low <= high:
            raise ValueError(f'low must be at most high, got {low} and {high}')
        if not 0.0 <= band <= high - low or band == math.inf:
            raise ValueError(f'band must be at least 0 and at most high - low = {high - low:g}, '
                             f'got {band}')
        self.low, self.high, self.band = low, high, band
        self.side = Side.INSIDE

    def update(self, value: float) -> Side:
        """Return where a number is; what is not a number leaves it where it was."""
        if value > self.high:
            self.side = Side.ABOVE
        elif value < self.low:
            self.side = Side.BELOW
        elif (self.side is Side.ABOVE and value <= self.high - self.band) or (
                self.side is Side.BELOW and value >= self.low + self.band):
            self.side = Side.INSIDE
        return self.side


def _short(key: str) -> str:
    """Return a key that can be shown, of bounded length; the same for what it returned."""
    shown = plain(key, MAX_KEY)
    if shown == key:
        return key
    digest = hashlib.blake2s(key.encode(errors='surrogatepass'), digest_size=8).hexdigest()
    return f'{plain(key, MAX_KEY - 1 - len(digest))}#{digest}'
