# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Alarms: delays, states, acknowledgement, shelving, order, journal, bounds, threads."""

from itertools import pairwise
import math
import threading

from hypothesis import given, settings
from hypothesis import strategies as st
import pytest

from koopman_ros.panel.alarms import (
    Alarms,
    AlarmState,
    Deadband,
    MAX_ALARMS,
    MAX_KEY,
    MAX_TEXT,
    MAX_WHO,
    OVERFLOW,
    Priority,
    Side,
)
from koopman_ros.panel.texts import plain

LOW, MEDIUM, HIGH = Priority
NOW = 1_700_000_000.0


def _raised(*keys: str, priority: Priority = MEDIUM) -> Alarms:
    """Return alarms that stand, raised at NOW + 1."""
    alarms = Alarms()
    for key in keys or ('x',):
        alarms.report(key, True, priority, f'text of {key}', NOW)
    alarms.advance(NOW + 1.0)
    return alarms


def _states(alarms: Alarms) -> dict[str, AlarmState]:
    return {alarm.key: alarm.state for alarm in alarms.standing}


def _happened(alarms: Alarms) -> list[tuple[str, str, float]]:
    """List what happened, the oldest first, by seconds after NOW."""
    return [(entry.key, entry.what, entry.time - NOW)
            for entry in reversed(alarms.journal(-math.inf))]


def test_an_alarm_is_raised_after_the_delay_and_from_then_on() -> None:
    alarms = Alarms(delay_on=1.0)
    alarms.report('x', True, HIGH, 'too hot', NOW)
    alarms.advance(NOW + 0.99)
    assert alarms.standing == alarms.journal(0.0) == ()
    # looked at late, it is of the same time
    alarms.advance(NOW + 1.5)
    (alarm,) = alarms.standing
    assert (alarm.key, alarm.text, alarm.priority, alarm.state, alarm.since) == (
        'x', 'too hot', HIGH, AlarmState.UNACKNOWLEDGED, NOW + 1.0)
    assert alarm.shelved_until is None
    assert alarm.acknowledged_by == ''
    assert _happened(alarms) == [('x', 'raised', 1.0)]


def test_without_delays_it_is_raised_and_gone_at_once() -> None:
    alarms = Alarms(delay_on=0.0, delay_off=0.0)
    alarms.report('x', True, LOW, '', NOW)
    assert _states(alarms) == {'x': AlarmState.UNACKNOWLEDGED}
    alarms.report('x', False, LOW, '', NOW)
    assert _states(alarms) == {'x': AlarmState.RETURNED}


@pytest.mark.parametrize('period', [0.1, 0.5, 0.99])
def test_what_flutters_faster_than_the_delay_is_no_alarm(period: float) -> None:
    alarms = Alarms(delay_on=1.0)
    for step in range(100):
        alarms.report('x', step % 2 == 0, HIGH, '', NOW + step * period)
    assert alarms.journal(0.0) == ()


@pytest.mark.parametrize('period', [0.1, 1.0, 4.9])
def test_a_standing_alarm_does_not_flutter(period: float) -> None:
    alarms = _raised()
    for step in range(100):
        alarms.report('x', step % 2 == 1, MEDIUM, 'x', NOW + 1.0 + step * period)
    assert _happened(alarms) == [('x', 'raised', 1.0)]


def test_reports_that_repeat_do_not_start_the_delay_anew() -> None:
    alarms = Alarms(delay_on=1.0, delay_off=5.0)
    for step in range(100):
        alarms.report('x', step < 50, LOW, '', NOW + 0.1 * step)
    alarms.advance(NOW + 20.0)
    assert _happened(alarms) == [
        ('x', 'raised', 1.0), ('x', 'returned', pytest.approx(10.0, abs=1e-6))]


