# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The part *recording* of the benchmark: a minute at 1 kHz, a ladder of rates, and from memory."""

from collections.abc import Mapping
from dataclasses import dataclass
import os
from pathlib import Path
import tempfile
from typing import Any

from koopman_ros.bags import read_messages
from koopman_ros.reports import machine
from koopman_ros.testing import isolated_domain
from validation.benchmarks.options import Extent, Options, say, tell
from validation.benchmarks.recording import memory, stream, table

_STEADY_RATE = 1000.0  # Hz


@dataclass(frozen=True)
class Plan:
    """One extent of the measurements."""

    seconds: float  #: length of the steady stream
    rates: tuple[float, ...]  #: of the ladder, Hz
    ladder_seconds: float  #: length of the stream on each step of the ladder
    messages: int  #: in each file written from memory
    runs: int  #: files by each writer


PLANS = {
    Extent.QUICK: Plan(10.0, (4e3, 16e3), 1.0, 20_000, 2),
    Extent.DEFAULT: Plan(60.0, (2e3, 4e3, 8e3, 16e3, 32e3, 64e3), 5.0, 100_000, 3),
    Extent.FULL: Plan(600.0, (2e3, 4e3, 8e3, 16e3, 24e3, 32e3, 48e3, 64e3), 20.0, 500_000, 5),
}


def run(options: Options) -> dict[str, Any]:
    """Measure the recorder and the writers side by side."""
    plan = PLANS[options.extent]
    figures: dict[str, Any] = {'machine': machine('mcap'), 'extent': options.extent.value}
    with tempfile.TemporaryDirectory() as name, isolated_domain() as environment:
        folder = Path(name)
        tell(f'recording: {plan.seconds:g} s at {_STEADY_RATE:.0f} Hz')
        steady = stream.record(folder / 'steady.mcap', _STEADY_RATE, plan.seconds, environment)
        figures['steady'] = steady
        options.save(figures)
        say(table.of_steady(steady))
        messages = list(read_messages(folder / 'steady.mcap', [stream.TOPIC]))
        figures.update(_climbed(plan, folder, environment))
        options.save(figures)
        say(table.of_ladder(figures))
        tell(f'recording: {plan.messages} messages from memory')
        figures['from_memory'] = memory.compare(messages, plan.messages, plan.runs, folder)
        plain = figures['from_memory']['none']['plain_mcap']['cpu_seconds_per_message']
        figures['recorder_cpu_ratio_to_plain_mcap'] = {
            f'{step["rate_hz"]:.0f}': step['cpu_seconds_per_message'] / plain
            for step in (steady, *figures['ladder'])}
        say(table.of_memory(figures))
    figures['machine']['load_at_end'] = os.getloadavg()[0]
    return figures


def _climbed(plan: Plan, folder: Path, environment: Mapping[str, str]) -> dict[str, Any]:
    """Raise the rate until messages are lost or the publisher does not keep up."""
    steps: list[dict[str, Any]] = []
    highest, ended = None, 'the last step of the ladder'
    for rate in plan.rates:
        tell(f'recording: {plan.ladder_seconds:g} s at {rate:.0f} Hz')
        bag = folder / f'{rate:.0f}.mcap'
        step = stream.record(bag, rate, plan.ladder_seconds, environment)
        bag.unlink()
        steps.append(step)
        if not step['lost']:
            highest = step['sent_hz']
        if reasons := [reason for reason, holds in (
                ('messages were lost', step['lost']),
                ('the publisher did not keep up', not step['publisher_kept_up'])) if holds]:
            ended = ' and '.join(reasons)
            break
    return {'ladder': steps, 'highest_hz_without_loss': highest, 'ladder_ended_by': ended}
