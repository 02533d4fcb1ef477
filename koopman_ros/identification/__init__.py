# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0


"""
How a plant's drift is estimated from sampled, noisy measurements; imports learning, lifting.

Training needs states with their derivatives; sensors give states with noise. Here the drift of
dx/dt = f(x) + B u is found from the measurements first; the lift is then learned from that drift.
"""

from koopman_ros.identification.drift import Box, DriftModel
from koopman_ros.identification.identify import Identified, identify, Score, Stopped
from koopman_ros.identification.output_error import output_error
from koopman_ros.identification.records import cut, Record
from koopman_ros.identification.stretches import (
    fitted_starts,
    longest_step,
    prediction_error,
    Stretches,
)
from koopman_ros.identification.total_variation import noise_level, total_variation
from koopman_ros.identification.weak_form import weak_form

__all__ = [
    'Box',
    'DriftModel',
    'Identified',
    'Record',
    'Score',
    'Stopped',
    'Stretches',
    'cut',
    'fitted_starts',
    'identify',
    'longest_step',
    'noise_level',
    'output_error',
    'prediction_error',
    'total_variation',
    'weak_form',
]
