# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Parameters of the controller node, and of the replay: its own beside a controller's."""

from dataclasses import dataclass
import math

import numpy as np

from koopman_ros.control import InputLimits, LevelSettings, Settings, SupervisorSettings
from koopman_ros.estimation import SensorLimits
from koopman_ros.parameters.table import parameter, ParameterTable
from koopman_ros.units import SECONDS_PER_MINUTE, to_kelvin


@dataclass(frozen=True)
class ControllerParameters:
    """Snapshot of the controller's parameters, temperatures in degrees Celsius."""

    model: str = parameter(
        'reactor_nz4', 'name of a shipped model, or path of a .safetensors model file')
    temperature_weight: float = parameter(
        1.0, 'cost of a squared temperature error', '1/K^2', 0.0, 1e6, open_minimum=True)
    coolant_weight: float = parameter(
        1.0, 'cost of a squared deviation of the coolant from its steady value', '1/K^2', 0.0, 1e6,
        open_minimum=True)
    coolant_min: float = parameter(
        5.0, 'lowest coolant temperature commanded', 'degC', -50.0, 150.0)
    coolant_max: float = parameter(
        32.0, 'highest coolant temperature commanded', 'degC', -50.0, 150.0)
    coolant_rate_limit: float = parameter(
        60.0, 'fastest change of the coolant command', 'K/min', 0.0, 1e6, open_minimum=True)
    setpoint_ramp: float = parameter(
        1000.0, 'fastest change of the tracked set-point; a large value makes it a step', 'K/min',
        0.0, 1e6, open_minimum=True)
    setpoint_filter: float = parameter(
        0.0, 'time constant with which the tracked set-point follows its ramp; 0 for none', 's',
        0.0, 86400.0)
    observer_bandwidth: float = parameter(
        6.0, 'how fast disturbances are estimated: more removes offsets sooner, less lets less '
        'noise through to the coolant; 0 switches the observer off', '1/min', 0.0, 600.0)
    max_disturbance: float = parameter(
        20.0, 'largest disturbance that is accepted, as a change of the coolant', 'K', 0.0, 1000.0,
        open_minimum=True)
    coolant_tolerance: float = parameter(
        2.0, 'how far the applied coolant temperature may be from its command before the '
        'observer goes by it, as at a limit of the actuator', 'K', 0.0, 1000.0)
    transfer_time: float = parameter(
        30.0, 'time constant in which the coolant moves to what another law, model, tuning or '
        'mode asks for', 's', 0.0, 86400.0)
    safe_coolant: float = parameter(
        5.0, 'coolant temperature that is safe whatever happened, commanded when nothing else can '
        'be; brought within coolant_min and coolant_max', 'degC', -50.0, 150.0)
    validity_margin: float = parameter(
        0.1, 'how far outside the trained range the learned law acts, in halves of its width; '
        'beyond, the linear law does', '', 0.0, 100.0)
    linear_margin: float = parameter(
        0.5, 'how far outside the trained range the linear law acts, in halves of its width; '
        'beyond, the safe coolant is commanded', '', 0.0, 100.0)
    hold_timeout: float = parameter(
        60.0, 'how long the coolant is held without a usable measurement or law before it goes to '
        'safe_coolant', 's', 0.0, 86400.0)
    recovery_time: float = parameter(
        10.0, 'how long a better law must have been possible before it acts again', 's', 0.0,
        86400.0)
    measurement_timeout: float = parameter(
        10.0, 'plant time without a measurement after which the coolant is held and diagnostics '
        'turn to ERROR; 0 switches this off', 's', 0.0, 86400.0)
    max_measurement_age: float = parameter(
        5.0, 'age of a measurement at its arrival from which on diagnostics warn; 0 switches this '
        'off', 's', 0.0, 86400.0)
    sensor_min: float = parameter(
        -20.0, 'lowest temperature that the sensor can measure', 'degC', -273.15, 1000.0)
    sensor_max: float = parameter(
        150.0, 'highest temperature that the sensor can measure', 'degC', -273.15, 1000.0)
    max_temperature_rate: float = parameter(
        120.0, 'fastest change of the temperature that is physically possible', 'K/min', 0.0, 1e6,
        open_minimum=True)
    max_temperature_jump: float = parameter(
        2.0, 'change between two measurements that is accepted beside that rate, for noise', 'K',
        0.0, 1e6, open_minimum=True)
    frozen_timeout: float = parameter(
        20.0, 'how long a measurement may stay bit-identical while the model moves by more '
        'than half of max_temperature_jump; 0 for ever', 's', 0.0, 86400.0)
    max_gain: float = parameter(
        1000.0, 'largest Riccati gain, in scaled coordinates, that is acted on; small weights '
        'need a large one', '', 0.0, 1e9, open_minimum=True)
    min_riccati_digits: float = parameter(
        8.0, 'decimal digits to which a solution must fulfil its Riccati equation to be acted on',
        '', 0.0, 15.0)
    max_riccati_residual: float = parameter(
        0.0, 'the same as a relative residual, as in former files: 1.0e-08 for 8 digits; 0 leaves '
        'it to min_riccati_digits', '', 0.0, 1.0)

    def settings(self) -> Settings:
        """Return the tuning of the control step in SI units."""
        return Settings(
            state_weight=np.array([self.temperature_weight]),
            input_weight=np.array([self.coolant_weight]),
            limits=InputLimits(np.array([to_kelvin(self.coolant_min)]),
                               np.array([to_kelvin(self.coolant_max)]),
                               np.array([self.coolant_rate_limit / SECONDS_PER_MINUTE])),
            setpoint_ramp=np.array([self.setpoint_ramp / SECONDS_PER_MINUTE]),
            setpoint_filter=self.setpoint_filter,
            observer_bandwidth=self.observer_bandwidth / SECONDS_PER_MINUTE,
            max_disturbance=np.array([self.max_disturbance]),
            input_tolerance=np.array([self.coolant_tolerance]),
            transfer_time=self.transfer_time,
            safe_input=np.array([to_kelvin(self.safe_coolant)]),
            max_gain=self.max_gain,
            max_residual=self.max_riccati_residual or 10.0 ** -self.min_riccati_digits,
            sensor=SensorLimits(
                lower=np.array([to_kelvin(self.sensor_min)]),
                upper=np.array([to_kelvin(self.sensor_max)]),
                rate=np.array([self.max_temperature_rate / SECONDS_PER_MINUTE]),
                jump=np.array([self.max_temperature_jump]),
                frozen_timeout=self.frozen_timeout or math.inf),
            supervisor=SupervisorSettings(
                (LevelSettings('sdre', self.validity_margin),
                 LevelSettings('linear', self.linear_margin)),
                self.hold_timeout, self.recovery_time))


