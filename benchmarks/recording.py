# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The cost of recording: a trainer sent numbered messages, our writer and mcap's from memory."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
import itertools
from pathlib import Path
import sys
import tempfile
import time
from typing import Any

from mcap.writer import CompressionType, Writer
from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Temperature

from benchmarks.process import processor_seconds
from koopman_ros.core.plots import table
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.records import BagMessage, BagWriter, message_definition, read_messages
from koopman_ros.ros.time_conversion import stamp_nanoseconds
from koopman_ros.testing import Harness

PACKAGES = ('mcap',)
_TOPIC, _TYPE = '/temperature', 'sensor_msgs/msg/Temperature'
_COMPRESSIONS = {'none': CompressionType.NONE, 'zstd': CompressionType.ZSTD}
_STEADY_RATE = 1000.0  # Hz
_DEPTH = 1000  # messages kept for the trainer
_TIMEOUT = 30.0  # s, until the trainer has everything


@dataclass(frozen=True)
class RecordingPlan:
    """One extent of the measurements."""

    seconds: float  #: length of the steady stream
    messages: int  #: in each file written from memory
    runs: int  #: files by each writer


PLANS = {'quick': RecordingPlan(10.0, 20_000, 2), 'default': RecordingPlan(60.0, 100_000, 3)}


def measure(plan: RecordingPlan, figures: dict[str, Any], folder: Path) -> Iterator[str]:
    """Measure a minute at 1 kHz, and the writers side by side."""
    with tempfile.TemporaryDirectory() as name:
        steady = figures['steady'] = _record(Path(name, 'steady'), _STEADY_RATE, plan.seconds)
        yield (f'recorder at {_STEADY_RATE:.0f} Hz: {steady["sent"]} messages sent, '
               f'{steady["recorded"]} recorded, {steady["lost"]} lost; '
               f'{steady["cpu_share"]:.1%} of a processor, '
               f'{steady["peak_memory_megabytes"]:.0f} MB of memory')
        messages = list(read_messages(Path(name, 'steady', 'bag.mcap'), [_TOPIC]))
        yield _compare(figures, messages, plan, Path(name, 'memory.mcap'))


def _tell(label: str) -> None:
    print(f'recording: {label}', file=sys.stderr, flush=True)


def _record(folder: Path, rate: float, seconds: float) -> dict[str, Any]:
    """Let a trainer record a stream into ``bag.mcap`` of a new folder; return its figures."""
    _tell(f'{seconds:g} s at {rate:.0f} Hz')
    folder.mkdir()
    bag, count = folder / 'bag.mcap', round(rate * seconds)
    with Harness(folder) as harness:
        trainer = harness.start('trainer', {'output': bag})
        publisher = harness.speak(Temperature, _TOPIC, QoSProfile(depth=_DEPTH), to='trainer')
        before = processor_seconds(trainer.process.pid)
        took = _publish(publisher, rate, count)
        if not publisher.wait_for_all_acked(Duration(seconds=_TIMEOUT)):
            raise RuntimeError(f'the trainer does not acknowledge within {_TIMEOUT:g} s')
        used = processor_seconds(trainer.process.pid) - before
        status = Path(f'/proc/{trainer.process.pid}/status').read_text()
        peak = int(status.partition('VmHWM:')[2].split()[0]) * 1024 / 1e6
        trainer.stop()
    numbers = [stamp_nanoseconds(m.message.header.stamp) for m in read_messages(bag, [_TOPIC])]
    return {
        'rate_hz': rate,
        'sent': count,
        'recorded': len(numbers),
        'lost': count - len(set(numbers)),
        'in_order': all(a < b for a, b in itertools.pairwise(numbers)),
        'sent_hz': count / took,
        'cpu_share': used / took,
        'cpu_seconds_per_message': used / count,
        'peak_memory_megabytes': peak,
        'bag_megabytes': bag.stat().st_size / 1e6,
    }


