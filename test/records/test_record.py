# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Records from tables: columns, units, times, missing values and gaps."""

import os
import re

import numpy as np
import pandas as pd
import pytest
from scipy.io import savemat

from koopman_ros.records import read
from support.heater_logs import DAYS, write_heater_logs

N, PERIOD = 60, 0.5
SECONDS = PERIOD * np.arange(N)
LEVEL = 1.0 + 0.5 * np.sin(0.3 * SECONDS)
PUMP = np.repeat([2.0, 4.0, 3.0], N // 3)
START = pd.Timestamp('2026-03-01 08:00:00')
LATE = pd.Timestamp('2026-02-12 23:59:45')
DST = pd.Timestamp('2026-03-29 01:59:45', tz='Europe/Berlin')


def frame(**columns):
    return pd.DataFrame({'level [m]': LEVEL, 'pump [V]': PUMP, **columns})


def levels(source, **options):
    (episode,) = read(source, 'level', 'pump', **options).episodes
    return episode


@pytest.mark.parametrize('write', [
    lambda table, path: table.to_csv(path / 'day.csv', index=False),
    lambda table, path: table.to_csv(path / 'day.csv', index=False, sep=';', decimal=',',
                                     encoding='utf-8-sig'),
    lambda table, path: table.to_csv(path / 'day.csv', index=False, sep='\t'),
    lambda table, path: table.to_parquet(path / 'day.parquet'),
    lambda table, path: savemat(path / 'day.mat', {
        'time': table['time [s]'], 'level': LEVEL, 'pump': PUMP[:, None], 'Ts': PERIOD}),
], ids=['csv', 'decimal comma', 'tabs', 'parquet', 'mat'])
def test_each_kind_of_file_gives_the_same_episode(tmp_path, write):
    if 'parquet' in str(write.__code__.co_consts):
        pytest.importorskip('pyarrow')
    write(frame(**{'time [s]': SECONDS}), tmp_path)
    (path,) = tmp_path.iterdir()
    record = read(path, 'level [m]', 'pump [V]')
    (episode,) = record.episodes
    assert episode.time == pytest.approx(SECONDS)
    assert episode.x[:, 0] == pytest.approx(LEVEL)
    assert episode.inputs_at(SECONDS)[:, 0].tolist() == PUMP.tolist()
    assert (record.plant.name, record.plant.state_units, record.plant.input_units) == (
        'day', ('m',), ('V',))
    assert (record.sources, record.report.used, record.report.measurements) == (
        (str(path),), N, N)


@pytest.mark.parametrize(('column', 'times'), [
    ('time', SECONDS),
    ('t', SECONDS + 1.7e9),
    ('time [h]', SECONDS / 3600.0),
    ('Time [min]', SECONDS / 60.0),
    ('time [ms]', (1000 * SECONDS).astype(np.int64)),
    ('time [d]', SECONDS / 86400.0),
    ('time [ns]', (1e9 * SECONDS).astype(np.int64)),
    ('stamp', 1_772_352_000_123 + (1e3 * SECONDS).astype(np.int64)),
    ('stamp', 1_772_352_000_123_456_789 + (1e9 * SECONDS).astype(np.int64)),
    ('stamp', START + pd.to_timedelta(SECONDS, 's')),
    ('stamp', (START.tz_localize('Europe/Berlin') + pd.to_timedelta(SECONDS, 's'))),
    ('stamp', [str(START + pd.Timedelta(t, 's')) for t in SECONDS]),
    ('stamp', [(START + pd.Timedelta(t, 's')).strftime('%m/%d/%Y %H:%M:%S.%f') for t in SECONDS]),
    # over the change to daylight-saving time, and to a day that is no month
    ('stamp', [(DST + pd.Timedelta(t, 's')).isoformat() for t in SECONDS]),
    ('stamp', [(LATE + pd.Timedelta(t, 's')).strftime('%d.%m.%Y %H:%M:%S.%f') for t in SECONDS]),
    ('elapsed', pd.to_timedelta(SECONDS, 's')),
    ('elapsed', [str(pd.Timedelta(t, 's')) for t in SECONDS]),
    ('time [ms]', (1000 * SECONDS).astype(np.uint64)[::-1]),
])
def test_times_of_each_kind_are_seconds_since_the_first_measurement(column, times):
    name = '' if column.lower()[0] == 't' else column
    assert levels(frame(**{column: times}), time=name).time == pytest.approx(SECONDS)


def test_a_row_for_each_value_may_have_times_of_another_name():
    table = {'entity': N * ['level', 'pump'], 'changed': np.repeat(SECONDS, 2),
             'state': np.column_stack([LEVEL, PUMP]).ravel()}
    episode = levels(table, time='changed [s]')
    assert episode.time == pytest.approx(SECONDS)
    assert episode.x[:, 0] == pytest.approx(LEVEL)


def test_a_minus_of_typography_is_a_minus():
    cells = [f'{value - 1.0:.6f}'.replace('-', '\u2212') for value in LEVEL]
    episode = levels({'time': SECONDS, 'level': cells, 'pump': PUMP})
    assert episode.x[:, 0] == pytest.approx(LEVEL - 1.0, abs=1e-6)


def test_rows_of_another_kind_have_no_time():
    stamps = ['YYYY-MM-DD', *map(str, START + pd.to_timedelta(SECONDS[1:], 's'))]
    assert levels(frame(date=['2026-03-01'] * N, time=stamps)).time == pytest.approx(SECONDS[:-1])


@pytest.mark.parametrize('options', [{'period': PERIOD}, {'time': 'when [min]'}, {}])
def test_times_may_be_a_period_a_unit_of_the_argument_or_an_index(options):
    table = frame(when=SECONDS / 60.0)
    if not options:
        table.index = START + pd.to_timedelta(SECONDS, 's')
    assert levels(table, **options).time == pytest.approx(SECONDS)


@pytest.mark.parametrize(('columns', 'options', 'words'), [
    ({'time': (1e9 * SECONDS).astype(np.int64)}, {}, r"cannot be seconds: .*time='time \[ns\]'"),
    ({'time': 1e9 * SECONDS}, {}, 'cannot be seconds'),
    ({'time': SECONDS, 'level [m]': LEVEL + 0j}, {}, 'complex'),
    ({'time': SECONDS}, {'period': np.nan}, 'finite'),
    ({'time': SECONDS}, {'period': np.inf}, 'finite'),
    ({'time': SECONDS, 'level [m]': [10 ** 400] * N}, {}, 'row 1, .*308 digits'),
    ({'time': SECONDS, 'level [cm]': LEVEL}, {}, '2 columns are called'),
    ({}, {}, "no column 'time'.*or give the period of the rows in s"),
    ({'time': SECONDS}, {'time': 'hour'}, "no column 'hour'"),
    ({'time': SECONDS}, {'time': 'time', 'period': 1.0}, 'give one'),
    ({'time': ['noon'] * N}, {}, 'neither numbers nor dates'),
    ({'time': ['noon', *[''] * (N - 1)]}, {}, 'neither numbers nor dates'),
    ({'time': [np.nan] * N}, {}, 'holds no times'),
    ({'time': [np.inf] * N}, {}, 'holds no times'),
    ({'time': SECONDS + 0j}, {}, 'complex'),
    ({'time': 740013.0 + SECONDS / 86400.0}, {}, 'MATLAB'),
    ({'time [K]': SECONDS}, {}, 'cannot be converted'),
    ({'time': SECONDS, 'level [m]': ['Bad'] * N}, {}, 'holds no number'),
    ({'time': SECONDS, 'level [m]': np.where(SECONDS < 4.0, LEVEL, np.nan)}, {},
     'no usable segment'),
])
def test_rejects_times_and_columns_that_are_none(columns, options, words):
    with pytest.raises(ValueError, match=words):
        read(frame(**columns), 'level', 'pump', **options)


@pytest.mark.parametrize(('second', 'point', 'separator'), [
    ('s;m;V', '.', ';'), ('[s];[m];[V]', '.', ';'), ('0;1;2', ',', ';'), ('s;m;V', ',', ';'),
    ('0;1;2', ',', '\t')])
def test_a_row_of_units_below_the_header_and_late_decimal_commas_are_understood(
        tmp_path, second, point, separator):
    rows = [f'{t:g};{x:g};{u:g}'.replace('.', point) for t, x, u in zip(
        SECONDS, LEVEL, PUMP, strict=True)][second[0] == '0':]
    text = '\n'.join(['time;level;pump', second, *rows])
    (tmp_path / 'day.csv').write_text(text.replace(';', separator))
    record = read(tmp_path / 'day.csv', 'level [m]', 'pump [V]')
    assert record.episodes[0].time == pytest.approx(SECONDS)
    assert record.episodes[0].x[:, 0] == pytest.approx(LEVEL, rel=1e-5)


@pytest.mark.parametrize(('text', 'words'), [
    ('time;level [°C];pump\n0;1;2\n', 'day.csv .*UTF-8'),
    ('time,level,pump\n' + '0,1,5,2,5\n' * N, 'as many cells'),
    ('', 'no row of headers'),
    ('time,level,pump\n' + '1,"0.5 m",2\n' * N, "row 2, column 'level': '0.5 m'"),
    ('time,level,pump\n' + '1,0.5,2\n' * N + '2,0.5\n3,1,2\n', 'line 62 has 2 cells'),
    ('time,level,pump\n' + '1,0.5,2\n' * 300 + '1,' + '9' * 5_000_000 + ',2\n', 'field'),
    ('x' * 5_000_000, 'line 1 has more than'),
    # a quote that is not closed makes one cell of all rows
    ('time,level,pump\n"' + '05/25/26 10:00:00 AM,1,2\n' * N + 'stopped', 'no row of headers'),
])
def test_a_file_that_is_no_table_is_named_with_the_next_step(tmp_path, text, words):
    (tmp_path / 'day.csv').write_text(text, encoding='latin-1')
    with pytest.raises(ValueError, match=words):
        read(tmp_path / 'day.csv', 'level', 'pump')


@pytest.mark.parametrize('remark', ['restarted,,', 'restarted', '# pause', 'time,level,pump'])
def test_remarks_among_the_rows_are_left_out(tmp_path, remark):
    rows = [f'{t:g},{x:g},{u:g}' for t, x, u in zip(SECONDS, LEVEL, PUMP, strict=True)]
    (tmp_path / 'day.csv').write_text('\n'.join(['time,level,pump', *rows[:5], remark, *rows[5:]]))
    assert levels(tmp_path / 'day.csv').x[:, 0] == pytest.approx(LEVEL, rel=1e-5)


def test_a_separator_at_the_end_of_each_row_moves_no_column(tmp_path):
    rows = [f'{t},{x},{u},' for t, x, u in zip(SECONDS, LEVEL, PUMP, strict=True)]
    (tmp_path / 'day.csv').write_text('\n'.join(['time,level,pump', *rows]))
    assert levels(tmp_path / 'day.csv').x[:, 0].tolist() == LEVEL.tolist()


def test_a_signal_may_have_another_column_name_and_unit():
    table = pd.DataFrame({'time': SECONDS, 'TI-101.PV [degC]': 20.0 + LEVEL, 'HC12': PUMP})
    record = read(table, 'temperature = TI-101.PV [K]', 'heater = HC12')
    assert record.episodes[0].x[:, 0] == pytest.approx(293.15 + LEVEL)
    assert (record.plant.state_names, record.plant.state_units) == (('temperature',), ('K',))
    assert record.plant.input_units == ('1',)
    assert "write 'heater [m]'" in str(record)
    for names, words in ((('flow', 'HC12'), "no column 'flow', it has 'time', 'TI-101.PV"),
                         (('TI-101.PV', 'HC12'), "name it, as in 'level = TI-101.PV'"),
                         (('level = TI-101.PV [m]', 'HC12'), 'cannot be converted'),
                         (('level = TI-101.PV', 'HC12 [squeeze]'), 'no unit')):
        with pytest.raises(ValueError, match=words):
            read(table, *names)


def test_of_columns_that_differ_in_the_unit_the_argument_tells_one():
    table = frame(time=SECONDS, **{'level [cm]': 90.0 * LEVEL})
    episode = read(table, 'level [cm]', 'pump').episodes[0]
    assert episode.x[:, 0] == pytest.approx(90.0 * LEVEL)


def test_a_missing_value_leaves_the_other_signals():
    level, lab = LEVEL.copy(), np.where(np.arange(N) % 20 == 0, 7.0 + SECONDS, np.nan)
    level[[5, 20]] = np.nan
    record = read({'time': SECONDS, 'level': level, 'lab': lab, 'pump': np.where(
        np.arange(N) == 30, np.nan, PUMP)}, ['level', 'lab'], ['pump'])
    (episode,) = record.episodes
    # neither was measured at row 5
    rows = np.delete(np.arange(N), 5)
    assert episode.time == pytest.approx(SECONDS[rows])
    assert np.array_equal(episode.x, np.column_stack([level, lab])[rows], equal_nan=True)
    assert episode.inputs_at(SECONDS[30:31]) == PUMP[29]
    assert (record.report.used, record.report.measurements) == (N - 2 + 3, N - 2 + 3)
    words = str(record)
    assert 'lab was measured in 3 of 60 rows' in words
    assert 'pump has no value in 1 rows' in words


def test_signals_with_rows_of_their_own_share_their_times():
    rows = pd.DataFrame({'time': SECONDS, 'level': LEVEL, 'pump': np.nan})
    rows = pd.concat([pd.DataFrame({'time': SECONDS[::20], 'level': np.nan, 'pump': PUMP[::20]}),
                      rows]).sort_values('time', kind='stable')
    assert levels(rows).x[:, 0] == pytest.approx(LEVEL)
    repeated = pd.concat([rows, rows.iloc[-1:]])
    assert read(repeated, 'level', 'pump').report.dropped == {
        'measurement with a repeated time': 1}
    # the newest first, as historians export
    assert levels(rows[::-1]).x[:, 0] == pytest.approx(LEVEL)


@pytest.mark.parametrize(('change', 'words', 'lengths'), [
    (lambda t, x: t.__setitem__(slice(30, None), t[30:] + 60.0), 'gap of 60.500 s', [30, 30]),
    (lambda t, x: t.__setitem__(slice(30, None), t[30:] - 60.0), 'set back by 59.500', [30, 30]),
    (lambda t, x: x.__setitem__(slice(30, None), x[30:] + 9.0), r'jump to 9\.\d+ 1', [30, 30]),
    (lambda t, x: x.__setitem__(30, 9.0), r'1 dropped: spike \(level\)', [59]),
    (lambda t, x: t.__setitem__(slice(55, None), t[55:] + 60.0), '5 dropped: in a segment', [55]),
    (lambda t, x: t.__setitem__(2, np.nan), '1 dropped: without a time', [59]),
])
def test_episodes_end_where_the_motion_is_interrupted(change, words, lengths):
    time, level = SECONDS.copy(), LEVEL.copy()
    change(time, level)
    record = read({'time': time, 'level': level, 'pump': PUMP}, 'level', 'pump')
    assert list(map(len, record.episodes)) == lengths
    assert [episode.time[0] for episode in record.episodes] == [0.0] * len(lengths)
    assert re.search(words, str(record))


def test_inputs_are_held_or_linear_and_count_from_the_first_row_that_has_all():
    table = {'time': SECONDS, 'level': LEVEL, 'pump': np.where(SECONDS < 2.0, np.nan, SECONDS),
             'valve': PUMP}
    record = read(table, 'level', ['pump', 'valve'], linear='pump')
    (episode,) = record.episodes
    assert len(episode) == N - 4
    assert record.report.dropped == {'before the first input': 4}
    assert episode.inputs_at(np.array([0.25])).tolist() == [[2.25, PUMP[4]]]


def test_several_tables_are_episodes_of_one_record(tmp_path):
    frame(time=SECONDS).to_csv(tmp_path / 'a.csv')
    record = read([tmp_path / 'a.csv', frame(time=SECONDS)], 'level', 'pump', name='tank')
    assert list(map(len, record.episodes)) == [N, N]
    assert (record.plant.name, record.sources) == ('tank', (str(tmp_path / 'a.csv'),))


@pytest.mark.parametrize(('arguments', 'words'), [
    ((frame(time=SECONDS), [], 'pump'), 'at least one of each'),
    ((frame(time=SECONDS), 'level', ['pump', 'level']), 'level is named twice'),
    ((frame(time=SECONDS), ' ', 'pump'), 'names no signal'),
    ((np.zeros((9, 2)), 'level', 'pump'), r'array\(.* is not a record'),
    ((frame(time=SECONDS), 'level', 'pump', 'valve'), 'linear names valve'),
])
def test_rejects_signals_and_sources_that_are_none(arguments, words):
    source, states, inputs, *linear = arguments
    with pytest.raises(ValueError, match=words):
        read(source, states, inputs, linear=linear)


@pytest.mark.parametrize(('arguments', 'words'), [
    ((['level'], frame(time=SECONDS), ['pump']), 'states .*DataFrame: .* first argument'),
    (('level', 'pump', {'time': SECONDS}), 'inputs .*dict: .* first argument')])
def test_a_table_in_the_place_of_names_is_rejected(arguments, words):
    with pytest.raises(TypeError, match=words):
        read(*arguments)


@pytest.mark.parametrize('file', ['notes.doc', 'old.mat'])
def test_rejects_other_files(tmp_path, file):
    (tmp_path / file).write_bytes(b'MATLAB 7.3 MAT-file'.ljust(124) + b'\x00\x02IM')
    with pytest.raises(ValueError, match=r'is not a record|version 7\.3'):
        read(tmp_path / file, 'level', 'pump')


@pytest.mark.parametrize('kind', ['csv', 'parquet', 'mat', 'mcap', 'txt'])
def test_pipes_and_devices_are_rejected_without_reading_them(tmp_path, kind):
    os.mkfifo(tmp_path / f'pipe.{kind}')
    (tmp_path / f'zeros.{kind}').symlink_to('/dev/zero')
    for path in tmp_path.iterdir():
        with pytest.raises(ValueError, match=path.name):
            read(path, 'level [m]', 'pump [V]')


def test_a_period_beside_a_column_of_times_is_a_notice():
    record = read(frame(time=SECONDS), 'level', 'pump', period=2.0)
    assert record.episodes[0].time[1] == 2.0
    assert any("'time' are not used" in note and 'period = 2' in note
               for note in record.report.notes)


@pytest.mark.parametrize(('quality', 'left_out'), [
    (np.where(np.arange(N) == 7, 'Bad', 'Good, local'), 1),
    (np.where(np.arange(N) == 7, 24, 192), 1),
    # of other codes, or a signal
    (np.zeros(N), 0), (np.full(N, 200.5), 0)])
@pytest.mark.parametrize('header', ['level_quality', 'Quality', 'level QualityDetail'])
def test_values_that_are_not_good_are_left_out(quality, left_out, header):
    table = frame(time=SECONDS).assign(**{header: quality})
    table.loc[7, 'level [m]'] = 1.2
    record = read(table, 'level', 'pump')
    assert record.report.used == N - left_out
    assert any(np.any(one.x == 1.2) for one in record.episodes) != bool(left_out)
    assert any(header in note for note in record.report.notes) == bool(left_out)


@pytest.mark.parametrize(('options', 'said'), [
    ({}, True), ({'time': 'time [s]'}, False), ({'period': 0.5}, False)])
def test_times_without_a_unit_are_taken_as_seconds_with_a_notice(options, said):
    record = read(frame(time=SECONDS), 'level', 'pump', **options)
    assert any("time='time [s]'" in note for note in record.report.notes) == said


@pytest.mark.parametrize(('dayfirst', 'step'), [
    (None, None), (True, 86400.0), (False, 31 * 86400.0)])
def test_days_and_months_that_no_date_tells_are_asked_for(dayfirst, step):
    dates = [f'0{1 + k // 12}/03/2026 {k % 12:02d}:00' for k in range(24)]
    if dayfirst is None:
        with pytest.raises(ValueError, match='dayfirst=True or dayfirst=False'):
            read({'time': dates, 'level': LEVEL[:24], 'pump': PUMP[:24]}, 'level', 'pump')
        return
    record = read({'time': dates, 'level': LEVEL[:24], 'pump': PUMP[:24]}, 'level', 'pump',
                  dayfirst=dayfirst)
    gap = step - 11 * 3600.0
    assert f'gap of {gap:.3f} s' in str(record)


def test_logs_of_a_device(tmp_path):
    write_heater_logs(tmp_path)
    record = read([tmp_path / name for name in DAYS], 'temperature [K]', 'heater')
    assert list(map(len, record.episodes)) == [600, 600]
    assert record.plant.input_units == ('percent',)
    assert record.episodes[0].x[0, 0] == pytest.approx(294.15, abs=0.5)
