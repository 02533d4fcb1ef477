# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A model's numbers in one row, as compiled code takes them: two arrays whatever the depth."""

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
    """The numbers of a model with a network of tanh and a constant input matrix."""

    #: n_x, n_u, n_z, whether z starts with the state, whether there is a read-out, and the width
    #: of each hidden layer
    sizes: NDArray[np.int64]
    #: transposed weight and bias of each hidden layer, its last one at the origin, (n_z, h) output
    #: with rows of zeros for the state, A, B, the slope of the pre-feedback, and (n_x, n_x + h)
    #: read-out, of zeros where there is none
    numbers: Array


def layout_of(model: LiftedModel) -> Layout | None:
    """Return the numbers of a model; None for one of another kind."""
    network = model.observables
    if (not isinstance(network, NetworkObservables) or network.activation != 'tanh'
            or model.input_terms is not None):
        return None
    widths = [len(bias) for _, bias in network.hidden]
    width = widths[-1] if widths else 0
    readout = np.zeros((model.n_x, model.n_x + width)) if model.readout is None else model.readout
    parts = [part for weight, bias in network.hidden for part in (weight.T, bias)]
    if widths:
        parts += [network.value_at_zero, network.rows]
    parts += [model.A, model.B, model.pre_feedback_slope, readout]
    return Layout(
        np.array([model.n_x, model.n_u, model.n_z, network.identity, model.readout is not None,
                  *widths], dtype=np.int64),
        np.concatenate([part.ravel() for part in parts]))
