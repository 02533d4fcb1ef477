# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What a lift is: its functions, its model and the file; in numpy, imports nothing of ours."""

from koopman_ros.lifting.artefact import load, load_with_digest, ModelFileError, save
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
    'load_with_digest',
    'save',
]
