# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A trainer that records what a publisher sends at a steady rate, and what that takes."""

from collections.abc import Mapping
import itertools
import json
import os
from pathlib import Path
import subprocess
import sys
from typing import Any

from koopman_ros.bags import read_messages
from koopman_ros.testing import NodeProcess

TOPIC = '/temperature'
# A publisher that needs this much longer than it should does not keep up.
_LATE = 1.02


def record(bag: Path, rate: float, seconds: float, environment: Mapping[str, str]
           ) -> dict[str, Any]:
    """
    Record a stream and return its figures.

    :param bag: new file that is left for the caller.
    :param rate: messages per second.
    :param seconds: length of the stream, s.
    :param environment: variables of the ROS domain.
    """
    count = round(rate * seconds)
    with NodeProcess('trainer', {'output': bag}, bag.with_suffix('.log'), environment) as trainer:
        command = [sys.executable, '-m', 'validation.benchmarks.recording.publisher',
                   '--rate', str(rate), '--count', str(count)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as publisher:
            assert publisher.stdout is not None
            publisher.stdout.readline()
            before = _processor_seconds(trainer.process.pid)
            said = publisher.stdout.readline()
            used = _processor_seconds(trainer.process.pid) - before
            memory = _peak_megabytes(trainer.process.pid)
        if publisher.returncode:
            raise RuntimeError(f'the publisher failed; the trainer said {trainer.output()}')
        trainer.stop()
    sent = json.loads(said)
    numbers = [m.message.header.stamp.sec * 10 ** 9 + m.message.header.stamp.nanosec
               for m in read_messages(bag, [TOPIC])]
    return {
        'rate_hz': rate,
        'sent': count,
        'recorded': len(numbers),
        'lost': count - len(set(numbers)),
        'in_order': all(a < b for a, b in itertools.pairwise(numbers)),
        'sent_hz': count / sent['seconds'],
        'publisher_kept_up': sent['seconds'] < _LATE * seconds,
        'publisher_latest_seconds': sent['latest_seconds'],
        'cpu_share': used / sent['seconds'],
        'cpu_seconds_per_message': used / count,
        'peak_memory_megabytes': memory,
        'bag_megabytes': bag.stat().st_size / 1e6,
    }


def _processor_seconds(process: int) -> float:
    """Return the processor time that all threads of a process have used."""
    # after the name, which may hold anything but ends with the last bracket: state is field 3
    fields = Path(f'/proc/{process}/stat').read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def _peak_megabytes(process: int) -> float:
    lines = Path(f'/proc/{process}/status').read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith('VmHWM')) * 1024 / 1e6
