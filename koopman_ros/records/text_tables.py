# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Text tables of loggers (CSV): the lines of the headers, and those above and below them."""

from __future__ import annotations

from collections.abc import Sequence
import csv
from dataclasses import dataclass
import itertools
from pathlib import Path
import re
from typing import Any, NamedTuple
import warnings

# A number, a date or a time; other texts with digits are names.
_VALUE = re.compile(r'[-+.,]?\d(?:[^A-Za-z]|[eE][-+]?\d|T(?=\d)|Z|\s?[AaPp]\.?[Mm]\.?'
                    r'|(?<=[ -])[A-Z][a-z]{2}(?=[ -]))*')
_UTF_16 = (b'\xff\xfe', b'\xfe\xff')


@dataclass(frozen=True)
class TextTableRules:
    """Where the headers of a text table are looked for."""

    separators: str = ',;\t|'  #: of the cells
    head: int = 200  #: lines among which the headers are
    longest: int = 2 ** 16  #: characters of one of these lines


class TextTable(NamedTuple):
    """Cells of a text table below its headers."""

    headers: Sequence[str]
    units: Sequence[str]  #: cells of the row below the headers, empty where there is none
    frame: Any  #: texts by the number of the column; its index numbers the lines of the file
    separator: str
    notes: Sequence[str]  #: about lines that may be wrong


def read_text_table(path: Path, rules: TextTableRules = TextTableRules()) -> TextTable:
    """
    Return the cells of a text table.

    The headers are names above two rows with numbers. Lines above them, comments, repeated headers
    and a last line that is cut short are left out.

    :raises ValueError: for a file without headers, or with rows of another length.
    """
    import pandas as pd
    with path.open('rb') as binary:
        encoding = 'utf-16' if binary.read(2) in _UTF_16 else 'utf-8-sig'
        binary.seek(max(0, binary.seek(0, 2) - 2))
        ended = binary.read().strip(b'\0')[-1:] in (b'\n', b'\r')
    with path.open(encoding=encoding, newline='') as file:
        lines = list(itertools.islice(
            iter(lambda: file.readline(rules.longest + 1), ''), rules.head))
    if too_long := [k for k, line in enumerate(lines, 1) if len(line) > rules.longest]:
        raise ValueError(f'line {too_long[0]} has more than {rules.longest} characters')
    hint = re.fullmatch(r'sep=(.)', lines[0].strip()) if lines else None
    heads = [found for one in (hint[1] if hint else rules.separators)
             if (found := _head(lines, one)) is not None]
    if not heads:
        raise ValueError('no row of headers with numbers in as many cells below it, but: '
                         f'{"".join(lines).strip()[:60]!r}')
    head = max(heads, key=lambda one: one.rows)
    width, first, notes, cut = len(head.units), head.first, [], 0
    with path.open(encoding=encoding, newline='') as file:
        rows = csv.reader(itertools.islice(file, first, None), delimiter=head.separator,
                          skipinitialspace=True)
        for cells in rows:
            # rows of texts alone are comments, as at the end
            if len(cells) == width or not any(_VALUE.fullmatch(cell.strip()) for cell in cells):
                continue
            line = first + rows.line_num
            if ended or len(cells) > width or next(rows, None) is not None:
                raise ValueError(f'line {line} has {len(cells)} cells, but line {first + 1}, the '
                                 f'first row of numbers, has {width}')
            cut = line
            notes = [f'line {line}, the last one, is cut short: left out']
        if not (ended or cut):
            notes = [f'line {first + rows.line_num}, the last one, has no end: its last number '
                     'may be cut short']
    with warnings.catch_warnings():
        # about longer rows: those left are comments
        warnings.simplefilter('ignore', pd.errors.ParserWarning)
        frame = pd.read_csv(
            path, sep=head.separator, header=None, names=range(width), index_col=False, dtype=str,
            keep_default_na=False, skip_blank_lines=False, skipinitialspace=True, skiprows=first,
            encoding=encoding).apply(lambda column: column.str.strip())
    frame.index = frame.index + first + 1
    repeated = (frame[list(range(len(head.headers)))] == head.headers).all(axis=1)
    comment = frame[0].str.startswith('#') & (frame[0] != '#')
    frame = frame[~(repeated | comment | (frame.index == cut)) & (frame != '').any(axis=1)]
    return TextTable(head.headers, head.units, frame, head.separator, notes)


class _Head(NamedTuple):
    separator: str
    headers: list[str]
    units: list[str]
    first: int  #: lines above the first row of numbers
    rows: int  #: rows of numbers in a row among the lines


def _head(lines: Sequence[str], separator: str) -> _Head | None:
    """Return the headers of a table with this separator, None where there are none."""
    reader = csv.reader(lines, delimiter=separator, skipinitialspace=True)
    rows: list[list[str]] = []
    ends = []
    try:
        for cells in reader:
            if any(map(str.strip, cells)):
                rows.append([cell.strip() for cell in cells])
                ends.append(reader.line_num)
    except csv.Error:
        # a quote that is not closed within these lines
        pass
    valued = [any(map(_VALUE.fullmatch, row)) for row in rows]
    widths = [len(row) if found else 0 for row, found in zip(rows, valued, strict=True)]
    heads, below = [], 0
    for width, same in itertools.groupby(widths):
        run = len(list(same))
        k, below = below, below + run
        if width < 2 or run < min(2, len(rows) - k):
            continue
        top = k
        while top and not valued[top - 1] and _widths(rows[top - 1]) & _widths(rows[k]):
            top -= 1
        block = [row[:width] for row in rows[top:k]]
        named = [row for row in block if not row[0].startswith('#') or row[0] == '#'] or [
            [row[0].lstrip('# '), *row[1:]] for row in block[-1:]]
        if named:
            # a title above the headers fills fewer cells
            best = max(range(len(named)), key=lambda i: (len(set(filter(None, named[i]))), -i))
            units = [*named[best + 1:best + 2], [''] * width][0]
            heads.append(_Head(separator, named[best], [*units, ''][:width], ends[k - 1], run))
    if heads:
        # lines above may look like a small table, and the headers may be repeated
        longest = max(heads, key=lambda one: one.rows)
        return next(one for one in heads if one.headers == longest.headers)._replace(
            rows=longest.rows)
    # columns that are called by numbers, and names
    if len(rows) > 1 and 1 < len(rows[0]) == len(rows[1]) and not all(
            map(_VALUE.fullmatch, rows[0])):
        return _Head(separator, rows[0], [''] * len(rows[0]), ends[0], len(rows) - 1)
    return None


def _widths(row: Sequence[str]) -> set[int]:
    """Return the possible widths of a row, which may end with a separator or a comment."""
    return {len(row), len(row) - (row[-1].lower() in ('', 'comment'))}
