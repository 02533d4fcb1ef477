# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Times of the rows of a table in seconds: numbers with a unit, epochs, dates and durations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import re
from typing import Any
import warnings

import numpy as np

from koopman_ros.core.arrays import Array
from koopman_ros.core.units import conversion

TIME_OF_DAY = re.compile(r'\d?\d:\d\d(:\d\d([.,:]\d+)?)?(\s?[AaPp]\.?[Mm]\.?)?')
_DURATION = re.compile(r'(-?\d+ days?,? )?\+?\d+:\d\d:\d\d([.,]\d*)?')
_DATE = re.compile(r'\d{1,4}[-/. ](\d{1,2}|[A-Za-z]{3,9})[-/. ]\d{1,4}|\d{8}T')
_DAY_AND_MONTH = re.compile(r'^(\d{1,2})([-/.])(\d{1,2})\2\d{2,4}')
_UNITS = {'sec': 's', 'secs': 's', 'second': 's', 'seconds': 's', 'msec': 'ms', 'usec': 'us',
          'µs': 'us', 'minutes': 'min', 'minute': 'min', 'mins': 'min', 'hours': 'h', 'hour': 'h',
          'hr': 'h', 'hrs': 'h', 'days': 'd', 'day': 'd'}
TIME_UNITS = {**_UNITS, **{unit: unit for unit in ('ns', 'us', 'ms', 's', 'min', 'h', 'd')}}


@dataclass(frozen=True)
class TimeRules:
    """Ranges by which the unit of times without one is recognised."""

    #: s; numbers that span more are no seconds: no record is 30 years long
    longest: float = 1e9
    #: s since 1970 (1990 to 2100): times in ms, us and ns have more digits
    epoch: tuple[float, float] = (6.3e8, 4.1e9)
    #: d since 1899-12-30 and since the year 0 (2000 to 2100), as spreadsheets and MATLAB count
    serial_days: tuple[tuple[float, float], ...] = ((36526.0, 73050.0), (730486.0, 767011.0))
    #: share of the rows whose time may be unreadable; they are left out
    unreadable: float = 0.05


def number_seconds(numbers: Any, unit: str, name: str, note: Callable[[str], None],
                   rules: TimeRules = TimeRules()) -> Array:
    """
    Return times (R,) in s since the first one.

    :param numbers: (R,) floats, or integers where all digits of an epoch count.
    :param unit: of the numbers; empty where it is not known.
    :param note: called with the assumption that they are seconds.
    :raises ValueError: for numbers that may be something else, with what to write.
    """
    finite = numbers[np.isfinite(numbers)]
    if not len(finite):
        raise ValueError(f'the column {name!r} holds no times: name another one')
    # whole nanoseconds since 1970 have more digits than a double
    first, since = finite[0], np.asarray(numbers - finite[0], dtype=np.float64)
    if unit:
        return conversion(unit, 's')(since)
    low, high = float(np.min(finite)), float(np.max(finite))
    for power in (0, 3, 6, 9):
        if rules.epoch[0] <= low / 10 ** power and high / 10 ** power <= rules.epoch[1]:
            return since / 10 ** power
    advice = f"give their unit, e.g. time='{name} [ns]', or write dates as 2026-01-31 14:00:00"
    whole = [str(int(value)) for value in (low, high) if value == int(value)]
    if len(whole) == 2 and all(re.fullmatch(
            r'(19|20)\d\d(0[1-9]|1[0-2])(0[1-9]|[12]\d|3[01])(\d{4}|\d{6})?', one)
            for one in whole):
        raise ValueError(f'the times in {name!r}, e.g. {whole[0]}, may be dates without separators'
                         f': write them as 2026-01-31 14:00:00, or give their unit if they are '
                         f"not, as in time='{name} [s]'")
    if any(first_day <= low and high <= last for first_day, last in rules.serial_days):
        raise ValueError(f'the times in {name!r}, from {low:.10g} to {high:.10g}, may be days as '
                         "spreadsheets or MATLAB count them, or seconds: write "
                         f"time='{name} [d]' or time='{name} [s]'")
    if high - low >= rules.longest or max(abs(low), abs(high)) > rules.epoch[1]:
        raise ValueError(f'the times in {name!r} go from {first} to {high:.6g}, which cannot be '
                         f'seconds: {advice}')
    note(f"the times in {name!r} have no unit, s is assumed: write time='{name} [s]', or [ms], "
         '[min]')
    return since


def text_seconds(cells: Sequence[str], name: str, dayfirst: bool | None,
                 rules: TimeRules = TimeRules()) -> Array:
    """
    Return dates or durations (R,) in s since the first one, NaN where there is none.

    :param dayfirst: whether 1/2 is 1 February; None where the column must tell.
    :raises ValueError: for a text that cannot be read as a time, or dates that leave day and
        month open.
    """
    import pandas as pd
    texts = pd.Series(list(cells), dtype=object)
    wrong = f'the column {name!r} holds neither numbers nor dates of one form, but e.g. {{!r}}'
    if texts.map(lambda cell: bool(_DURATION.fullmatch(cell))).mean() > 0.5:
        found = pd.to_timedelta(texts.str.replace(',', '.').where(
            texts.map(lambda cell: bool(_DURATION.fullmatch(cell)))), errors='coerce')
        return np.asarray(found.dt.total_seconds(), dtype=np.float64)
    # only texts that look like dates: others could be completed by today's date
    dated = texts.where(texts.map(lambda cell: bool(_DATE.match(cell)))).str.replace(
        r'(:\d\d:\d\d)(?:,(?=\d)|:(?=\d{3}$))', r'\1.', regex=True)
    match = dated.str.extract(_DAY_AND_MONTH)
    first, second = (pd.to_numeric(match[column]) for column in (0, 2))
    if (first > 12).any() and (second > 12).any():
        raise ValueError(wrong.format(texts[int((second > 12).idxmax())]) + ': day and month are '
                         'in both orders; write dates as 2026-01-31 14:00:00')
    if (first > 12).any() or (second > 12).any() or (match[1] == '.').any():
        told = not (second > 12).any()
        if dayfirst not in (None, told):
            raise ValueError(f'dayfirst={dayfirst} does not fit {texts[int(first.idxmax())]!r} in '
                             f'{name!r}: leave it out')
        dayfirst = told
    elif dayfirst is None and len(set(zip(first.dropna(), second.dropna(), strict=True))) > 1 and (
            first != second)[first.notna()].any():
        raise ValueError(f'{texts[int(first.first_valid_index())]!r} in {name!r} may be month/day '
                         'or day/month: give dayfirst=True or dayfirst=False, on the command line '
                         '--dayfirst or --no-dayfirst')
    with warnings.catch_warnings():
        # pandas finds the form by the first text, and looks at the others one by one
        warnings.simplefilter('ignore')
        times = pd.to_datetime(dated, format='ISO8601', errors='coerce', utc=True)
        if match[1].notna().any():
            times = pd.to_datetime(dated, dayfirst=bool(dayfirst), errors='coerce', utc=True)
        left = times.isna() & dated.notna()
        if left.any():
            times = times.where(~left, pd.to_datetime(
                dated[left], format='mixed', dayfirst=bool(dayfirst), errors='coerce', utc=True))
    unread = times.isna() & (texts != '')
    if times.isna().all() or unread.sum() > max(1.0, rules.unreadable * len(texts)):
        raise ValueError(wrong.format(texts[int(unread.idxmax())]) + ': write dates as '
                         '2026-01-31 14:00:00, or name another column')
    return np.asarray((times - times.dropna().iloc[0]).dt.total_seconds(), dtype=np.float64)
