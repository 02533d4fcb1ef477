# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Bags opened by two independent readers: mcap's own, and the rosbags package."""

from collections.abc import Callable
import importlib
from pathlib import Path

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
import pytest

from koopman_ros.bags import BagWriter, message_definition
from support.bag_samples import OFFERED_QOS, ROUNDS, Sample, TOPICS

highlevel = importlib.import_module('rosbags.highlevel')
rosbag2 = importlib.import_module('rosbags.rosbag2')

WriteBag = Callable[..., Path]

FORMS = pytest.mark.parametrize('name', ['run', 'run.mcap'])
COMPRESSIONS = pytest.mark.parametrize('compression', ['none', 'zstd', 'lz4'])


@COMPRESSIONS
def test_mcap_reader_decodes_everything(
    tmp_path: Path, write_bag: WriteBag, samples: list[Sample], compression: str
) -> None:
    path = write_bag(tmp_path / 'run.mcap', compression=compression, max_chunk_bytes=2000)
    with path.open('rb') as stream:
        reader = make_reader(
            stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        found = list(reader.iter_decoded_messages())
    for entry, sample in zip(found, samples, strict=True):
        assert entry.message.data == sample.data
        assert entry.message.log_time == sample.log_time_ns
        assert entry.message.publish_time == sample.publish_time_ns
        assert entry.channel.topic == sample.topic
        assert entry.schema.name == TOPICS[sample.topic]
        if sample.topic == '/temperature':
            assert entry.decoded_message.temperature == sample.message.temperature


@FORMS
@COMPRESSIONS
def test_rosbags_reads_bytes_times_and_types(
    tmp_path: Path, write_bag: WriteBag, samples: list[Sample], name: str, compression: str
) -> None:
    path = write_bag(tmp_path / name, compression=compression)
    with rosbag2.Reader(path) as reader:
        found = [(c.topic, c.msgtype, time, bytes(data)) for c, time, data in reader.messages()]
        assert reader.message_count == len(samples)
        assert reader.start_time == samples[0].log_time_ns
        assert reader.end_time == samples[-1].log_time_ns + 1  # rosbags counts past the last
        assert {t: info.msgcount for t, info in reader.topics.items()} == dict.fromkeys(
            TOPICS, ROUNDS)
    assert found == [(s.topic, TOPICS[s.topic], s.log_time_ns, s.data) for s in samples]


@FORMS
def test_rosbags_parses_the_offered_qos(
    tmp_path: Path, write_bag: WriteBag, name: str
) -> None:
    with rosbag2.Reader(write_bag(tmp_path / name)) as reader:
        for connection in reader.connections:
            profiles = connection.ext.offered_qos_profiles
            for found, offered in zip(profiles, OFFERED_QOS[connection.topic], strict=True):
                assert found.history.name.lower() == offered.history
                assert found.depth == offered.depth
                assert found.reliability.name.lower() == offered.reliability
                assert found.durability.name.lower() == offered.durability
                assert found.liveliness.name.lower() == offered.liveliness
                assert found.deadline.sec * 10**9 + found.deadline.nsec == offered.deadline_ns


def test_rosbags_reads_the_bag_metadata(tmp_path: Path, write_bag: WriteBag) -> None:
    path = write_bag(tmp_path / 'run', custom_data={'scenario': 'setpoint step'})
    with rosbag2.Reader(path) as reader:
        assert reader.ros_distro
        assert reader.storage.metadata.custom == {'scenario': 'setpoint step'}
        assert reader.storage.files[0]['path'] == 'run_0.mcap'
        for connection in reader.connections:
            assert connection.digest == message_definition(TOPICS[connection.topic]).type_hash


@FORMS
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


@FORMS
def test_bag_without_messages_opens(tmp_path: Path, name: str) -> None:
    with BagWriter(tmp_path / name) as writer:
        writer.add_topic('/clock', message_definition('rosgraph_msgs/msg/Clock'))
    with rosbag2.Reader(writer.path) as reader:
        assert reader.message_count == 0
        assert list(reader.messages()) == []
        assert list(reader.topics) == ['/clock']
