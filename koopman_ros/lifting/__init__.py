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
How a lift is learned and used; imports nothing of ours.

Listed here is the run-time part, in numpy alone, which a controller loads. What it does not need
is imported by name: ``koopman_ros.lifting.validation`` (scipy's integrators) and
``koopman_ros.lifting.training`` and ``.growth`` (torch).
"""

from koopman_ros.lifting.artefact import load, ModelFileError, save
from koopman_ros.lifting.linearisation import linearised_model
from koopman_ros.lifting.model import Coordinates, LiftedModel, Provenance

__all__ = [
    'Coordinates',
    'LiftedModel',
    'ModelFileError',
    'Provenance',
    'linearised_model',
    'load',
    'save',
]