@pytest.mark.parametrize(('steps', 'state', 'happened'), [
    ('a', AlarmState.ACKNOWLEDGED, ['raised', 'acknowledged']),
    ('r', AlarmState.RETURNED, ['raised', 'returned']),
    ('ra', None, ['raised', 'returned', 'acknowledged']),
    ('ar', None, ['raised', 'acknowledged', 'returned']),
    ('rx', AlarmState.UNACKNOWLEDGED, ['raised', 'returned', 'raised']),
    ('arx', AlarmState.UNACKNOWLEDGED, ['raised', 'acknowledged', 'returned', 'raised']),
    ('rax', AlarmState.UNACKNOWLEDGED, ['raised', 'returned', 'acknowledged', 'raised'])])
def test_states_follow_the_standard(
        steps: str, state: AlarmState | None, happened: list[str]) -> None:
    alarms, now = _raised(), NOW + 1.0
    for step in steps:
        if step == 'a':
            assert alarms.acknowledge('x', 'Ada', now) == ''
        else:
            alarms.report('x', step == 'x', MEDIUM, 'again', now)
        now += 10.0
        alarms.advance(now)
    assert _states(alarms) == ({} if state is None else {'x': state})
    assert [what for _, what, _ in _happened(alarms)] == happened
    for alarm in alarms.standing:
        assert alarm.acknowledged_by == (
            'Ada' if alarm.state is AlarmState.ACKNOWLEDGED else '')


def test_who_acknowledged_is_in_the_journal() -> None:
    alarms = _raised()
    alarms.acknowledge('x', 'Ada', NOW + 2.0)
    assert [(entry.what, entry.who) for entry in alarms.journal(0.0)] == [
        ('acknowledged', 'Ada'), ('raised', '')]


@pytest.mark.parametrize('key', ['y', '', 'X', 'x '])
@pytest.mark.parametrize('what', ['acknowledge', 'shelve', 'unshelve'])
def test_what_there_is_not_cannot_be_handled(key: str, what: str) -> None:
    alarms = _raised()
    arguments = (60.0, 'Ada', NOW + 2.0) if what == 'shelve' else ('Ada', NOW + 2.0)
    before = alarms.standing
    assert getattr(alarms, what)(key, *arguments) == f'there is no such alarm to {what}'
    assert alarms.standing == before
    assert len(alarms.journal(0.0)) == 1


def test_a_second_acknowledgement_names_the_first() -> None:
    alarms = _raised()
    assert alarms.acknowledge('x', 'Ada', NOW + 2.0) == ''
    assert alarms.acknowledge('x', 'Bob', NOW + 3.0) == 'it was acknowledged already, by Ada'
    assert alarms.acknowledge('x', 'Bob', NOW + 3.0)
    assert len(alarms.journal(0.0)) == 2


def test_what_is_pending_cannot_be_acknowledged_yet() -> None:
    alarms = Alarms()
    alarms.report('x', True, LOW, '', NOW)
    assert alarms.acknowledge('x', 'Ada', NOW + 0.5) == 'there is no such alarm to acknowledge'


def test_text_changes_at_once() -> None:
    alarms = _raised()
    alarms.report('x', True, MEDIUM, '71 degC', NOW + 2.0)
    assert alarms.standing[0].text == '71 degC'
    # what returned says what it was
    alarms.report('x', False, MEDIUM, '', NOW + 3.0)
    alarms.advance(NOW + 10.0)
    assert alarms.standing[0].text == '71 degC'
    assert len(alarms.journal(0.0)) == 2


def test_a_higher_priority_needs_a_new_acknowledgement_after_the_delay() -> None:
    alarms = _raised()
    alarms.acknowledge('x', 'Ada', NOW + 2.0)
    alarms.report('x', True, HIGH, 'worse', NOW + 3.0)
    assert alarms.standing[0].priority is MEDIUM
    alarms.advance(NOW + 4.0)
    assert alarms.standing[0].priority is HIGH
    assert _states(alarms) == {'x': AlarmState.UNACKNOWLEDGED}
    assert alarms.standing[0].since == NOW + 4.0


