# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Tables (CSV, Parquet, MAT, DataFrame): columns by name, their units, numbers and times."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
import os
from pathlib import Path
import re
import reprlib
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from koopman_ros.core.arrays import Array
from koopman_ros.core.units import check_unit
from koopman_ros.records.cells import CellError, decimal_mark, numbers
from koopman_ros.records.import_spec import ImportReport
from koopman_ros.records.text_tables import read_text_table
from koopman_ros.records.times import number_seconds, text_seconds, TIME_OF_DAY, TIME_UNITS

#: A file or folder, a DataFrame, or columns by name.
Source: TypeAlias = Any

_TEXT = ('.csv', '.txt', '.tsv', '.dat', '.lvm')
_TIME_NAMES = ('time', 't', 'timestamp', 'datetime', 'timestring', 'date', 'x_value')
_VALUE_NAMES = ('value', 'values', 'wert')


@cache
def name_and_unit(text: str) -> tuple[str, str]:
    """Return name and unit of ``level [m]`` or ``level (m)``; the unit is empty for none."""
    text = text.strip()
    for opening, closing in ('[]', '()'):
        name, found, unit = text[:-1].rpartition(opening)
        if not (text.endswith(closing) and found and name.strip()):
            continue
        if opening == '[' or (is_unit(unit) and not unit.isdigit()):
            return name.strip(), unit.strip()
    return text, ''


def is_unit(text: str) -> bool:
    """Whether a text is a unit."""
    try:
        check_unit(text)
    except ValueError:
        return False
    return bool(text)


@dataclass(frozen=True)
class SignalColumn:
    """A signal to be read."""

    name: str
    column: str  #: its name in the table, without a unit
    unit: str  #: empty for that of the column

    @classmethod
    def of(cls, text: str) -> SignalColumn:
        """Return a signal that is written ``level``, ``level [m]`` or ``level = LT101.PV [m]``."""
        name, given, column = text.partition('=')
        if not (given and re.fullmatch(r'\w+', name.strip())):
            name, column = '', text
        column, unit = name_and_unit(column)
        if not column or '[' in column[:1]:
            raise ValueError(f'{text!r} names no signal: write level, level [m], or '
                             'level = LT101.PV [m]')
        return cls(name.strip() or column, column, unit)

    def with_unit_in(self, table: Table, report: ImportReport) -> SignalColumn:
        """Return it with its unit, that of its column in a table where it has none."""
        if (k := table.find(self.column, self.unit)) is None:
            raise table.missing(self.column)
        unit = self.unit or table.unit(k)
        if not unit:
            report.note(f"{self.name} has no unit, 1 is assumed: write '{self.name} [m]' for m")
        return replace(self, unit=unit or '1')


