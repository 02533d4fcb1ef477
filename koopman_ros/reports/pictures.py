# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Pictures: panels in a file, and what all of them show alike."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# A trained range is drawn as a grey band, a limit as a dotted line.
DRAWN_RANGE: dict[str, Any] = {'color': '0.92', 'zorder': 0}
LIMIT: dict[str, Any] = {'color': '0.4', 'linestyle': ':', 'linewidth': 1.0}


@contextmanager
def drawing(path: Path, rows: int = 1, columns: int = 1, *, size: tuple[float, float],
            dpi: int = 150, grid: bool = True, **options: Any
            ) -> Iterator[tuple[Figure, list[Axes]]]:
    """
    Draw panels; they are written as PNG when the block ends, unless by an exception.

    :param path: the file; its folder is made.
    :param rows: of panels.
    :param columns: of panels; they are counted row by row.
    :param size: width and height in inches.
    :param grid: whether the panels have one.
    :param options: of matplotlib's ``Figure.subplots``.
    :raises ImportError: without matplotlib.
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
    figure.savefig(path, dpi=dpi)


def draw_limits(axes: Axes, bounds: Iterable[float], label: str) -> None:
    """Draw limits of what an axis shows as dotted lines with one label."""
    for number, bound in enumerate(bounds):
        axes.axhline(bound, label=label if number == 0 else None, **LIMIT)


def legend(figure: Figure, panels: Iterable[Axes], columns: int) -> None:
    """Put what some panels show, each thing once, below all of them."""
    shown = {label: handle for panel in panels
             for handle, label in zip(*panel.get_legend_handles_labels(), strict=True)}
    figure.legend(shown.values(), shown.keys(), loc='outside lower center', ncols=columns,
                  fontsize=8)
