# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Tables (CSV, Parquet, MAT, DataFrame) as episodes: columns, units, times, missing values."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
import os
from pathlib import Path
import re
from typing import Any, TypeAlias
import warnings

import numpy as np
from numpy.typing import NDArray

from koopman_ros.core.arrays import Array
from koopman_ros.core.datasets import Episode
from koopman_ros.core.units import Conversion, conversion, NANOSECONDS
from koopman_ros.records.episodes import GAP_PERIODS, SHORTEST
from koopman_ros.records.import_spec import break_notes, ImportReport
from koopman_ros.records.series import outliers_and_steps

#: A file or folder, a DataFrame, or columns by name.
Source: TypeAlias = Any

_SIGNAL = re.compile(r'\s*(?:(\w+)\s*=\s*)?(\S.*?)\s*(?:\[([^\[\]]+)\])?\s*')
_LOOK = 2 ** 16  # characters of a CSV file in which a decimal comma is looked for
_DURATION = re.compile(r'(-?\d+ days?,? )?\+?\d+:\d\d:\d\d(\.\d*)?')
_TIME_NAMES = ('time', 't', 'timestamp', 'datetime', 'date')
# Numbers without a unit are seconds unless they cannot be: no record is 30 years long, and no
# clock shows the year 5138. ROS and pandas count nanoseconds since 1970.
_LONGEST, _LATEST, _EPOCH_NS = 1e9, 1e11, 1e17


@dataclass(frozen=True)
class SignalColumn:
    """A signal to be read."""

    name: str
    column: str  #: its name in the table, without a unit
    unit: str  #: empty for that of the column

    @classmethod
    def of(cls, text: str) -> SignalColumn:
        """Return a signal that is written ``level``, ``level [m]`` or ``level = LT101.PV [m]``."""
        match = _SIGNAL.fullmatch(text)
        if match is None:
            raise ValueError(f'{text!r} names no signal: write level, level [m], or '
                             'level = LT101.PV [m]')
        return cls(match[1] or match[2], match[2], match[3] or '')


def conversion_of(name: str, unit: str, wanted: str) -> Conversion:
    """Return the conversion of a signal; ValueError with its name where there is none."""
    try:
        return conversion(unit, wanted)
    except ValueError as error:
        raise ValueError(f"{name}: {error}; read it as '{name} [unit]', in its own unit"
                         ) from error


def table_of(source: Source) -> Any:
    """Return a source as a DataFrame."""
    try:
        import pandas as pd
    except ImportError as error:
        raise ValueError('tables are read by pandas, which is not installed: pip install '
                         'pandas') from error
    if isinstance(source, pd.DataFrame):
        return source
    if isinstance(source, Mapping):
        return _columns(source)
    kind = Path(source).suffix.lower() if isinstance(source, str | os.PathLike) else ''
    if kind == '.csv':
        try:
            return _csv_table(source)
        except (ValueError, pd.errors.ParserWarning) as error:
            raise ValueError(
                f'{source} cannot be read ({str(error).strip()}): save it in UTF-8, with one row '
                'of headers and as many cells in each row, or read it as a DataFrame, e.g. by '
                "pandas.read_csv(file, encoding='latin-1')") from error
    if kind == '.parquet':
        try:
            return pd.read_parquet(source)
        except ImportError as error:
            raise ValueError('Parquet is read by pyarrow, which is not installed: pip install '
                             'pyarrow') from error
    if kind == '.mat':
        from scipy.io import loadmat
        try:
            return _columns(loadmat(source, squeeze_me=True))
        except NotImplementedError as error:
            raise ValueError(f'{source} is a MAT file of version 7.3, which SciPy does not read: '
                             "save it with '-v7'") from error
    what = f'a {type(source).__name__}' if not isinstance(source, str | os.PathLike) else source
    raise ValueError(f'{what} is not a record: give a .csv, .parquet, .mat or .mcap file, the '
                     'folder of a bag, a DataFrame of pandas, or columns by name')


