# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The demo of any plant that is shipped: its learned controller, the linear law and the optimum.

What happens is in the section `demo` of the plant's parameter file. The controller runs as a
process in the loop; the linear law and the optimum are found on the plant's equations.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
import time
from typing import Any

import numpy as np

from koopman_ros.bags import summary
from koopman_ros.demo.console import LiveTable
from koopman_ros.demo.loop import run_loop, Scenario
from koopman_ros.demo.results import read_run, Run
from koopman_ros.lifting import load
from koopman_ros.lifting.coordinates import Coordinates
from koopman_ros.parameters.controller import table_of
from koopman_ros.parameters.plant import PlantTable
from koopman_ros.parameters.table import parameter, ParameterTable, per_signal
from koopman_ros.parameters.trainer import preset_wiring
from koopman_ros.parameters.wire import preset, shipped, Signals
from koopman_ros.plants import steady_state
from koopman_ros.plants.optimum import cost_along, Course, linear_law, optimum, Task
from koopman_ros.reports import draw_limits, drawing, DRAWN_RANGE, legend, write_figures
from koopman_ros.resources import model_path
from koopman_ros.units import conversion, display_unit, shown, unit_label

_LINEAR = 'linear law'


@dataclass(frozen=True)
class _State:
    """What happens to a state."""

    initial_offset: float = parameter(0.0, 'start this far from the steady state', '{unit}')
    setpoint: float = parameter(0.0, 'new set-point, where it is controlled', '{shown}')
    tolerance: float = parameter(0.0, 'error within which it has settled', '{unit}')


@dataclass(frozen=True)
class _Parameters:
    """What happens in a demo."""

    step_time: float = parameter(0.0, 'when the set-points change', 's')
    duration: float = parameter(600.0, 'length of the run', 's')
    states: Mapping[str, _State] = per_signal(_State)


def run_plant(name: str, output: Path, speed: float) -> dict[str, object]:
    """Run the loop of a plant, compare it, and write and return what came of it."""
    begin = time.monotonic()
    wiring = preset_wiring(name)
    if wiring is None or 'duration' not in (own := preset(name, 'demo')):
        raise ValueError(f'there is no demo of {name!r}: choose one of {", ".join(shipped())}')
    signals = wiring.signals
    told = ParameterTable(_Parameters, signals={'states': signals.states}, defaults=own
                          ).snapshot({})
    plants = PlantTable({'system': name})
    plant = plants.snapshot({})
    system = plants.system(plant)
    setpoints = {signal: conversion(display_unit(signals.states[signal]), signals.states[signal])(
        told.states[signal].setpoint) for signal in signals.controlled}
    scenario = Scenario(
        setpoints, name, told.step_time, told.duration, plant.sample_period, speed,
        plant={f'{signal}.initial_offset': state.initial_offset
               for signal, state in told.states.items()})
    logs = output / 'logs'
    logs.mkdir(parents=True, exist_ok=True)
    bag, picture = output / 'closed_loop.mcap', output / 'closed_loop.png'
    for old in (bag, picture, output / 'summary.json'):
        old.unlink(missing_ok=True)
    wanted = ', '.join(f'{signal} -> {told.states[signal].setpoint:g}{_unit(signals, signal)}'
                       for signal in setpoints)
    with LiveTable(f'{system.name}: {wanted} after {told.step_time:g} s', signals,
                   told.duration) as table:
        run_loop(scenario, bag, logs, table.show)

    model = load(model_path(str(preset(name, 'controller')['model'])))
    rows = table_of(model, {'system': name}).rows
    tuned = {parameter: row.default for parameter, row in rows.items()}
    run = read_run(wiring, bag)
    first = round(told.step_time / plant.sample_period)
    states, inputs = (np.stack(list(of.values()), axis=1)[first:]
                      for of in (run.measured, run.commanded))
    x_ref, u_ref = steady_state(system, setpoints)
    task = Task(system, states[0], x_ref, u_ref,
                np.array([tuned[f'{signal}.weight'] for signal in signals.states]),
                np.array([tuned[f'{signal}.weight'] for signal in signals.inputs]),
                plant.sample_period / system.seconds_per_time_unit, len(states) - 1)
    best, linear = optimum(task), linear_law(task)
    cost = cost_along(task, states, inputs[:-1])
    title = (f'{system.name}: {wanted}. Cost over that of the optimum: learned '
             f'{cost / best.cost:.4f}, linear {linear.cost / best.cost:.4f}')
    _plot(picture, title, run, {_LINEAR: linear, 'optimum': best}, signals, scenario,
          model.states, tuned)
    counts = summary(bag).counts
    result: dict[str, object] = {
        'unit': {signal: signals.states[signal] for signal in setpoints},
        'setpoint': setpoints,
        'final_error': {signal: abs(run.final_error(signal, setpoint))
                        for signal, setpoint in setpoints.items()},
        'linear_final_error': {
            signal: float(abs(linear.states[-1, list(signals.states).index(signal)] - setpoint))
            for signal, setpoint in setpoints.items()},
        'settling_time_seconds': {
            signal: run.settling_time(signal, setpoint, told.step_time,
                                      told.states[signal].tolerance)
            for signal, setpoint in setpoints.items()},
        'cost': cost, 'optimal_cost': best.cost, 'linear_cost': linear.cost,
        'measurements': len(run.seconds), 'commands': len(run.command_seconds),
        'bag_messages': sum(counts.values()),
        'wall_seconds': round(time.monotonic() - begin, 3),
    }
    write_figures(output / 'summary.json', result)
    return result


