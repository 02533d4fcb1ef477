# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Estimation of state and disturbance from outputs; imports lifting, signals and solvers."""

from collections.abc import Callable

from koopman_ros.estimation.kalman import ExtendedKalmanFilter, UnscentedKalmanFilter
from koopman_ros.estimation.measurement import Accepted, check, FrozenCheck, SensorLimits, Verdict
from koopman_ros.estimation.observer import (
    DisturbanceObserver,
    equivalent_bias,
    Estimate,
    Estimator,
    EstimatorTuning,
    Innovation,
    MeasuredState,
)

# By name. The Kalman filters beside the observer: that needs every state measured, and is two
# numbers in place of a covariance.
ESTIMATORS: dict[str, Callable[..., Estimator]] = {
    'disturbance_observer': DisturbanceObserver,
    'extended_kalman_filter': ExtendedKalmanFilter,
    'measured_state': MeasuredState,
    'unscented_kalman_filter': UnscentedKalmanFilter,
}

__all__ = ['ESTIMATORS', 'Accepted', 'DisturbanceObserver', 'Estimate', 'Estimator',
           'EstimatorTuning', 'ExtendedKalmanFilter', 'FrozenCheck', 'Innovation', 'MeasuredState',
           'SensorLimits', 'UnscentedKalmanFilter', 'Verdict', 'check', 'equivalent_bias']
