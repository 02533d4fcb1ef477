# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The plot of a replay: measurements, commands, and where commands differ."""

from pathlib import Path
import textwrap

import matplotlib.axes
import numpy as np

from koopman_ros.core.plots import draw_limits, drawing, DRAWN_RANGE
from koopman_ros.core.units import shown, unit_label
from koopman_ros.event_log.report import ReplayedBag, verdict

_RECORDED, _CHECK, _NEW = '0.55', 'tab:blue', 'tab:orange'


def draw(path: Path, bag: ReplayedBag, new_model: str) -> None:
    """Draw a replayed bag to a PNG file; `new_model` is the new model's name, or empty."""
    inputs = bag.recorded.shape[1]
    states = bag.measured.shape[1]
    time, label = _time(bag)
    rows = states + 2 * inputs
    with drawing(path, rows, 1, size=(9.0, 3.0 * rows), sharex=True,
                 height_ratios=[1.0] * states + [1.2] * inputs + [0.8] * inputs) as (_, axes):
        for i in range(states):
            _draw_measured(axes[i], time, bag, i)
        for i in range(inputs):
            _draw_commands(axes[states + i], time, bag, i, new_model)
            _draw_difference(axes[states + inputs + i], time, bag, i, new_model)
        axes[0].set_title('\n'.join([f'{Path(bag.path).name}: recorded and replayed commands',
                                     *textwrap.wrap(verdict(bag), 90)]), fontsize='medium')
        axes[-1].set_xlabel(label)
        if len(time) > 1:
            axes[-1].set_xlim(time[0], time[-1])
        for one in axes:
            if one.get_legend_handles_labels()[0]:
                one.legend(loc='best', fontsize='small', framealpha=0.9)


def _time(bag: ReplayedBag) -> tuple[np.ndarray, str]:
    """Return the axis: stamps, or the number of the command when stamps go back."""
    if not bag.found.samples:
        return np.zeros(0), ''
    seconds = bag.seconds
    if np.any(np.diff(seconds) < 0.0):
        return np.arange(1.0, len(seconds) + 1.0), 'command (the stamps of this bag go back)'
    if seconds[-1] > 300.0:
        return seconds / 60.0, 'time since the first command [min]'
    return seconds, 'time since the first command [s]'


def _draw_measured(axes: matplotlib.axes.Axes, time: np.ndarray, bag: ReplayedBag, i: int) -> None:
    controller = bag.found.controller
    name, unit, tracked = 'measured', '', bag.setpoint[:, i:i + 1]
    if controller is not None:
        states = controller.model.states
        name, unit = states.names[i], states.units[i]
        tracked = bag.setpoint[:, [k for k, other in enumerate(controller.controlled.names)
                                   if other == name]]
        low, high = shown(np.array([states.lower[i], states.upper[i]]), unit)
        axes.axhspan(low, high, label='training range', **DRAWN_RANGE)
    setpoint, measured = shown(tracked, unit), shown(bag.measured[:, i], unit)
    finite = measured[np.isfinite(measured)]
    typical = _typical(finite)
    hidden = len(finite) - len(typical)
    if setpoint.size:
        axes.step(time, setpoint, 'k--', where='post', linewidth=1.2, label='set-point tracked')
    axes.plot(time, measured, color='tab:green', label='measured' + (
        f' ({hidden} of {len(finite)} outside the plot)' if hidden else ''))
    both = np.concatenate([typical, setpoint[np.isfinite(setpoint)]])
    if both.size:
        margin = 0.5 + 0.05 * float(np.ptp(both))
        axes.set_ylim(float(both.min()) - margin, float(both.max()) + margin)
    axes.set_ylabel(f'{name} [{unit_label(unit)}]')


def _typical(finite: np.ndarray) -> np.ndarray:
    """Return the values to plot: those of a broken sensor would flatten all others."""
    if not finite.size:
        return finite
    low, high = np.percentile(finite, (2.0, 98.0))
    reach = high - low + 1.0
    return finite[(finite >= low - reach) & (finite <= high + reach)]


def _draw_commands(axes: matplotlib.axes.Axes, time: np.ndarray, bag: ReplayedBag, i: int,
                   new_model: str) -> None:
    controller = bag.found.controller
    name, unit = 'command', ''
    if controller is not None:
        inputs, limits = controller.model.inputs, controller.tuning.limits
        name, unit = inputs.names[i], inputs.units[i]
        low, high = shown(np.array([limits.lower[i], limits.upper[i]]), unit)
        draw_limits(axes, (high, low), 'limits')
    axes.step(time, shown(bag.recorded[:, i], unit), where='post', color=_RECORDED,
              linewidth=4.0, label='recorded')
    axes.step(time, shown(bag.commands[:, i], unit), where='post', color=_CHECK, linewidth=1.2,
              label='replayed')
    if new_model:
        axes.step(time, shown(bag.new_commands[:, i], unit), where='post', color=_NEW,
                  linewidth=1.5, label=f'{_short(new_model)} on the same measurements')
    axes.set_ylabel(f'{name.replace("_", " ")}, command [{unit_label(unit)}]')


def _draw_difference(axes: matplotlib.axes.Axes, time: np.ndarray, bag: ReplayedBag, i: int,
                     new_model: str) -> None:
    axes.axhspan(-bag.tolerance, bag.tolerance, color='0.9', label=f'within ±{bag.tolerance:g}',
                 zorder=0)
    drawn = [(bag.check, _CHECK, 'replayed')]
    if bag.new is not None:
        drawn.append((bag.new, _NEW, _short(new_model)))
    for comparison, color, name in drawn:
        difference, spots = comparison.difference[:, i], comparison.beyond
        axes.step(time, difference, where='post', color=color, linewidth=1.2,
                  label=f'{name}: {np.count_nonzero(spots)} of {comparison.compared} beyond')
        axes.plot(time[spots], difference[spots], '.', color='tab:red', markersize=4.0)
    axes.set_ylabel('command minus recorded')


def _short(name: str) -> str:
    return Path(name).name.removesuffix('.safetensors')
