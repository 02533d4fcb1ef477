# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Results of a demo run, from its bag: series, figures and the picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
from numpy.typing import NDArray

from koopman_ros.bags import temperature_series
from koopman_ros.lifting import LiftedModel
from koopman_ros.nodes import topics
from koopman_ros.nodes.controller_parameters import ControllerParameters
from koopman_ros.nodes.messages import to_celsius, ZERO_CELSIUS

matplotlib.use('Agg')
from matplotlib import pyplot

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
    measured = temperature_series(bag, '/' + topics.TEMPERATURE)
    origin = int(measured.stamp_ns[0])
    measured = temperature_series(bag, '/' + topics.TEMPERATURE, origin_ns=origin)
    commands = temperature_series(bag, '/' + topics.COOLANT_SETPOINT, origin_ns=origin)
    return Run(measured.stamp_s, measured.celsius + ZERO_CELSIUS,
               commands.stamp_s, commands.celsius + ZERO_CELSIUS)


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
    figure, (upper, lower) = pyplot.subplots(2, 1, sharex=True, figsize=(9.0, 7.0),
                                             layout='constrained')
    minutes = [run.seconds / 60.0 for run in (learned, linear)]
    command_minutes = [run.command_seconds / 60.0 for run in (learned, linear)]
    steps = np.array([0.0, step_time, step_time, learned.seconds[-1]]) / 60.0
    start = float(learned.temperature[0])
    low, high = (to_celsius(float(bound[0])) for bound in (model.states.lower,
                                                           model.states.upper))
    upper.axhspan(low, high, color='0.93', label='training range')
    upper.plot(steps, np.array([start, start, setpoint, setpoint]) - ZERO_CELSIUS, 'k--',
               linewidth=1.2, label='set-point')
    upper.plot(minutes[1], linear.temperature - ZERO_CELSIUS, color='tab:red',
               label=f'linearised controller (ends {linear.final_error(setpoint):+.2f} K off)')
    upper.plot(minutes[0], learned.temperature - ZERO_CELSIUS, color='tab:green', linewidth=2.0,
               label=f'learned controller (ends {learned.final_error(setpoint):+.0e} K off)')
    upper.set_ylabel('reactor temperature [°C]')
    upper.set_ylim(low - 1.0, high + 1.0)
    upper.set_title(f'Set-point step of {setpoint - start:+.0f} K at {step_time / 60.0:.0f} min, '
                    'disturbance observer off: what each model knows')
    upper.legend(loc='upper right')
    lower.axhline(limits.coolant_max, color='0.4', linestyle=':', label='coolant limits')
    lower.axhline(limits.coolant_min, color='0.4', linestyle=':')
    lower.step(command_minutes[1], linear.coolant - ZERO_CELSIUS, where='post', color='tab:red',
               label='linearised controller')
    lower.step(command_minutes[0], learned.coolant - ZERO_CELSIUS, where='post',
               color='tab:green', linewidth=2.0, label='learned controller')
    lower.set_ylabel('coolant set-point [°C]')
    lower.set_xlabel('plant time [min]')
    lower.set_xlim(0.0, float(minutes[0][-1]))
    lower.legend(loc='lower right', bbox_to_anchor=(1.0, 0.1))
    for axes in (upper, lower):
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=130)
    pyplot.close(figure)
