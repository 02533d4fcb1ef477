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

# A number, a date or a time; other texts with digits are names.
_VALUE = re.compile(r'[-+.,]?\d(?:[^A-Za-z]|[eE][-+]?\d|T(?=\d)|Z|[AaPp]\.?[Mm]'
                    r'|(?<=[ -])[A-Z][a-z]{2}(?=[ -]))*+')
_UTF_16 = (b'\xff\xfe', b'\xfe\xff')


@dataclass(frozen=True)
class TextTableRules:
    """Where the headers of a text table are looked for."""

    separators: str = ',;\t|'  #: of the cells
    head: int = 200  #: lines among which the headers are
    longest: int = 2 ** 16  #: characters of one of these lines


def read_text_table(path: Path, rules: TextTableRules = TextTableRules()
                    ) -> tuple[list[str], list[str], Any, str, list[str]]:
    """
    Return headers, units in the row below, cells, separator and notes of a text table.

    The headers are names above two rows with numbers. The cells are texts in a DataFrame, by the
    number of the column and of the line. Lines above the headers, comments, repeated headers and a
    last line that is cut short are left out.

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
    width, kept, notes = len(head.units), {}, []
    with path.open(encoding=encoding, newline='') as file:
        rows = csv.reader(itertools.islice(file, head.first, None), delimiter=head.separator,
                          skipinitialspace=True)
        for row in rows:
            cells, line = [cell.strip() for cell in row], head.first + rows.line_num
            if cells[:len(head.headers)] == head.headers or not any(cells) or _is_comment(cells):
                continue
            if len(cells) == width:
                kept[line] = cells
            # rows of texts alone are comments, as at the end
            elif any(map(_VALUE.fullmatch, cells)):
                if ended or len(cells) > width or next(rows, None) is not None:
                    raise ValueError(f'line {line} has {len(cells)} cells, but line '
                                     f'{head.first + 1}, the first row of numbers, has {width}')
                notes = [f'line {line}, the last one, is cut short: left out']
        if not (ended or notes):
            notes = [f'line {head.first + rows.line_num}, the last one, has no end: its last '
                     'number may be cut short']
    frame = pd.DataFrame(list(kept.values()), list(kept), range(width), dtype=object)
    return head.headers, head.units, frame, head.separator, notes


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
        named = [row for row in block if not _is_comment(row)] or [
            [row[0].lstrip('# '), *row[1:]] for row in block[-1:]]
        if named:
            # a title above the headers fills fewer cells
            best = max(range(len(named)), key=lambda i: (len(set(filter(None, named[i]))), -i))
            units = [*named[best + 1:best + 2], [''] * width][0]
            heads.append(_Head(separator, named[best], [
                unit.strip('[]') for unit in [*units, ''][:width]], ends[k - 1], run))
    if heads:
        # lines above may look like a small table, a remark among the rows like headers of one
        # column, and the headers may be repeated
        longest = max(heads, key=lambda one: (
            2 * len(set(filter(None, one.headers))) >= len(one.units), one.rows))
        return next(one for one in heads if one.headers == longest.headers)._replace(
            rows=longest.rows)
    # columns that are called by numbers, and names
    if len(rows) > 1 and 1 < len(rows[0]) == len(rows[1]) and not all(
            map(_VALUE.fullmatch, rows[0])):
        return _Head(separator, rows[0], [''] * len(rows[0]), ends[0], len(rows) - 1)
    return None


def _is_comment(row: Sequence[str]) -> bool:
    """Return whether a row is a comment; a column of numbers of rows may be called #."""
    return row[0].startswith('#') and row[0] != '#'


def _widths(row: Sequence[str]) -> set[int]:
    """Return the possible widths of a row, which may end with a separator or a comment."""
    return {len(row), len(row) - (row[-1].lower() in ('', 'comment'))}
