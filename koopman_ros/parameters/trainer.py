# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Parameters of the trainer node, which records bags, and of the player, which plays them."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from koopman_ros.experiment import Experiment
from koopman_ros.parameters import wire
from koopman_ros.parameters.table import parameter, ParameterTable
from koopman_ros.units import SECONDS_PER_MINUTE, to_kelvin

LOOP_TOPICS = (wire.TEMPERATURE, wire.CONCENTRATION, wire.SETPOINT, wire.ACTIVE_SETPOINT,
               wire.COOLANT_SETPOINT, wire.COOLANT_TEMPERATURE,
               wire.MANUAL_COOLANT_SETPOINT, wire.PREDICTED_TEMPERATURE,
               wire.CONTROLLER_STATE, wire.CONTROLLER_EVENTS, wire.DIAGNOSTICS)
EXPERIMENT_TOPICS = (wire.COOLANT_SETPOINT, wire.MANUAL_COOLANT_SETPOINT)


@dataclass(frozen=True)
class TrainerParameters:
    """Snapshot of the trainer's parameters."""

    task: str = parameter(
        'record', 'record: the node, which records, drives experiments and trains on request; '
        'train: train from the bags, and end', choices=('record', 'train'), read_only=True)
    record_at_start: bool = parameter(
        True, 'start recording when the node starts, without waiting for ~/record', read_only=True)
    output: str = parameter(
        '', 'where to record: a file ending in .mcap, or the folder of a new bag; empty names a '
        'folder after the date and time; never overwritten: where run exists, run_2 is taken')
    topics: tuple[str, ...] = parameter(
        LOOP_TOPICS, 'topics to record; those that are not part of the loop are subscribed when '
        'somebody publishes them')
    compression: str = parameter(
        'none', 'compression of the bag; none is readable even when damaged',
        choices=('none', 'zstd', 'lz4'))
    max_bag_size: float = parameter(
        0.0, 'size from which the recording goes on in the next file of the folder; 0 for never',
        'MB', 0.0, 1e9, smallest=1e-6)
    max_bag_duration: float = parameter(
        0.0, 'time after which the recording goes on in the next file of the folder; 0 for never',
        's', 0.0, 1e9, smallest=1e-6)
    min_free_disk: float = parameter(
        100.0, 'room that the disk must have; with less, recording does not start, or stops', 'MB',
        0.0, 1e12)
    experiment_topic: str = parameter(
        EXPERIMENT_TOPICS[0], 'where the experiment commands the coolant: the plant, or a '
        'controller in manual mode', choices=EXPERIMENT_TOPICS)
    experiment_duration: float = parameter(
        60.0, 'length of the experiment', 'min', 0.0, 1e4, open_minimum=True)
    experiment_coolant_min: float = parameter(
        8.5, 'lowest coolant temperature of a step', 'degC', -50.0, 150.0)
    experiment_coolant_max: float = parameter(
        27.5, 'highest coolant temperature of a step', 'degC', -50.0, 150.0)
    experiment_hold_min: float = parameter(0.5, 'shortest step', 'min', 0.01, 1e4)
    experiment_hold_max: float = parameter(2.0, 'longest step', 'min', 0.01, 1e4)
    experiment_rate_limit: float = parameter(
        60.0, 'fastest change of the coolant in the experiment', 'K/min', 0.0, 1e6,
        open_minimum=True)
    experiment_temperature_min: float = parameter(
        31.85, 'temperature of the reactor below which the experiment is aborted', 'degC', -50.0,
        300.0)
    experiment_temperature_max: float = parameter(
        53.85, 'temperature of the reactor above which the experiment is aborted', 'degC', -50.0,
        300.0)
    experiment_timeout: float = parameter(
        10.0, 'wall time without a newer measurement after which the experiment is aborted', 's',
        0.0, 86400.0, open_minimum=True)
    experiment_seed: int = parameter(
        0, 'seed of the steps; the same seed gives the same steps', '', 0, 2 ** 31)
    safe_coolant: float = parameter(
        18.85, 'coolant temperature that is safe whatever happened; the experiment starts and '
        'ends with it', 'degC', -50.0, 150.0)

    bags: tuple[str, ...] = parameter(
        ('',), 'what to train from: .mcap files or bag folders; an empty name for what this '
        'trainer records')
    model: str = parameter(
        'reactor_nz4', 'present lift, which a new one has to beat: name of a shipped model, or '
        'path of a .safetensors model file')
    model_output: str = parameter(
        'retrained.safetensors', 'model file that an accepted lift is written to; the one before '
        'it is kept as .previous.safetensors')
    model_coordinates: int = parameter(3, 'coordinates n_z of the new lift', '', 2, 8)
    training_starts: int = parameter(
        3, 'starts of which each coordinate keeps the best', '', 1, 100)
    training_seed: int = parameter(
        0, 'seed of the training and of what is held out', '', 0, 2 ** 31)
    input_gain: float = parameter(
        0.0, 'change of dT/dt with the coolant temperature where it is known; 0 to learn it',
        '1/min', -1e6, 1e6)
    input_delay: float = parameter(
        0.0, 'dead time of the actuator: a coolant acts this long after its command', 's', 0.0,
        3600.0)
    gate_margin: float = parameter(
        0.1, 'share by which the held-out error of a new lift must be below those of the present '
        'lift and of the best linear model', '', 0.0, 0.99)
    gate_condition: float = parameter(
        1e4, 'largest condition number of the coordinates of a new lift', '', 1.0, 1e12,
        open_minimum=True)

    def experiment(self) -> Experiment:
        """Return the plan of an experiment in SI units."""
        return Experiment(
            duration=self.experiment_duration * SECONDS_PER_MINUTE,
            names=('coolant_temperature',),
            lower=np.array([to_kelvin(self.experiment_coolant_min)]),
            upper=np.array([to_kelvin(self.experiment_coolant_max)]),
            rate=np.array([self.experiment_rate_limit / SECONDS_PER_MINUTE]),
            home=np.array([to_kelvin(self.safe_coolant)]),
            hold_shortest=self.experiment_hold_min * SECONDS_PER_MINUTE,
            hold_longest=self.experiment_hold_max * SECONDS_PER_MINUTE,
            measured=('temperature',),
            measured_lower=np.array([to_kelvin(self.experiment_temperature_min)]),
            measured_upper=np.array([to_kelvin(self.experiment_temperature_max)]),
            seed=self.experiment_seed)

    def training(self) -> dict[str, Any]:
        """Return the fields of a :class:`koopman_ros.retraining.Task` that are settings."""
        return {'coordinates': self.model_coordinates, 'seed': self.training_seed,
                'starts': self.training_starts, 'input_gain': self.input_gain,
                'input_delay': self.input_delay, 'margin': self.gate_margin,
                'condition': self.gate_condition}


