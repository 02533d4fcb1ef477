# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The numbers of a model in two flat arrays, as compiled code takes them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from koopman_ros.arrays import Array
from koopman_ros.lifting.observables import NetworkObservables

if TYPE_CHECKING:
    from koopman_ros.lifting.model import LiftedModel


@dataclass(frozen=True, eq=False)
class Layout:
    """The numbers of a model of a network with a constant input matrix."""

    #: n_x, n_u, n_z, whether z starts with the state, whether there is a read-out, and, unless
    #: there are none, the number h of hidden units
    sizes: NDArray[np.int64]
    #: row by row: W' (n_x, h), b (h,), h(0) (h,), V (n_z, h) below rows of zeros for the state,
    #: A (n_z, n_z), B (n_x, n_u), slope of the pre-feedback (n_x, n_x), and the read-out
    #: (n_x, n_x + h), zeros where there is none
    numbers: Array


def layout_of(model: LiftedModel) -> Layout | None:
    """Return the numbers of a model; None for monomials, or an input matrix of the state."""
    network = model.observables
    if not isinstance(network, NetworkObservables) or model.input_terms is not None:
        return None
    h = len(network.W)
    rows = np.zeros((model.n_z, h))
    rows[model.n_z - len(network.V):] = network.V
    readout = np.zeros((model.n_x, model.n_x + h)) if model.readout is None else model.readout
    return Layout(
        np.array([model.n_x, model.n_u, model.n_z, network.identity, model.readout is not None,
                  *([h] if h else [])], dtype=np.int64),
        np.concatenate([part.ravel() for part in (
            network.W.T, network.b, network.value_at_zero, rows, model.A, model.B,
            model.pre_feedback_slope, readout)]))
