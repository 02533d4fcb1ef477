# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Results of both acts, from their bags: series, figures and the pictures."""

from collections.abc import Sequence
from dataclasses import dataclass
import itertools
from pathlib import Path

# where it is missing, the demo ends before it has run and not after
import matplotlib.figure  # noqa: F401
import numpy as np

from koopman_ros.arrays import Array
from koopman_ros.bags import read_series
from koopman_ros.lifting import LiftedModel
from koopman_ros.parameters.controller import ControllerParameters
from koopman_ros.reports import draw_limits, drawing, DRAWN_RANGE, LIMIT
from koopman_ros.ros import topics
from koopman_ros.units import NANOSECONDS, to_celsius, ZERO_CELSIUS

SETTLED = 0.1  # K
_AVERAGED = 600.0  # s over which an offset is averaged
_COLORS = ('0.96', '#fde8e4', '#e6eefa', '#fdf5dc', '#e4f3e4')  # of phases


@dataclass(frozen=True)
class Run:
    """A recorded loop, possibly over several bags; times in s since the first measurement."""

    seconds: Array  #: (n,) of the measurements
    temperature: Array  #: (n,) K
    command_seconds: Array  #: (m,) of the commands
    coolant: Array  #: (m,) K

    def final_error(self, setpoint: float) -> float:
        """Return the last temperature minus the set-point, in K."""
        return float(self.temperature[-1] - setpoint)

    def settling_time(self, setpoint: float, step_time: float) -> float | None:
        """Return the seconds from the step until the error stays within 0.1 K, or None."""
        outside = np.flatnonzero(np.abs(self.temperature - setpoint) > SETTLED)
        last = int(outside[-1]) if len(outside) else -1
        if last + 1 >= len(self.seconds):
            return None
        return max(0.0, float(self.seconds[last + 1]) - step_time)

    def offset(self, setpoint: float, end: float) -> float:
        """Return the size of the mean error, in K, over the ten minutes before a time."""
        rows = (self.seconds > end - _AVERAGED) & (self.seconds <= end)
        return float(abs(np.mean(self.temperature[rows] - setpoint)))

    def largest_step(self, start: float, end: float) -> float:
        """Return the largest change from one command to the next, in K, between two times."""
        rows = (self.command_seconds >= start) & (self.command_seconds <= end)
        return float(np.max(np.abs(np.diff(self.coolant[rows]))))


def read_run(*bags: Path) -> Run:
    """Read the bags of one run, in their order."""
    origin, joined = 0, []
    for topic in (topics.TEMPERATURE, topics.COOLANT_SETPOINT):
        parts = [read_series(bag, '/' + topic) for bag in bags]
        origin = origin or int(parts[0].stamp_ns[0])
        joined.append(np.concatenate([(part.stamp_ns - origin) / NANOSECONDS for part in parts]))
        joined.append(np.concatenate([part.values for part in parts]) + ZERO_CELSIUS)
    return Run(*joined)


def plot(path: Path, learned: Run, linear: Run, setpoint: float, step_time: float,
         model: LiftedModel, limits: ControllerParameters) -> None:
    """
    Draw both runs: temperature with set-point and training range, coolant with limits.

    :param setpoint: in K, from `step_time` on, in s after the first measurement.
    """
    start, end = float(learned.temperature[0]), float(learned.seconds[-1])
    low, high = (to_celsius(float(b[0])) for b in (model.states.lower, model.states.upper))
    with drawing(path, 2, 1, size=(9.0, 7.0), sharex=True) as (_, (upper, lower)):
        upper.axhspan(low, high, label='training range', **DRAWN_RANGE)
        upper.step(np.array([0.0, step_time, end]) / 60.0,
                   np.array([start, setpoint, setpoint]) - ZERO_CELSIUS, 'k--', where='post',
                   linewidth=1.2, label='set-point')
        draw_limits(lower, (limits.coolant_min, limits.coolant_max), 'coolant limits')
        for name, run, digits, style in (
                ('linearised', linear, '+.2f', {'color': 'tab:red'}),
                ('learned', learned, '+.0e', {'color': 'tab:green', 'linewidth': 2.0})):
            upper.plot(run.seconds / 60.0, run.temperature - ZERO_CELSIUS, **style,
                       label=f'{name} controller '
                       f'(ends {run.final_error(setpoint):{digits}} K off)')
            lower.step(run.command_seconds / 60.0, run.coolant - ZERO_CELSIUS, where='post',
                       label=f'{name} controller', **style)
        upper.set(ylabel='reactor temperature [°C]', ylim=(low - 1.0, high + 1.0), title=(
            f'Set-point step of {setpoint - start:+.0f} K at {step_time / 60.0:.0f} min, '
            'disturbance observer off: what each model knows'))
        upper.legend(loc='upper right')
        lower.set(ylabel='coolant set-point [°C]', xlabel='plant time [min]',
                  xlim=(0.0, end / 60.0))
        lower.legend(loc='lower right', bbox_to_anchor=(1.0, 0.1))


