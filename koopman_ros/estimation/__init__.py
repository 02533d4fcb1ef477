# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Estimation of state and disturbance from measured outputs; imports lifting and signals."""

from collections.abc import Callable

from koopman_ros.estimation.measurement import Accepted, check, FrozenCheck, SensorLimits, Verdict
from koopman_ros.estimation.observer import (
    DisturbanceObserver,
    equivalent_bias,
    Estimate,
    Estimator,
    MeasuredState,
)

# From a model, the observer's bandwidth in 1/s, and the largest disturbance (n_u,), as an input in
# scaled deviations.
ESTIMATORS: dict[str, Callable[..., Estimator]] = {
    'disturbance_observer': DisturbanceObserver,
    'measured_state': MeasuredState,
}

__all__ = ['ESTIMATORS', 'Accepted', 'DisturbanceObserver', 'Estimate', 'Estimator', 'FrozenCheck',
           'MeasuredState', 'SensorLimits', 'Verdict', 'check', 'equivalent_bias']