def _cross_check(values: TrainerParameters) -> str:
    if reason := wire.refusal(values.topics):
        return reason
    if values.output.endswith('.mcap') and (values.max_bag_size or values.max_bag_duration):
        return (f'output = {values.output!r} is one file, which max_bag_size and '
                'max_bag_duration cannot split: give the name of a folder, without .mcap')
    if not values.model_output.endswith('.safetensors'):
        return f'model_output = {values.model_output!r} must end in .safetensors'
    return ''


TABLE = ParameterTable(
    TrainerParameters, _cross_check, TrainerParameters.experiment,
    tuple((f'experiment_{name}_min', f'experiment_{name}_max')
          for name in ('coolant', 'temperature', 'hold')))


@dataclass(frozen=True)
class PlayerParameters:
    """Snapshot of the player's parameters."""

    bag: str = parameter('run_1', 'bag to play: a .mcap file or a bag folder', read_only=True)
    topics: tuple[str, ...] = parameter(
        (wire.COOLANT_TEMPERATURE, wire.TEMPERATURE, wire.SETPOINT, wire.MANUAL_COOLANT_SETPOINT),
        'topics to play; a relative name stands for that below / in the bag, and follows '
        'namespaces and remaps when it is published', read_only=True)
    rate: float = parameter(
        1.0, 'seconds of the recording, by the time of receipt, per second; 0 plays as fast as '
        'the controller answers, in lock-step', '', 0.0, 10000.0, smallest=1e-6, read_only=True)
    measurement: str = parameter(
        wire.TEMPERATURE, 'the topic among them whose messages are answered', read_only=True)
    answer: str = parameter(
        wire.COOLANT_SETPOINT, 'where the answers are heard, which carry the stamps of the '
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


def _check_player(values: PlayerParameters) -> str:
    return wire.refusal(values.topics) or wire.refusal((values.measurement, values.answer))


PLAYER_TABLE = ParameterTable(PlayerParameters, _check_player)