def _csv_table(source: Source) -> Any:
    import pandas as pd
    with Path(source).open(encoding='utf-8-sig') as file:
        head, rows = file.readline(), file.read(_LOOK)
    separator = max(',;\t', key=head.count)
    decimal = ',' if separator != ',' and ',' in rows else '.'
    with warnings.catch_warnings():
        # without index_col pandas moves the headers where rows have more cells
        warnings.simplefilter('error', pd.errors.ParserWarning)
        table = pd.read_csv(source, sep=separator, decimal=decimal, skipinitialspace=True,
                            encoding='utf-8-sig', index_col=False)
    # texts remain in a column whose first cell is its unit
    return table.replace(',', '.', regex=True) if decimal == ',' else table


def _columns(arrays: Mapping[str, Any]) -> Any:
    """Return arrays of one or two dimensions as columns; shorter ones end with NaN."""
    import pandas as pd
    columns: dict[str, Any] = {}
    for name, array in arrays.items():
        values = np.asarray(array)
        if name.startswith('__') or values.ndim not in (1, 2):
            continue
        columns |= {name: values} if values.ndim == 1 else {
            f'{name}_{j + 1}': values[:, j] for j in range(values.shape[1])}
    return pd.DataFrame({name: pd.Series(values) for name, values in columns.items()})


def header_of(table: Any, column: str) -> tuple[Any, str] | None:
    """Return the header of a column unchanged, with its unit, or None for no such column."""
    for header in table.columns:
        match = _SIGNAL.fullmatch(str(header))
        if column in (str(header), match and match[2]):
            return header, (match and match[3]) or ''
    return None


def _headers(table: Any) -> str:
    return ', '.join(map(repr, map(str, table.columns)))


def with_unit(table: Any, signal: SignalColumn, report: ImportReport) -> SignalColumn:
    """Return a signal with its unit, that of its column where the request has none."""
    found = header_of(table, signal.column)
    if found is None:
        raise ValueError(f'the record has no column {signal.column!r}, it has {_headers(table)}: '
                         'name one of them')
    if not (signal.unit or found[1]):
        report.note(f"{signal.name} has no unit, 1 is assumed: write '{signal.name} [m]' for m")
    return replace(signal, unit=signal.unit or found[1] or '1')


def seconds_of(table: Any, name: str, period: float) -> Array:
    """Return the times (R,) of the rows of a table in s, NaN where there is none."""
    import pandas as pd
    if period < 0.0:
        raise ValueError(f'period = {period} s must be above 0 s, or 0 for a column of times')
    if period:
        if name:
            raise ValueError(f'both time = {name!r} and period = {period} s are given: give one')
        return period * np.arange(len(table), dtype=np.float64)
    column, unit = _time_column(table, name)
    label = str(column.name)
    if not len(column.dropna()):
        raise ValueError(f'the column {label!r} holds no times: name another one')
    kinds = pd.api.types
    if not (kinds.is_datetime64_any_dtype(column) or kinds.is_timedelta64_dtype(column)):
        numbers = pd.to_numeric(column, errors='coerce')
        if 2 * numbers.notna().sum() > len(column):
            whole = kinds.is_integer_dtype(numbers) and numbers.notna().all()
            return _numbers_in_seconds(
                numbers.to_numpy(np.int64 if whole else np.float64), unit, label)
        column = _dates(column)
    if not kinds.is_timedelta64_dtype(column):
        column = column - column.dropna().iloc[0]
    return column.dt.total_seconds().to_numpy(dtype=np.float64)


def _dates(column: Any) -> Any:
    """Return texts as dates or durations; where most rows have one, the others have none."""
    import pandas as pd
    first = str(column.dropna().iloc[0])
    # whole seconds may be written without a fraction, and offsets differ with daylight-saving time
    found = (pd.to_timedelta(column, errors='coerce') if _DURATION.fullmatch(first) else
             pd.to_datetime(column, format='ISO8601', errors='coerce', utc=True))
    if 2 * found.notna().sum() > len(column):
        return found
    try:
        return pd.to_datetime(column, dayfirst='.' in first[:3], utc=True)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f'the column {str(column.name)!r} holds neither numbers nor dates of one form, but '
            f'e.g. {first!r}: write dates as 2026-01-31 14:00:00, or name another column'
        ) from error


