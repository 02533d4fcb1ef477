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

"""How it is controlled: one pure step on a lifted model; imports lifting's run-time part only."""

from koopman_ros.control.closed_loop import ClosedLoop, run_closed_loop
from koopman_ros.control.controller import Controller
from koopman_ros.control.ladder import LadderSettings, Rung
from koopman_ros.control.laws import Feedback, feedback, Law, projected, recentred, Weights
from koopman_ros.control.limits import InputLimits, limit, LimitedInput
from koopman_ros.control.riccati import RiccatiSolution, RiccatiStatus, solve_riccati
from koopman_ros.control.sensor import SensorLimits
from koopman_ros.control.setpoint import Setpoint
from koopman_ros.control.state import Mode, Report, Settings, State
from koopman_ros.control.target import steady_state_target, Target

__all__ = [
    'ClosedLoop',
    'Controller',
    'Feedback',
    'InputLimits',
    'LadderSettings',
    'Law',
    'LimitedInput',
    'Mode',
    'Report',
    'RiccatiSolution',
    'RiccatiStatus',
    'Rung',
    'SensorLimits',
    'Setpoint',
    'Settings',
    'State',
    'Target',
    'Weights',
    'feedback',
    'limit',
    'projected',
    'recentred',
    'run_closed_loop',
    'solve_riccati',
    'steady_state_target',
]