def _cross_check(values: ControllerParameters) -> str:
    if values.validity_margin > values.linear_margin:
        return (f'validity_margin = {values.validity_margin} must be at most linear_margin = '
                f'{values.linear_margin}: change the other one first')
    return ''


TABLE = ParameterTable(
    ControllerParameters, _cross_check, ControllerParameters.settings,
    (('coolant_min', 'coolant_max'), ('sensor_min', 'sensor_max')))


@dataclass(frozen=True)
class ReplayParameters(ControllerParameters):
    """Snapshot of the replay's parameters; a controller's are for the new model alone."""

    model: str = parameter(
        'reactor_nz4', 'where a recorded model is looked for beside the shipped ones: a name, a '
        '.safetensors file or a folder of them')

    bags: tuple[str, ...] = parameter(
        ('run_1',), 'bags to replay, each a run of its own: .mcap files or bag folders')
    new_model: str = parameter(
        '', 'model whose commands are compared with the recorded ones, by name or path, under the '
        'recorded parameters but for those given here; empty only checks that the recorded '
        'commands are reproduced')
    output: str = parameter(
        'replay', 'folder for report.md, summary.json and the pictures; older ones in it are '
        'replaced')
    tolerance: float = parameter(
        0.1, 'difference of two commands from which on it is counted and marked', 'K', 0.0, 100.0)
    recover: bool = parameter(
        False, 'read bags that were not closed or are damaged as far as they are whole')


def _check_replay(values: ReplayParameters) -> str:
    if not values.bags or not all(values.bags):
        return f'bags = {list(values.bags)} must hold at least one path and no empty one'
    if not values.output:
        return "output = '' must name a folder, e.g. replay"
    return _cross_check(values)


REPLAY_TABLE = ParameterTable(
    ReplayParameters, _check_replay, ReplayParameters.settings, TABLE.ordered)
