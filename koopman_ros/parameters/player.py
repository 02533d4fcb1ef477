# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Parameters of the player."""

from dataclasses import dataclass

from koopman_ros.parameters.table import parameter, ParameterTable
from koopman_ros.parameters.wire import (
    COOLANT_SETPOINT,
    COOLANT_TEMPERATURE,
    MANUAL_COOLANT_SETPOINT,
    refusal,
    SETPOINT,
    TEMPERATURE,
)


@dataclass(frozen=True)
class PlayerParameters:
    """Snapshot of the player's parameters."""

    bag: str = parameter('run_1', 'bag to play: a .mcap file or a bag folder', read_only=True)
    topics: tuple[str, ...] = parameter(
        (COOLANT_TEMPERATURE, TEMPERATURE, SETPOINT, MANUAL_COOLANT_SETPOINT), 'topics to play; a '
        'relative name stands for that below / in the bag, and follows namespaces and remaps when '
        'it is published', read_only=True)
    rate: float = parameter(
        1.0, 'seconds of the recording, by the time of receipt, per second; 0 plays as fast as '
        'the controller answers, in lock-step', '', 0.0, 10000.0, smallest=1e-6, read_only=True)
    measurement: str = parameter(
        TEMPERATURE, 'the topic among them whose messages are answered', read_only=True)
    answer: str = parameter(
        COOLANT_SETPOINT, 'where the answers are heard, which carry the stamps of the '
        'measurements', read_only=True)
    clock: bool = parameter(
        False, 'publish the stamp of each measurement on /clock before it, as the plant does, for '
        'nodes with use_sim_time', read_only=True)
    start_offset: float = parameter(
        0.0, 'time after the start of the bag from which on it is played', 's', 0.0, 1e9,
        read_only=True)
    wait_for_subscribers: int = parameter(
        1, 'how many subscribers each played topic must have before the first message', '', 0,
        1000, read_only=True)
    wait_timeout: float = parameter(
        30.0, 'longest wait for them', 's', 0.0, 86400.0, read_only=True)
    answer_timeout: float = parameter(
        5.0, 'longest wait for an answer when rate is 0', 's', 0.0, 86400.0, open_minimum=True,
        read_only=True)
    recover: bool = parameter(
        False, 'play a bag that was not closed or is damaged as far as it is whole',
        read_only=True)


def _cross_check(values: PlayerParameters) -> str:
    return refusal(values.topics) or refusal((values.measurement, values.answer))


TABLE = ParameterTable(PlayerParameters, _cross_check)