def plot_retraining(path: Path, history: Run, phases: Sequence[tuple[str, float]],
                    setpoint: float, present: LiftedModel, learned: LiftedModel,
                    limits: ControllerParameters) -> None:
    """
    Draw the story: temperature, coolant and error over plant time, phase by phase.

    :param phases: name and start of each, in s.
    :param setpoint: in K, from the step on.
    :param present: the lift at the start; training ranges of both are drawn.
    """
    minutes = history.seconds / 60.0
    end = float(minutes[-1])
    starts = [start / 60.0 for _, start in phases] + [end]
    smooth = np.convolve(history.temperature - setpoint, np.ones(60) / 60.0, mode='valid')
    with drawing(path, 3, 1, size=(11.0, 9.0), sharex=True,
                 height_ratios=(3, 2, 2)) as (_, panels):
        for axes in panels:
            for color, (left, right) in zip(itertools.cycle(_COLORS), itertools.pairwise(starts)):
                axes.axvspan(left, right, color=color, linewidth=0.0)
        upper, middle, lower = panels
        upper.plot(minutes, history.temperature - ZERO_CELSIUS, color='tab:green', linewidth=1.0,
                   label='measured')
        upper.axhline(to_celsius(setpoint), color='k', linestyle='--', linewidth=1.0,
                      label='set-point')
        for model, name, style in ((present, 'shipped lift', ':'), (learned, 'new lift', '-.')):
            for i, bound in enumerate((model.states.lower[0], model.states.upper[0])):
                upper.axhline(to_celsius(float(bound)), **{**LIMIT, 'linestyle': style},
                              label=f'training range of the {name}' if i == 0 else None)
        low, high = upper.get_ylim()
        # in two rows in turn: the first phases are short
        for number, ((name, _), start) in enumerate(zip(phases, starts, strict=False)):
            upper.text(start, high + (0.17, 0.08)[number % 2] * (high - low), ' ' + name,
                       va='top', fontsize=9)
        upper.set(ylabel='reactor temperature [°C]', ylim=(low, high + 0.18 * (high - low)),
                  title='The plant drifts, is recorded, and its controller learns it anew '
                  '(disturbance observer off)')
        upper.legend(loc='lower right', ncols=2, fontsize=8)
        draw_limits(middle, (limits.coolant_min, limits.coolant_max), 'coolant limits')
        middle.step(history.command_seconds / 60.0, history.coolant - ZERO_CELSIUS, where='post',
                    color='tab:blue', linewidth=1.0, label='commanded')
        middle.set_ylabel('coolant [°C]')
        middle.legend(loc='upper right', fontsize=8)
        lower.semilogy(minutes[30:30 + len(smooth)], np.maximum(np.abs(smooth), 1e-4),
                       color='tab:red', linewidth=1.0, label='mean over a minute')
        lower.set(ylabel='size of the error [K]', xlabel='plant time [min]', xlim=(0.0, end))
        lower.legend(loc='lower left', fontsize=8)
