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
How a lift is learned from samples, in torch; imports lifting and control.

Nothing else imports torch, and no node imports this package where it controls or simulates.
"""

from koopman_ros.learning.algorithm1 import Algorithm1
from koopman_ros.learning.baselines import Edmd, Linearisation
from koopman_ros.learning.growth import Growth
from koopman_ros.learning.samples import Plant, Samples, Scaling, split_by_episode
from koopman_ros.learning.training import (
    NoUsefulLift,
    Progress,
    RECIPES,
    train,
    Trained,
)
from koopman_ros.learning.validation import (
    compare_closed_loops,
    Fit,
    fit,
    judge,
    Report,
    roll_out,
    rollout_rmse,
)

__all__ = [
    'RECIPES',
    'Algorithm1',
    'Edmd',
    'Fit',
    'Growth',
    'Linearisation',
    'NoUsefulLift',
    'Plant',
    'Progress',
    'Report',
    'Samples',
    'Scaling',
    'Trained',
    'compare_closed_loops',
    'fit',
    'judge',
    'roll_out',
    'rollout_rmse',
    'split_by_episode',
    'train',
]
