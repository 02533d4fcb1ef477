# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The demo: a learned controller moves a plant to a set-point; linear law and optimum compared.

The section `demo` of the plant's parameter file defines the scenario. The controller runs as a
process in the loop; the linear law and the optimum are computed on the plant's equations.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
import math
from pathlib import Path
import time
from typing import Any

import numpy as np

from koopman_ros.core.paths import model_path
from koopman_ros.core.plots import (
    axis_label,
    draw_limits,
    drawing,
    DRAWN_RANGE,
    legend,
    write_figures,
)
from koopman_ros.core.units import (
    conversion,
    difference_text,
    display_unit,
    printed,
    shown,
    unit_label,
)
from koopman_ros.demo.console import LiveTable, read_options, run_demo
from koopman_ros.demo.exported import ExportedLoop
from koopman_ros.demo.line_demo import PLANT as LINE
from koopman_ros.demo.line_demo import run_line
from koopman_ros.demo.loop import Row, run_loop, running_loop, Scenario
from koopman_ros.demo.results import DemoRun, read_run
from koopman_ros.evaluation.optimal_cost import (
    cost_along,
    linear_law,
    OptimalTrajectory,
    optimum,
    Task,
)
from koopman_ros.model import load
from koopman_ros.model.coordinates import Coordinates
from koopman_ros.parameters.controller import built, table_of
from koopman_ros.parameters.plant import PlantTable
from koopman_ros.parameters.signal_topics import bundled_plants, plant_defaults, Signals
from koopman_ros.parameters.table import parameter, ParameterTable, per_signal
from koopman_ros.parameters.trainer_table import preset_wiring
from koopman_ros.plants import steady_state
from koopman_ros.records import summary
from koopman_ros.tuning import Tuning

PLANT = 'reactor'
_PANEL_SPEED = 10.0  # at most, of a loop with the panel
_STYLES: dict[str, dict[str, Any]] = {
    'linear law': {'color': 'tab:red'},
    'optimum': {'color': 'black', 'linestyle': (0, (1, 2)), 'linewidth': 1.5}}


@dataclass(frozen=True)
class _StateParameters:
    """The course of a state."""

    initial_offset: float = parameter(0.0, 'initial distance from the steady state', '{unit}')
    setpoint: float = parameter(0.0, 'new set-point of a controlled state', '{shown}')
    tolerance: float = parameter(0.0, 'error below which the state has settled', '{unit}')


@dataclass(frozen=True)
class _Parameters:
    """The course of a demo."""

    step_time: float = parameter(0.0, 'time of the set-point step', 's')
    duration: float = parameter(600.0, 'duration of the run', 's')
    observer: bool = parameter(True, 'whether the controller estimates disturbances')
    states: Mapping[str, _StateParameters] = per_signal(_StateParameters)


