# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""One record as loggers, historians and spreadsheets write it."""

from collections.abc import Callable
from datetime import datetime, timedelta
from typing import NamedTuple

import numpy as np

N, PERIOD = 80, 20.0
SECONDS = PERIOD * np.arange(N)
_NOISE = np.random.default_rng(4).uniform(-0.4, 0.4, N)
FLOW = np.where(np.arange(N) % 30 < 15, 990.5, 1210.25)
#: around 1000, so that thousands are separated in some cells and not in others
LEVEL = np.round(985.0 + 40.0 * np.sin(SECONDS / 150.0) + _NOISE, 2)
START = datetime(2026, 1, 30, 23, 50, 0)
DATES = [START + timedelta(seconds=t) for t in SECONDS.tolist()]


class Dialect(NamedTuple):
    """A file, how it is read, and the word of its refusal, empty where it is read."""

    text: str
    refused: str = ''
    suffix: str = '.csv'
    states: str = 'level'
    inputs: str = 'flow'
    encoding: str = 'utf-8'


def us(value: float) -> str:
    return f'{value:,.2f}'


def german(value: float) -> str:
    return us(value).translate(str.maketrans(',.', '.,'))


def plain(value: float) -> str:
    return f'{value:.2f}'


def comma(value: float) -> str:
    return plain(value).replace('.', ',')


def rows(cells: Callable[[int], list[str]], separator: str = ',') -> str:
    return ''.join(separator.join(cells(k)) + '\n' for k in range(N))


def table(header: str, time: Callable[[int], str], number: Callable[[float], str] = plain,
          separator: str = ',') -> str:
    return header + '\n' + rows(
        lambda k: [time(k), number(LEVEL[k]), number(FLOW[k])], separator)


def quoted(value: float) -> str:
    return f'"{us(value)}"'


def seconds(k: int) -> str:
    return f'{SECONDS[k]:g}'


def day(form: str) -> Callable[[int], str]:
    return lambda k: DATES[k].strftime(form)


#: 1904 or 1900, spreadsheets count days
SERIAL = [(one - datetime(1899, 12, 30)) / timedelta(days=1) for one in DATES]
EPOCH = [round((one - datetime(1970, 1, 1)) / timedelta(seconds=1)) for one in DATES]
HEADER = 'time,level,flow'