def test_a_lower_priority_needs_none() -> None:
    alarms = _raised(priority=HIGH)
    alarms.acknowledge('x', 'Ada', NOW + 2.0)
    alarms.report('x', True, LOW, 'better', NOW + 3.0)
    alarms.advance(NOW + 8.0)
    assert alarms.standing[0].priority is LOW
    assert _states(alarms) == {'x': AlarmState.ACKNOWLEDGED}
    assert len(alarms.journal(0.0)) == 2


@pytest.mark.parametrize('first', [LOW, HIGH])
def test_a_priority_that_flutters_is_raised_once(first: Priority) -> None:
    alarms = Alarms(delay_on=1.0)
    other = HIGH if first is LOW else LOW
    for step in range(100):
        alarms.report('x', True, first if step % 2 == 0 else other, '', NOW + 0.3 * step)
    assert len(_happened(alarms)) == 1
    assert alarms.standing[0].priority is LOW


def test_a_priority_that_rises_before_the_alarm_follows_after_one_more_delay() -> None:
    alarms = Alarms(delay_on=1.0)
    alarms.report('x', True, LOW, '', NOW)
    for step in range(10):
        alarms.report('x', True, HIGH, '', NOW + 0.5 + 0.2 * step)
    assert [(entry.priority, entry.time - NOW) for entry in alarms.journal(0.0)] == [
        (HIGH, 2.0), (LOW, 1.0)]


def test_a_short_gap_at_the_end_of_a_longer_lower_priority_is_no_return() -> None:
    alarms = _raised(priority=HIGH)
    alarms.report('x', True, LOW, '', NOW + 2.0)
    alarms.report('x', False, LOW, '', NOW + 6.9)
    alarms.report('x', True, LOW, '', NOW + 7.1)
    alarms.advance(NOW + 60.0)
    assert _happened(alarms) == [('x', 'raised', 1.0)]


def test_the_most_urgent_comes_first_and_of_these_the_newest() -> None:
    alarms = Alarms(delay_on=0.0)
    for offset, (key, priority) in enumerate(
            [('old', HIGH), ('low', LOW), ('new', HIGH), ('seen', HIGH), ('middle', MEDIUM)]):
        alarms.report(key, True, priority, '', NOW + offset)
    alarms.acknowledge('seen', 'Ada', NOW + 9.0)
    assert [alarm.key for alarm in alarms.standing] == ['new', 'old', 'middle', 'low', 'seen']


@pytest.mark.parametrize(('seconds', 'allowed'), [
    (60.0, True), (8 * 3600.0, True), (59.9, False), (8 * 3600.1, False), (-1.0, False),
    (math.inf, False), (math.nan, False)])
def test_shelving_is_bounded(seconds: float, allowed: bool) -> None:
    alarms = _raised()
    answer = alarms.shelve('x', seconds, 'Ada', NOW + 2.0)
    assert answer == ('' if allowed else 'an alarm can be shelved for 1 min to 8 h')
    assert len(alarms.shelved) == allowed
    assert len(alarms.standing) == (not allowed)


def test_what_is_shelved_comes_back_by_itself() -> None:
    alarms = _raised()
    alarms.shelve('x', 60.0, 'Ada', NOW + 2.0)
    assert alarms.shelved[0].shelved_until == NOW + 62.0
    alarms.advance(NOW + 61.9)
    assert not alarms.standing
    alarms.advance(NOW + 100.0)
    assert _states(alarms) == {'x': AlarmState.UNACKNOWLEDGED}
    assert not alarms.shelved
    entry = alarms.journal(0.0)[0]
    assert (entry.what, entry.who, entry.time) == ('unshelved', '', NOW + 62.0)


