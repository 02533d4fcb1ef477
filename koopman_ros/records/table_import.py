# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Signals of a table, in their units and in the order of time, cut into episodes."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from koopman_ros.core.arrays import Array
from koopman_ros.core.datasets import Episode
from koopman_ros.core.units import Conversion, conversion
from koopman_ros.records.applied_inputs import Applied
from koopman_ros.records.cutter import EpisodeCutter
from koopman_ros.records.import_spec import ImportReport
from koopman_ros.records.tables import SignalColumn, Table


def conversion_of(name: str, unit: str, wanted: str) -> Conversion:
    """Return the conversion of a signal; ValueError with its name where there is none."""
    try:
        return conversion(unit, wanted)
    except ValueError as error:
        raise ValueError(f"{name}: {error}; read it as '{name} [unit]', in its own unit"
                         ) from error


def import_table(table: Table, seconds: Array, states: Sequence[SignalColumn],
                 inputs: Sequence[SignalColumn], linear: Sequence[str], report: ImportReport
                 ) -> Iterator[Episode]:
    """
    Yield the episodes of a table.

    :param seconds: (R,) times of its rows, NaN where there is none.
    :param linear: names of the inputs that are linear from row to row.
    """
    report.notes += [f'{table.label}: {note}' for note in table.notes]
    cutter = EpisodeCutter(table.label, [one.name for one in states], [one.unit for one in states],
                           report)
    x, u = (np.column_stack([_values(table, one, report, one in states) for one in some])
            for some in (states, inputs))
    report.measurements += int(np.sum(np.isfinite(x)))
    timed = np.isfinite(seconds)
    cutter.drop('without a time', x[~timed])
    seconds, x, u = seconds[timed], x[timed], u[timed]
    if table.tagged:
        order = np.argsort(seconds, kind='stable')
        seconds, x, u = seconds[order], x[order], u[order]
    elif len(seconds) > 1 and np.median(np.diff(seconds)) < 0.0:
        seconds, x, u = seconds[::-1], x[::-1], u[::-1]
    seconds, x, u = _merged(seconds, x, u, cutter)
    back = np.flatnonzero(np.diff(seconds) < 0.0) + 1
    for end in back.tolist():
        amount = seconds[end - 1] - seconds[end]
        cutter.breaks['time was set back by'].append((amount, f'{amount:.3f} s'))
    for rows in np.split(np.arange(len(seconds)), back):
        if not len(rows):
            continue
        known = np.isfinite(u[rows])
        for j, signal in enumerate(inputs):
            first = int(np.argmax(known[:, j]))
            if missing := int(np.sum(~known[first:, j])):
                report.note(f'{table.label}: {signal.name} has no value in {missing} rows, in '
                            'which the previous value is held')
        applied = [_applied(seconds[rows], u[rows, j], signal.name in linear)
                   for j, signal in enumerate(inputs)]
        yield from cutter.cut(seconds[rows], x[rows], lambda times, _: applied)  # noqa: B023
    cutter.note_breaks()


def _values(table: Table, signal: SignalColumn, report: ImportReport, measured: bool) -> Array:
    """Return the numbers (R,) of a column in the unit of the signal, NaN for none."""
    k = table.find(signal.column, signal.unit)
    if k is None:
        raise table.missing(signal.column)
    values = table.numbers(k)
    if (quality := table.bad_quality(k)) is not None:
        header, bad = quality
        if count := int(np.sum(bad & np.isfinite(values))):
            report.note(f'{table.label}: {count} values of {signal.name} are left out, which are '
                        f'not good by {header!r}')
        values = np.where(bad, np.nan, values)
    missing = int(np.sum(np.isnan(values)))
    if missing == len(values):
        text = table.first_text(k)
        raise ValueError(f'{table.label}: the column {table.headers[k]!r} holds no number'
                         f'{text and f", but e.g. {text}"}: write numbers as 1.5, or name another '
                         'column')
    if missing and measured:
        report.note(f'{table.label}: {signal.name} was measured in {len(values) - missing} of '
                    f'{len(values)} rows')
    return conversion_of(signal.name, table.unit(k) or signal.unit, signal.unit)(values)


def _merged(seconds: Array, x: Array, u: Array, cutter: EpisodeCutter
            ) -> tuple[Array, Array, Array]:
    """Return each time once: signals may have a row each; of several values the first counts."""
    new = np.diff(seconds, prepend=-np.inf) != 0.0
    if new.all():
        return seconds, x, u
    import pandas as pd
    merged = np.array(pd.DataFrame(np.hstack([x, u])).groupby(np.cumsum(new)).first())
    cutter.report.dropped['measurement with a repeated time'] += int(
        np.sum(np.isfinite(x)) - np.sum(np.isfinite(merged[:, :x.shape[1]])))
    return (seconds[new], *np.hsplit(merged, [x.shape[1]]))


def _applied(seconds: Array, values: Array, linear: bool) -> Applied:
    """Return an input at the rows in which it has a value."""
    known: NDArray[np.bool_] = np.isfinite(values)
    return seconds[known], values[known], linear
