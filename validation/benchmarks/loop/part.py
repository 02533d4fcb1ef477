# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The part *loop* of the benchmark: the control step, and the loop across processes."""

from dataclasses import dataclass
import os
from pathlib import Path
import tempfile
from typing import Any

from koopman_ros.reports import machine
from koopman_ros.testing import Harness
from validation.benchmarks.loop import across, step, table
from validation.benchmarks.options import Extent, Options, say, tell

MEANING = {
    'step_us': 'median time of a control step, by n_z; step has the 99th percentiles, too',
    'step_ratio_to_naive': 'how many times as long the same law takes by torch jacrev and '
                           'control.lqr, by n_z; medians of processor time, since a busy machine '
                           'interrupts the longer one more often',
    'latency_ratio_median': 'measurement published to command received, over that of a bare echo',
    'latency_ratio_p99': 'the same for 99th percentiles',
    'max_rate_hz': 'highest rate of measurements at which every one was answered and the median '
                   'answer in the last tenth of the run took less than 20 ms',
    'startup_seconds': "from the start of the controller's process to its first command, median",
    'rss_megabytes': 'resident memory: plant and controller after the lock-step run, trainer and '
                     'echo idle',
    'speedup_over_real_time': 'seconds of the plant per second, in lock-step at one sample a '
                              'second of the plant',
}


@dataclass(frozen=True)
class Plan:
    """One extent of the measurements."""

    coordinates: tuple[int, ...]  #: the n_z of the lifts
    steps: int  #: timed control steps with each lift
    rounds: int  #: of latency, fifty measurements of each side in one
    rate_seconds: float  #: length of a run at one rate
    lowest_rate: float  #: of measurements, Hz
    starts: int  #: of the controller
    plant_seconds: float  #: length of the lock-step loop


PLANS = {
    Extent.QUICK: Plan((2, 3, 4, 5, 6), 200, 4, 0.4, 500.0, 2, 600.0),
    Extent.DEFAULT: Plan((2, 3, 4, 5, 6), 1500, 30, 2.0, 500.0, 5, 3600.0),
    Extent.FULL: Plan((2, 3, 4, 5, 6), 20_000, 400, 10.0, 250.0, 20, 86_400.0),
}


def run(options: Options) -> dict[str, Any]:
    """Measure the control step and the loop, each beside its like."""
    plan = PLANS[options.extent]
    figures: dict[str, Any] = {'machine': machine('numpy', 'scipy', 'torch', 'control'),
                               'extent': options.extent.value, 'meaning': MEANING}
    _add_steps(figures, plan)
    options.save(figures)
    say(table.of_step(figures))
    with tempfile.TemporaryDirectory() as name, Harness(Path(name), name='probe') as harness:
        tell('loop: latency beside an echo')
        latency = figures['latency'] = across.latency(harness, plan.rounds)
        for quantile in ('median', 'p99'):
            ours, echo = (latency[side][f'{quantile}_us'] for side in ('controller', 'echo'))
            figures[f'latency_ratio_{quantile}'] = ours / echo
        options.save(figures)
        say(table.of_latency(figures))
        tell('loop: highest rate')
        figures['rate'] = across.highest_rate(
            harness, plan.rate_seconds, plan.lowest_rate)
        figures['max_rate_hz'] = figures['rate']['max_rate_hz']
        options.save(figures)
        say(table.of_rate(figures))
        tell('loop: start-up, memory and lock-step')
        figures['startup'] = across.start_up(harness, plan.starts)
        figures['startup_seconds'] = figures['startup']['seconds']
        figures['lockstep'] = across.lockstep(harness, plan.plant_seconds)
        figures['speedup_over_real_time'] = figures['lockstep']['speed_over_real_time']
        figures['rss_megabytes'] = {**figures['lockstep'].pop('rss_megabytes'),
                                    'echo': latency['echo_rss_megabytes']}
        say(table.of_nodes(figures))
    figures['machine']['load_at_end'] = os.getloadavg()[0]
    return figures


def _add_steps(figures: dict[str, Any], plan: Plan) -> None:
    """Time the control step by the number of coordinates."""
    tell(f'loop: {plan.steps} control steps with each lift')
    found = figures['step'] = step.measured(plan.coordinates, plan.steps)
    figures['step_us'] = {n_z: one['median_us'] for n_z, one in found.items()}
    figures['step_ratio_to_naive'] = {
        n_z: one['naive_cpu_median_us'] / one['cpu_median_us'] for n_z, one in found.items()}
