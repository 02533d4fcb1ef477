# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The bag of a closed loop: opened with readers that are not ours, and recorded twice."""

from __future__ import annotations

from collections import Counter
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

SAMPLES = 61
SETPOINT = 315.15  # K
TOPICS = {'/temperature', '/concentration', '/setpoint', '/active_setpoint', '/coolant_setpoint',
          '/coolant_temperature', '/predicted_temperature', '/controller_state',
          '/controller_events', '/diagnostics'}
LATCHED = {'/active_setpoint', '/coolant_temperature'}


# A minute of a closed loop on the noisy two-state reactor, with a step at 20 s and a coolant that
# comes late and slowly.
SCENARIO = Scenario('reactor_nz4', SETPOINT, step_time=20.0, duration=SAMPLES - 1.0,
                    plant={'reactor': 'two_state', 'noise': 0.05, 'seed': 3,
                           'command_delay': 1.0, 'coolant_lag': 2.0})


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('recorded')
    run_loop(SCENARIO, folder / 'loop.mcap', folder)
    return folder / 'loop.mcap'


def stamps(messages: list[Any]) -> list[int]:
    return [message.header.stamp.sec for message in messages]


def test_mcap_finds_every_measurement_and_command(bag: Path) -> None:
    heard: dict[str, list[Any]] = {topic: [] for topic in TOPICS}
    with bag.open('rb') as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for entry in reader.iter_decoded_messages():
            heard[entry.channel.topic].append(entry.decoded_message)
    assert stamps(heard['/temperature']) == list(range(1, SAMPLES + 1))
    assert stamps(heard['/coolant_setpoint']) == list(range(1, SAMPLES + 1))
    # of what keeps the last only, a recorder that is found late misses the first
    assert stamps(heard['/coolant_temperature'])[-50:] == list(range(SAMPLES - 49, SAMPLES + 1))
    assert [m.temperature for m in heard['/setpoint']] == pytest.approx([SETPOINT - 273.15])
    assert heard['/active_setpoint'][-1].temperature == pytest.approx(SETPOINT - 273.15)
    assert stamps(heard['/active_setpoint']) == [1, 21]
    names = {status.name for array in heard['/diagnostics'] for status in array.status}
    assert names >= {'controller: control', 'trainer: recording'}


def test_rosbags_finds_and_decodes_the_same(bag: Path) -> None:
    with AnyReader([bag]) as reader:
        assert {connection.topic for connection in reader.connections} == TOPICS
        decoded = [(c.topic, reader.deserialize(data, c.msgtype))
                   for c, _, data in reader.messages()]
    counts = Counter(topic for topic, _ in decoded)
    assert counts['/temperature'] == counts['/coolant_setpoint'] == SAMPLES
    assert stamps([m for topic, m in decoded if topic == '/temperature']) == list(
        range(1, SAMPLES + 1))
    concentrations = [m for topic, m in decoded if topic == '/concentration']
    assert stamps(concentrations)[-50:] == list(range(SAMPLES - 49, SAMPLES + 1))
    assert {tuple(m.name) for m in concentrations} == {('reactant_concentration [mol/L]',)}
    assert all(0.5 < m.position[0] < 1.0 for m in concentrations)


def test_replay_reproduces_every_command(bag: Path) -> None:
    found = replayed_bag(str(bag), Names(), ReplayParameters())
    assert found.check.identical == found.check.compared == SAMPLES
    assert (found.unexplained, found.found.lost) == (0, [])


def test_type_hashes_are_those_of_ros(ros: Harness, bag: Path) -> None:
    with bag.open('rb') as stream:
        channels = make_reader(stream).get_summary().channels.values()
        stored = {channel.topic: channel.metadata['topic_type_hash'] for channel in channels}
    assert set(stored) == TOPICS
    for topic, found in stored.items():
        kind = topics.TYPES.get(topic) or topics.TYPES[topic.removeprefix('/')]
        ros.node.create_publisher(kind, topic, 1)
        (info, *_) = ros.node.get_publishers_info_by_topic(topic)
        assert found == str(info.topic_type_hash)
        assert re.fullmatch('RIHS01_[0-9a-f]{64}', found)


def test_offered_qos_is_kept(bag: Path) -> None:
    with bag.open('rb') as stream:
        channels = make_reader(stream).get_summary().channels.values()
        offered = {channel.topic: yaml.safe_load(channel.metadata['offered_qos_profiles'])
                   for channel in channels}
    for topic, profiles in offered.items():
        latched = topic in LATCHED
        assert profiles
        for profile in profiles:
            assert profile['reliability'] == 'reliable'
            assert profile['durability'] == ('transient_local' if latched else 'volatile')
    with Reader(bag) as reader:
        parsed = {c.topic: c.ext.offered_qos_profiles for c in reader.connections}
    for topic in LATCHED:
        assert {p.durability.name.lower() for p in parsed[topic]} == {'transient_local'}


def test_bare_file_describes_itself_as_rosbag2_does(bag: Path) -> None:
    with bag.open('rb') as stream:
        # as rosbag2 does, at the start and again, with the counts, at the end
        *_, record = (r for r in make_reader(stream).iter_metadata() if r.name == 'rosbag2')
        information = yaml.safe_load(record.metadata['serialized_metadata'])
    information = information.get('rosbag2_bagfile_information', information)
    assert information['storage_identifier'] == 'mcap'
    counts = {entry['topic_metadata']['name']: entry['message_count']
              for entry in information['topics_with_message_count']}
    assert set(counts) == TOPICS
    assert counts['/temperature'] == SAMPLES
    assert information['message_count'] == sum(counts.values())


def test_second_run_is_the_same_to_the_bit(tmp_path: Path, bag: Path) -> None:
    run_loop(SCENARIO, tmp_path / 'again.mcap', tmp_path)
    for topic in ('/temperature', '/coolant_setpoint', '/coolant_temperature'):
        first = read_series(bag, topic)
        again = read_series(tmp_path / 'again.mcap', topic)
        # a recorder that is found late misses the first of what keeps the last only
        compared = slice(-50, None) if topic == '/coolant_temperature' else slice(None)
        np.testing.assert_array_equal(first.stamp_ns[compared], again.stamp_ns[compared])
        np.testing.assert_array_equal(first.values[compared].view(np.uint64),
                                      again.values[compared].view(np.uint64))
        assert len(np.unique(first.values)) > 45
