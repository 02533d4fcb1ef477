# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A picture of cases side by side: temperature and coolant around the fault."""

from __future__ import annotations

from collections.abc import Sequence
import math
from pathlib import Path

from koopman_ros.nodes.controller_parameters import ControllerParameters
from validation.faults.case import Outcome

# Those that tell most; others are drawn only where none of these was run.
TELLING = ('nan-long', 'bias', 'feed-warm', 'controller-killed-in-a-step', 'plant-reset',
           'actuator-saturated')
_BEFORE, _AFTER = 30.0, 300.0  # s around the fault


def draw(outcomes: Sequence[Outcome], path: Path) -> bool:
    """Draw the telling cases into a file; return whether there was one."""
    import matplotlib
    matplotlib.use('Agg')
    from matplotlib import pyplot

    shown = [outcome for name in TELLING for outcome in outcomes
             if outcome.case.name == name and outcome.course.commands
             and math.isfinite(outcome.course.end)]
    if not shown:
        return False
    limits = ControllerParameters()
    figure, axes = pyplot.subplots(2, len(shown), sharex='col', squeeze=False,
                                   figsize=(3.2 * len(shown), 5.2), layout='constrained')
    for (upper, lower), outcome in zip(axes.T, shown, strict=True):
        course = outcome.course
        times, temperatures = zip(*course.samples, strict=True)
        upper.plot(times, temperatures, label='reactor, true')
        since, wanted = zip(*course.setpoints, strict=True)
        upper.step([*since, times[-1]], [*wanted, wanted[-1]], where='post', linestyle='--',
                   color='black', linewidth=1.0, label='set-point')
        lower.plot([command.seconds for command in course.commands],
                   [command.celsius for command in course.commands], label='command')
        for bound, label in ((limits.coolant_min, 'limits'), (limits.coolant_max, None)):
            lower.axhline(bound, color='grey', linestyle=':', linewidth=1.0, label=label)
        for axis in (upper, lower):
            axis.axvspan(course.begin, max(course.end, course.begin + 2.0), alpha=0.2,
                         color='tab:red', linewidth=0.0, label='fault')
            axis.grid(alpha=0.3)
        upper.set_xlim(course.begin - _BEFORE, min(course.end + _AFTER, times[-1]))
        near = [celsius for seconds, celsius in course.samples if seconds > course.begin - _BEFORE]
        upper.set_ylim(min(*near, *wanted) - 0.5, max(*near, *wanted) + 0.5)
        upper.set_title(outcome.case.name, fontsize='medium')
        lower.set_xlabel('plant time [s]')
    axes[0, 0].set_ylabel('temperature [°C]')
    axes[1, 0].set_ylabel('coolant [°C]')
    axes[0, 0].legend(fontsize='small')
    axes[1, 0].legend(fontsize='small')
    figure.savefig(path, dpi=110)
    pyplot.close(figure)
    return True
