# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The demo of an input that acts late, compared with its optimum, PI and a Smith predictor.

The tank of the plant `heated_line` is heated through a line, by a valve of equal percentage. Its
temperature steps up and down, then the feed gets colder, which is measured.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from koopman_ros.core.arrays import Array
from koopman_ros.core.message_fields import place
from koopman_ros.core.paths import model_path
from koopman_ros.core.plots import draw_limits, drawing, legend, write_figures
from koopman_ros.core.units import display_unit, shown, to_celsius, unit_label
from koopman_ros.demo.console import LiveTable
from koopman_ros.demo.late_input import FirstOrder, LateRun, pi_law, Piece, Response
from koopman_ros.demo.loop import FIRST_STAMP_NS, running_loop, Scenario
from koopman_ros.demo.results import read_run, read_signal
from koopman_ros.model import load
from koopman_ros.parameters.controller import table_of
from koopman_ros.parameters.plant import PlantTable
from koopman_ros.parameters.signal_topics import CONTROLLER_INTERNALS, EVENT_LOG
from koopman_ros.plants import Process, sensor_noise

PLANT = 'heated_line'
TEMPERATURE, FEED, VALVE, CONCENTRATION = (
    'temperature', 'feed_temperature', 'valve', 'concentration')
STEPS = ((300.0, 333.15), (2100.0, 321.15))  # s, K
FEED_TIME, COLD = 3900.0, 285.15  # s, K
_DURATION = 5400.0  # s
_STYLES: dict[str, dict[str, Any]] = {
    'learned': {'color': 'tab:green', 'linewidth': 2.5},
    'optimum': {'color': 'black', 'linestyle': (0, (1, 2)), 'linewidth': 1.5},
    'PI': {'color': 'tab:red', 'linewidth': 1.0},
    'Smith predictor': {'color': 'tab:orange', 'linewidth': 1.0}}


def run_line(output: Path, speed: float) -> dict[str, object]:
    """Run the loop, compute the others, and write and return the figures."""
    scenario = Scenario({TEMPERATURE: STEPS[0][1]}, PLANT, STEPS[0][0], 0.0,
                        PlantTable({'system': PLANT}).snapshot({}).sample_period, speed,
                        (f'{FEED} [K]',))
    wiring, logs, bag = scenario.wiring, output / 'logs', output / 'closed_loop.mcap'
    for old in (bag, output / 'closed_loop.png', output / 'summary.json'):
        old.unlink(missing_ok=True)
    table = LiveTable(f'heated line: temperature in two steps, feed colder after {FEED_TIME:g} s',
                      wiring.signals, _DURATION)
    topics = [*wiring.topics, CONCENTRATION, CONTROLLER_INTERNALS, EVENT_LOG]
    with running_loop(scenario, logs, {'output': bag, 'topics': topics}, table.show) as operator:
        for at, kelvin in STEPS[1:]:
            operator.request_setpoints({TEMPERATURE: kelvin}, at)
        operator.run_until(FEED_TIME)
        operator.set('plant', **{f'constants.{FEED}': to_celsius(COLD)})
        operator.run_until(operator.seconds + _DURATION - FEED_TIME)
        operator.wait_for_recording()

    run, feed = read_run(wiring, bag), read_signal(
        bag, wiring.measured_disturbances[FEED], 'K')
    colder = feed[0][np.argmax(feed[1] < 0.5 * (feed[1][0] + COLD))]
    # a plant in lock-step goes on while it is given the constant, and until it is stopped
    commands = run.commanded[VALVE][run.command_seconds <= colder + _DURATION - FEED_TIME]
    responses = _responses(commands, round(colder / scenario.sample_period))
    best, seconds = responses['optimum'], scenario.sample_period * np.arange(float(len(commands)))
    result: dict[str, object] = {'unit': 'K', 'feed_step': COLD - float(feed[1][0])} | {
        f'{name.lower().replace(" ", "_")}': {
            'cost_by_optimum': response.cost / best.cost, **_figures(response, seconds, colder)}
        for name, response in responses.items()}
    analysed = read_signal(bag, place(CONCENTRATION, CONCENTRATION, 'mol/L'), 'mol/L')
    estimated = read_signal(bag, replace(
        place(CONTROLLER_INTERNALS, CONCENTRATION, 'mol/L'),
        field=f'position[estimated_{CONCENTRATION} [mol/L]]'), 'mol/L')
    _draw(output / 'closed_loop.png', seconds, responses, feed, analysed, estimated)
    write_figures(output / 'summary.json', result)
    return result