@dataclass(frozen=True)
class Table:
    """Columns in the order of a file, which may have equal headers."""

    label: str  #: the file
    headers: Sequence[str]
    units: Sequence[str]  #: in a row below the headers; empty where there is none
    frame: Any  #: by the number of the column; its index numbers the rows for people
    separator: str = ''  #: of the cells of a text table
    notes: Sequence[str] = ()  #: about lines that may be wrong
    indexed: bool = False  #: whether the first column is an index of times
    tagged: bool = False  #: whether it had a row for each value of a signal

    def find(self, column: str, unit: str = '') -> int | None:
        """
        Return the number of a column, by its header or that without a unit; None for no such one.

        :raises ValueError: for several columns of the name, none of them alone in the unit.
        """
        exact = [k for k, header in enumerate(self.headers) if header.strip() == column]
        found = exact or [k for k, header in enumerate(self.headers)
                          if name_and_unit(header)[0] == column]
        if len(found) > 1:
            found = [k for k in found if self.unit(k) == unit] or found
        if len(found) > 1:
            raise ValueError(f'{self.label}: {len(found)} columns are called {column!r} ('
                             + ', '.join(repr(self.headers[k]) for k in found)
                             + '): rename all but one, or give the unit of one of them')
        return found[0] if found else None

    def unit(self, k: int) -> str:
        """Return the unit of a column, in its header or below."""
        below = re.sub(r'(?i)^deg\.? ?([cf])$', lambda match: f'deg{match[1].upper()}',
                       self.units[k])
        return name_and_unit(self.headers[k])[1] or (below if is_unit(below) else '')

    def cells(self, k: int) -> list[str] | None:
        """Return the cells of a column as texts, None for a column of numbers or dates."""
        column = self.frame[k]
        if column.dtype.kind in 'biufcmM':
            return None
        # some languages write another minus
        return [str(cell).strip().replace('\u2212', '-') if known else '' for cell, known in zip(
            column.tolist(), column.notna(), strict=True)]

    def numbers(self, k: int) -> Array:
        """
        Return the numbers (R,) of a column, NaN for none.

        :raises ValueError: naming the cell, where its number is ambiguous.
        """
        column, cells = self.frame[k], self.cells(k)
        if cells is None:
            if column.dtype.kind not in 'biuf':
                raise ValueError(f'{self.label}: the column {self.headers[k]!r} holds '
                                 f'{column.dtype}: name a column of real numbers')
            values = column.to_numpy(dtype=np.float64, na_value=np.nan)
            return np.where(np.isfinite(values), values, np.nan)
        return self._numbers(k, cells)

    def _numbers(self, k: int, cells: Sequence[str]) -> Array:
        try:
            return numbers(cells, self._decimal_mark)
        except CellError as error:
            raise ValueError(
                f'{self.label}, row {self.frame.index[error.row]}, column {self.headers[k]!r}: '
                f'{error.cell!r} {error.why}') from error

    def _decimal_mark(self) -> str:
        """Return the decimal mark that other columns prove, or the separator leaves."""
        for k in self.frame.columns:
            if (cells := self.cells(k)) and (mark := decimal_mark(cells)):
                return mark
        return '.' if self.separator == ',' and not any(
            ',' in cell for k in self.frame.columns for cell in self.cells(k) or ()) else ''

    def bad_quality(self, k: int) -> tuple[str, NDArray[np.bool_]] | None:
        """
        Return the header of the quality of a column, and where (R,) it is not good.

        Good are texts that begin so, and the codes 192 to 255 of OPC. None where the column has no
        quality, or one in other codes.
        """
        name = re.escape(name_and_unit(self.headers[k])[0].lower())
        for other, header in enumerate(self.headers):
            if other == k or not re.fullmatch(
                    rf'({name})?[\s_./:-]*quality\s?(detail)?', header.strip().lower()):
                continue
            if self._has_numbers(other):
                codes = self.numbers(other)
                good = (codes // 64 == 3.0) & ~np.any(codes % 1.0 > 0.0)
            else:
                good = np.char.startswith(np.char.lower(self.cells(other) or ['']), 'good')
            if good.any():
                return header, ~good
        return None

    def first_text(self, k: int) -> str:
        """Return the first cell that is not empty, as a text in quotes, or nothing."""
        return next((repr(text[:40]) for text in map(str, self.frame[k].dropna()) if text), '')

    def missing(self, column: str) -> ValueError:
        """Return the error of a column that is not there."""
        return ValueError(f'{self.label}: the record has no column {column!r}, it has '
                          f'{", ".join(map(repr, self.headers))}: name one of them')

    def with_tags(self, wanted: Iterable[SignalColumn], time: str = '') -> Table:
        """
        Return a table with a column for each of some signals, of one with a row for each value.

        Such a table has columns of time, name (tag) and value; others are returned as they are.

        :raises ValueError: for a table whose values may be in several columns.
        """
        lacking = [one.column for one in wanted if self.find(one.column, one.unit) is None]
        if not lacking:
            return self
        for tag in self.frame.columns:
            names = self.cells(tag) or []
            if set(lacking) <= set(names):
                break
        else:
            tag = -1
        named = [k for k, header in enumerate(self.headers)
                 if name_and_unit(header)[0].strip('_').lower().endswith(_VALUE_NAMES)]
        if tag < 0:
            texts = [f'{self.headers[k]!r} ({", ".join(sorted(set(cells))[:5])})' for k in self.
                     frame.columns if (cells := self.cells(k)) and not self._has_numbers(k)]
            if not (named and texts):
                return self
            raise ValueError(f'{self.label} has no column {lacking[0]!r}, but a row for each '
                             f'value: name the signals as in {" or ".join(texts)}')
        found = named or [k for k in self.frame.columns if k not in (
            tag, self.time_column(time)[0]) and self._has_numbers(k)]
        if len(found) != 1:
            raise ValueError(f'{self.label} has a row for each value of {self.headers[tag]!r}, '
                             'and its values may be in ' + ' or '.join(
                                 repr(self.headers[k]) for k in found) + ": call one 'value'")
        series = [k for k, header in enumerate(self.headers) if header == 'table']
        frame = self.frame.copy()
        for number, column in enumerate(lacking, len(self.headers)):
            own = np.array(names) == column
            if several := [k for k in series if self.frame[k][own].nunique() > 1]:
                raise ValueError(f'{self.label} has several series of {column!r}, numbered in '
                                 f'{self.headers[several[0]]!r}: keep the rows of one')
            values = self.frame[found[0]]
            frame[number] = values.where(own, '' if self.cells(found[0]) else np.nan)
        return replace(self, headers=[*self.headers, *lacking], frame=frame, tagged=True,
                       units=[*self.units, *[self.unit(found[0])] * len(lacking)])

    def _has_numbers(self, k: int) -> bool:
        try:
            return bool(np.isfinite(self.numbers(k)).any())
        except ValueError:
            return False

    def time_column(self, name: str) -> tuple[int, str]:
        """
        Return the number of the column of times and its unit, empty for none.

        :raises ValueError: for no such column, or a unit that is none of time.
        """
        if self.indexed and not name:
            return 0, ''
        wanted = SignalColumn.of(name or next(
            (header for known in _TIME_NAMES for header in self.headers
             if re.split(r'[\s\[(/,]', header.strip().lower().strip('_'))[0] == known), 'time'))
        k = self.find(wanted.column, wanted.unit)
        if k is None:
            raise ValueError(f'{self.missing(wanted.column)}, or give the period of the rows in s')
        header = self.headers[k]
        # as in Time (sec), t/ms, time_ms; and in the row below
        last = re.split(r'[\s\[(/,_]', header.strip(' ])'))[-1]
        unit = wanted.unit or name_and_unit(header)[1] or (
            last if last.lower() in TIME_UNITS else self.units[k])
        return k, TIME_UNITS.get(unit.lower(), unit)

    def seconds(self, time: str, period: float, dayfirst: bool | None,
                note: Callable[[str], None] = lambda text: None) -> Array:
        """
        Return the times (R,) of the rows in s, NaN where there is none.

        :raises ValueError: for a column that holds no times, or leaves open which.
        """
        if period:
            if not 0.0 < period < np.inf:
                raise ValueError(f'period = {period} s must be finite and above 0 s, or 0 for a '
                                 'column of times')
            if time:
                raise ValueError(f'both time = {time!r} and period = {period} s are given: give '
                                 'one')
            try:
                k, _ = self.time_column('')
                note(f'{self.label}: the times in {self.headers[k]!r} are not used, because '
                     f'period = {period:g} s is given')
            except ValueError:
                pass
            return period * np.arange(len(self.frame), dtype=np.float64)
        k, unit = self.time_column(time)
        column, cells, label = self.frame[k], self.cells(k), self.headers[k]
        if not self.first_text(k):
            raise ValueError(f'{self.label}: the column {label!r} holds no times: name another '
                             'one')
        if column.dtype.kind in 'mM':
            since = column if column.dtype.kind == 'm' else column - column.dropna().iloc[0]
            return since.dt.total_seconds().to_numpy(dtype=np.float64)
        if cells and all(map(TIME_OF_DAY.fullmatch, filter(None, cells))):
            for date, header in enumerate(self.headers):
                if header.strip().lower() in ('date', 'datum') and (days := self.cells(date)):
                    cells = list(map(' '.join, zip(days, cells, strict=True)))
        times: Any = None
        if cells is None:
            whole = column.dtype.kind in 'iu' and column.notna().all()
            times = column.to_numpy(np.int64) if whole else self.numbers(k)
        elif all(cell.isdecimal() and len(cell) < 19 for cell in cells):
            times = np.array(cells, dtype=np.int64)
        else:
            mostly = [bool(re.match(r"[-+]?[.,]?\d[\d.,' ]*([eE][-+]?\d+)?$", cell))
                      and not re.match(r'\d+\.\d+\.\d', cell) for cell in cells]
            if 2 * sum(mostly) > len(cells):
                times = self._numbers(k, [
                    cell if number else '' for cell, number in zip(cells, mostly, strict=True)])
        try:
            if times is None:
                return text_seconds(cells or [], label, dayfirst)
            return number_seconds(times, unit, label, lambda text: note(f'{self.label}: {text}'))
        except ValueError as error:
            raise ValueError(f'{self.label}: {error}') from error


def table_of(source: Source, label: str = 'table') -> Table:
    """
    Return a source as a table.

    :raises ValueError: for a file of another kind, or one that cannot be read, with the reason.
    """
    try:
        import pandas as pd
    except ImportError as error:
        raise ValueError('tables are read by pandas, which is not installed: pip install '
                         'pandas') from error
    if isinstance(source, pd.DataFrame):
        return _of_frame(source, label)
    if isinstance(source, Mapping):
        return _of_frame(_columns(source), label)
    if not isinstance(source, str | os.PathLike):
        raise ValueError(_no_record(f'{reprlib.repr(source)}'))
    path = Path(source)
    kind = path.suffix.lower()
    if kind not in (*_TEXT, '.parquet', '.mat'):
        raise ValueError(_no_record(reprlib.repr(str(source)) if '\n' in str(source) else source))
    if path.exists() and not path.is_file():
        raise ValueError(f'{source} is not a file: give a file')
    try:
        if kind in _TEXT:
            return Table(str(source), *read_text_table(path))
        if kind == '.parquet':
            return _of_frame(pd.read_parquet(path), str(source))
        from scipy.io import loadmat
        return _of_frame(_columns(loadmat(path, squeeze_me=True)), str(source))
    except (OSError, MemoryError):
        raise
    except ImportError as error:
        raise ValueError('Parquet is read by pyarrow, which is not installed: pip install '
                         'pyarrow') from error
    except NotImplementedError as error:
        raise ValueError(f'{source} is a MAT file of version 7.3, which SciPy does not read: '
                         "save it with '-v7'") from error
    # the parsers meet the bytes of others: their exceptions are of many kinds
    except Exception as error:
        raise ValueError(
            f'{source} cannot be read ({" ".join(str(error).split())[:200]})' + (
                ': save it in UTF-8, with one row of headers and as many cells in each row, or '
                "read it as a DataFrame, e.g. by pandas.read_csv(file, encoding='latin-1')"
                if kind in _TEXT else ': write it again')) from error


def _no_record(what: object) -> str:
    return (f'{what} is not a record: give a .csv, .parquet, .mat or .mcap file, the folder of a '
            'bag, a DataFrame of pandas, or columns by name; save a workbook as .csv')


def _of_frame(frame: Any, label: str) -> Table:
    import pandas as pd
    index = frame.index
    if isinstance(index, pd.PeriodIndex):
        index = index.to_timestamp()
    dated = isinstance(index, pd.DatetimeIndex | pd.TimedeltaIndex)
    headers = [str(header) for header in frame.columns]
    frame = frame.set_axis(range(len(headers)), axis=1).reset_index(drop=True)
    if dated or index.name is not None:
        headers = [str(index.name or 'time'), *headers]
        frame = pd.concat([pd.Series(index), frame], axis=1)
        frame.columns = range(len(headers))
    frame.index = frame.index + 1
    return Table(label, headers, [''] * len(headers), frame, indexed=dated)


def _columns(arrays: Mapping[Any, Any]) -> Any:
    """Return arrays of one or two dimensions as columns; shorter ones end with NaN."""
    import pandas as pd
    columns: dict[str, Any] = {}
    for name, array in ((str(name), array) for name, array in arrays.items()):
        values = np.asarray(array)
        if name.startswith('__') or values.ndim not in (1, 2):
            continue
        columns |= {name: values} if values.ndim == 1 else {
            f'{name}_{j + 1}': values[:, j] for j in range(values.shape[1])}
    if not columns:
        raise ValueError('the table has no columns of values '
                         f'({", ".join(map(str, arrays))}): give a list for each name')
    return pd.DataFrame({name: pd.Series(values) for name, values in columns.items()})
