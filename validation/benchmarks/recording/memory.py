# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Writers fed from memory: ours beside mcap's own with the same chunks."""

from collections.abc import Callable, Sequence
from pathlib import Path
import time
from typing import Any

from mcap.writer import CompressionType, Writer

from koopman_ros.bags import BagMessage, BagWriter, message_definition

_TYPE = 'sensor_msgs/msg/Temperature'
_TOPIC = '/temperature'
_COMPRESSIONS = {'none': CompressionType.NONE, 'zstd': CompressionType.ZSTD}


def compare(messages: Sequence[BagMessage], count: int, runs: int, folder: Path) -> dict[str, Any]:
    """
    Return messages per second and processor time of both writers by compression.

    :param messages: what is written, over and over.
    :param count: how many messages make a file.
    :param runs: files by each writer, of which the quickest counts: what else the machine does
        only slows them.
    :param folder: for the files, which are deleted.
    """
    again = [messages[k % len(messages)] for k in range(count)]
    figures: dict[str, Any] = {'messages': count}
    for compression in _COMPRESSIONS:
        seconds: dict[str, list[tuple[float, float]]] = {'plain_mcap': [], 'our_writer': []}
        for _ in range(runs):
            for name, write in (('plain_mcap', _plain), ('our_writer', _ours)):
                seconds[name].append(_timed(write, again, compression, folder / 'memory.mcap'))
        best = {name: tuple(min(column) for column in zip(*found, strict=True))
                for name, found in seconds.items()}
        figures[compression] = {
            name: {'messages_per_second': count / wall, 'cpu_seconds_per_message': cpu / count}
            for name, (wall, cpu) in best.items()}
        figures[compression]['cpu_ratio_to_plain_mcap'] = (
            best['our_writer'][1] / best['plain_mcap'][1])
    return figures


def _timed(write: Callable[[Sequence[BagMessage], str, Path], None],
           messages: Sequence[BagMessage], compression: str, path: Path) -> tuple[float, float]:
    """Return the seconds on the wall and of the processor that writing took."""
    wall, cpu = time.perf_counter(), time.process_time()
    write(messages, compression, path)
    found = time.perf_counter() - wall, time.process_time() - cpu
    path.unlink()
    return found


def _plain(messages: Sequence[BagMessage], compression: str, path: Path) -> None:
    definition = message_definition(_TYPE)
    with path.open('wb') as stream:
        writer = Writer(stream, compression=_COMPRESSIONS[compression])
        writer.start(profile='ros2')
        schema = writer.register_schema(_TYPE, 'ros2msg', definition.text.encode())
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