def test_what_is_shelved_may_come_and_go_unseen_and_be_unshelved() -> None:
    alarms = _raised()
    alarms.shelve('x', 3600.0, 'Ada', NOW + 2.0)
    assert alarms.acknowledge('x', 'Ada', NOW + 3.0) == ''
    alarms.report('x', False, MEDIUM, '', NOW + 4.0)
    alarms.advance(NOW + 20.0)
    assert alarms.shelved[0].state is AlarmState.NORMAL
    assert alarms.acknowledge('x', 'Ada', NOW + 20.0) == 'there is no such alarm to acknowledge'
    alarms.report('x', True, MEDIUM, '', NOW + 21.0)
    alarms.advance(NOW + 30.0)
    assert not alarms.standing
    assert alarms.unshelve('x', 'Bob', NOW + 31.0) == ''
    assert _states(alarms) == {'x': AlarmState.UNACKNOWLEDGED}
    assert alarms.unshelve('x', 'Bob', NOW + 32.0) == 'it is not shelved'
    assert alarms.journal(0.0)[0].who == 'Bob'


def test_what_is_normal_and_unshelved_is_forgotten() -> None:
    alarms = _raised()
    alarms.shelve('x', 60.0, 'Ada', NOW + 2.0)
    alarms.acknowledge('x', 'Ada', NOW + 2.0)
    alarms.report('x', False, MEDIUM, '', NOW + 3.0)
    alarms.advance(NOW + 100.0)
    assert alarms.standing == alarms.shelved == ()
    assert alarms.unshelve('x', 'Ada', NOW + 101.0) == 'there is no such alarm to unshelve'


def test_the_journal_is_of_a_day_and_bounded_with_the_newest_first() -> None:
    alarms = Alarms(delay_on=0.0, delay_off=0.0, kept=10, day=100.0)
    for step in range(20):
        alarms.report('x', step % 2 == 0, LOW, str(step), NOW + step)
    entries = alarms.journal(0.0)
    assert [entry.time - NOW for entry in entries] == list(range(19, 9, -1))
    assert [entry.time - NOW for entry in alarms.journal(NOW + 18.0)] == [19, 18]
    alarms.advance(NOW + 115.0)
    assert [entry.time - NOW for entry in alarms.journal(0.0)] == [19, 18, 17, 16, 15]


def test_a_clock_that_is_set_back_leaves_what_remains() -> None:
    alarms = _raised()
    alarms.shelve('x', 600.0, 'Ada', NOW + 2.0)
    alarms.report('y', True, LOW, '', NOW + 2.0)
    back = NOW - 3600.0
    alarms.advance(back)
    assert alarms.shelved[0].shelved_until == back + 600.0
    alarms.advance(back + 0.9)
    assert not alarms.standing
    alarms.advance(back + 1.1)
    assert [alarm.key for alarm in alarms.standing] == ['y']
    alarms.advance(back + 601.0)
    assert len(alarms.standing) == 2


@pytest.mark.parametrize('now', [math.nan, math.inf, -math.inf])
def test_times_are_finite(now: float) -> None:
    alarms = _raised()
    with pytest.raises(ValueError, match='the time must be finite'):
        alarms.advance(now)
    assert len(alarms.standing) == 1


@pytest.mark.parametrize(('options', 'word'), [
    ({'delay_on': -1.0}, 'delay_on'), ({'delay_off': math.inf}, 'delay_off'),
    ({'delay_on': math.nan}, 'delay_on'), ({'kept': 0}, 'kept'), ({'day': 0.0}, 'day')])
def test_bounds_are_checked(options: dict[str, float], word: str) -> None:
    with pytest.raises(ValueError, match=word):
        Alarms(**options)


