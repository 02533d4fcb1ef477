# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The report builder of the studies: figures over the seeds as cells of tables, and pages."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import reduce
import math
from operator import getitem
from pathlib import Path
import statistics
from typing import Any, TypeAlias

from koopman_ros.core.plots import Picture, table, write_page

Values: TypeAlias = Sequence[float | bool | None]  # of a figure, by seed
Cell: TypeAlias = Callable[[Values | None], str]
PACKAGES = ('torch', 'numpy', 'scipy')


def at(summary: Any, path: str) -> Values:
    """Return the values at a path of a summary, e.g. ``reactor/nz=3/rw``."""
    return reduce(getitem, path.split('/'), summary)


def present(values: Values | None) -> list[float]:
    """Return the finite values."""
    return [float(v) for v in values or () if v is not None and math.isfinite(v)]


def median(values: Values | None) -> float:
    """Return the median of the finite values, NaN without any."""
    return statistics.median(present(values) or [math.nan])


def spread(values: Values | None, offset: float = 0.0) -> str:
    """Return the median with the range, and the number of seeds without a value."""
    numbers = [number - offset for number in present(values)]
    missing = len(values or ()) - len(numbers)
    if not numbers:
        return f'none in {missing}' if missing else '-'
    text = f'{statistics.median(numbers):.3g} [{min(numbers):.2g}, {max(numbers):.2g}]'
    return text + (f', none in {missing}' if missing else '')


def of(function: Callable[[list[float]], float]) -> Cell:
    """Return a cell with a function of the finite values, e.g. ``of(max)``."""
    return lambda values: f'{function(numbers):.4g}' if (numbers := present(values)) else '-'


def share(values: Values | None) -> str:
    """Return how many values are true, of those that there are."""
    known = [v for v in values or () if v is not None]
    return f'{sum(map(bool, known))} of {len(known)}' if known else '-'


def total(values: Values | None) -> str:
    """Return the sum."""
    return f'{sum(present(values)):.0f}' if values else '-'


def rows_table(title: str, parts: Mapping[str, Mapping[str, Values]],
               columns: Mapping[str, tuple[str, Cell]]) -> str:
    """Return a table with a row for each part; `columns` have figure and cell by heading."""
    return table((title, *columns), [
        (name, *(cell(part.get(figure)) for figure, cell in columns.values()))
        for name, part in parts.items()])


def figures_table(labels: Mapping[str, str], parts: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a table with a row for each figure, by its label, and a column for each part."""
    return table(('', *parts), [(label, *(spread(at(part, name)) for part in parts.values()))
                                for label, name in labels.items()])


def opening(summary: Mapping[str, Any]) -> str:
    """Return the first lines of a report over seeds."""
    state = '' if summary['complete'] else ' **Interrupted before the end.**'
    return f'Seeds 0 to {summary["seeds"] - 1}, {summary["wall_seconds"]:.0f} s.{state}'


def write(folder: Path, title: str, sections: Iterable[str], pictures: Sequence[Picture] = (),
          packages: Sequence[str] = PACKAGES) -> None:
    """Write ``report.md`` with its pictures, numbered, in the end."""
    shown = [f'![{picture.caption.partition(". ")[0]}]({picture.file})\n\n'
             f'*Figure {number}. {picture.caption}*' for number, picture in enumerate(pictures, 1)]
    write_page(folder / 'report.md', title, [*sections, *(['## Figures'] if shown else []),
                                             *shown], packages)
