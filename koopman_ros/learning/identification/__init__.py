# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Estimates of a plant's drift from sampled, noisy measurements.

Training needs states with their derivatives; sensors give states with noise. Here the drift of
dx/dt = f(x) + B u is found from the measurements first; the lift is then learned from that drift.
"""

from koopman_ros.identification_methods import WeakFormParameters
from koopman_ros.learning.identification.base import (
    DriftEstimate,
    DriftProblem,
    IdentificationMethod,
    methods_of,
)
from koopman_ros.learning.identification.characteristics import (
    identify_measured,
    identify_with_characteristics,
)
from koopman_ros.learning.identification.dead_time import DeadTimes, find_dead_times
from koopman_ros.learning.identification.drift import (
    box_of,
    Drift,
    DriftModel,
    fitted_starts,
    longest_step,
    prediction_error,
    Segments,
)
from koopman_ros.learning.identification.grey_box import estimate_parameters
from koopman_ros.learning.identification.identify import (
    EstimatedConstant,
    EstimateStatus,
    Identified,
    identify,
    Score,
    Stopped,
)
from koopman_ros.learning.identification.lag import find_lags, lagged, LaggedDrift, with_lag
from koopman_ros.learning.identification.non_affine import identify_non_affine
from koopman_ros.learning.identification.output_error import output_error
from koopman_ros.learning.identification.structure_search import identify_structure
from koopman_ros.learning.identification.total_variation import (
    noise_level,
    total_variation,
    TotalVariation,
)
from koopman_ros.learning.identification.unmeasured_states import identify_unmeasured
from koopman_ros.learning.identification.weak_form import weak_form, WeakForm

__all__ = ['DeadTimes', 'Drift', 'DriftEstimate', 'DriftModel', 'DriftProblem', 'EstimateStatus',
           'EstimatedConstant', 'IdentificationMethod', 'Identified', 'LaggedDrift', 'Score',
           'Segments', 'Stopped', 'TotalVariation', 'WeakForm', 'WeakFormParameters', 'box_of',
           'estimate_parameters', 'find_dead_times', 'find_lags', 'fitted_starts', 'identify',
           'identify_measured', 'identify_non_affine', 'identify_structure', 'identify_unmeasured',
           'identify_with_characteristics', 'lagged', 'longest_step', 'methods_of', 'noise_level',
           'output_error', 'prediction_error', 'total_variation', 'weak_form', 'with_lag']
