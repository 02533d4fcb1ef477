# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""How it is controlled: one pure step on a lifted model; imports lifting's run-time part only."""

from koopman_ros.control.closed_loop import ClosedLoop, run_closed_loop
from koopman_ros.control.controller import Controller
from koopman_ros.control.ladder import LadderSettings, Rung
from koopman_ros.control.laws import Feedback, feedback, Law, projected, recentred, Weights
from koopman_ros.control.limits import InputLimits, limit, LimitedInput
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
    'steady_state_target',
]
