# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Offered quality of service, in the words that rosbag2 stores with a topic (Jazzy and later)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import yaml

from koopman_ros.bags.plain_yaml import load_plain
from koopman_ros.units import NANOSECONDS

# An unlimited duration [ns]: RMW_DURATION_INFINITE, 9223372036 s and 854775807 ns.
INFINITE_NS = 2**63 - 1

# The spellings of rmw/qos_string_conversions.h; 'unknown' is what discovery reports when a
# publisher's history is not on the wire.
_POLICIES = {
    'history': ('keep_last', 'keep_all', 'system_default', 'unknown'),
    'reliability': ('reliable', 'best_effort', 'system_default', 'best_available', 'unknown'),
    'durability': ('volatile', 'transient_local', 'system_default', 'best_available', 'unknown'),
    'liveliness': ('automatic', 'manual_by_topic', 'system_default', 'best_available', 'unknown'),
}
# Before version 9 (Jazzy) rosbag2 wrote the numbers of rmw/types.h.
_NUMBERED = {
    'history': ('system_default', 'keep_last', 'keep_all', 'unknown'),
    'reliability': ('system_default', 'reliable', 'best_effort', 'unknown', 'best_available'),
    'durability': ('system_default', 'transient_local', 'volatile', 'unknown', 'best_available'),
    'liveliness': ('system_default', 'automatic', 'manual_by_node', 'manual_by_topic', 'unknown',
                   'best_available'),
}
_DURATIONS = ('deadline_ns', 'lifespan_ns', 'liveliness_lease_duration_ns')


@dataclass(frozen=True)
class QosProfile:
    """
    One publisher's offer, as plain values (durations in ns, `INFINITE_NS` for no limit).

    The policies are rmw's own words, which rclpy gives as `policy.short_key`. Raises ValueError
    for a word that rmw does not know, a negative depth and a duration outside
    [0, INFINITE_NS] ns.
    """

    history: str = 'keep_last'
    depth: int = 10
    reliability: str = 'reliable'
    durability: str = 'volatile'
    deadline_ns: int = INFINITE_NS
    lifespan_ns: int = INFINITE_NS
    liveliness: str = 'automatic'
    liveliness_lease_duration_ns: int = INFINITE_NS
    avoid_ros_namespace_conventions: bool = False

    def __post_init__(self) -> None:
        for policy, words in _POLICIES.items():
            if getattr(self, policy) not in words:
                raise ValueError(
                    f'{policy} {getattr(self, policy)!r} is not one of {", ".join(words)}')
        if self.depth < 0:
            raise ValueError(f'depth {self.depth} is negative: give a queue length of 0 or more')
        for name in _DURATIONS:
            if not 0 <= getattr(self, name) <= INFINITE_NS:
                raise ValueError(
                    f'{name} {getattr(self, name)} is outside [0, {INFINITE_NS}] ns: '
                    'use INFINITE_NS for no limit')


def qos_mappings(profiles: Sequence[QosProfile]) -> list[dict[str, Any]]:
    """Return the profiles as rosbag2's metadata.yaml (version 9) lists them."""
    return [
        {
            'history': profile.history,
            'depth': profile.depth,
            'reliability': profile.reliability,
            'durability': profile.durability,
            'deadline': _duration(profile.deadline_ns),
            'lifespan': _duration(profile.lifespan_ns),
            'liveliness': profile.liveliness,
            'liveliness_lease_duration': _duration(profile.liveliness_lease_duration_ns),
            'avoid_ros_namespace_conventions': profile.avoid_ros_namespace_conventions,
        }
        for profile in profiles
    ]


def dump_offered_qos(profiles: Sequence[QosProfile]) -> str:
    """Return the text of the channel metadata `offered_qos_profiles`: a YAML sequence."""
    return yaml.safe_dump(qos_mappings(profiles), sort_keys=False).rstrip('\n')


def parse_offered_qos(text: str) -> tuple[QosProfile, ...]:
    """
    Return the profiles of the channel metadata `offered_qos_profiles`, of any version of rosbag2.

    What cannot be read gives no profile: a bag is of use without.
    """
    try:
        return tuple(_profile(mapping) for mapping in load_plain(text) or ())
    except (yaml.YAMLError, ValueError, KeyError, TypeError, IndexError, AttributeError,
            RecursionError):
        return ()


def _profile(mapping: Mapping[str, Any]) -> QosProfile:
    values: dict[str, Any] = {
        policy: _NUMBERED[policy][word] if isinstance(word := mapping[policy], int) else word
        for policy in _POLICIES}
    values |= {name: _nanoseconds(mapping[name.removesuffix('_ns')]) for name in _DURATIONS}
    return QosProfile(
        **values, depth=int(mapping['depth']),
        avoid_ros_namespace_conventions=bool(mapping['avoid_ros_namespace_conventions']))


def _nanoseconds(duration: Mapping[str, int]) -> int:
    return min(int(duration['sec']) * NANOSECONDS + int(duration['nsec']), INFINITE_NS)


def _duration(nanoseconds: int) -> dict[str, int]:
    seconds, rest = divmod(nanoseconds, NANOSECONDS)
    return {'sec': seconds, 'nsec': rest}
