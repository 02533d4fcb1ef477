# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Bags opened by two independent readers: mcap's own, and the rosbags package."""

from collections.abc import Callable
import importlib
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
import pytest

from koopman_ros.bags import message_definition
from support.bag_samples import OFFERED_QOS, record, ROUNDS, Sample, TOPICS

highlevel = importlib.import_module('rosbags.highlevel')
rosbag2 = importlib.import_module('rosbags.rosbag2')

WriteBag = Callable[..., Path]

FORMS = pytest.mark.parametrize(('name', 'options'), [
    ('run', {}), ('run', {'compression': 'zstd', 'max_file_bytes': 4000}), ('run.mcap', {}),
    *(('run.mcap', {'compression': compression, 'max_chunk_bytes': 2000})
      for compression in ('zstd', 'lz4'))])


@FORMS
def test_mcap_reader_decodes_everything(
    tmp_path: Path, write_bag: WriteBag, samples: list[Sample], name: str, options: dict[str, Any]
) -> None:
    path = write_bag(tmp_path / name, **options)
    files = sorted(path.glob('*.mcap')) if path.is_dir() else [path]
    assert (len(files) > 2) == ('max_file_bytes' in options)
    found = []
    for file in files:
        with file.open('rb') as stream:
            reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
            found += reader.iter_decoded_messages()
    for entry, sample in zip(found, samples, strict=True):
        assert entry.message.data == sample.data
        assert entry.message.log_time == sample.log_time_ns
        assert entry.message.publish_time == sample.publish_time_ns
        assert entry.channel.topic == sample.topic
        assert entry.schema.name == TOPICS[sample.topic]
        if sample.topic == '/temperature':
            assert entry.decoded_message.temperature == sample.message.temperature


@FORMS
def test_rosbags_reads_messages_offers_and_metadata(
    tmp_path: Path, write_bag: WriteBag, samples: list[Sample], name: str, options: dict[str, Any]
) -> None:
    path = write_bag(tmp_path / name, **options)
    with rosbag2.Reader(path) as reader:
        found = [(c.topic, c.msgtype, time, bytes(data)) for c, time, data in reader.messages()]
        assert reader.message_count == len(samples)
        assert reader.start_time == samples[0].log_time_ns
        assert reader.end_time == samples[-1].log_time_ns + 1  # rosbags counts past the last
        assert {t: info.msgcount for t, info in reader.topics.items()} == dict.fromkeys(
            TOPICS, ROUNDS)
        for connection in reader.connections:
            hash_ = message_definition(connection.msgtype).type_hash
            assert connection.digest == (hash_ if path.is_dir() else '')
            profiles = connection.ext.offered_qos_profiles
            for profile, offered in zip(profiles, OFFERED_QOS[connection.topic], strict=True):
                for policy in ('history', 'reliability', 'durability', 'liveliness'):
                    assert getattr(profile, policy).name.lower() == getattr(offered, policy)
                assert profile.depth == offered.depth
                deadline = profile.deadline
                assert deadline.sec * 10**9 + deadline.nsec == offered.deadline_ns
        if path.is_dir():
            assert reader.ros_distro
            assert reader.storage.files[0]['path'] == 'run_0.mcap'
    assert found == [(s.topic, TOPICS[s.topic], s.log_time_ns, s.data) for s in samples]


@pytest.mark.parametrize('name', ['run', 'run.mcap'])
def test_any_reader_checks_the_hash_and_deserializes(
    tmp_path: Path, write_bag: WriteBag, samples: list[Sample], name: str
) -> None:
    """Opening compares each stored type hash with one computed from the stored text."""
    path = write_bag(tmp_path / name)
    with highlevel.AnyReader([path]) as reader:
        for connection, sample in zip(reader.connections, samples, strict=False):
            assert reader.typestore.hash_rihs01(connection.msgtype) == (
                message_definition(connection.msgtype).type_hash)
            assert connection.topic == sample.topic
        for (connection, _, data), sample in zip(reader.messages(), samples, strict=True):
            message = reader.deserialize(data, connection.msgtype)
            if sample.topic == '/temperature':
                assert message.temperature == sample.message.temperature
                assert message.header.stamp.nanosec == sample.message.header.stamp.nanosec
            elif sample.topic == '/diagnostics':
                assert [s.message for s in message.status] == [
                    s.message for s in sample.message.status]
    with rosbag2.Reader(record(tmp_path / f'empty_{name}')) as reader:
        assert reader.message_count == 0
        assert list(reader.messages()) == []
        assert list(reader.topics) == ['/x']
