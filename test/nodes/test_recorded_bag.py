# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The bag of a closed loop: opened with readers that are not ours, and recorded twice."""

from pathlib import Path
import re
from typing import Any

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader
import yaml

from koopman_ros.bags import read_series
from koopman_ros.demo.loop import run_loop, Scenario
from koopman_ros.nodes.replay import Names, replayed_bag
from koopman_ros.parameters.replay import ReplayParameters
from koopman_ros.ros import topics
from koopman_ros.testing import Harness

STAMPS = list(range(1, 62))
SETPOINT = 42.0  # degC
TOPICS = {'/temperature', '/concentration', '/setpoint', '/active_setpoint', '/coolant_setpoint',
          '/coolant_temperature', '/predicted_temperature', '/controller_state',
          '/controller_events', '/diagnostics'}
LATCHED = {'/active_setpoint', '/coolant_temperature'}


def by_mcap(bag: Path) -> list[tuple[str, Any]]:
    """Return topics and messages as mcap's own reader finds them."""
    with bag.open('rb') as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        return [(entry.channel.topic, entry.decoded_message)
                for entry in reader.iter_decoded_messages()]


def by_rosbags(bag: Path) -> list[tuple[str, Any]]:
    """Return the same as rosbags finds it."""
    with AnyReader([bag]) as reader:
        return [(connection.topic, reader.deserialize(data, connection.msgtype))
                for connection, _, data in reader.messages()]


@pytest.mark.parametrize('read', [by_mcap, by_rosbags])
def test_other_readers_find_every_measurement_and_command(recorded_loop: Path, read: Any) -> None:
    heard: dict[str, list[Any]] = {}
    for topic, message in read(recorded_loop):
        heard.setdefault(topic, []).append(message)

    def stamps(topic: str) -> list[int]:
        return [message.header.stamp.sec for message in heard[topic]]

    assert set(heard) == TOPICS
    assert stamps('/temperature') == stamps('/coolant_setpoint') == STAMPS
    # of what keeps the last only, a recorder that is found late misses the first
    for topic in ('/coolant_temperature', '/concentration'):
        assert stamps(topic)[-50:] == STAMPS[-50:]
    assert [m.temperature for m in heard['/setpoint']] == pytest.approx([SETPOINT])
    assert heard['/active_setpoint'][-1].temperature == pytest.approx(SETPOINT)
    assert stamps('/active_setpoint') == [1, 21]
    assert {status.name for array in heard['/diagnostics'] for status in array.status} >= {
        'controller: control', 'trainer: recording'}
    for message in heard['/concentration']:
        assert list(message.name) == ['reactant_concentration [mol/L]']
        assert 0.5 < message.position[0] < 1.0


def test_replay_reproduces_every_command(recorded_loop: Path) -> None:
    found = replayed_bag(str(recorded_loop), Names(), ReplayParameters())
    assert found.check.identical == found.check.compared == len(STAMPS)
    assert (found.unexplained, found.found.lost) == (0, [])


def test_types_and_offers_are_those_of_ros(ros: Harness, recorded_loop: Path) -> None:
    with recorded_loop.open('rb') as stream:
        channels = make_reader(stream).get_summary().channels.values()
    stored = {channel.topic: channel.metadata for channel in channels}
    assert set(stored) == TOPICS
    for topic, metadata in stored.items():
        kind = topics.TYPES.get(topic) or topics.TYPES[topic.removeprefix('/')]
        ros.node.create_publisher(kind, topic, 1)
        (info, *_) = ros.node.get_publishers_info_by_topic(topic)
        assert metadata['topic_type_hash'] == str(info.topic_type_hash)
        assert re.fullmatch('RIHS01_[0-9a-f]{64}', metadata['topic_type_hash'])
        durability = 'transient_local' if topic in LATCHED else 'volatile'
        profiles = yaml.safe_load(metadata['offered_qos_profiles'])
        assert {(profile['reliability'], profile['durability']) for profile in profiles} == {
            ('reliable', durability)}
    with Reader(recorded_loop) as reader:
        parsed = {c.topic: c.ext.offered_qos_profiles for c in reader.connections}
    for topic in LATCHED:
        assert {p.durability.name.lower() for p in parsed[topic]} == {'transient_local'}


def test_bare_file_describes_itself_as_rosbag2_does(recorded_loop: Path) -> None:
    with recorded_loop.open('rb') as stream:
        # as rosbag2 does, at the start and again, with the counts, at the end
        *_, record = (r for r in make_reader(stream).iter_metadata() if r.name == 'rosbag2')
        information = yaml.safe_load(record.metadata['serialized_metadata'])
    information = information.get('rosbag2_bagfile_information', information)
    assert information['storage_identifier'] == 'mcap'
    counts = {entry['topic_metadata']['name']: entry['message_count']
              for entry in information['topics_with_message_count']}
    assert set(counts) == TOPICS
    assert counts['/temperature'] == len(STAMPS)
    assert information['message_count'] == sum(counts.values())


def test_second_run_is_bit_identical(
        tmp_path: Path, scenario: Scenario, recorded_loop: Path) -> None:
    run_loop(scenario, tmp_path / 'again.mcap', tmp_path)
    for topic in ('/temperature', '/coolant_setpoint', '/coolant_temperature'):
        first, again = (read_series(bag, topic)
                        for bag in (recorded_loop, tmp_path / 'again.mcap'))
        # a recorder that is found late misses the first of what keeps the last only
        compared = slice(-50, None) if topic == '/coolant_temperature' else slice(None)
        np.testing.assert_array_equal(first.stamp_ns[compared], again.stamp_ns[compared])
        np.testing.assert_array_equal(first.values[compared].view(np.uint64),
                                      again.values[compared].view(np.uint64))
        assert len(np.unique(first.values)) > 45
