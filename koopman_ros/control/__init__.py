# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Set-point control on lifted models: pure, no ROS."""

from koopman_ros.control.controller import Controller
from koopman_ros.control.events import (
    AnalysisValue,
    ClearSafeState,
    Event,
    Initialisation,
    ManualCommand,
    Measurement,
    ModeChange,
    SetpointRequest,
    Silence,
)
from koopman_ros.control.laws import averaged, Feedback, feedback, Form, LAWS, recentred, Weights
from koopman_ros.control.laws.base import Target
from koopman_ros.control.setpoint import Setpoint
from koopman_ros.control.state import Arrival, Mode, State, StepReport
from koopman_ros.control.steady_state import steady_state_target
from koopman_ros.control.supervisor import HOLD, MANUAL, SAFE, Supervisor
from koopman_ros.tuning import InputLimits, SensorLimits, Tuning

__all__ = ['HOLD', 'LAWS', 'MANUAL', 'SAFE', 'AnalysisValue', 'Arrival', 'ClearSafeState',
           'Controller', 'Event', 'Feedback', 'Form', 'Initialisation', 'InputLimits',
           'ManualCommand', 'Measurement', 'Mode', 'ModeChange', 'SensorLimits', 'Setpoint',
           'SetpointRequest', 'Silence', 'State', 'StepReport', 'Supervisor', 'Target', 'Tuning',
           'Weights', 'averaged', 'feedback', 'recentred', 'steady_state_target']
