# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Pictures of where in its box a model's law does well, and where not; with matplotlib."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from koopman_ros.core.plots import axis_label, drawing, DRAWN_RANGE, legend
from koopman_ros.core.units import shown
from koopman_ros.evaluation.closed_loop_test import ClosedLoopTest

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ['draw_loops', 'plot_law_check']

_PANEL = 5.0  # inches


def plot_law_check(check: ClosedLoopTest, path: Path) -> Path:
    """
    Draw the loops of a check as PNG, a panel for each state.

    :return: the path.
    :raises ImportError: without matplotlib.
    """
    n = len(check.states)
    with drawing(path, 1, n, size=(_PANEL * n, _PANEL + 1.2)) as (figure, panels):
        for i, axes in enumerate(panels):
            draw_loops(axes, check, i)
        legend(figure, panels, min(n, 2))
        figure.suptitle(f'{check.loops} closed loops:\nthe model is '
                        f'{"accepted" if check.accepted else "rejected"} as a controller')
    return path


def draw_loops(axes: Axes, check: ClosedLoopTest, i: int) -> None:
    """Draw start and set-point of each loop in state i, with its outcome."""
    states, failed = check.states, check.failed
    unit = states.units[i]
    signal = axis_label(states.names[i], unit)
    low, high = shown(states.lower[i], unit), shown(states.upper[i], unit)
    axes.axvspan(low, high, **DRAWN_RANGE)
    kinds: tuple[tuple[NDArray[np.bool_], str, dict[str, Any]], ...] = (
        (~check.poor & ~failed, 'arrives, at most '
         f'{check.settings.most_cost:g} times the cost of a linear law',
         {'color': '0.45', 'marker': '.'}),
        (check.poor & ~failed, 'does not, nor with a perfect model',
         {'facecolors': 'none', 'edgecolors': 'tab:blue', 'marker': 'o'}),
        (failed, 'does clearly better with a perfect model',
         {'color': 'tab:red', 'marker': 'x'}))
    for chosen, label, style in kinds:
        if chosen.any():
            axes.scatter(shown(check.starts[chosen, i], unit),
                         shown(check.setpoints[chosen, i], unit), s=36.0, zorder=2,
                         label=f'{label} ({int(chosen.sum())})', **style)
    axes.axline((low, low), (high, high), color='0.6', linestyle='--', linewidth=1.0,
                label='set-point at the start')
    axes.set(xlabel=f'start, {signal}', ylabel=f'set-point, {signal}',
             xlim=_with_margin(low, high), ylim=_with_margin(low, high))


def _with_margin(low: float, high: float) -> tuple[float, float]:
    margin = 0.03 * (high - low)
    return low - margin, high + margin
