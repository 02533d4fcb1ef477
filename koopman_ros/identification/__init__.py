# Copyright 2026 The koopman_ros Authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.


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
