# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The demo: bring the reactor 10 K down with the learned lift, and with the linearisation.

The disturbance observer is off, so that what is seen is what each model knows.
"""

from collections.abc import Callable, Mapping
from functools import partial
import math
from pathlib import Path
import time

from koopman_ros.bags import summary
from koopman_ros.demo import reactor
from koopman_ros.demo.console import LiveTable, read_options, run_act
from koopman_ros.demo.loop import run_loop, running_loop, Scenario
from koopman_ros.demo.results import plot, read_run
from koopman_ros.lifting import load
from koopman_ros.parameters.trainer import preset_wiring
from koopman_ros.parameters.wire import shipped
from koopman_ros.reports import write_figures
from koopman_ros.resources import model_path
from koopman_ros.testing import HarnessError

STEP = -10.0  # K
_SETTLED = 0.1  # K
_SHOWN_SPEED = 10.0  # at most, of a loop that a person looks at


def run_demo(output: Path, speed: float) -> dict[str, object]:
    """Run both loops, the linearised one as fast as it can; write and return what came of them."""
    begin = time.monotonic()
    model = load(model_path(reactor.MODEL))
    setpoint = float(model.states.center[0]) + STEP
    scenario = reactor.scenario(reactor.MODEL, setpoint, speed=speed)
    logs = output / 'logs'
    logs.mkdir(parents=True, exist_ok=True)
    bags = [output / 'closed_loop.mcap', output / 'linearised.mcap']
    for old in (*bags, output / 'closed_loop.png', output / 'summary.json'):
        old.unlink(missing_ok=True)

    with LiveTable(f'learned controller ({reactor.MODEL}) without observer, set-point '
                   f'{STEP:+.0f} K after {scenario.step_time:.0f} s', scenario.wiring.signals,
                   scenario.duration) as table:
        run_loop(scenario, bags[0], logs, table.show)
    print('the same with the linearised controller ...', flush=True)
    run_loop(reactor.scenario(reactor.LINEAR_MODEL, setpoint), bags[1], logs)

    learned, linear = (read_run(scenario.wiring, bag) for bag in bags)
    plot(output / 'closed_loop.png', learned, linear, setpoint, scenario.step_time, model,
         reactor.coolant_limits())
    counts = summary(bags[0]).counts
    result: dict[str, object] = {
        'setpoint_kelvin': setpoint,
        'final_error_kelvin': abs(learned.final_error(reactor.TEMPERATURE, setpoint)),
        'linear_final_error_kelvin': abs(linear.final_error(reactor.TEMPERATURE, setpoint)),
        'settling_time_seconds': learned.settling_time(
            reactor.TEMPERATURE, setpoint, scenario.step_time, _SETTLED),
        'measurements': counts['/' + reactor.TEMPERATURE],
        'commands': counts['/' + reactor.COOLANT_SETPOINT],
        'bag_messages': sum(counts.values()),
        'wall_seconds': round(time.monotonic() - begin, 3),
    }
    write_figures(output / 'summary.json', result)
    return result


def run_beside_panel(plant: str, port: int, output: Path, speed: float) -> dict[str, object]:
    """Run the loop of a plant until Ctrl-C, with the panel beside it."""
    if preset_wiring(plant) is None:
        raise ValueError(f'there is no demo of {plant!r}: choose one of {", ".join(shipped())}')
    logs = output / 'logs'
    logs.mkdir(parents=True, exist_ok=True)
    scenario = Scenario({}, plant, duration=0.0, speed=min(speed or _SHOWN_SPEED, _SHOWN_SPEED))
    with running_loop(scenario, logs, {'output': output / 'panel.mcap'},
                      panel={'port': port}) as operator:
        print(f'{scenario.speed:g} times as fast as the clock; Ctrl-C ends it', flush=True)
        operator.run_until(math.inf)
    return {}


def main(args: list[str] | None = None) -> int:
    """Run the demo from the command line: this one, or that of another plant."""
    options = read_options(args, __doc__, 'out/demo', 60.0, plant=reactor.SYSTEM)
    if options.panel:
        act: Callable[[Path, float], Mapping[str, object]] = partial(
            run_beside_panel, options.plant, options.port)
    elif options.plant == reactor.SYSTEM:
        act = run_demo
    else:
        # here, as the optimum of a plant takes scipy's integrators, which the reactor's does not
        from koopman_ros.demo.any_plant import run_plant

        act = partial(run_plant, options.plant)
    return run_act(act, options, (HarnessError, OSError, ValueError),
                   'closed_loop.png, closed_loop.mcap and summary.json')
