# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Declared sizes that are not believed, and bags that would expand beyond reason."""

from collections.abc import Callable
from pathlib import Path
import struct
import tracemalloc

import lz4.frame
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk
import pytest
import zstandard

from koopman_ros.bags import BagReadError, BagWriter, MessageDefinition, read_messages, summary
from support.bag_samples import Sample

WriteBag = Callable[..., Path]

MIB = 2**20


def _with_chunk(path: Path, chunk: Chunk) -> Path:
    """Return an MCAP file that begins with this chunk."""
    builder = RecordBuilder()
    chunk.write(builder)
    path.write_bytes(b'\x89MCAP0\r\n' + builder.end())
    return path


def _chunk(compression: str, data: bytes, declared: int) -> Chunk:
    return Chunk(compression=compression, data=data, message_start_time=0, message_end_time=0,
                 uncompressed_crc=0, uncompressed_size=declared)


def _zstd_bomb(mebibytes: int, declared: bool) -> bytes:
    size = mebibytes * MIB if declared else -1
    compressor = zstandard.ZstdCompressor().compressobj(size=size)
    return b''.join([compressor.compress(bytes(MIB)) for _ in range(mebibytes)]
                    + [compressor.flush()])


@pytest.mark.parametrize(('chunk', 'words'), [
    (_chunk('', b'', 2**60), 'declares 1152921504606846976 bytes'),
    (_chunk('', b'abc', 4), 'a chunk of 3 bytes that declares 4'),
    (_chunk('zstd', _zstd_bomb(100, declared=True), 1000), 'a zstd frame that declares'),
    (_chunk('zstd', _zstd_bomb(100, declared=False), 1000), 'ZstdError'),
    (_chunk('zstd', zstandard.compress(b'abc')[:-1], 3), 'ZstdError'),
    (_chunk('lz4', lz4.frame.compress(bytes(20 * MIB)), 1000), 'a chunk of 1001 bytes'),
    (_chunk('lz4', lz4.frame.compress(b'abc')[:-8], 3), 'a chunk of 0 bytes'),
    (_chunk('lz4', b'\x04"M\x18' + bytes(20), 1000), 'RuntimeError'),
    (_chunk('snappy', b'abc', 3), "compressed with 'snappy'"),
])
def test_chunk_that_is_not_what_it_declares(tmp_path: Path, chunk: Chunk, words: str) -> None:
    path = _with_chunk(tmp_path / 'run.mcap', chunk)
    tracemalloc.start()
    assert list(read_messages(path, recover=True)) == []
    assert not summary(path).complete
    footer = struct.pack('<BQQQI', 2, 20, 0, 0, 0) + b'\x89MCAP0\r\n'
    path.write_bytes(path.read_bytes() + footer)
    with pytest.raises(BagReadError, match=f'is damaged .*{words}'):
        list(read_messages(path))
    assert tracemalloc.get_traced_memory()[1] < 10 * MIB
    tracemalloc.stop()


def test_compressed_file_that_grows_beyond_reason(tmp_path: Path) -> None:
    path = tmp_path / 'run.mcap.zstd'
    path.write_bytes(_zstd_bomb(100, declared=True))
    for function in (read_messages, summary):
        with pytest.raises(BagReadError, match='grows to more than 1000 times its size'):
            function(path)


@pytest.mark.parametrize(('text', 'body'), [
    # a sequence of 4e9 elements whose bytes are not there
    ('Id[] ids\n' + '=' * 80 + '\nMSG: std_msgs/Id\nuint8[16] id\n', b'\xff\xff\xff\xff\x01'),
    ('float64[] x\n', b'\xff\xff\xff\xff\x01'),
    # the string ends before its declared length, with nothing behind it that would notice
    ('string x\n', b'\x09\x00\x00\x00abc'),
])
def test_message_whose_lengths_are_damaged(tmp_path: Path, text: str, body: bytes) -> None:
    path = tmp_path / 'run.mcap'
    with BagWriter(path) as writer:
        writer.add_topic('/x', MessageDefinition('std_msgs/msg/X', text, 'RIHS01_' + 'a' * 64))
        writer.write('/x', b'\x00\x01\x00\x00' + body, 1)
    with pytest.raises(BagReadError, match="the message on '/x' at 1 ns does not decode"):
        list(read_messages(path))


def test_compressed_file_that_is_cut_reads_up_to_there(
    tmp_path: Path, write_bag: WriteBag, samples: list[Sample]
) -> None:
    content = write_bag(tmp_path / 'run.mcap', max_chunk_bytes=1000).read_bytes()
    # blocks of their own, as rosbag2 writes them
    compressor = zstandard.ZstdCompressor().compressobj()
    pieces = [compressor.compress(content[start:start + 1000])
              + compressor.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)
              for start in range(0, len(content), 1000)]
    path = tmp_path / 'cut.mcap.zstd'
    path.write_bytes(b''.join(pieces[:len(pieces) // 2]))
    with pytest.raises(BagReadError, match='is cut short'):
        read_messages(path)
    found = [m.data for m in read_messages(path, recover=True)]
    assert 10 < len(found) < len(samples)
    assert found == [s.data for s in samples[:len(found)]]
