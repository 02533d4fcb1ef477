# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The demo of a measured disturbance: the feed of the reactor becomes 5 K warmer, in two loops.

In one of them the controller receives the measured feed temperature, and compensates the effect
that its model has learned. In the other it does not, and the disturbance observer has to estimate
that effect.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from koopman_ros.core.arrays import Array
from koopman_ros.core.plots import drawing, legend, write_figures
from koopman_ros.core.units import shown, unit_label
from koopman_ros.demo import reactor
from koopman_ros.demo.console import LiveTable, read_options, run_demo
from koopman_ros.demo.loop import running_loop, Scenario
from koopman_ros.demo.results import DemoRun, read_run, read_signal

MODEL, FEED = 'reactor_feed', 'feed_temperature'
STEP = 5.0  # K
_STEP_TIME, _AFTER = 60.0, 240.0  # s
_BEFORE = 20.0  # s before the step that are drawn


@dataclass(frozen=True)
class _DisturbedRun:
    """A recorded loop, with the feed temperature; times in s since the first measurement."""

    loop: DemoRun
    feed_seconds: Array
    feed: Array  # in K

    @property
    def step(self) -> float:
        """Time of the step."""
        return float(self.feed_seconds[np.argmax(self.feed > self.feed[0] + 0.5 * STEP)])

    @property
    def peak(self) -> float:
        """Largest distance of the temperature from that before the step, in K."""
        kelvin = self.loop.measured[reactor.TEMPERATURE]
        before = kelvin[self.loop.seconds < self.step][-1]
        return float(np.max(np.abs(kelvin - before)))


def run_disturbance(output: Path, speed: float) -> dict[str, object]:
    """Run both loops, and write and return their figures."""
    runs = {}
    for name, topic in (('measured', FEED), ('unmeasured', f'not_{FEED}')):
        scenario = Scenario(
            {}, duration=0.0, speed=speed, disturbances=(f'{FEED} [K]',),
            controller={'model': MODEL, f'{FEED}.topic': topic})
        logs, bag = output / f'logs_{name}', output / f'{name}.mcap'
        bag.unlink(missing_ok=True)
        table = LiveTable(f'feed {STEP:g} K warmer after {_STEP_TIME:g} s, {name}',
                          scenario.wiring.signals, _STEP_TIME + _AFTER)
        with running_loop(scenario, logs, {'output': bag}, table.show) as operator:
            operator.run_until(_STEP_TIME)
            operator.set('plant', **{f'constants.{FEED}': reactor.constant(FEED) + STEP})
            operator.run_until(operator.seconds + _AFTER)
            operator.wait_for_recording()
        runs[name] = _read(scenario, bag)
    peaks = {name: run.peak for name, run in runs.items()}
    result: dict[str, object] = {
        'feed_step_kelvin': STEP, 'peak_measured_kelvin': peaks['measured'],
        'peak_unmeasured_kelvin': peaks['unmeasured'],
        'peak_ratio': peaks['measured'] / peaks['unmeasured']}
    _draw(output / 'disturbance.png', runs)
    write_figures(output / 'summary.json', result)
    return result


def _read(scenario: Scenario, bag: Path) -> _DisturbedRun:
    wiring = scenario.wiring
    return _DisturbedRun(read_run(wiring, bag), *read_signal(
        bag, wiring.measured_disturbances[FEED], 'K'))


def _draw(path: Path, runs: dict[str, _DisturbedRun]) -> None:
    """Draw feed, temperature and coolant of both loops over the time since the step."""
    with drawing(path, 3, 1, size=(9.0, 8.0), sharex=True) as (figure, panels):
        for (name, run), color in zip(runs.items(), ('tab:green', 'tab:red'), strict=True):
            loop = run.loop
            for panel, times, values in (
                    (panels[0], run.feed_seconds, run.feed),
                    (panels[1], loop.seconds, loop.measured[reactor.TEMPERATURE]),
                    (panels[2], loop.command_seconds,
                     loop.commanded[reactor.COOLANT_TEMPERATURE])):
                panel.step(times - run.step, shown(values, 'K'), where='post', color=color,
                           label=f'feed {name}: peak {run.peak:.3g} K')
        for panel, signal in zip(panels, (FEED, reactor.TEMPERATURE, reactor.COOLANT_TEMPERATURE),
                                 strict=True):
            panel.set_ylabel(f'{signal.replace("_", " ")} [{unit_label("K")}]')
        panels[0].set_title('The feed becomes 5 K warmer')
        panels[-1].set(xlabel='time since the step [s]', xlim=(-_BEFORE, _AFTER))
        legend(figure, panels, 2)


def main(args: list[str] | None = None) -> int:
    """Run the demo from the command line."""
    options = read_options(args, __doc__, 'out/demo-disturbance', 60.0)
    return run_demo(run_disturbance, options,
                    'disturbance.png, measured.mcap, unmeasured.mcap and summary.json')