def _responses(commands: Array, colder: int) -> dict[str, Response]:
    """Return the recorded run on the plant's equations, and those of the others, by name."""
    table = PlantTable({'system': PLANT})
    values = table.snapshot({})
    system, actuator, samples = table.system(values), table.actuator(values), len(commands)
    cold = table.system(replace(values, constants={
        **values.constants, FEED: to_celsius(COLD)}))
    u, period = actuator.position(system.nominal_input), values.sample_period
    process = Process(system, FIRST_STAMP_NS, system.nominal_state, u, actuator, u)
    i = system.state_names.index(TEMPERATURE)
    wanted = [(0, float(process.x[i])), *((round(at / period), kelvin) for at, kelvin in STEPS)]
    tuning = table_of(load(model_path(PLANT)), {'system': PLANT}).snapshot({}).tuning
    noise = np.array([[sensor_noise(state.measurement_noise, values.seed, n, j)
                       for j, state in enumerate(values.states.values())]
                      for n in range(samples)])
    run = LateRun(process, [
        *(Piece(begin, system, {TEMPERATURE: kelvin}) for begin, kelvin in wanted),
        Piece(colder, cold, {TEMPERATURE: wanted[-1][1]})], period, samples,
        tuning.state_weight, tuning.input_weight, noise)

    def setpoint(n: int) -> float:
        return [kelvin for begin, kelvin in wanted if begin <= n][-1]

    model = FirstOrder.of(process, TEMPERATURE, period)
    return {'learned': run.under(lambda n, _: commands[n:n + 1]), 'optimum': run.optimum(), **{
        name: run.under(pi_law(
            model, (float(tuning.limits.lower[0]), float(tuning.limits.upper[0])),
            (wanted[0][1], float(u[0])), i, setpoint, period, predicts=predicts))
        for name, predicts in (('PI', False), ('Smith predictor', True))}}


def _figures(response: Response, seconds: Array, colder: float) -> dict[str, float]:
    """Return how far the temperature goes beyond its set-points, and from it by the feed."""
    kelvin = response.states[:, 1]
    (first, high), (second, low) = STEPS
    return {'overshoot_up': float(np.max(kelvin[(seconds > first) & (seconds <= second)]) - high),
            'overshoot_down': float(low - np.min(kelvin[
                (seconds > second) & (seconds <= colder)])),
            'feed_peak': float(np.max(np.abs(kelvin[seconds > colder] - low))),
            'final_error': float(abs(np.mean(kelvin[-60:]) - low))}


def _draw(path: Path, seconds: Array, responses: Mapping[str, Response],
          feed: tuple[Array, Array], analysed: tuple[Array, Array],
          estimated: tuple[Array, Array]) -> None:
    """Draw temperature, valve, concentration and feed over minutes."""
    minutes, best = seconds / 60.0, responses['optimum'].cost
    with drawing(path, 4, 1, sharex=True, size=(9.0, 9.0), gridspec_kw={
            'height_ratios': (6, 4, 4, 3)}) as (figure, panels):
        temperature, valve, concentration, cold = panels
        edges = [*(at for at, _ in STEPS), seconds[-1]]
        for (at, kelvin), end in zip(STEPS, edges[1:], strict=True):
            temperature.plot([at / 60.0, end / 60.0], [to_celsius(kelvin)] * 2, 'k--',
                             linewidth=1.0, label='set-point')
        for name, response in responses.items():
            temperature.plot(minutes, shown(response.states[:, 1], 'K'), label=name,
                             **_STYLES[name])
            valve.step(minutes, response.commands[:, 0], where='post', label=name, **_STYLES[name])
        draw_limits(valve, (0.0, 100.0), 'limits')
        concentration.plot(minutes, responses['learned'].states[:, 0], color='tab:gray',
                           linewidth=2.5, label='true')
        concentration.plot(estimated[0] / 60.0, estimated[1], color='tab:purple',
                           linewidth=1.0, label='estimated')
        concentration.plot(analysed[0] / 60.0, analysed[1], '.', color='tab:blue',
                           label='analyser, 2 min late')
        cold.step(feed[0] / 60.0, shown(feed[1], 'K'), where='post', color='tab:blue')
        for panel, name, unit in zip(panels, (TEMPERATURE, VALVE, CONCENTRATION, 'feed'), (
                'K', 'percent', 'mol/L', 'K'), strict=True):
            panel.set_ylabel(f'{name} [{unit_label(display_unit(unit))}]')
        temperature.set_title(
            'heated line, 45 s late. Within the same limits the learned controller costs '
            f'{responses["learned"].cost / best:.3f} times the optimum,\n' + ', '.join(
                f'{name} {responses[name].cost / best:.3f} times'
                for name in ('PI', 'Smith predictor')), fontsize=9)
        panels[-1].set(xlabel='plant time [min]', xlim=(0.0, minutes[-1]))
        legend(figure, panels, 5)
