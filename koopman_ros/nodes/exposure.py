# Copyright 2026 The koopman_ros Authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

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
