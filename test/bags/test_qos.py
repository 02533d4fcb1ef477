# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

import importlib
from typing import Any

import pytest
import yaml

from koopman_ros.bags import INFINITE_NS, QosProfile
from koopman_ros.bags.metadata import dump_offered_qos, qos_mappings

# As rosbag2 (Jazzy) writes a discovered publisher of the default profile.
DISCOVERED = """\
- history: unknown
  depth: 0
  reliability: reliable
  durability: volatile
  deadline:
    sec: 9223372036
    nsec: 854775807
  lifespan:
    sec: 9223372036
    nsec: 854775807
  liveliness: automatic
  liveliness_lease_duration:
    sec: 9223372036
    nsec: 854775807
  avoid_ros_namespace_conventions: false"""


def test_text_of_profiles() -> None:
    assert dump_offered_qos([]) == '[]'
    assert dump_offered_qos([QosProfile(history='unknown', depth=0)]) == DISCOVERED
    # those that are equal are written out each
    profile = QosProfile(deadline_ns=2_500_000_001)
    text = dump_offered_qos([profile, profile])
    assert not {'&', '*'}.intersection(text)
    assert yaml.safe_load(text) == qos_mappings([profile, profile])
    assert yaml.safe_load(text)[0]['deadline'] == {'sec': 2, 'nsec': 500_000_001}


@pytest.mark.parametrize(('field', 'value', 'sentence'), [
    ('history', 'last', "history 'last' is not one of keep_last, keep_all"),
    ('reliability', 1, 'reliability 1 is not one of reliable, best_effort'),
    ('durability', 'latched', "durability 'latched' is not one of volatile, transient_local"),
    ('liveliness', '', "liveliness '' is not one of automatic, manual_by_topic"),
    ('depth', -1, 'depth -1 is negative'),
    ('deadline_ns', -1, r'deadline_ns -1 is outside \[0, 9223372036854775807\] ns'),
    ('lifespan_ns', INFINITE_NS + 1, 'use INFINITE_NS for no limit'),
    ('liveliness_lease_duration_ns', -5, 'liveliness_lease_duration_ns -5 is outside'),
])
def test_bad_values(field: str, value: Any, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        QosProfile(**{field: value})


def test_words_are_those_of_rclpy() -> None:
    qos = importlib.import_module('rclpy.qos')
    for field in ('history', 'reliability', 'durability', 'liveliness'):
        for word in getattr(qos, f'{field.capitalize()}Policy').short_keys():
            assert getattr(QosProfile(**{field: word}), field) == word