def _time_column(table: Any, name: str) -> tuple[Any, str]:
    """Return the column of the times, or the index, and its unit, empty for none."""
    import pandas as pd
    index = table.index.to_series()
    if not name and isinstance(table.index, pd.DatetimeIndex | pd.TimedeltaIndex):
        return index, ''
    wanted = SignalColumn.of(name or next(
        (one for known in _TIME_NAMES for one in map(str, table.columns)
         if re.split(r'[\s\[]', one.strip().lower())[0] == known), 'time'))
    if (found := header_of(table, wanted.column)) is not None:
        return table[found[0]], wanted.unit or found[1]
    if name and wanted.column == table.index.name:
        return index, wanted.unit
    raise ValueError(f'the record has no column {wanted.column!r}, it has {_headers(table)}: name '
                     'that of the times, or give the period of the rows in s')


def _numbers_in_seconds(numbers: Any, unit: str, name: str) -> Array:
    # whole nanoseconds since 1970 have more digits than a double
    first = numbers[np.isfinite(numbers)][0]
    since = np.asarray(numbers - first, dtype=np.float64)
    if unit:
        return conversion(unit, 's')(since)
    if abs(float(first)) >= _EPOCH_NS:
        return since / NANOSECONDS
    span = float(np.nanmax(since) - np.nanmin(since))
    if span >= _LONGEST or abs(float(first)) >= _LATEST:
        raise ValueError(f'the times in {name!r} go from {first} to {first + span:.6g}, which '
                         f"cannot be seconds: give their unit, e.g. time='{name} [ns]'")
    return since


