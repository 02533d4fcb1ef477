# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Alarms: delays, states, acknowledgement, shelving, order, journal, bounds, threads."""

from itertools import pairwise
import math
import threading

from hypothesis import given, settings
from hypothesis import strategies as st
import pytest

from koopman_ros.panel.alarms import Alarms, AlarmState, MAX_TEXT, MAX_WHO, Priority
from koopman_ros.panel.files import sanitize_text

LOW, MEDIUM, HIGH = Priority
RANKS = {'-': None, 'l': LOW, 'm': MEDIUM, 'h': HIGH}
NOW = 1_700_000_000.0


def _raised(priority: Priority = MEDIUM) -> Alarms:
    """Return an alarm `x`, raised at NOW + 1."""
    alarms = Alarms()
    alarms.report('x', True, priority, 'text of x', NOW)
    alarms.advance(NOW + 1.0)
    return alarms


def _states(alarms: Alarms) -> dict[str, AlarmState]:
    return {alarm.key: alarm.state for alarm in alarms.standing}


def _events(alarms: Alarms) -> list[str]:
    return [entry.what for entry in reversed(alarms.journal(-math.inf))]


# Reports of one condition: '-' inactive, or its priority; the times of the changes after NOW.
@pytest.mark.parametrize(('reports', 'period', 'changes'), [
    # raised after the delay, at that time however late it is looked at
    ('h', 1.5, [('raised', HIGH, 1.0)]),
    # shorter than the delay
    ('h-' * 50, 0.1, []), ('h-' * 50, 0.99, []),
    # an active alarm does not flutter
    ('mm' + '-m' * 50, 1.0, [('raised', MEDIUM, 1.0)]),
    ('m' + '-m' * 10, 4.9, [('raised', MEDIUM, 1.0)]),
    # repeated reports do not restart the delays
    ('l' * 50 + '-' * 150, 0.1, [('raised', LOW, 1.0), ('returned', LOW, 10.0)]),
    # a priority that flutters is raised once, a higher one after one more delay
    ('lh' * 50, 0.3, [('raised', LOW, 1.0)]), ('hl' * 50, 0.3, [('raised', LOW, 1.0)]),
    ('lhhhhhhhhhhhh', 0.5, [('raised', LOW, 1.0), ('raised', HIGH, 2.0)]),
    # a short gap at the end of a longer lower priority is no return
    ('hhhh' + 'l' * 9 + '-' + 'l' * 20, 0.5, [('raised', HIGH, 1.0)])])
def test_delays(reports: str, period: float, changes: list[tuple[str, Priority, float]]) -> None:
    alarms = Alarms(delay_on=1.0, delay_off=5.0)
    for step, rank in enumerate(reports):
        alarms.report('x', rank != '-', RANKS[rank] or LOW, '', NOW + step * period)
    alarms.advance(NOW + len(reports) * period)
    assert [(entry.what, entry.priority, pytest.approx(entry.time - NOW, abs=1e-6))
            for entry in reversed(alarms.journal(0.0))] == changes


# a: acknowledge, otherwise a report as above, 10 s later each
@pytest.mark.parametrize(('steps', 'state', 'priority', 'events'), [
    ('a', AlarmState.ACKNOWLEDGED, MEDIUM, ['raised', 'acknowledged']),
    ('-', AlarmState.RETURNED, MEDIUM, ['raised', 'returned']),
    ('-a', None, None, ['raised', 'returned', 'acknowledged']),
    ('a-', None, None, ['raised', 'acknowledged', 'returned']),
    ('-m', AlarmState.UNACKNOWLEDGED, MEDIUM, ['raised', 'returned', 'raised']),
    ('a-m', AlarmState.UNACKNOWLEDGED, MEDIUM,
     ['raised', 'acknowledged', 'returned', 'raised']),
    ('-am', AlarmState.UNACKNOWLEDGED, MEDIUM,
     ['raised', 'returned', 'acknowledged', 'raised']),
    # a higher priority needs a new acknowledgement, a lower one none
    ('ah', AlarmState.UNACKNOWLEDGED, HIGH, ['raised', 'acknowledged', 'raised']),
    ('al', AlarmState.ACKNOWLEDGED, LOW, ['raised', 'acknowledged'])])
