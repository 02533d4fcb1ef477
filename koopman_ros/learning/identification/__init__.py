# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Estimates of a plant's drift from sampled, noisy measurements.

Training needs states with their derivatives; sensors give states with noise. Here the drift of
dx/dt = f(x) + B u is found from the measurements first; the lift is then learned from that drift.
"""

from koopman_ros.learning.identification.drift import (
    box_of,
    Drift,
    DriftModel,
    fitted_starts,
    longest_step,
    prediction_error,
    Segments,
)
from koopman_ros.learning.identification.grey_box import identify_grey
from koopman_ros.learning.identification.identify import (
    EstimatedConstant,
    Identified,
    identify,
    Method,
    METHODS,
    Score,
    Standing,
    Stopped,
    weak_forms,
)
from koopman_ros.learning.identification.output_error import output_error
from koopman_ros.learning.identification.unmeasured_states import identify_hidden
from koopman_ros.learning.identification.weak_form import noise_level, total_variation, weak_form

__all__ = [
    'METHODS', 'Drift', 'DriftModel', 'EstimatedConstant', 'Identified', 'Method', 'Score',
    'Segments', 'Standing', 'Stopped', 'box_of', 'fitted_starts', 'identify', 'identify_grey',
    'identify_hidden', 'longest_step', 'noise_level', 'output_error', 'prediction_error',
    'total_variation', 'weak_form', 'weak_forms',
]
