# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Lifted models at run time: observables, scaling, model file; in numpy alone."""

from koopman_ros.lifting.artefact import load, load_with_digest, ModelFileError, save
from koopman_ros.lifting.coordinates import Box, Coordinates, TrainingStates, TriedLoops
from koopman_ros.lifting.input_terms import InputTerms
from koopman_ros.lifting.model import LiftedModel, linearised_model, Provenance
from koopman_ros.lifting.observables import NetworkObservables, Observables, PolynomialObservables
from koopman_ros.lifting.shared import load_shared

__all__ = ['Box', 'Coordinates', 'InputTerms', 'LiftedModel', 'ModelFileError',
           'NetworkObservables', 'Observables', 'PolynomialObservables', 'Provenance',
           'TrainingStates', 'TriedLoops', 'linearised_model', 'load', 'load_shared',
           'load_with_digest', 'save']