def test_states_follow_the_standard(steps: str, state: AlarmState | None,
                                    priority: Priority | None, events: list[str]) -> None:
    alarms, now = _raised(), NOW + 1.0
    for step in steps:
        if step == 'a':
            assert alarms.acknowledge('x', 'Ada', now)
        else:
            alarms.report('x', step != '-', RANKS[step] or LOW, 'again', now)
        now += 10.0
        alarms.advance(now)
    assert _events(alarms) == events
    assert [(alarm.state, alarm.priority, alarm.acknowledged_by) for alarm in alarms.standing] == (
        [] if state is None else [
            (state, priority, 'Ada' if state is AlarmState.ACKNOWLEDGED else '')])


@pytest.mark.parametrize('key', ['y', '', 'X', 'x '])
@pytest.mark.parametrize('what', ['acknowledge', 'shelve', 'unshelve'])
def test_an_unknown_alarm_cannot_be_changed(key: str, what: str) -> None:
    alarms = _raised()
    arguments = (60.0, 'Ada', NOW + 2.0) if what == 'shelve' else ('Ada', NOW + 2.0)
    assert not getattr(alarms, what)(key, *arguments)
    assert _states(alarms) == {'x': AlarmState.UNACKNOWLEDGED}
    assert _events(alarms) == ['raised']


def test_the_first_acknowledgement_counts() -> None:
    alarms = _raised()
    assert alarms.acknowledge('x', 'Ada', NOW + 2.0)
    assert not alarms.acknowledge('x', 'Bob', NOW + 3.0)
    assert [(entry.what, entry.who) for entry in alarms.journal(0.0)] == [
        ('acknowledged', 'Ada'), ('raised', '')]


def test_a_text_changes_at_once_and_stays_after_the_return() -> None:
    alarms = _raised()
    alarms.report('x', True, MEDIUM, '71 degC', NOW + 2.0)
    assert alarms.standing[0].text == '71 degC'
    alarms.report('x', False, MEDIUM, '', NOW + 3.0)
    alarms.advance(NOW + 10.0)
    assert alarms.standing[0].text == '71 degC'


def test_alarms_are_sorted_by_priority_then_age() -> None:
    alarms = Alarms(delay_on=0.0)
    for offset, (key, priority) in enumerate(
            [('old', HIGH), ('low', LOW), ('new', HIGH), ('seen', HIGH), ('middle', MEDIUM)]):
        alarms.report(key, True, priority, '', NOW + offset)
    alarms.acknowledge('seen', 'Ada', NOW + 9.0)
    assert [alarm.key for alarm in alarms.standing] == ['new', 'old', 'middle', 'low', 'seen']


def test_a_shelved_alarm_returns_when_its_time_is_over() -> None:
    alarms = _raised()
    alarms.shelve('x', 60.0, 'Ada', NOW + 2.0)
    assert alarms.shelved[0].shelved_until == NOW + 62.0
    alarms.advance(NOW + 61.9)
    assert not alarms.standing
    alarms.advance(NOW + 100.0)
    assert _states(alarms) == {'x': AlarmState.UNACKNOWLEDGED}
    entry = alarms.journal(0.0)[0]
    assert (entry.what, entry.who, entry.time) == ('unshelved', '', NOW + 62.0)


def test_a_shelved_alarm_may_come_and_go_and_be_unshelved() -> None:
    alarms = _raised()
    alarms.shelve('x', 3600.0, 'Ada', NOW + 2.0)
    assert alarms.acknowledge('x', 'Ada', NOW + 3.0)
    alarms.report('x', False, MEDIUM, '', NOW + 4.0)
    alarms.advance(NOW + 20.0)
    assert alarms.shelved[0].state is AlarmState.NORMAL
    assert not alarms.acknowledge('x', 'Ada', NOW + 20.0)
    alarms.report('x', True, MEDIUM, '', NOW + 21.0)
    alarms.advance(NOW + 30.0)
    assert not alarms.standing
    assert alarms.unshelve('x', 'Bob', NOW + 31.0)
    assert _states(alarms) == {'x': AlarmState.UNACKNOWLEDGED}
    assert not alarms.unshelve('x', 'Bob', NOW + 32.0)
    assert alarms.journal(0.0)[0].who == 'Bob'


