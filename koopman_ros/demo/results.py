# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Results of a demo run, from its bag: series, figures and the picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

# where it is missing, the demo ends before it has run and not after
import matplotlib.figure  # noqa: F401
import numpy as np
from numpy.typing import NDArray

from koopman_ros.bags import read_series
from koopman_ros.lifting import LiftedModel
from koopman_ros.parameters.controller import ControllerParameters
from koopman_ros.reports import draw_limits, drawing, DRAWN_RANGE
from koopman_ros.ros import topics
from koopman_ros.units import to_celsius, ZERO_CELSIUS

Array = NDArray[np.float64]
SETTLED = 0.1  # K


@dataclass(frozen=True)
class Run:
    """
    A closed loop as recorded.

    :param seconds: (n,) stamps since the first measurement.
    :param temperature: (n,) K.
    :param command_seconds: (m,) stamps of the commands since the first measurement.
    :param coolant: (m,) K.
    """

    seconds: Array
    temperature: Array
    command_seconds: Array
    coolant: Array

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


def read_run(bag: Path) -> Run:
    """Read a run from its bag."""
    measured = read_series(bag, '/' + topics.TEMPERATURE)
    origin = int(measured.stamp_ns[0])
    measured = read_series(bag, '/' + topics.TEMPERATURE, origin_ns=origin)
    commands = read_series(bag, '/' + topics.COOLANT_SETPOINT, origin_ns=origin)
    return Run(measured.stamp_s, measured.values + ZERO_CELSIUS,
               commands.stamp_s, commands.values + ZERO_CELSIUS)


def plot(path: Path, learned: Run, linear: Run, setpoint: float, step_time: float,
         model: LiftedModel, limits: ControllerParameters) -> None:
    """
    Draw both runs: temperature with set-point and training range, coolant with limits.

    :param path: PNG file to write.
    :param learned: the run with the learned lift.
    :param linear: the same with the linearised model.
    :param setpoint: in K.
    :param step_time: in s after the first measurement.
    :param model: whose training range is drawn.
    :param limits: whose coolant limits are drawn.
    """
    start, end = float(learned.temperature[0]), float(learned.seconds[-1])
    low, high = (to_celsius(float(bound[0])) for bound in (model.states.lower,
                                                           model.states.upper))
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
