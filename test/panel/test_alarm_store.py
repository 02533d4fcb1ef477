# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Alarms that outlast the panel: what is loaded of them, and from which files."""

from collections.abc import Callable
import json
import math
import os
from pathlib import Path

import pytest

from koopman_ros.panel.alarm_store import AlarmStore
from koopman_ros.panel.alarms import Alarms, AlarmState, Priority

NOW = 1_700_000_000.0
AGAIN = NOW + 100.0


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """Return a file of one alarm of each kind: acknowledged, not, returned, shelved."""
    path, alarms = tmp_path / 'alarms.json', Alarms()
    store = AlarmStore(alarms, path, NOW)
    for key in ('seen', 'new', 'over', 'shelved'):
        alarms.report(key, True, Priority.HIGH, f'text of {key}', NOW)
    alarms.advance(NOW + 1.0)
    alarms.acknowledge('seen', 'anna', NOW + 2.0)
    alarms.shelve('shelved', 600.0, 'anna', NOW + 3.0)
    alarms.report('over', False, Priority.HIGH, '', NOW + 4.0)
    alarms.advance(NOW + 9.0)
    store.close()
    return path


def loaded(path: Path) -> Alarms:
    alarms = Alarms()
    assert not AlarmStore(alarms, path, AGAIN).complaint
    return alarms


def test_states_shelving_and_the_list_of_the_day_are_loaded(file: Path) -> None:
    alarms = loaded(file)
    assert {alarm.key: (alarm.state, alarm.text, alarm.acknowledged_by)
            for alarm in alarms.standing} == {
        'seen': (AlarmState.ACKNOWLEDGED, 'text of seen', 'anna'),
        'new': (AlarmState.UNACKNOWLEDGED, 'text of new', ''),
        'over': (AlarmState.RETURNED, 'text of over', '')}
    assert [(alarm.key, alarm.shelved_until) for alarm in alarms.shelved] == [
        ('shelved', NOW + 603.0)]
    happened = [(entry.key, entry.what, entry.who) for entry in alarms.journal(-math.inf)]
    assert happened[:3] == [
        ('over', 'returned', ''), ('shelved', 'shelved', 'anna'), ('seen', 'acknowledged', 'anna')]
    assert len(happened) == 7


def test_changes_are_saved_soon_after_a_clock_is_set_back(file: Path) -> None:
    alarms = Alarms()
    store = AlarmStore(alarms, file, AGAIN)
    for key, now in (('new', AGAIN), ('over', AGAIN - 3600.0)):
        assert alarms.acknowledge(key, 'anna', now)
        store.save(now)
        assert (key, 'acknowledged') in [
            (entry.key, entry.what) for entry in loaded(file).journal(-math.inf)]


def test_a_returning_condition_raises_no_second_alarm(file: Path) -> None:
    alarms = loaded(file)
    # nodes take a while until they are heard
    alarms.advance(AGAIN + 8.0)
    for key in ('seen', 'shelved'):
        alarms.report(key, True, Priority.HIGH, 'the same', AGAIN + 9.0)
    alarms.advance(AGAIN + 60.0)
    assert {alarm.key: alarm.state for alarm in alarms.standing} == {
        'seen': AlarmState.ACKNOWLEDGED, 'new': AlarmState.RETURNED, 'over': AlarmState.RETURNED}
    assert [entry.what for entry in alarms.journal(AGAIN)] == ['returned']
    # a day later there is nothing to list
    alarms.advance(AGAIN + 86_401.0 + 60.0)
    assert [entry.what for entry in alarms.journal(-math.inf)] == ['unshelved']


def test_it_is_written_every_few_seconds_where_something_changed(tmp_path: Path) -> None:
    path, alarms = tmp_path / 'alarms.json', Alarms(delay_on=0.0)
    store = AlarmStore(alarms, path, NOW)
    assert json.loads(path.read_text())['alarms'] == []
    for second, keys, kept in ((0.0, 'a', 1), (1.0, 'ab', 1), (5.0, 'ab', 2)):
        for key in keys:
            alarms.report(key, True, Priority.LOW, '', NOW + second)
        store.save(NOW + second)
        assert len(json.loads(path.read_text())['alarms']) == kept
    path.unlink()
    store.save(NOW + 60.0)
    store.close()
    assert not path.exists(), 'nothing had changed'


@pytest.mark.parametrize(('change', 'words'), [
    (lambda text: text[:-20], ' line '),
    (lambda text: text.replace('"version": 1', '"version": 2'), 'version'),
    (lambda text: text.replace('"HIGH"', '"HIGHEST"'), 'HIGHEST'),
    (lambda text: text.replace('"raised"', '"praised"'), "'praised' must be one of raised"),
    (lambda text: text.replace(f'"time": {NOW + 1.0}', '"time": NaN'), 'times must be finite'),
    (lambda text: text.replace('"text of new"', '"\udcff"'), 'utf-8'),
    (lambda text: text.replace('"key"', '"lock"'), 'key'),
    (lambda text: '{"version": 1, "alarms": [' + '[' * 100_000, 'recursion'),
    (lambda text: text.replace(f'"time": {NOW + 1.0}', '"time": ' + '9' * 400), 'too large'),
])
def test_a_damaged_file_is_moved_aside_and_reported(
        file: Path, change: Callable[[str], str], words: str) -> None:
    text = change(file.read_text())
    file.write_bytes(text.encode(errors='surrogateescape'))
    alarms = Alarms()
    store = AlarmStore(alarms, file, AGAIN)
    assert store.complaint.endswith(f'it is kept as {file}.damaged')
    assert words in store.complaint
    assert Path(f'{file}.damaged').read_bytes() == text.encode(errors='surrogateescape')
    assert not alarms.all
    assert json.loads(file.read_text())['journal'] == []


@pytest.mark.parametrize('content', [
    b'anna:operator:scrypt$16384$8$5$c2FsdHNhbHQ=$aGFzaA==\n', b'[]', b'\xff', b'[' * 100_000,
    b'{"__metadata__": {"format": "koopman_ros.lift"}}', b'# note',
    b'{"alarms": [], "version": 1}'])
def test_a_file_of_something_else_is_rejected_and_stays(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / 'other'
    path.write_bytes(content)
    path.chmod(0o640)
    before = os.stat(path)
    with pytest.raises(ValueError, match='is not an alarm file and is not replaced'):
        AlarmStore(Alarms(), path, NOW)
    assert path.read_bytes() == content
    assert (os.stat(path).st_ino, os.stat(path).st_mode) == (before.st_ino, before.st_mode)
    assert [one.name for one in tmp_path.iterdir()] == ['other']


def test_an_empty_file_becomes_one_of_alarms_and_a_link_stays_one(tmp_path: Path) -> None:
    (tmp_path / 'target').touch()
    (tmp_path / 'link').symlink_to(tmp_path / 'target')
    AlarmStore(Alarms(), tmp_path / 'link', NOW)
    assert (tmp_path / 'link').is_symlink()
    assert json.loads((tmp_path / 'target').read_text())['alarms'] == []


def test_markup_and_control_characters_are_shown_as_text(file: Path) -> None:
    file.write_text(file.read_text().replace('text of new', 'a\\u0000b' + 'c' * 10_000))
    (alarm,) = (alarm for alarm in loaded(file).standing if alarm.key == 'new')
    assert alarm.text.startswith('a�bc')
    assert len(alarm.text) == 500