def test_the_journal_is_bounded_in_entries_and_time_with_the_newest_first() -> None:
    alarms = Alarms(delay_on=0.0, delay_off=0.0, kept=10, day=100.0)
    for step in range(20):
        alarms.report('x', step % 2 == 0, LOW, str(step), NOW + step)
    assert [entry.time - NOW for entry in alarms.journal(0.0)] == list(range(19, 9, -1))
    assert [entry.time - NOW for entry in alarms.journal(NOW + 18.0)] == [19, 18]
    alarms.advance(NOW + 115.0)
    assert [entry.time - NOW for entry in alarms.journal(0.0)] == [19, 18, 17, 16, 15]


def test_a_clock_that_is_set_back_leaves_the_remaining_times() -> None:
    alarms = _raised()
    alarms.shelve('x', 600.0, 'Ada', NOW + 2.0)
    alarms.report('y', True, LOW, '', NOW + 2.0)
    back = NOW - 3600.0
    for seconds, standing in ((0.0, 0), (0.9, 0), (1.1, 1), (601.0, 2)):
        alarms.advance(back + seconds)
        assert len(alarms.standing) == standing


@pytest.mark.parametrize('hostile', [
    '<script>alert(1)</script>', 'a\nb\tc', 'x' * 5000, '\ud800', '\u202egnp.exe', '\0', ' '])
def test_hostile_texts_are_bounded_and_printable(hostile: str) -> None:
    alarms = Alarms(delay_on=0.0)
    alarms.report('x', True, LOW, hostile, NOW)
    assert alarms.acknowledge('x', hostile, NOW)
    (alarm,) = alarms.standing
    for text, most in ((alarm.text, MAX_TEXT), *(
            (entry.who, MAX_WHO) for entry in alarms.journal(0.0))):
        assert text.isprintable()
        assert len(text) <= most


@given(st.lists(st.sampled_from('aä.…\n \t\0\ud800\u202e\u3000\U0001f600'), max_size=120)
       .map(''.join), st.integers(1, 20))
def test_sanitized_text_is_stable(text: str, longest: int) -> None:
    shown = sanitize_text(text, longest)
    assert len(shown) <= longest
    assert shown.isprintable()
    assert sanitize_text(shown, longest) == shown.strip()


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(
    st.floats(0.0, 3.0), st.sampled_from('xyz'), st.sampled_from([None, *Priority]),
    st.sampled_from(['', '', '', 'acknowledge', 'shelve', 'unshelve'])), max_size=60))
def test_changes_of_an_alarm_are_apart(
        steps: list[tuple[float, str, Priority | None, str]]) -> None:
    alarms, now = Alarms(delay_on=1.0, delay_off=5.0), NOW
    for after, key, priority, act in steps:
        now += after
        if act:
            getattr(alarms, act)(key, *([60.0] if act == 'shelve' else []), 'Ada', now)
        else:
            alarms.report(key, priority is not None, priority or LOW, '', now)
    alarms.advance(now + 8.0)
    for key in 'xyz':
        entries = [entry for entry in reversed(alarms.journal(0.0))
                   if entry.key == key and entry.what in ('raised', 'returned')]
        for before, later in pairwise(entries):
            delay = 1.0 if later.what == 'raised' else 5.0
            assert later.time - before.time > delay - 1e-6
            assert (before.what, later.what) != ('returned', 'returned')
    # only records with something to remember are kept
    assert all(not record.idle for record in alarms._records.values())
    assert alarms._running == {record.key for record in alarms._records.values()
                               if record.pending or record.shelved_until is not None}


def test_threads_do_not_disturb_each_other() -> None:
    alarms, failed = Alarms(delay_on=0.0, delay_off=0.0, kept=100_000), []

    def report(key: str) -> None:
        try:
            for step in range(300):
                alarms.report(key, step % 2 == 0, HIGH, '', NOW)
                for alarm in alarms.standing:
                    alarms.acknowledge(alarm.key, 'Ada', NOW)
        except Exception as error:
            failed.append(error)

    threads = [threading.Thread(target=report, args=(key,)) for key in 'abc']
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failed
    assert sum(entry.what == 'raised' for entry in alarms.journal(0.0)) == 3 * 150