def _publish(publisher: Publisher, rate: float, count: int) -> float:
    """Publish on schedule, the number k as stamp in ns; return the s it took."""
    message, begun = Temperature(), time.monotonic()
    for k in range(count):
        due = begun + k / rate
        if (wait := due - time.monotonic()) > 0.0:
            time.sleep(wait)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(k, NANOSECONDS)
        message.temperature = float(k)
        publisher.publish(message)
    return time.monotonic() - begun


def _compare(figures: dict[str, Any], messages: Sequence[BagMessage], plan: RecordingPlan,
             path: Path
             ) -> str:
    """Time the writers, of whose runs the quickest counts: other programs only slow them."""
    _tell(f'{plan.messages} messages from memory')
    again = [messages[k % len(messages)] for k in range(plan.messages)]
    found = figures['from_memory'] = {'messages': plan.messages}
    rows = []
    for compression in _COMPRESSIONS:
        seconds = [[_timed(write, again, compression, path) for write in (_plain, _ours)]
                   for _ in range(plan.runs)]
        best = {name: tuple(map(min, zip(*taken, strict=True))) for name, taken in zip(
            ('plain_mcap', 'our_writer'), zip(*seconds, strict=True), strict=True)}
        found[compression] = {
            name: {'messages_per_second': len(again) / wall,
                   'cpu_seconds_per_message': cpu / len(again)}
            for name, (wall, cpu) in best.items()}
        ratio = found[compression]['cpu_ratio_to_plain_mcap'] = (
            best['our_writer'][1] / best['plain_mcap'][1])
        for label, name, one in (("mcap's writer", 'plain_mcap', 1.0),
                                 ('our writer', 'our_writer', ratio)):
            wall, cpu = best[name]
            rows.append(_row(f'{label} from memory, {compression}', len(again) / wall,
                             cpu / len(again), one))
    plain = found['none']['plain_mcap']['cpu_seconds_per_message']
    steady = figures['steady']
    cpu = steady['cpu_seconds_per_message']
    ratio = figures['recorder_cpu_ratio_to_plain_mcap'] = cpu / plain
    rows.append(_row(f'recorder at {_STEADY_RATE:.0f} Hz', steady['sent_hz'], cpu, ratio))
    return table(('', 'messages/s', 'CPU us each', 'ratio'), rows)


def _row(name: str, rate: float, cpu: float, ratio: float) -> tuple[str, ...]:
    return name, f'{rate:.0f}', f'{1e6 * cpu:.2f}', f'{ratio:.2f}'


def _timed(write: Callable[[Sequence[BagMessage], str, Path], None],
           messages: Sequence[BagMessage], compression: str, path: Path) -> tuple[float, float]:
    """Return the seconds on the wall and of the processor that writing took."""
    wall, cpu = time.perf_counter(), time.process_time()
    write(messages, compression, path)
    found = time.perf_counter() - wall, time.process_time() - cpu
    path.unlink()
    return found


def _plain(messages: Sequence[BagMessage], compression: str, path: Path) -> None:
    with path.open('wb') as stream:
        writer = Writer(stream, compression=_COMPRESSIONS[compression])
        writer.start(profile='ros2')
        definition = message_definition(_TYPE).text
        schema = writer.register_schema(_TYPE, 'ros2msg', definition.encode())
        channel = writer.register_channel(_TOPIC, 'cdr', schema)
        for k, message in enumerate(messages):
            writer.add_message(channel, message.log_time_ns, message.data,
                               message.publish_time_ns, k)
        writer.finish()


def _ours(messages: Sequence[BagMessage], compression: str, path: Path) -> None:
    with BagWriter(path, compression=compression) as writer:
        writer.add_topic(_TOPIC, message_definition(_TYPE))
        for message in messages:
            writer.write(_TOPIC, message.data, message.log_time_ns, message.publish_time_ns)
