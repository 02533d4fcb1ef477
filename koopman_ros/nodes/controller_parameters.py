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

"""Parameters of the controller node."""

from __future__ import annotations

from dataclasses import dataclass

from koopman_ros.control import InputLimits, Settings
from koopman_ros.nodes.messages import SECONDS_PER_MINUTE, to_kelvin
from koopman_ros.nodes.parameters import parameter, ParameterTable
import numpy as np


@dataclass(frozen=True)
class ControllerParameters:
    """Snapshot of the controller's parameters, temperatures in degrees Celsius."""

    model: str = parameter(
        'reactor_nz4', 'name of a shipped model, or path of a .safetensors model file')
    temperature_weight: float = parameter(
        1.0, 'cost of a squared temperature error', unit='1/K^2', minimum=0.0, maximum=1e6,
        open_minimum=True)
    coolant_weight: float = parameter(
        1.0, 'cost of a squared deviation of the coolant from its steady value', unit='1/K^2',
        minimum=0.0, maximum=1e6, open_minimum=True)
    coolant_min: float = parameter(
        5.0, 'lowest coolant temperature commanded', unit='degC', minimum=-50.0, maximum=150.0)
    coolant_max: float = parameter(
        32.0, 'highest coolant temperature commanded', unit='degC', minimum=-50.0, maximum=150.0)
    coolant_rate_limit: float = parameter(
        60.0, 'fastest change of the coolant command', unit='K/min', minimum=0.0, maximum=1e6,
        open_minimum=True)
    setpoint_ramp: float = parameter(
        1000.0, 'fastest change of the tracked set-point; a large value makes it a step',
        unit='K/min', minimum=0.0, maximum=1e6, open_minimum=True)
    measurement_timeout: float = parameter(
        10.0, 'wall time without a measurement after which diagnostics turn to ERROR', unit='s',
        minimum=0.0, maximum=86400.0, open_minimum=True)
    max_gain: float = parameter(
        1000.0, 'largest Riccati gain, in scaled coordinates, that is acted on; small weights '
        'need a large one', minimum=0.0,
        maximum=1e9, open_minimum=True)
    max_riccati_residual: float = parameter(
        1e-8, 'largest relative Riccati residual that is acted on', minimum=0.0, maximum=1.0,
        open_minimum=True)

    def settings(self) -> Settings:
        """Return the tuning of the control step in SI units."""
        return Settings(
            state_weight=np.array([self.temperature_weight]),
            input_weight=np.array([self.coolant_weight]),
            limits=InputLimits(np.array([to_kelvin(self.coolant_min)]),
                               np.array([to_kelvin(self.coolant_max)]),
                               np.array([self.coolant_rate_limit / SECONDS_PER_MINUTE])),
            setpoint_ramp=self.setpoint_ramp / SECONDS_PER_MINUTE,
            max_gain=self.max_gain, max_residual=self.max_riccati_residual)


def _cross_check(values: ControllerParameters) -> str:
    if not values.coolant_min < values.coolant_max:
        return (f'coolant_min = {values.coolant_min} degC must be below coolant_max = '
                f'{values.coolant_max} degC: change the other one first')
    return ''


TABLE = ParameterTable(ControllerParameters, _cross_check)
