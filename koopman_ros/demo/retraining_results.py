# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0


"""Results of the demo's second act, from its bags: offsets, steps and the picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import itertools
from pathlib import Path

# where it is missing, the demo ends before it has run and not after
import matplotlib.figure  # noqa: F401
import numpy as np
from numpy.typing import NDArray

from koopman_ros.bags import read_series
from koopman_ros.lifting import LiftedModel
from koopman_ros.parameters.controller import ControllerParameters
from koopman_ros.parameters.plant import PlantParameters
from koopman_ros.plants import (
    ControlAffineSystem,
    one_state_reactor,
    random_steps,
    RandomStepDesign,
    simulate,
)
from koopman_ros.reports import draw_limits, drawing, LIMIT
from koopman_ros.ros import topics
from koopman_ros.units import to_celsius, ZERO_CELSIUS

Array = NDArray[np.float64]
_AVERAGED = 600.0  # s over which an offset is averaged
_COLORS = ('0.96', '#fde8e4', '#e6eefa', '#fdf5dc', '#e4f3e4')
_TEST_SEED = 7


@dataclass(frozen=True)
class History:
    """
    A recorded loop, possibly over several bags; times in s since the first measurement.

    :param seconds: (n,) of the measurements.
    :param temperature: (n,) K.
    :param command_seconds: (m,) stamps of the commands.
    :param coolant: (m,) K.
    """

    seconds: Array
    temperature: Array
    command_seconds: Array
    coolant: Array

    def offset(self, setpoint: float, end: float) -> float:
        """Return the size of the mean error, in K, over the ten minutes before a time."""
        rows = (self.seconds > end - _AVERAGED) & (self.seconds <= end)
        return float(abs(np.mean(self.temperature[rows] - setpoint)))

    def largest_step(self, start: float, end: float) -> float:
        """Return the largest change from one command to the next, in K, between two times."""
        rows = (self.command_seconds >= start) & (self.command_seconds <= end)
        return float(np.max(np.abs(np.diff(self.coolant[rows]))))


def read_history(bags: Sequence[Path]) -> History:
    """Read the bags of one run, in their order."""
    series = [[read_series(bag, '/' + topic) for bag in bags]
              for topic in (topics.TEMPERATURE, topics.COOLANT_SETPOINT)]
    origin = int(series[0][0].stamp_ns[0])
    joined = []
    for parts in series:
        joined.append(np.concatenate([(part.stamp_ns - origin) * 1e-9 for part in parts]))
        joined.append(np.concatenate([part.values for part in parts]) + ZERO_CELSIUS)
    return History(*joined)


def rollout_rmse(model: LiftedModel, plant: PlantParameters) -> float:
    """
    Predict the reactor over 15 min of fresh random steps without noise, from the projected drift.

    :param model: the lift.
    :param plant: the reactor as it is now.
    :return: root mean square error in K.
    """
    reactor = one_state_reactor(plant.constants(), nominal_state=model.states.center)
    design = RandomStepDesign(model.inputs.lower, model.inputs.upper, model.states.lower,
                              model.states.upper, (0.5, 2.0), 1.0 / 60.0, rtol=1e-9)
    truth = random_steps(reactor, design, 15.0, _TEST_SEED)
    scale, center = model.states.scale, model.states.center
    push = scale[:, None] * model.B / model.inputs.scale

    def drift(x: Array) -> Array:
        return scale * model.drift((x - center) / scale) - model.inputs.center @ push.T

    lifted = ControlAffineSystem(
        name='projected drift', state_names=model.states.names, state_units=model.states.units,
        input_names=model.inputs.names, input_units=model.inputs.units,
        time_unit=model.time_unit, drift=drift, drift_jacobian=reactor.drift_jacobian, B=push,
        nominal_state=center, nominal_input=model.inputs.center)
    predicted = simulate(lifted, truth.x[0], truth.u, design.sample_period)
    return float(np.sqrt(np.mean((predicted.x - truth.x) ** 2)))


def plot(path: Path, history: History, phases: Sequence[tuple[str, float]], setpoint: float,
         present: LiftedModel, learned: LiftedModel, limits: ControllerParameters) -> None:
    """
    Draw the story: temperature, coolant and error over plant time, phase by phase.

    :param path: PNG file to write.
    :param history: what was recorded.
    :param phases: name and start of each, in s.
    :param setpoint: in K, from the step on.
    :param present: the lift at the start, whose training range is drawn.
    :param learned: the lift at the end, likewise.
    :param limits: whose coolant limits are drawn.
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
        for (name, _), left, right in zip(phases, starts[:-1], starts[1:], strict=True):
            upper.text(0.5 * (left + right), high + 0.16 * (high - low), name.replace(' ', '\n'),
                       ha='center', va='top', fontsize=9)
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
