# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Set-point control on lifted models: pure, no ROS; imports estimation, lifting and solvers."""

from koopman_ros.control.closed_loop import ClosedLoop, run_closed_loop
from koopman_ros.control.controller import Controller
from koopman_ros.control.laws import (
    Feedback,
    feedback,
    Form,
    LAWS,
    projected,
    recentred,
    Weights,
)
from koopman_ros.control.levels import weights_of
from koopman_ros.control.limits import InputLimits, limit, LimitedInput
from koopman_ros.control.report import Arrival, Report
from koopman_ros.control.setpoint import Setpoint
from koopman_ros.control.settings import Settings
from koopman_ros.control.state import Mode, State
from koopman_ros.control.supervisor import (
    HOLD,
    LevelSettings,
    MANUAL,
    SAFE,
    Supervisor,
    SupervisorSettings,
)
from koopman_ros.control.target import steady_state_target, Target

__all__ = [
    'HOLD',
    'LAWS',
    'MANUAL',
    'SAFE',
    'Arrival',
    'ClosedLoop',
    'Controller',
    'Feedback',
    'Form',
    'InputLimits',
    'LevelSettings',
    'LimitedInput',
    'Mode',
    'Report',
    'Setpoint',
    'Settings',
    'State',
    'Supervisor',
    'SupervisorSettings',
    'Target',
    'Weights',
    'feedback',
    'limit',
    'projected',
    'recentred',
    'run_closed_loop',
    'steady_state_target',
    'weights_of',
]
