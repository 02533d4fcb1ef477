# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Set-point control on lifted models: pure, no ROS."""

from koopman_ros.control.controller import Controller
from koopman_ros.control.events import (
    Event,
    Initialisation,
    ManualCommand,
    Measurement,
    ModeChange,
    SetpointRequest,
    Silence,
)
from koopman_ros.control.hindsight import compare, Comparison, Recent, Windows
from koopman_ros.control.law_check import check_law, LawCheck
from koopman_ros.control.laws import averaged, Feedback, feedback, Form, LAWS, recentred, Weights
from koopman_ros.control.laws.base import steady_state_target, Target
from koopman_ros.control.setpoint import Setpoint
from koopman_ros.control.simulate import (
    at,
    Change,
    ClosedLoop,
    exchange,
    Loop,
    perfect,
    Plant,
    restart,
    run_closed_loop,
    Sensor,
    simulate,
    Simulation,
    Timed,
)
from koopman_ros.control.state import Arrival, Mode, Report, State
from koopman_ros.control.supervisor import HOLD, MANUAL, SAFE, Supervisor
from koopman_ros.tuning import InputLimits, SensorLimits, Tuning

__all__ = ['HOLD', 'LAWS', 'MANUAL', 'SAFE', 'Arrival', 'Change', 'ClosedLoop', 'Comparison',
           'Controller', 'Event', 'Feedback', 'Form', 'Initialisation', 'InputLimits', 'LawCheck',
           'Loop', 'ManualCommand', 'Measurement', 'Mode', 'ModeChange', 'Plant', 'Recent',
           'Report', 'Sensor', 'SensorLimits', 'Setpoint', 'SetpointRequest', 'Silence',
           'Simulation', 'State', 'Supervisor', 'Target', 'Timed', 'Tuning', 'Weights', 'Windows',
           'at', 'averaged', 'check_law', 'compare', 'exchange', 'feedback', 'perfect',
           'recentred', 'restart', 'run_closed_loop', 'simulate', 'steady_state_target']
