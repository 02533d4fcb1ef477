# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Who can reach a node: this machine alone, or the networks that it is on."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

LOOPBACK_PROFILE = 'loopback_discovery.xml'

_PROFILES = ('FASTDDS_DEFAULT_PROFILES_FILE', 'FASTRTPS_DEFAULT_PROFILES_FILE')
_CLOSED_RANGES = ('LOCALHOST', 'OFF')


def open_to_the_network(environment: Mapping[str, str]) -> str:
    """
    Return a warning for a node that others on the network can command, or an empty string.

    :param environment: variables of the process.
    """
    closed = (
        environment.get('ROS_AUTOMATIC_DISCOVERY_RANGE', '').upper() in _CLOSED_RANGES
        or environment.get('ROS_LOCALHOST_ONLY') == '1'
        or any(Path(environment.get(name, '')).name == LOOPBACK_PROFILE for name in _PROFILES)
        # with keys, or not at all
        or (environment.get('ROS_SECURITY_ENABLE', '').lower() == 'true'
            and environment.get('ROS_SECURITY_STRATEGY', '') == 'Enforce'))
    return '' if closed else (
        'open to the network: whoever is on a network of this machine, in ROS domain '
        f'{environment.get("ROS_DOMAIN_ID") or 0}, can command this node; '
        'ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST keeps it to this machine')