def run_plant(name: str, export: bool, output: Path, speed: float) -> dict[str, object]:
    """
    Run the loop of a plant, compare it, and write and return its figures.

    :param export: whether the exported C code answers the same measurements.
    """
    begin = time.monotonic()
    wiring = preset_wiring(name)
    if wiring is None or 'duration' not in (own := plant_defaults(name, 'demo')):
        raise ValueError(f'no demo for the plant {name!r}: choose one of '
                         f'{", ".join(bundled_plants())}')
    signals = wiring.signals
    plan = ParameterTable(_Parameters, signals={'states': signals.states}, defaults=own
                          ).snapshot({})
    plants = PlantTable({'system': name})
    plant = plants.snapshot({})
    system = plants.system(plant)
    setpoints = {signal: conversion(display_unit(signals.states[signal]), signals.states[signal])(
        plan.states[signal].setpoint) for signal in signals.controlled}
    scenario = Scenario(
        setpoints, name, plan.step_time, plan.duration, plant.sample_period, speed,
        plant={f'{signal}.initial_offset': state.initial_offset
               for signal, state in plan.states.items()},
        controller={} if plan.observer else {'observer_bandwidth': 0.0})
    bag, picture = output / 'closed_loop.mcap', output / 'closed_loop.png'
    for old in (bag, picture, output / 'summary.json'):
        old.unlink(missing_ok=True)
    change = ', '.join(f'{signal} -> {plan.states[signal].setpoint:.4g}'
                       f' [{unit_label(signals.states[signal])}]'
                       for signal in setpoints)
    table = LiveTable(f'{system.name}: {change} after {plan.step_time:g} s', signals,
                      plan.duration)
    model = load(model_path(str(plant_defaults(name, 'controller')['model'])))
    settings = table_of(model, {'system': name}).snapshot(scenario.controller)
    tuning, code = settings.tuning, None
    if export:
        code = ExportedLoop(built(settings, model), plant.sample_period, output / 'controller',
                            setpoints, plan.step_time)

    def on_row(row: Row) -> None:
        table.show(row)
        if code is not None:
            code.answer(row)

    run_loop(scenario, bag, output / 'logs', on_row)
    differences = {} if code is None else {'exported_difference': code.close()}
    run = read_run(wiring, bag)
    first = round(plan.step_time / plant.sample_period)
    states, inputs = (np.stack(list(of.values()), axis=1)[first:]
                      for of in (run.measured, run.commanded))
    task = Task(system, states[0], *steady_state(system, setpoints),
                tuning.state_weight, tuning.input_weight,
                plant.sample_period / system.seconds_per_time_unit, len(states) - 1)
    before = system.nominal_input if first == 0 else np.array([
        values[first - 1] for values in run.commanded.values()])
    linear, best = (of(task, tuning.limits, before) for of in (linear_law, optimum))
    cost = cost_along(task, states, inputs[:-1])
    ratio, linear_ratio = cost / best.cost, linear.cost / best.cost
    ends = dict(zip(signals.states, linear.states[-1].tolist(), strict=True))
    errors = {signal: abs(run.final_error(signal, setpoint))
              for signal, setpoint in setpoints.items()}
    linear_errors = {signal: abs(ends[signal] - setpoint)
                     for signal, setpoint in setpoints.items()}
    end, linear_end = (_end(some, plan, signals) for some in (errors, linear_errors))
    title = (f'{system.name}: {change}\nWithin the same limits the learned controller costs '
             f'{ratio:.3f} times the optimum and {end},\n'
             f'the linear law {linear_ratio:.3g} times and {linear_end}')
    _draw(picture, title, run, {'linear law': linear, 'optimum': best}, signals, scenario,
          model.states, tuning, code)
    counts = summary(bag).counts
    result: dict[str, object] = {
        'unit': {signal: signals.states[signal] for signal in setpoints},
        'setpoint': setpoints,
        'final_error': errors, 'linear_final_error': linear_errors,
        'settling_time_seconds': {
            signal: run.settling_time(signal, setpoint, plan.step_time,
                                      plan.states[signal].tolerance)
            for signal, setpoint in setpoints.items()},
        'cost': cost, 'optimal_cost': best.cost, 'linear_cost': linear.cost,
        'cost_by_optimum': ratio, 'linear_cost_by_optimum': linear_ratio,
        'measurements': len(run.seconds), 'commands': len(run.command_seconds),
        'bag_messages': sum(counts.values()),
        'wall_seconds': round(time.monotonic() - begin, 3), **differences,
    }
    write_figures(output / 'summary.json', result)
    return result


def _end(errors: Mapping[str, float], plan: _Parameters, signals: Signals) -> str:
    """Return the final errors above the tolerances in words."""
    off = [printed(difference_text(error, signals.states[signal], '.2g'))
           + f' of {signal}' * (len(errors) > 1)
           for signal, error in errors.items() if not error <= plan.states[signal].tolerance]
    return f'stays {" and ".join(off)} off' if off else 'settles'


