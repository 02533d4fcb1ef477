# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Reports: pages in Markdown, figures in JSON, plots in PNG, and the machine they were made on.

Matplotlib is imported when a picture is drawn.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
import json
import math
import os
from pathlib import Path
import platform
import re
from typing import Any, TYPE_CHECKING

import numpy as np

from koopman_ros import __version__
from koopman_ros.core.arrays import Array
from koopman_ros.core.paths import write_atomically
from koopman_ros.core.units import unit_label

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# A trained range is drawn as a grey band, a limit as a dotted line.
DRAWN_RANGE: dict[str, Any] = {'color': '0.92', 'zorder': 0}
LIMIT: dict[str, Any] = {'color': '0.4', 'linestyle': ':', 'linewidth': 1.0}


@dataclass(frozen=True)
class Picture:
    """A picture of a page."""

    file: str  #: its name, in the folder of the page
    caption: str  #: with its numbers

    def __str__(self) -> str:
        """Return the picture with its caption, in Markdown."""
        return f'![{self.caption.partition(". ")[0]}]({self.file})\n\n*{self.caption}*'


def table(head: Sequence[str], rows: Iterable[Sequence[object]], numbers: Collection[int] = ()
          ) -> str:
    """Return a table in Markdown; `head` has units in brackets, `numbers` are flush right."""
    rule = ['---:' if column in numbers else '---' for column in range(len(head))]
    lines = [f'| {" | ".join(head)} |', f'|{"|".join(rule)}|']
    for row in rows:
        if len(row) != len(head):
            raise ValueError(f'a row of {len(row)} cells in a table of {len(head)} columns: '
                             f'{row}')
        lines.append(f'| {" | ".join(str(cell).replace("|", chr(92) + "|") for cell in row)} |')
    return '\n'.join(lines)


def bullets(lines: Iterable[str]) -> str:
    """Return a list in Markdown."""
    return '\n'.join(f'- {line}' for line in lines)


def write_page(path: Path, title: str, sections: Iterable[str], packages: Sequence[str] = ()
               ) -> Path:
    """
    Write a page in Markdown; its folder is made, and empty sections are left out.

    Below its title it names the machine and the versions of this package and `packages`.
    """
    parts = [f'# {title}', f'*{_headline(*packages)}*', *filter(None, map(str, sections))]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, ('\n\n'.join(parts) + '\n').encode())
    return path


def write_figures(path: Path, figures: Mapping[str, Any]) -> Path:
    """
    Write figures as JSON, with null for infinity and NaN; the folder is made.

    An interrupt leaves the old file or the new one, never a part.
    """
    text = json.dumps(finite(figures), indent=2, allow_nan=False) + '\n'
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, text.encode())
    return path


def finite(value: Any) -> Any:
    """Replace values that JSON does not know by None, at any depth."""
    if isinstance(value, Mapping):
        return {name: finite(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@contextmanager
def drawing(path: Path, rows: int = 1, columns: int = 1, *, size: tuple[float, float],
            grid: bool = True, **options: Any) -> Iterator[tuple[Figure, list[Axes]]]:
    """
    Draw panels, counted row by row; they are written as PNG when the block ends without exception.

    The folder is made. `size` is width and height in inches, `options` are those of matplotlib's
    ``Figure.subplots``. Raises ImportError without matplotlib.
    """
    from matplotlib.figure import Figure
    # without pyplot: no window, no state that another picture could see
    figure = Figure(figsize=size, layout='constrained')
    panels = list(figure.subplots(rows, columns, squeeze=False, **options).flat)
    for panel in panels:
        if grid:
            panel.grid(alpha=0.3)
    yield figure, panels
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)


def axis_label(name: str, unit: str) -> str:
    """Return name and unit of a signal for an axis: a state that is not measured has no unit."""
    words = re.sub(r'^hidden (\d+)$', r'unmeasured state \1', name.replace('_', ' '))
    return words if unit == '1' else f'{words} [{unit_label(unit)}]'


def time_axis(span: float) -> tuple[str, float]:
    """Return the unit in which a span of time in s is read, and its length in s."""
    return next((one for one in (('d', 86400.0), ('h', 3600.0)) if span >= 3.0 * one[1]),
                ('s', 1.0))


def zoom(axes: Axes, values: Array) -> None:
    """Limit the vertical axis to some values and half their range on both sides."""
    low, high = np.nanmin(values), np.nanmax(values)
    margin = 0.5 * (high - low) or 1.0
    below, above = axes.get_ylim()
    axes.set_ylim(max(below, low - margin), min(above, high + margin))


def draw_limits(axes: Axes, bounds: Iterable[float], label: str) -> None:
    """Draw limits of the plotted signals as dotted lines with one label."""
    for number, bound in enumerate(bounds):
        axes.axhline(bound, label=label if number == 0 else None, **LIMIT)


def legend(figure: Figure, panels: Iterable[Axes], columns: int) -> None:
    """Put one legend for all panels below them."""
    shown = {label: handle for panel in panels
             for handle, label in zip(*panel.get_legend_handles_labels(), strict=True)}
    figure.legend(shown.values(), shown.keys(), loc='outside lower center', ncols=columns,
                  fontsize=8)


def machine(*packages: str) -> dict[str, Any]:
    """Return processor, system and load of this machine, and the versions of some packages."""
    processor = platform.processor()
    with suppress(OSError):
        lines = Path('/proc/cpuinfo').read_text().splitlines()
        processor = next((line.partition(':')[2].strip() for line in lines
                          if line.startswith('model name')), processor)
    versions: dict[str, str | None] = dict.fromkeys(packages)
    for name in packages:
        with suppress(PackageNotFoundError):
            versions[name] = version(name)
    return {'processor': processor, 'cpu_count': os.cpu_count(), 'system': platform.platform(),
            'python': platform.python_version(), **versions, 'load_at_start': os.getloadavg()[0]}


def _headline(*packages: str) -> str:
    """Return one line with the versions of this package and others, and the machine."""
    found = machine(*packages)
    versions = ''.join(f', {name} {found[name]}' for name in packages if found[name])
    return (f'koopman_ros {__version__}, Python {found["python"]}{versions}; '
            f'{found["processor"]}, {found["cpu_count"]} processors, load '
            f'{found["load_at_start"]:.1f}')
