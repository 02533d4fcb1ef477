# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The arrays of a model as the compiled functions take them."""

import numpy as np

from koopman_ros.control.mpc.condensing import ModelArrays
from koopman_ros.model import LiftedModel, NetworkObservables, PolynomialObservables


def model_arrays(model: LiftedModel) -> ModelArrays:
    """Return the arrays of a model of any kind."""
    lift, n, terms = model.observables, model.n_x, model.input_terms
    W, b = np.zeros((0, n)), np.zeros(0)
    exponents = input_exponents = np.zeros((0, n), dtype=np.int64)
    if isinstance(lift, PolynomialObservables):
        exponents, P = lift.exponents, np.eye(lift.n_z)
    else:
        assert isinstance(lift, NetworkObservables)
        W, b, states = lift.W, lift.b, lift.n_z - len(lift.V)
        P = np.zeros((lift.n_z, n + len(b)))
        P[:states, :n], P[states:, n:] = np.eye(states, n), lift.V
    if terms is not None:
        input_exponents = PolynomialObservables.total_degree(n, terms.degree).exponents
    arrays = [np.array(part, order='C') for part in (
        W, b, np.tanh(b), exponents, P, model.A,
        np.zeros((0, P.shape[1])) if model.readout is None else model.readout,
        model.pre_feedback_slope, model.B, input_exponents,
        np.zeros((0, n, model.n_u)) if terms is None else terms.coefficients)]
    for array in arrays:
        # numba distinguishes arrays that can be written to
        array.setflags(write=False)
    return ModelArrays(*arrays)
