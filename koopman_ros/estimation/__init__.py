# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Estimation of state and disturbance from measurements."""

from koopman_ros.estimation.base import (
    Estimate,
    Estimator,
    Innovation,
    with_applied,
    with_commands,
)
from koopman_ros.estimation.dead_time import (
    AppliedInputs,
    held_means,
    PendingInputs,
)
from koopman_ros.estimation.disturbance_observer import (
    DisturbanceObserver,
    equivalent_bias,
    MeasuredState,
)
from koopman_ros.estimation.history import Analysis, History, Instant, Pieces
from koopman_ros.estimation.kalman_filters import ExtendedKalmanFilter, UnscentedKalmanFilter
from koopman_ros.estimation.measured_disturbances import (
    check_disturbances,
    MeasuredDisturbances,
)
from koopman_ros.estimation.sensor_checks import Accepted, check, Standstill, Verdict

#: by name
ESTIMATORS: dict[str, type[Estimator] | str] = {
    'disturbance_observer': DisturbanceObserver,
    'extended_kalman_filter': ExtendedKalmanFilter,
    'measured_state': MeasuredState,
    'unscented_kalman_filter': UnscentedKalmanFilter,
}

__all__ = ['ESTIMATORS', 'Accepted', 'Analysis', 'AppliedInputs', 'DisturbanceObserver',
           'Estimate', 'Estimator', 'ExtendedKalmanFilter', 'History', 'Innovation', 'Instant',
           'MeasuredDisturbances', 'MeasuredState', 'PendingInputs', 'Pieces', 'Standstill',
           'UnscentedKalmanFilter', 'Verdict', 'check', 'check_disturbances', 'equivalent_bias',
           'held_means', 'with_applied',
           'with_commands']
