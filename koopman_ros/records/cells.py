# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Numbers in the cells of a column: decimal marks and thousands, by the whole column."""

from collections.abc import Callable, Iterable, Sequence
import itertools
import math
import re

import numpy as np

from koopman_ros.core.arrays import Array

_LONGEST = 308  # digits of the largest double
_BOOLEANS = {'true': 1.0, 'false': 0.0}
_NUMERIC = re.compile(r'[-+]?[.,]?\d')
# '1.#QNAN' and such are how compilers of Windows write what is not a number
_NOT_A_NUMBER = re.compile(r'[-+]?1[.,]#.*')
# spaces and apostrophes between groups of three digits
_GROUPED = re.compile(r"[-+]?\d{1,3}([ \u00a0\u2009\u202f'\u2019])\d{3}(?:\1\d{3})*(?!\d)")
_PLAIN = set('0123456789.-+eE')


class CellError(ValueError):
    """A cell that cannot be read, with its place in the column and the reason."""

    def __init__(self, row: int, cell: str, why: str) -> None:
        super().__init__(row, cell, why)
        self.row, self.cell, self.why = row, cell, why


def decimal_mark(cells: Iterable[str]) -> str:
    """
    Return the decimal mark that a cell proves: '.' or ',', empty where none does.

    One mark before exactly three digits, as in 1.234, may separate thousands, and proves nothing.
    """
    return next((mark for cell in cells if (mark := _proof(cell))), '')


def _proof(cell: str) -> str:
    """Return the decimal mark that a number proves."""
    if not _NUMERIC.match(cell) or len(cell) > _LONGEST:
        return ''
    match = re.fullmatch(r'[-+]?([\d.,]+)(?:[eE][-+]?\d+)?', _GROUPED.sub(_joined, cell))
    marks = re.findall('[.,]', match[1]) if match else []
    if not match or not marks:
        return ''
    other = {'.': ',', ',': '.'}
    if len(set(marks)) == 2:
        return marks[-1] if marks.count(marks[-1]) == 1 else ''
    if len(marks) > 1:
        return other[marks[0]] if re.fullmatch(r'\d{1,3}([.,]\d{3})+', match[1]) else ''
    return '' if re.fullmatch(r'[1-9]\d{0,2}[.,]\d{3}', match[1]) else marks[0]


def _joined(match: re.Match[str]) -> str:
    return match[0].replace(match[1], '')


def numbers(cells: Sequence[str], mark: Callable[[], str] = lambda: '') -> Array:
    """
    Return the numbers (R,) in cells, NaN for cells that are empty or begin with no number.

    :param mark: returns the decimal mark where the column leaves it open, or an empty text.
    :raises CellError: for a cell that is a number in no form, or in another form than others.
    """
    unique = dict.fromkeys(cells, math.nan)
    if {''} != {cell.lower() for cell in itertools.islice(unique, 9)} <= {*_BOOLEANS, ''}:
        return np.array([_BOOLEANS.get(cell.lower(), math.nan) for cell in cells])
    # four digits without a separator tell that thousands have none
    plain = any(re.match(r'[-+]?\d{4}', cell) for cell in unique)
    own = decimal_mark(unique) or (next(
        (found[0] for cell in unique if (found := re.search('[.,]', cell))), '.') if plain else '')
    decimal = own or mark()
    apart = not plain and (not own or any(re.search(r'\d[.,]\d{3}[.,]', one) for one in unique))
    for cell in unique:
        try:
            unique[cell] = _number(cell, decimal, apart)
        except ValueError as error:
            raise CellError(cells.index(cell), cell[:40], str(error)) from error
    return np.array([unique[cell] for cell in cells])


def _number(cell: str, decimal: str, apart: bool) -> float:
    """Return a number; ValueError says why there is none in a cell that begins with one."""
    if not _NUMERIC.match(cell) or _NOT_A_NUMBER.fullmatch(cell):
        return math.nan
    if len(cell) > _LONGEST:
        raise ValueError(f'has more than {_LONGEST} digits: correct it, or empty it')
    text = _GROUPED.sub(_joined, cell)
    if not decimal and re.search('[.,]', text):
        raise ValueError('may have thousands or three decimals, which no other cell shows: write '
                         'numbers as 1234.5')
    group = ',' if decimal == '.' else '.'
    if apart:
        text = re.sub(rf'[1-9]\d{{0,2}}(?:\{group}\d{{3}})+(?!\d)',
                      lambda match: match[0].replace(group, ''), text, count=1)
    text = '' if group in text else text.replace(decimal or '.', '.')
    try:
        value = float(text if _PLAIN.issuperset(text) else '')
    except ValueError:
        raise ValueError(f'is not a number like the others, with the decimal mark '
                         f'{decimal or "."!r}: correct it, or empty it') from None
    if not math.isfinite(value):
        raise ValueError('is larger than any number: correct it, or empty it')
    return value