def test_too_many_alarms_are_said_and_the_more_urgent_stay() -> None:
    alarms = Alarms(delay_on=0.0, delay_off=0.0)
    for number in range(2 * MAX_ALARMS):
        alarms.report(f'low {number}', True, LOW, '', NOW)
    assert len(alarms.standing) == MAX_ALARMS + 1
    assert alarms.standing[0].key == OVERFLOW
    assert alarms.standing[0].text.startswith(f'more than {MAX_ALARMS} alarms at once')
    alarms.report('high', True, HIGH, '', NOW + 1.0)
    assert 'high' in _states(alarms)
    assert len(alarms.standing) == MAX_ALARMS + 1
    # one goes, and another may come
    alarms.report('high', False, HIGH, '', NOW + 1.0)
    alarms.acknowledge('high', 'Ada', NOW + 1.0)
    alarms.report('last', True, LOW, '', NOW + 1.0)
    assert 'last' in _states(alarms)
    alarms.report('one too many', True, LOW, '', NOW + 1.0)
    assert 'one too many' not in _states(alarms)
    # nobody else speaks for it
    alarms.report(OVERFLOW, False, LOW, 'all is well', NOW + 1.0)
    assert _states(alarms)[OVERFLOW] is AlarmState.UNACKNOWLEDGED
    for alarm in alarms.standing:
        if alarm.key != OVERFLOW:
            alarms.acknowledge(alarm.key, 'Ada', NOW + 2.0)
            alarms.report(alarm.key, False, LOW, '', NOW + 2.0)
    alarms.advance(NOW + 3.0)
    assert _states(alarms) == {OVERFLOW: AlarmState.RETURNED}
    assert alarms.acknowledge(OVERFLOW, 'Ada', NOW + 4.0) == ''
    assert alarms.standing == ()


def test_what_gives_way_may_be_pending_or_shelved() -> None:
    alarms = Alarms()
    for number in range(MAX_ALARMS):
        alarms.report(f'{number}', True, LOW, '', NOW)
    alarms.report('high', True, HIGH, '', NOW)
    alarms.advance(NOW + 2.0)
    assert 'high' in _states(alarms)
    for alarm in alarms.standing:
        alarms.shelve(alarm.key, 60.0, 'Ada', NOW + 2.0)
    alarms.report('higher', True, HIGH, '', NOW + 3.0)
    alarms.advance(NOW + 100.0)
    assert {'high', 'higher', OVERFLOW} <= set(_states(alarms))


def test_many_conditions_that_come_and_go_leave_nothing() -> None:
    alarms = Alarms()
    for number in range(3 * MAX_ALARMS):
        alarms.report(f'{number}', True, LOW, '', NOW + number)
        alarms.report(f'{number}', False, LOW, '', NOW + number + 0.5)
        alarms.report(f'never {number}', False, LOW, '', NOW + number + 0.5)
    assert alarms.journal(0.0) == alarms.standing == ()
    assert not alarms._records
    assert not alarms._running


@pytest.mark.parametrize('hostile', [
    '<script>alert(1)</script>', 'a\nb\tc', 'x' * 5000, '\ud800', '\u202egnp.exe', '\0', ' ',
    'ä' * MAX_KEY])
def test_hostile_keys_and_texts_are_bounded_and_can_be_shown(hostile: str) -> None:
    alarms = Alarms(delay_on=0.0)
    alarms.report(hostile, True, LOW, hostile, NOW)
    (alarm,) = alarms.standing
    assert len(alarm.key) <= MAX_KEY
    assert len(alarm.text) <= MAX_TEXT
    assert alarm.key.isprintable()
    assert alarm.text.isprintable()
    # by the key as it is shown and as it was
    assert alarms.shelve(hostile, 60.0, hostile, NOW) == ''
    assert alarms.acknowledge(alarm.key, hostile, NOW) == ''
    for entry in alarms.journal(0.0):
        assert len(entry.who) <= MAX_WHO
        assert entry.who.isprintable()


def test_long_keys_that_begin_alike_are_two() -> None:
    alarms = Alarms(delay_on=0.0)
    for end in 'ab':
        alarms.report('x' * 1000 + end, True, LOW, '', NOW)
    assert len(alarms.standing) == 2


@given(st.lists(st.sampled_from('aä.…\n \t\0\ud800\u202e\u3000\U0001f600'), max_size=120)
       .map(''.join), st.integers(1, 20))
