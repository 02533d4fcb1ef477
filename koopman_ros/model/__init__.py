# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The learned model at run time, and its file."""

from koopman_ros.model.coordinates import Box, Coordinates
from koopman_ros.model.input_matrix import InputTerms
from koopman_ros.model.lifted_model import (
    APPLIED,
    COMMANDED,
    LiftedModel,
    linearised_model,
    LONGEST_DEAD_TIME,
)
from koopman_ros.model.model_file import load, load_with_digest, ModelFileError, save
from koopman_ros.model.observables import NetworkObservables, Observables, PolynomialObservables
from koopman_ros.model.provenance import Provenance
from koopman_ros.model.rate_band import RateBand
from koopman_ros.model.training_data import TrainingStates, VerifiedLoops

__all__ = ['APPLIED', 'COMMANDED', 'LONGEST_DEAD_TIME', 'Box', 'Coordinates', 'InputTerms',
           'LiftedModel', 'ModelFileError', 'NetworkObservables', 'Observables',
           'PolynomialObservables', 'Provenance', 'RateBand', 'TrainingStates',
           'VerifiedLoops', 'linearised_model', 'load', 'load_with_digest', 'save']
