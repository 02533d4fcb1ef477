# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Bags of some kilobytes that would take gigabytes or hours are refused in a bounded process."""

from pathlib import Path
import subprocess
import sys

from mcap.writer import CompressionType, IndexType, Writer
import pytest

from support.bag_samples import NUMBER, number, TEXT, text

# reads a bag with less memory and time than there is, then without
PROGRAM = """
import signal
import sys
from koopman_ros import records
from koopman_ros.records import limits
limits._MEMORY_SHARE, limits._SECONDS = map(float, sys.argv[2:])
try:
    with limits.bounded_reading([sys.argv[1]]):
        print(sum(1 for _ in records.read_messages(sys.argv[1], ['/x'], recover=True)))
except records.BagReadError as error:
    print(error)
assert signal.getsignal(signal.SIGXCPU) is signal.SIG_DFL
print(records.summary(sys.argv[1]).message_count)
"""


def bag(path: Path, data: bytes, count: int) -> Path:
    """Write one message many times, into chunks that shrink as far as possible."""
    with path.open('wb') as stream:
        writer = Writer(stream, chunk_size=2**24, compression=CompressionType.ZSTD,
                        index_types=IndexType.NONE)
        writer.start('ros2')
        kind = NUMBER if data == number(0.0) else TEXT
        schema = writer.register_schema(kind.type_name, 'ros2msg', kind.text.encode())
        channel = writer.register_channel('/x', 'cdr', schema)
        for _ in range(count):
            writer.add_message(channel, 0, data, 0)
        writer.finish()
    return path


@pytest.mark.parametrize(('data', 'count', 'memory', 'seconds', 'said'), [
    pytest.param(number(0.0), 30_000, 0.5, 60.0, '30000', id='enough'),
    pytest.param(number(0.0), 400_000, 0.5, -2.0, 'the bags take more than', id='time'),
    pytest.param(text(bytes(2**28)), 1, 1e-3, 60.0, 'memory does not suffice', id='memory'),
])
def test_reading_within_memory_and_time(
    tmp_path: Path, data: bytes, count: int, memory: float, seconds: float, said: str
) -> None:
    path = bag(tmp_path / 'run.mcap', data, count)
    assert path.stat().st_size < 2**17
    ended = subprocess.run(
        [sys.executable, '-c', PROGRAM, str(path), str(memory), str(seconds)],
        capture_output=True, text=True, timeout=120, check=False)
    assert ended.stderr == ''
    first, last = ended.stdout.splitlines()
    assert first.startswith(said)
    # the limits have ended with the context
    assert last == str(count)