def _draw(path: Path, title: str, run: DemoRun, trajectories: Mapping[str, OptimalTrajectory],
          signals: Signals, scenario: Scenario, box: Coordinates, tuning: Tuning,
          code: ExportedLoop | None) -> None:
    """Draw each signal: states with set-points and training range, inputs with limits."""
    count = len(signals.states) + len(signals.inputs)
    learned: dict[str, Any] = {
        'color': 'tab:green', 'linewidth': 2.5, 'label': 'learned controller'}

    def times(values: Any) -> Any:
        return scenario.step_time + scenario.sample_period * np.arange(len(values))

    with drawing(path, count, 1, sharex=True, size=(9.0, 2.0 + 1.8 * count)) as (figure, panels):
        for i, ((signal, unit), panel) in enumerate(zip(
                signals.states.items(), panels, strict=False)):
            low, high = (float(shown(float(end[i]), unit)) for end in (box.lower, box.upper))
            panel.axhspan(low, high, label='training range', **DRAWN_RANGE)
            if signal in scenario.setpoints:
                setpoint = scenario.setpoints[signal]
                panel.plot([scenario.step_time, run.seconds[-1]],
                           [float(shown(setpoint, unit))] * 2, 'k--', linewidth=1.0,
                           label='set-point')
            panel.plot(run.seconds, shown(run.measured[signal], unit), **learned)
            for name, trajectory in trajectories.items():
                # a course that diverges stays at the edge
                values = np.clip(np.nan_to_num(shown(trajectory.states[:, i], unit), nan=high),
                                 2.0 * low - high, 2.0 * high - low)
                panel.plot(times(values), values, label=name, **_STYLES[name])
            panel.set_ylabel(axis_label(signal, unit))
        for j, ((signal, unit), panel) in enumerate(zip(
                signals.inputs.items(), panels[len(signals.states):], strict=True)):
            low, high = (float(shown(float(end[j]), unit))
                         for end in (tuning.limits.lower, tuning.limits.upper))
            draw_limits(panel, (low, high), 'limits')
            panel.step(run.command_seconds, shown(run.commanded[signal], unit), where='post',
                       **learned)
            if code is not None:
                panel.plot(code.seconds, shown(np.array(code.commands)[:, j], unit), 'o',
                           color='tab:orange', fillstyle='none', markevery=len(code.seconds) // 50,
                           label='exported C code')
                panel.text(
                    0.99, 0.06, f'C code at most {code.largest()[signal]:.1e} [{unit}] off',
                    transform=panel.transAxes, ha='right', fontsize=8)
            for name, trajectory in trajectories.items():
                values = np.clip(np.nan_to_num(shown(trajectory.inputs[:, j], unit), nan=high),
                                 low, high)
                panel.step(times(values), values, where='post', label=name, **_STYLES[name])
            panel.set_ylabel(axis_label(signal, unit))
        panels[0].set_title(title, fontsize=9)
        panels[-1].set(xlabel='plant time [s]', xlim=(0.0, run.seconds[-1]))
        legend(figure, panels, 6 if code is None else 4)


def run_with_panel(plant: str, port: int, output: Path, speed: float) -> dict[str, object]:
    """Run the loop of a plant until Ctrl-C, with the panel."""
    if preset_wiring(plant) is None:
        raise ValueError(f'no demo for the plant {plant!r}: choose one of '
                         f'{", ".join(bundled_plants())}')
    scenario = Scenario({}, plant, duration=0.0, speed=min(speed or _PANEL_SPEED, _PANEL_SPEED))
    with running_loop(scenario, output / 'logs', {'output': output / 'panel.mcap'},
                      panel={'port': port}) as operator:
        print(f'{scenario.speed:g} times real time; Ctrl-C ends it', flush=True)
        operator.run_until(math.inf)
    return {}


def main(args: list[str] | None = None) -> int:
    """Run the demo from the command line."""
    options = read_options(args, __doc__, 'out/demo', 60.0, plant=PLANT)
    demo: Callable[[Path, float], Mapping[str, object]] = (
        partial(run_with_panel, options.plant, options.port) if options.panel
        else run_line if options.plant == LINE and not options.export
        else partial(run_plant, options.plant, options.export))
    return run_demo(demo, options, 'closed_loop.png, closed_loop.mcap and summary.json')
