# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The figures as text."""

from collections.abc import Iterator
from typing import Any

_NAMES = {'plain_mcap': "mcap's writer", 'our_writer': 'our writer'}


def of_steady(steady: dict[str, Any]) -> Iterator[str]:
    """Write what the recorder took at the steady rate."""
    yield (f'recorder at {steady["rate_hz"]:.0f} Hz: {steady["sent"]} messages sent, '
           f'{steady["recorded"]} recorded, {steady["lost"]} lost; '
           f'{_percent(steady)} of a processor, '
           f'{steady["peak_memory_megabytes"]:.0f} MB of memory')


def of_ladder(figures: dict[str, Any]) -> Iterator[str]:
    """Write how far the rate could be raised."""
    yield f'{"asked":>10}{"sent":>10}{"lost":>10}{"processor":>12}'
    for step in figures['ladder']:
        yield (f'{step["rate_hz"]:7.0f} Hz{step["sent_hz"]:7.0f} Hz{step["lost"]:10d}'
               f'{_percent(step):>12}')
    highest = figures['highest_hz_without_loss']
    reached = 'no rate' if highest is None else f'{highest:.0f} Hz'
    yield f'without loss up to {reached}; ended by: {figures["ladder_ended_by"]}'


def of_memory(figures: dict[str, Any]) -> Iterator[str]:
    """Write the writers and the recorder side by side."""
    yield f'{"":32}{"messages/s":>12}{"CPU us each":>12}{"ratio":>8}'
    found = figures['from_memory']
    for compression in ('none', 'zstd'):
        plain = found[compression]['plain_mcap']['cpu_seconds_per_message']
        for name, label in _NAMES.items():
            one = found[compression][name]
            cpu = one['cpu_seconds_per_message']
            yield (f'{f"{label} from memory, {compression}":32}'
                   f'{one["messages_per_second"]:12.0f}{1e6 * cpu:12.2f}{cpu / plain:8.2f}')
    for step in (figures['steady'], *figures['ladder']):
        cpu = step['cpu_seconds_per_message']
        ratio = figures['recorder_cpu_ratio_to_plain_mcap'][f'{step["rate_hz"]:.0f}']
        rate = f'recorder at {step["rate_hz"]:.0f} Hz'
        yield f'{rate:32}{step["sent_hz"]:12.0f}{1e6 * cpu:12.2f}{ratio:8.2f}'


def _percent(step: dict[str, Any]) -> str:
    return f'{100.0 * step["cpu_share"]:.1f} %'
