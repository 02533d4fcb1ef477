# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A picture of cases side by side: temperature and coolant around the fault."""

from __future__ import annotations

from collections.abc import Sequence
import math
from pathlib import Path
from typing import TYPE_CHECKING

from koopman_ros.parameters.controller import ControllerParameters
from koopman_ros.reports import draw_limits, drawing
from validation.faults.case import Outcome
from validation.faults.trace import Trace

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Those that tell most; others are drawn only where none of these was run.
TELLING = ('nan-long', 'bias', 'feed-warm', 'controller-killed-in-a-step', 'plant-reset',
           'actuator-saturated')
_BEFORE, _AFTER = 30.0, 300.0  # s around the fault


def draw(outcomes: Sequence[Outcome], path: Path) -> bool:
    """Draw the telling cases into a file; return whether there was one."""
    shown = [outcome for name in TELLING for outcome in outcomes
             if outcome.case.name == name and outcome.trace.commands
             and math.isfinite(outcome.trace.end)]
    if not shown:
        return False
    with drawing(path, 2, len(shown), size=(3.2 * len(shown), 5.2), sharex='col') as (_, panels):
        for upper, lower, outcome in zip(panels, panels[len(shown):], shown, strict=False):
            _draw_case(upper, lower, outcome.trace)
            upper.set_title(outcome.case.name, fontsize='medium')
        for panel, quantity in ((panels[0], 'temperature'), (panels[len(shown)], 'coolant')):
            panel.set_ylabel(f'{quantity} [°C]')
            panel.legend(fontsize='small')
    return True


def _draw_case(upper: Axes, lower: Axes, trace: Trace) -> None:
    times, temperatures = zip(*trace.samples, strict=True)
    upper.plot(times, temperatures, label='reactor, true')
    since, wanted = zip(*trace.setpoints, strict=True)
    upper.step([*since, times[-1]], [*wanted, wanted[-1]], where='post', linestyle='--',
               color='black', linewidth=1.0, label='set-point')
    lower.plot([command.seconds for command in trace.commands],
               [command.celsius for command in trace.commands], label='command')
    limits = ControllerParameters()
    draw_limits(lower, (limits.coolant_min, limits.coolant_max), 'limits')
    for axes in (upper, lower):
        axes.axvspan(trace.begin, max(trace.end, trace.begin + 2.0), alpha=0.2,
                     color='tab:red', linewidth=0.0, label='fault')
    upper.set_xlim(trace.begin - _BEFORE, min(trace.end + _AFTER, times[-1]))
    near = [celsius for seconds, celsius in trace.samples if seconds > trace.begin - _BEFORE]
    upper.set_ylim(min(*near, *wanted) - 0.5, max(*near, *wanted) + 0.5)
    lower.set_xlabel('plant time [s]')