def test_plain_text_is_stable(text: str, longest: int) -> None:
    shown = plain(text, longest)
    assert len(shown) <= longest
    assert shown.isprintable()
    assert plain(shown, longest) == shown.strip()


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(
    st.floats(0.0, 3.0), st.sampled_from('xyz'), st.sampled_from([None, *Priority]),
    st.sampled_from(['', '', '', 'acknowledge', 'shelve', 'unshelve'])), max_size=60))
def test_whatever_happens_changes_of_an_alarm_are_apart(steps: list) -> None:
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
        for before, after in pairwise(entries):
            delay = 1.0 if after.what == 'raised' else 5.0
            assert after.time - before.time > delay - 1e-6
            assert (before.what, after.what) != ('returned', 'returned')
    # what still runs is remembered, and nothing else
    assert all(not record.idle for record in alarms._records.values())
    assert alarms._running == {record.key for record in alarms._records.values()
                               if record.pending or record.shelved_until is not None}


def test_threads_do_not_get_in_each_others_way() -> None:
    alarms, failed = Alarms(delay_on=0.0, delay_off=0.0, kept=100_000), []

    def report(key: str) -> None:
        try:
            for step in range(300):
                alarms.report(key, step % 2 == 0, HIGH, '', NOW)
        except Exception as error:
            failed.append(error)

    def handle() -> None:
        try:
            for _ in range(150):
                for alarm in alarms.standing:
                    alarms.acknowledge(alarm.key, 'Ada', NOW)
                alarms.journal(0.0)
        except Exception as error:
            failed.append(error)

    threads = [*(threading.Thread(target=report, args=(key,)) for key in 'abc'),
               threading.Thread(target=handle)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failed
    raised = [entry for entry in alarms.journal(0.0) if entry.what == 'raised']
    assert len(raised) == 3 * 150


@pytest.mark.parametrize(('values', 'sides'), [
    ([5.0, 10.0, 10.1, 9.5, 9.1, 9.0, 9.5], 'iiaaaii'),
    ([0.0, -0.1, 0.5, 0.99, 1.0, 0.5], 'ibbbii'),
    ([11.0, -1.0, 11.0, 5.0], 'abai'),
    ([11.0, math.nan, 9.5, math.nan, 8.0, math.nan], 'aaaaii'),
    ([math.inf, -math.inf, 5.0], 'abi')])
def test_deadband(values: list[float], sides: str) -> None:
    deadband = Deadband(0.0, 10.0, 1.0)
    names = {'i': Side.INSIDE, 'a': Side.ABOVE, 'b': Side.BELOW}
    assert [deadband.update(value) for value in values] == [names[side] for side in sides]


def test_deadband_with_one_limit() -> None:
    assert [Deadband(high=1.0, band=0.5).update(value) for value in (-1e300, 2.0)] == [
        Side.INSIDE, Side.ABOVE]
    assert Deadband().update(1e300) is Side.INSIDE


@pytest.mark.parametrize(('low', 'high', 'band', 'word'), [
    (1.0, 0.0, 0.0, 'low'), (math.nan, 1.0, 0.0, 'low'), (0.0, 1.0, -0.1, 'band'),
    (0.0, 1.0, 1.1, 'band'), (0.0, 1.0, math.nan, 'band'), (0.0, math.inf, math.inf, 'band')])
def test_deadbands_that_make_no_sense_are_refused(
        low: float, high: float, band: float, word: str) -> None:
    with pytest.raises(ValueError, match=word):
        Deadband(low, high, band)


@given(st.lists(st.floats(-20.0, 20.0), min_size=1, max_size=50))
def test_a_deadband_is_right_about_what_is_clear(values: list[float]) -> None:
    deadband = Deadband(-5.0, 5.0, 2.0)
    for value in values:
        side = deadband.update(value)
        if abs(value) > 5.0:
            assert side is (Side.ABOVE if value > 0.0 else Side.BELOW)
        elif abs(value) <= 3.0:
            assert side is Side.INSIDE