DIALECTS: dict[str, Dialect] = {
    'commas': Dialect(table(HEADER, seconds)),
    'semicolons': Dialect(table(
        HEADER.replace(',', ';'), seconds, comma, ';')),
    'tabs': Dialect(table(HEADER.replace(',', '\t'), seconds, plain, '\t'),
                            suffix='.txt', encoding='utf-16'),
    '"1,234.5"': Dialect(table(HEADER, seconds, quoted)),
    '1.234,5': Dialect(table(HEADER.replace(',', ';'), seconds, german, ';')),
    '1 234,5': Dialect(table(
        HEADER.replace(',', ';'), seconds,
        lambda v: us(v).replace(',', '\u202f').replace('.', ','), ';')),
    "1'234.5": Dialect(table(
        HEADER.replace(',', ';'), seconds, lambda v: us(v).replace(',', "'"), ';')),
    '1.234 of 1234': Dialect(table(
        HEADER.replace(',', ';'), seconds, lambda v: f'{round(v):,}'.replace(',', '.'), ';'),
        refused='thousands'),
    '23.4 degC': Dialect(table(HEADER, seconds, lambda v: f'{plain(v)} degC'),
                         refused='row 2, column .level.: .985.+degC'),
    'Time (ms)': Dialect(table('Time (ms),level,flow', lambda k: f'{1000 * SECONDS[k]:.0f}')),
    'units below': Dialect(table(
        f'{HEADER}\nmin,mm,L/h', lambda k: f'{SECONDS[k] / 60.0:.9f}')),
    'ticks below': Dialect(table(
        f'{HEADER}\nticks,mm,L/h', lambda k: f'{50 * SECONDS[k]:.0f}'), refused='ticks'),
    'epochs (s to ns)': Dialect(table(
        HEADER, lambda k: f'{EPOCH[k]}000000')),
    '20260131140000': Dialect(table(HEADER, day('%Y%m%d%H%M%S')), refused='dates without'),
    'serial days': Dialect(table(HEADER, lambda k: f'{SERIAL[k]:.10f}'),
                           refused='spreadsheets or MATLAB count'),
    '31/01/2026': Dialect(table(HEADER, day('%d/%m/%Y %H:%M:%S'))),
    '01/02/2026': Dialect(table(HEADER, lambda k: (
        DATES[k] + timedelta(days=2)).strftime('%d/%m/%Y %H:%M:%S')), refused='dayfirst'),
    '31.01.2026': Dialect(table(
        HEADER.replace(',', ';'), day('%d.%m.%Y %H:%M:%S'),
        comma, ';')),
    'time, tag, value': Dialect('time,tag,value\n' + rows(
        lambda k: [seconds(k), f'level,{plain(LEVEL[k])}\n{seconds(k)},flow', plain(FLOW[k])])),
    'InfluxDB': Dialect(
        '#group,false,false,true,true,false,false,true\n#datatype,string,long,dateTime:RFC3339,'
        'dateTime:RFC3339,dateTime:RFC3339,double,string\n#default,_result,,,,,,\n'
        ',result,table,_start,_stop,_time,_value,_field\n' + '\n'.join(''.join(
            f',,{number},2026-01-01T00:00:00Z,2026-03-01T00:00:00Z,'
            f'{DATES[k].isoformat()}Z,{value:.2f},{field}\n' for k, value in enumerate(values))
            for number, (field, values) in enumerate([('flow', FLOW), ('level', LEVEL)]))),
    'TOA5': Dialect(
        '"TOA5","CR1000","CR1000","1234","CR1000.Std","CPU:tank.CR1","5","Table1"\n'
        '"TIMESTAMP","RECORD","level","flow"\n"TS","RN","mm","L/h"\n"","","Avg","Smp"\n' + rows(
            lambda k: [f'"{DATES[k]}"', str(k), plain(LEVEL[k]), plain(FLOW[k])]), suffix='.dat'),
    'HOBO': Dialect(
        '"Plot Title: tank"\n"#","Date Time, GMT-07:00","Level, mm (LGR S/N: 7)","Flow, L/h"\n'
        + rows(lambda k: [str(k + 1), DATES[k].strftime('%m/%d/%y %I:%M:%S %p'),
                          plain(LEVEL[k]), plain(FLOW[k])]),
        states='level = Level, mm (LGR S/N: 7) [mm]', inputs='flow = Flow, L/h [L/h]'),
    'LabVIEW': Dialect(
        'LabVIEW Measurement\t\nWriter_Version\t2\nReader_Version\t2\nSeparator\tTab\n'
        'Date\t2026/01/30\n***End_of_Header***\t\n\t\t\t\nChannels\t2\t\nSamples\t80\t80\nX_Dimension\tTime\tTime\n'
        'X0\t0.0\t0.0\nDelta_X\t20.0\t20.0\n***End_of_Header***\n'
        'X_Value\tlevel\tflow\tComment\n' + rows(
            lambda k: [f'{SECONDS[k]:.6f}', plain(LEVEL[k]), plain(FLOW[k])], '\t'),
        suffix='.lvm'),
    'PI': Dialect('Tag,Timestamp,Value\n' + rows(
        lambda k: [f'level,{day("%d-%b-%Y %H:%M:%S")(k)}', f'{plain(LEVEL[k])}\nflow',
                   day('%d-%b-%Y %H:%M:%S')(k), plain(FLOW[k])])),
    'Wonderware': Dialect('DateTime,TagName,Value,Quality,QualityDetail\n' + rows(
        # one value of 0 before another one is not good
        lambda k: ['\n'.join(f'{DATES[k]}.0000000,{cells}' for cells in [
            *['level,0.0,1,24'] * (k == 40), f'level,{plain(LEVEL[k])},0,192',
            f'flow,{plain(FLOW[k])},0,192'])])),
    'WinCC': Dialect(
        '"VarName";"TimeString";"VarValue";"Validity";"Time_ms"\n' + ''.join(
            f'"{name}";"{day("%d.%m.%Y %H:%M:%S")(k)}";{comma(value)};1;{comma(1e6 * SERIAL[k])}\n'
            for k in range(N) for name, value in [('level', LEVEL[k]), ('flow', FLOW[k])])
        + f'"$RT_OFF$";"{day("%d.%m.%Y %H:%M:%S")(-1)}";0;2;{comma(1e6 * SERIAL[-1])}\n'),
    'BenchLink': Dialect(
        'Name:,tank\nOwner:,me\nChannel,Name,Function\n101,level,DC\n102,flow,DC\nScan Control:\n'
        'Interval:,20\n\nScan,Time,level (mm),Alarm 101,flow (L/h),Alarm 102\n' + rows(
            lambda k: [str(k + 1), day('%m/%d/%Y %H:%M:%S:000')(k), plain(LEVEL[k]), '0',
                       plain(FLOW[k]), '0']), encoding='utf-16'),
    'Date, Time': Dialect('Date,Time,level,flow\n' + rows(
        lambda k: [day('%Y/%m/%d')(k), day('%H:%M:%S')(k), plain(LEVEL[k]), plain(FLOW[k])])),
    'level [m], level [mm]': Dialect(table(
        'time,level [mm],level [m]', seconds), inputs='level2 = level [m]', refused='2 columns'),
    'equal headers': Dialect(table('time,level,level', seconds), inputs='level2 = level',
                                       refused='2 columns'),
    '.xlsx': Dialect('PK', suffix='.xlsx', refused='as .csv'),
    'spaces': Dialect(table('time level flow', seconds, plain, ' '),
                                         refused='no row of headers'),
}
