# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Parameters of the player node, which plays bags and set-points."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from koopman_ros.core.declaration import parameter
from koopman_ros.parameters.signal_topics import DEFAULT_SYSTEM, rejection, system_of
from koopman_ros.parameters.table import ParameterTable
from koopman_ros.parameters.trainer_table import preset_wiring


@dataclass(frozen=True)
class PlayerParameters:
    """Snapshot of the player's parameters."""

    bag: str = parameter(
        'run_1', 'Bag to play: a .mcap file or a bag folder; or a .csv of set-points with the '
        'columns time [s] and <signal> [unit].', read_only=True)
    setpoint_ramps: bool = parameter(
        False, 'Ramp the set-points between the rows of a .csv, instead of stepping them.',
        read_only=True)
    ramp_period: float = parameter(
        1.0, 'Time between two set-points of a ramp.', 's', 0.01, 3600.0, read_only=True)
    setpoint_lead: float = parameter(
        0.0, 'Time by which set-points of a .csv are sent in advance, stamped with the time at '
             'which they take effect, so that the law mpc prepares for them; 0: not in '
             'advance.', 's', 0.0, 3600.0, read_only=True)
    system: str = parameter(
        DEFAULT_SYSTEM, 'Bundled plant whose topics are the defaults; any other name: no '
        'defaults.', read_only=True)
    topics: tuple[str, ...] = parameter(
        ('',), 'Topics to play. A relative name is looked up below / in the bag and published in '
               'the namespace and with the remaps of the player.', read_only=True)
    rate: float = parameter(
        1.0, 'Recorded seconds per second, by time of receipt; 0: lock-step, as fast as the '
        'controller answers.', '', 0.0, 10000.0, smallest=1e-6, read_only=True)
    measurement: tuple[str, ...] = parameter(
        ('',), 'Topics that together carry one measurement, for which a command is '
               'expected.', read_only=True)
    answer: str = parameter(
        '', 'Topic of the commands, which carry the stamps of the measurements.', read_only=True)
    answer_type: str = parameter(
        '', 'Message type of the commands if the bag has none.', read_only=True)
    clock: bool = parameter(
        False, 'Publish the stamp of each measurement on /clock first, for nodes with '
        'use_sim_time.', read_only=True)
    start_offset: float = parameter(
        0.0, 'Offset from the start of the bag at which playing begins.', 's', 0.0, 1e9,
        read_only=True)
    wait_for_subscribers: int = parameter(
        1, 'Number of subscribers of each topic to wait for before the first '
           'message.', '', 0, 1000,
        read_only=True)
    wait_timeout: float = parameter(
        30.0, 'Longest wait for these subscribers.', 's', 0.0, 86400.0, read_only=True)
    answer_timeout: float = parameter(
        5.0, 'Longest wait for a command if rate is 0.', 's', 0.0, 86400.0, open_minimum=True,
        read_only=True)
    recover: bool = parameter(
        False, 'Play the intact part of a bag that is damaged or was not closed.',
        read_only=True)


def _check_player(values: PlayerParameters) -> str:
    if values.bag.endswith('.csv') and values.rate == 0.0:
        return 'rate = 0 plays in lock-step, which a .csv of set-points cannot: set rate above 0'
    if values.rate == 0.0 and not all((*values.measurement, values.answer)):
        return ('rate = 0 waits for the command that answers each measurement: set measurement '
                'and answer to their topics, or rate above 0')
    if values.clock and not all(values.measurement):
        return 'clock publishes the stamps of measurements: set measurement to their topics'
    return rejection(values.topics) or (
        rejection(values.measurement) if any(values.measurement) else '')


def player_table(given: Mapping[str, Any] = MappingProxyType({})
                 ) -> ParameterTable[PlayerParameters]:
    """Return the parameters of a player; `given` as for :func:`trainer_table`."""
    system = system_of(given)
    defaults: dict[str, Any] = {'system': system}
    if (wiring := preset_wiring(system)) is not None:
        defaults |= {
            'topics': tuple(dict.fromkeys(place.topic for places in (
                wiring.applied, wiring.measured_disturbances, wiring.quality, wiring.measured,
                wiring.setpoints, wiring.joint_setpoints, wiring.manual)
                for place in places.values())),
            'measurement': tuple(dict.fromkeys(
                place.topic for place in wiring.measured.values())),
            'answer': next(iter(wiring.commands.values())).topic,
            'answer_type': next(iter(wiring.commands.values())).type}
    return ParameterTable(PlayerParameters, _check_player, defaults=defaults)
