# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Bags as rosbag2 itself has written them through the years, and of types that only look right."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from koopman_ros.bags import (
    BagReadError,
    BagWriter,
    message_definition,
    MessageDefinition,
    QosProfile,
    read_messages,
    summary,
    temperature_series,
)
from koopman_ros.bags.qos import dump_offered_qos, parse_offered_qos
from support.bag_mutants import compressed_files
from support.bag_samples import OFFERED_QOS, Sample

WriteBag = Callable[..., Path]

# An offer as Humble writes it: the numbers of rmw, and infinity as it was spelt then.
HUMBLE_OFFER = """
- history: 3
  depth: 0
  reliability: 2
  durability: 1
  deadline:
    sec: 9223372036
    nsec: 854775807
  lifespan:
    sec: 9223372036
    nsec: 854775807
  liveliness: 1
  liveliness_lease_duration:
    sec: 1
    nsec: 500000000
  avoid_ros_namespace_conventions: false
"""


def _downgrade(path: Path, version: int) -> None:
    """Write the metadata of a bag as that version of rosbag2 did (rosbag2_storage/yaml.hpp)."""
    source = path / 'metadata.yaml'
    information: dict[str, Any] = yaml.safe_load(
        source.read_text('utf-8'))['rosbag2_bagfile_information']
    information['version'] = version
    for entry in information['topics_with_message_count']:
        topic = entry['topic_metadata']
        topic['offered_qos_profiles'] = HUMBLE_OFFER if version < 9 else []
        if version < 7:
            del topic['type_description_hash']
    for key, since in (('files', 5), ('custom_data', 6), ('ros_distro', 8)):
        if version < since:
            del information[key]
    source.write_text(
        yaml.safe_dump({'rosbag2_bagfile_information': information}, sort_keys=False), 'utf-8')


@pytest.mark.parametrize('version', [4, 5, 6, 7, 8, 9])
def test_metadata_of_every_version(
    tmp_path: Path, write_bag: WriteBag, samples: list[Sample], version: int
) -> None:
    path = write_bag(tmp_path / 'run')
    _downgrade(path, version)
    assert [m.data for m in read_messages(path)] == [s.data for s in samples]
    assert summary(path).complete


def test_compressed_files_of_a_killed_recorder(
    tmp_path: Path, write_bag: WriteBag, samples: list[Sample]
) -> None:
    """Without metadata, and with the last file not compressed yet or half compressed."""
    path = write_bag(tmp_path / 'run', max_file_bytes=8000)
    files = {file.name: file.read_bytes() for file in path.iterdir()}
    compressed = compressed_files(files)
    del compressed['metadata.yaml']
    assert len(compressed) >= 3
    last = max(files)
    compressed[f'{last}.zstd'] = compressed[f'{last}.zstd'][:100]
    (path / 'metadata.yaml').unlink()
    for name, content in compressed.items():
        (path / name).write_bytes(content)
        if name != f'{last}.zstd':
            (path / name.removesuffix('.zstd')).unlink()
    assert [m.data for m in read_messages(path, recover=True)] == [s.data for s in samples]


def test_bare_compressed_file(tmp_path: Path, write_bag: WriteBag, samples: list[Sample]) -> None:
    path = write_bag(tmp_path / 'run')
    files = compressed_files({file.name: file.read_bytes() for file in path.iterdir()})
    bare = tmp_path / 'run_0.mcap.zstd'
    bare.write_bytes(files['run_0.mcap.zstd'])
    assert [m.data for m in read_messages(bare)] == [s.data for s in samples]


def test_offers_come_back(tmp_path: Path, write_bag: WriteBag) -> None:
    assert summary(write_bag(tmp_path / 'run.mcap')).offered_qos == OFFERED_QOS


def test_offer_in_numbers() -> None:
    assert parse_offered_qos(HUMBLE_OFFER) == (QosProfile(
        history='unknown', depth=0, reliability='best_effort', durability='transient_local',
        liveliness_lease_duration_ns=1_500_000_000),)


@pytest.mark.parametrize('text', [
    '', 'x', '- 3', '- history: 1', '[', HUMBLE_OFFER.replace('reliability: 2', 'reliability: 9'),
    HUMBLE_OFFER.replace('depth: 0', 'depth: -1'),
    HUMBLE_OFFER.replace('sec: 1', 'sec: 2001-99-01'),
])
def test_offer_that_cannot_be_read_is_left_out(text: str) -> None:
    assert parse_offered_qos(text) == ()


def test_offers_of_all_kinds_are_written_and_read_back() -> None:
    profiles = tuple(profile for offered in OFFERED_QOS.values() for profile in offered)
    assert parse_offered_qos(dump_offered_qos(profiles)) == profiles


@pytest.mark.parametrize(('field', 'other'), [
    ('float64 temperature', 'float64 heat'),
    ('float64 temperature', 'string temperature'),
    ('std_msgs/Header header', 'builtin_interfaces/Time header'),
])
def test_type_that_only_bears_the_name(
    tmp_path: Path, samples: list[Sample], field: str, other: str
) -> None:
    known = message_definition('sensor_msgs/msg/Temperature')
    sample = next(s for s in samples if s.topic == '/temperature')
    text = known.text.replace(field, other)
    assert text != known.text
    with BagWriter(tmp_path / 'run.mcap') as writer:
        writer.add_topic('/t', MessageDefinition(known.type_name, text, known.type_hash))
        writer.write('/t', sample.data, 1)
    with pytest.raises(BagReadError, match=r'laid out differently|does not decode'):
        temperature_series(writer.path, '/t')


@pytest.mark.parametrize('names', ['[]', '3', 'run_0.mcap', '[run_0.mcap, run_0.mcap]', '[[a]]'])
def test_listed_files_that_cannot_be(tmp_path: Path, write_bag: WriteBag, names: str) -> None:
    path = write_bag(tmp_path / 'run')
    source = path / 'metadata.yaml'
    information = yaml.safe_load(source.read_text('utf-8'))
    information['rosbag2_bagfile_information']['relative_file_paths'] = yaml.safe_load(names)
    source.write_text(yaml.safe_dump(information), 'utf-8')
    with pytest.raises(BagReadError, match='is not the metadata of a bag'):
        read_messages(path)
