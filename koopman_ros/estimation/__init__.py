# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Estimation of state and disturbance from measured outputs; imports lifting and signals."""

from koopman_ros.estimation.base import Estimate, Estimator
from koopman_ros.estimation.frozen import FrozenCheck
from koopman_ros.estimation.measurement import Accepted, check, SensorLimits, Verdict
from koopman_ros.estimation.observer import (
    DisturbanceObserver,
    equivalent_bias,
    MeasuredState,
)

__all__ = [
    'Accepted',
    'DisturbanceObserver',
    'Estimate',
    'Estimator',
    'FrozenCheck',
    'MeasuredState',
    'SensorLimits',
    'Verdict',
    'check',
    'equivalent_bias',
]
