# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Results of both acts, from their bags: series, figures and the pictures."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
import itertools
from pathlib import Path

# where it is missing, the demo ends before it has run and not after
import matplotlib.figure  # noqa: F401
import numpy as np

from koopman_ros.arrays import Array
from koopman_ros.bags import read_series
from koopman_ros.demo.reactor import COOLANT_TEMPERATURE, TEMPERATURE
from koopman_ros.lifting import LiftedModel
from koopman_ros.parameters.wire import Wiring
from koopman_ros.reports import draw_limits, drawing, DRAWN_RANGE, LIMIT
from koopman_ros.units import conversion, NANOSECONDS, to_celsius, ZERO_CELSIUS
from koopman_ros.wire import Place

_AVERAGED = 600.0  # s over which an offset is averaged
_COLORS = ('0.96', '#fde8e4', '#e6eefa', '#fdf5dc', '#e4f3e4')  # of phases


@dataclass(frozen=True)
class Run:
    """A recorded loop, possibly over several bags; times in s since the first measurement."""

    seconds: Array  #: (n,) of the measurements
    measured: Mapping[str, Array]  #: (n,) by signal, in its unit
    command_seconds: Array  #: (m,) of the commands
    commanded: Mapping[str, Array]  #: (m,) by signal, in its unit

    def final_error(self, signal: str, setpoint: float) -> float:
        """Return the last measurement minus the set-point."""
        return float(self.measured[signal][-1] - setpoint)

    def settling_time(self, signal: str, setpoint: float, step_time: float, tolerance: float
                      ) -> float | None:
        """Return the seconds from the step until the error stays within a tolerance, or None."""
        outside = np.flatnonzero(np.abs(self.measured[signal] - setpoint) > tolerance)
        last = int(outside[-1]) if len(outside) else -1
        if last + 1 >= len(self.seconds):
            return None
        return max(0.0, float(self.seconds[last + 1]) - step_time)

    def offset(self, signal: str, setpoint: float, end: float) -> float:
        """Return the size of the mean error over the ten minutes before a time."""
        rows = (self.seconds > end - _AVERAGED) & (self.seconds <= end)
        return float(abs(np.mean(self.measured[signal][rows] - setpoint)))

    def largest_step(self, signal: str, start: float, end: float) -> float:
        """Return the largest change from one command to the next between two times."""
        rows = (self.command_seconds >= start) & (self.command_seconds <= end)
        return float(np.max(np.abs(np.diff(self.commanded[signal][rows]))))


def read_run(wiring: Wiring, *bags: Path) -> Run:
    """Read the bags of one run, in their order."""
    stamps: Array = np.empty(0)

    def series(places: Mapping[str, Place], units: Mapping[str, str]) -> dict[str, Array]:
        """Read signals whose messages have the same stamps."""
        nonlocal stamps
        found = {}
        for name, place in places.items():
            parts = [read_series(bag, replace(place, topic=f'/{place.topic}')) for bag in bags]
            stamps = np.concatenate([part.stamp_ns for part in parts])
            found[name] = conversion(place.unit, units[name])(
                np.concatenate([part.values for part in parts]))
        return found

    measured = series(wiring.measured, wiring.signals.states)
    origin, seconds = stamps[0], (stamps - stamps[0]) / NANOSECONDS
    commanded = series(wiring.commands, wiring.signals.inputs)
    return Run(seconds, measured, (stamps - origin) / NANOSECONDS, commanded)


def plot(path: Path, learned: Run, linear: Run, setpoint: float, step_time: float,
         model: LiftedModel, limits: tuple[float, float]) -> None:
    """
    Draw both runs: temperature with set-point and training range, coolant with limits.

    :param setpoint: in K, from `step_time` on, in s after the first measurement.
    """
    start, end = float(learned.measured[TEMPERATURE][0]), float(learned.seconds[-1])
    low, high = (to_celsius(float(b[0])) for b in (model.states.lower, model.states.upper))
    with drawing(path, 2, 1, size=(9.0, 7.0), sharex=True) as (_, (upper, lower)):
        upper.axhspan(low, high, label='training range', **DRAWN_RANGE)
        upper.step(np.array([0.0, step_time, end]) / 60.0,
                   np.array([start, setpoint, setpoint]) - ZERO_CELSIUS, 'k--', where='post',
                   linewidth=1.2, label='set-point')
        draw_limits(lower, limits, 'coolant limits')
        for name, run, digits, style in (
                ('linearised', linear, '+.2f', {'color': 'tab:red'}),
                ('learned', learned, '+.0e', {'color': 'tab:green', 'linewidth': 2.0})):
            upper.plot(run.seconds / 60.0, run.measured[TEMPERATURE] - ZERO_CELSIUS, **style,
                       label=f'{name} controller '
                       f'(ends {run.final_error(TEMPERATURE, setpoint):{digits}} K off)')
            lower.step(run.command_seconds / 60.0,
                       run.commanded[COOLANT_TEMPERATURE] - ZERO_CELSIUS, where='post',
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
                    limits: tuple[float, float]) -> None:
    """
    Draw the story: temperature, coolant and error over plant time, phase by phase.

    :param phases: name and start of each, in s.
    :param setpoint: in K, from the step on.
    :param present: the lift at the start; training ranges of both are drawn.
    """
    minutes = history.seconds / 60.0
    end = float(minutes[-1])
    starts = [start / 60.0 for _, start in phases] + [end]
    temperature = history.measured[TEMPERATURE]
    smooth = np.convolve(temperature - setpoint, np.ones(60) / 60.0, mode='valid')
    with drawing(path, 3, 1, size=(11.0, 9.0), sharex=True,
                 height_ratios=(3, 2, 2)) as (_, panels):
        for axes in panels:
            for color, (left, right) in zip(itertools.cycle(_COLORS), itertools.pairwise(starts)):
                axes.axvspan(left, right, color=color, linewidth=0.0)
        upper, middle, lower = panels
        upper.plot(minutes, temperature - ZERO_CELSIUS, color='tab:green', linewidth=1.0,
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
        draw_limits(middle, limits, 'coolant limits')
        middle.step(history.command_seconds / 60.0,
                    history.commanded[COOLANT_TEMPERATURE] - ZERO_CELSIUS, where='post',
                    color='tab:blue', linewidth=1.0, label='commanded')
        middle.set_ylabel('coolant [°C]')
        middle.legend(loc='upper right', fontsize=8)
        lower.semilogy(minutes[30:30 + len(smooth)], np.maximum(np.abs(smooth), 1e-4),
                       color='tab:red', linewidth=1.0, label='mean over a minute')
        lower.set(ylabel='size of the error [K]', xlabel='plant time [min]', xlim=(0.0, end))
        lower.legend(loc='lower left', fontsize=8)