@dataclass(frozen=True)
class TableImport:
    """The import of one table: its rows in the units of the signals, cut into episodes."""

    label: str
    states: Sequence[SignalColumn]
    inputs: Sequence[SignalColumn]
    linear: Sequence[str]
    report: ImportReport

    def episodes(self, table: Any, seconds: Array) -> Iterator[Episode]:
        """Yield the episodes of a table whose rows have these times (R,)."""
        x, u = (np.column_stack([self._values(table, one) for one in some])
                for some in (self.states, self.inputs))
        self.report.measurements += int(np.sum(np.isfinite(x)))
        seconds, x, u = self._in_order(seconds, x, u)
        jump = self._without_spikes(x)
        u, known = self._held(u)
        self._drop('before the first input', x[:known])
        seconds, x, u, jump = seconds[known:], x[known:], u[known:], jump[known:]
        linear = tuple(one.name in self.linear for one in self.inputs)
        for rows in np.split(np.arange(len(seconds)), self._ends(seconds, x, jump)):
            measured = rows[np.isfinite(x[rows]).any(axis=1)]
            if len(measured) < SHORTEST:
                self._drop(f'in a segment of fewer than {SHORTEST}', x[measured])
                continue
            self.report.used += int(np.sum(np.isfinite(x[measured])))
            origin = seconds[measured[0]]
            yield Episode(seconds[measured] - origin, x[measured], seconds[rows] - origin, u[rows],
                          linear if any(linear) else ()).part(0, len(measured))

    def _values(self, table: Any, signal: SignalColumn) -> Array:
        """Return the numbers (R,) of a column in the unit of the signal, NaN for none."""
        import pandas as pd
        header, unit = header_of(table, signal.column) or ('', '')
        values = pd.to_numeric(table[header], errors='coerce').to_numpy(dtype=np.float64)
        values = np.where(np.isfinite(values), values, np.nan)
        missing = int(np.sum(np.isnan(values)))
        if missing == len(values):
            texts = [f', but e.g. {str(one)!r}' for one in table[header].dropna()[:1]]
            raise ValueError(f'the column {str(header)!r} holds no number{"".join(texts)}: write '
                             'numbers as 1.5, or name another column')
        if missing and signal in self.states:
            self.report.note(f'{self.label}: {signal.name} was measured in '
                             f'{len(values) - missing} of {len(values)} rows')
        return conversion_of(signal.name, unit or signal.unit, signal.unit)(values)

    def _in_order(self, seconds: Array, x: Array, u: Array) -> tuple[Array, Array, Array]:
        """Return the rows with a time, each time once, and the oldest first."""
        timed = np.isfinite(seconds)
        self._drop('without a time', x[~timed])
        seconds, x, u = seconds[timed], x[timed], u[timed]
        if len(seconds) > 1 and np.median(np.diff(seconds)) < 0.0:
            seconds, x, u = seconds[::-1], x[::-1], u[::-1]
        first = np.flatnonzero(np.diff(seconds, prepend=-np.inf))
        if len(first) < len(seconds):
            import pandas as pd
            # signals may have a row each; of several values of one signal the first one counts
            number = np.cumsum(np.diff(seconds, prepend=-np.inf) != 0.0)
            merged = np.array(pd.DataFrame(np.hstack([x, u])).groupby(number).first())
            repeated = int(np.sum(np.isfinite(x)) - np.sum(np.isfinite(merged[:, :x.shape[1]])))
            self.report.dropped['measurement with a repeated time'] += repeated
            x, u = np.hsplit(merged, [x.shape[1]])
        return seconds[first], x, u

    def _without_spikes(self, x: Array) -> NDArray[np.int64]:
        """Replace spikes by NaN in place; return the state that jumps in each row, -1 for none."""
        jumps = np.full(len(x), -1)
        for j, signal in enumerate(self.states):
            rows = np.flatnonzero(np.isfinite(x[:, j]))
            spike, jump = outliers_and_steps(x[rows, j])
            x[rows[spike], j] = np.nan
            jumps[rows[jump]] = j
            if spike.any():
                self.report.dropped[f'spike of a single sample ({signal.name})'] += int(
                    np.sum(spike))
        return jumps

    def _held(self, u: Array) -> tuple[Array, int]:
        """Return the inputs (R, n_u) without gaps, and the first row in which all are known."""
        rows = np.where(np.isfinite(u), np.arange(len(u))[:, None], -1)
        last = np.maximum.accumulate(rows, axis=0)
        known = int(np.argmax((last >= 0).all(axis=1)))
        for j, signal in enumerate(self.inputs):
            if missing := int(np.sum(rows[known:, j] < 0)):
                self.report.note(f'{self.label}: {signal.name} has no value in {missing} rows, in '
                                 'which the previous value is held')
        return np.take_along_axis(u, np.maximum(last, 0), axis=0), known

    def _ends(self, seconds: Array, x: Array, jump: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the rows at which a new episode begins, and note the reasons."""
        step = np.diff(seconds, prepend=seconds[:1])
        usual = float(np.median(step[step > 0.0])) if np.any(step > 0.0) else 0.0
        ends = np.flatnonzero((step < 0.0) | (step > GAP_PERIODS * usual) | (jump >= 0))
        ends = ends[ends > 0]
        breaks: defaultdict[str, list[tuple[float, str]]] = defaultdict(list)
        for end in ends.tolist():
            at = f'at {seconds[end - 1]:.3f} s'
            if step[end] < 0.0:
                breaks['set back'].append((-step[end], f'{-step[end]:.3f} s'))
            elif step[end] > GAP_PERIODS * usual:
                breaks['gap'].append((step[end], f'{step[end]:.3f} s {at}'))
            else:
                j = int(jump[end])
                breaks['jump'].append((
                    abs(x[end, j]), f'{x[end, j]:.6g} {self.states[j].unit} {at}'))
        self.report.notes += break_notes(self.label, breaks)
        return ends

    def _drop(self, reason: str, x: Array) -> None:
        if count := int(np.sum(np.isfinite(x))):
            self.report.dropped[reason] += count