def _unit(signals: Signals, signal: str) -> str:
    """Return the unit of a state as it follows a number."""
    return '' if signals.states[signal] == '1' else f' {unit_label(signals.states[signal])}'


def _plot(path: Path, title: str, run: Run, courses: Mapping[str, Course], signals: Signals,
          scenario: Scenario, box: Coordinates, tuned: Mapping[str, Any]) -> None:
    """Draw each signal: states with set-points and training range, inputs with limits."""
    styles: dict[str, dict[str, Any]] = {
        _LINEAR: {'color': 'tab:red'},
        'optimum': {'color': 'black', 'linestyle': (0, (1, 2)), 'linewidth': 1.5}}
    later = scenario.step_time + scenario.sample_period * np.arange(
        1 + max(len(course.inputs) for course in courses.values()))
    with drawing(path, len(signals.states) + len(signals.inputs), 1, sharex=True, size=(
            9.0, 2.0 + 1.8 * (len(signals.states) + len(signals.inputs)))) as (figure, panels):
        for i, ((signal, unit), panel) in enumerate(zip(
                signals.states.items(), panels, strict=False)):
            low, high = (float(shown(float(end[i]), unit)) for end in (box.lower, box.upper))
            panel.axhspan(low, high, label='training range', **DRAWN_RANGE)
            if signal in scenario.setpoints:
                setpoint = scenario.setpoints[signal]
                goal = float(shown(setpoint, unit))
                panel.plot([scenario.step_time, run.seconds[-1]], [goal, goal], 'k--',
                           linewidth=1.0, label='set-point')
                panel.text(
                    0.99, 0.06, f'ends {run.final_error(signal, setpoint):+.1e} off, linear law '
                    f'{courses[_LINEAR].states[-1, i] - setpoint:+.1e}{_unit(signals, signal)}',
                    transform=panel.transAxes, ha='right', fontsize=8)
            panel.plot(run.seconds, shown(run.measured[signal], unit), color='tab:green',
                       linewidth=2.5, label='learned controller')
            for name, course in courses.items():
                # one that has run away stays at the edge
                values = np.clip(np.nan_to_num(shown(course.states[:, i], unit), nan=high),
                                 2.0 * low - high, 2.0 * high - low)
                panel.plot(later, values, label=name, **styles[name])
            panel.set_ylabel(f'{signal} [{unit_label(unit)}]')
        for j, ((signal, unit), panel) in enumerate(zip(
                signals.inputs.items(), panels[len(signals.states):], strict=True)):
            lowest, highest = tuned[f'{signal}.min'], tuned[f'{signal}.max']
            draw_limits(panel, (lowest, highest), 'limits')
            panel.step(run.command_seconds, shown(run.commanded[signal], unit), where='post',
                       color='tab:green', linewidth=2.5, label='learned controller')
            for name, course in courses.items():
                values = np.clip(np.nan_to_num(shown(course.inputs[:, j], unit), nan=highest),
                                 lowest, highest)
                panel.step(later[:-1], values, where='post', label=name, **styles[name])
            panel.set_ylabel(f'{signal} [{unit_label(unit)}]')
        panels[0].set_title(title, fontsize=9)
        panels[-1].set(xlabel='plant time [s]', xlim=(0.0, run.seconds[-1]))
        legend(figure, panels, 6)
