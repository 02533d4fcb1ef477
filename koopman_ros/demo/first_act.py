# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The demo: bring the reactor 10 K down with the learned lift, and with the linearisation.

The disturbance observer is off, so that what is seen is what each model knows.
"""

from dataclasses import replace
from pathlib import Path
import time

from koopman_ros.bags import summary
from koopman_ros.demo.console import LiveTable, read_options, run_act
from koopman_ros.demo.loop import run_loop, Scenario
from koopman_ros.demo.results import plot, read_run
from koopman_ros.lifting import load
from koopman_ros.parameters.controller import ControllerParameters
from koopman_ros.reports import write_figures
from koopman_ros.resources import model_path
from koopman_ros.ros import topics
from koopman_ros.testing import HarnessError

STEP = -10.0  # K
LINEAR_MODEL = 'reactor_linear'


def run_demo(output: Path, speed: float) -> dict[str, object]:
    """Run both loops, the linearised one as fast as it can; write and return what came of them."""
    begin = time.monotonic()
    parameters = ControllerParameters()
    model = load(model_path(parameters.model))
    scenario = Scenario(parameters.model, float(model.states.center[0]) + STEP, speed=speed)
    logs = output / 'logs'
    logs.mkdir(parents=True, exist_ok=True)
    bags = [output / 'closed_loop.mcap', output / 'linearised.mcap']
    for old in (*bags, output / 'closed_loop.png', output / 'summary.json'):
        old.unlink(missing_ok=True)

    with LiveTable(f'learned controller ({parameters.model}) without observer, set-point '
                   f'{STEP:+.0f} K after {scenario.step_time:.0f} s') as table:
        run_loop(scenario, bags[0], logs, table.show)
    print('the same with the linearised controller ...', flush=True)
    linear_scenario = replace(scenario, model=LINEAR_MODEL, speed=0.0)
    run_loop(linear_scenario, bags[1], logs)

    learned, linear = read_run(bags[0]), read_run(bags[1])
    plot(output / 'closed_loop.png', learned, linear, scenario.setpoint, scenario.step_time,
         model, parameters)
    counts = summary(bags[0]).counts
    result: dict[str, object] = {
        'setpoint_kelvin': scenario.setpoint,
        'final_error_kelvin': abs(learned.final_error(scenario.setpoint)),
        'linear_final_error_kelvin': abs(linear.final_error(scenario.setpoint)),
        'settling_time_seconds': learned.settling_time(scenario.setpoint, scenario.step_time),
        'measurements': counts['/' + topics.TEMPERATURE],
        'commands': counts['/' + topics.COOLANT_SETPOINT],
        'bag_messages': sum(counts.values()),
        'wall_seconds': round(time.monotonic() - begin, 3),
    }
    write_figures(output / 'summary.json', result)
    return result


def main(args: list[str] | None = None) -> int:
    """Run the demo from the command line."""
    options = read_options(args, __doc__, 'out/demo', 60.0)
    return run_act(run_demo, options, (HarnessError, OSError),
                   'closed_loop.png, closed_loop.mcap and summary.json')
