# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Laws behind one protocol, by the names under which settings choose them."""

from collections.abc import Callable

from koopman_ros.control.laws.base import Figures, Law, LawResult, Plan, Tuning, Weights
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
from koopman_ros.lifting import LiftedModel

LAWS: dict[str, Callable[[LiftedModel, Tuning], Law] | str] = {
    'mpc': 'koopman_ros.control.laws.receding_horizon:RecedingHorizon',
    'sdre': StateDependentRiccati, 'linear': Linear, 'pi': ProportionalIntegral}

__all__ = ['LAWS', 'Feedback', 'Figures', 'Form', 'Law', 'LawResult', 'Linear',
           'Plan', 'ProportionalIntegral', 'StateDependentRiccati', 'Tuning', 'Weights',
           'averaged', 'feedback', 'recentred']
