# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Control laws, by the names under which a tuning chooses them."""

from koopman_ros.control.laws.base import Law, LawResult, Plan, Weights
from koopman_ros.control.laws.pi import ProportionalIntegral
from koopman_ros.control.laws.riccati import (
    averaged,
    Feedback,
    feedback,
    Form,
    Linear,
    recentred,
    StateDependentRiccati,
)

#: by name; a text is imported on first use
LAWS: dict[str, type[Law] | str] = {
    'mpc': 'koopman_ros.control.mpc:RecedingHorizon',
    'sdre': StateDependentRiccati, 'linear': Linear, 'pi': ProportionalIntegral}

__all__ = ['LAWS', 'Feedback', 'Form', 'Law', 'LawResult', 'Linear', 'Plan',
           'ProportionalIntegral', 'StateDependentRiccati', 'Weights', 'averaged', 'feedback',
           'recentred']
