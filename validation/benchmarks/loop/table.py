# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The figures as text, ratios first."""

from collections.abc import Iterator
from typing import Any


def of_step(figures: dict[str, Any]) -> Iterator[str]:
    """Write the control step beside the naive one."""
    yield (f'{"control step":14}{"ratio":>8}{"median us":>12}{"p99 us":>10}'
           f'{"naive median":>14}{"naive p99":>11}')
    for n_z, one in figures['step'].items():
        yield (f'{f"n_z = {n_z}":14}{figures["step_ratio_to_naive"][n_z]:7.1f}x'
               f'{one["median_us"]:12.0f}{one["p99_us"]:10.0f}{one["naive_median_us"]:14.0f}'
               f'{one["naive_p99_us"]:11.0f}')


def of_latency(figures: dict[str, Any]) -> Iterator[str]:
    """Write the way from measurement to command beside the echo's."""
    latency = figures['latency']
    yield f'{"latency":14}{"ratio":>8}{"controller us":>16}{"echo us":>10}'
    for name, label in (('median', 'median'), ('p99', 'p99')):
        ours, echo = (latency[side][f'{name}_us'] for side in ('controller', 'echo'))
        yield f'{label:14}{figures[f"latency_ratio_{name}"]:8.2f}{ours:16.0f}{echo:10.0f}'


def of_rate(figures: dict[str, Any]) -> Iterator[str]:
    """Write the highest rate that the controller kept up with."""
    rate = figures['max_rate_hz']
    reached = 'no rate' if rate is None else f'{rate:.0f} Hz'
    yield f'keeps up with {reached}; ended because {figures["rate"]["ended_by"]}'


def of_nodes(figures: dict[str, Any]) -> Iterator[str]:
    """Write start-up time, memory, and the speed of lock-step."""
    yield f'first command {figures["startup_seconds"]:.2f} s after the start'
    memory = ', '.join(f'{name} {megabytes:.0f}'
                       for name, megabytes in figures['rss_megabytes'].items())
    yield f'resident memory in MB: {memory}'
    yield f'lock-step runs {figures["speedup_over_real_time"]:.0f} times as fast as the plant'
