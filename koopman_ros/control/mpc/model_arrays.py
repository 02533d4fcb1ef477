# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A model's numbers as compiled code takes them."""
import numpy as np

from koopman_ros.control.mpc.condensing import ModelArrays
from koopman_ros.lifting import LiftedModel, NetworkObservables


def model_arrays(model: LiftedModel) -> ModelArrays:
    lift, n, m = model.observables, model.n_x, model.n_u
    none = np.zeros((0, n), dtype=np.int64)
    network = isinstance(lift, NetworkObservables)
    widths = [len(bias) for _, bias in lift.hidden] if network else []
    n_phi = n + (widths[-1] if widths else 0) if network else lift.n_z
    P = np.eye(n_phi)
    if network:
        P = np.zeros((lift.n_z, n_phi))
        if lift.identity:
            P[:n, :n] = np.eye(n)
        if widths:
            P[:, n:] = lift.rows
    terms = model.input_terms
    parts = (
        np.array(widths, dtype=np.int64),
        np.concatenate([np.zeros(0), *(part.ravel() for weight, bias in (lift.hidden if network else ())
                         for part in (weight.T, bias))]),
        lift.value_at_zero if widths else np.zeros(0),
        none if network else lift.exponents, P, model.A,
        np.zeros((0, n_phi)) if model.readout is None else model.readout, model.pre_feedback_slope,
        model.B, none if terms is None else terms._monomials.exponents,
        np.zeros((0, n, m)) if terms is None else terms.coefficients)
    parts = [np.array(part) for part in parts]
    for part in parts:
        part.setflags(write=False)
    return ModelArrays(*parts)
