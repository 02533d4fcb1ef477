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

"""What a lift is: its functions, its model and the file; in numpy, imports nothing of ours."""

from koopman_ros.lifting.artefact import load, ModelFileError, save
from koopman_ros.lifting.linearisation import linearised_model
from koopman_ros.lifting.model import Coordinates, LiftedModel, Provenance
from koopman_ros.lifting.observables import (
    NetworkObservables,
    Observables,
    PolynomialObservables,
)
from koopman_ros.lifting.training_states import TrainingStates

__all__ = [
    'Coordinates',
    'LiftedModel',
    'ModelFileError',
    'NetworkObservables',
    'Observables',
    'PolynomialObservables',
    'Provenance',
    'TrainingStates',
    'linearised_model',
    'load',
    'save',
]
