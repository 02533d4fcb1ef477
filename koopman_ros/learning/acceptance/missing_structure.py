# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The part of a plant's structure that a drift lacks, by the corrections that a record demands."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

from koopman_ros.learning.acceptance.corrections import CorrectionPosterior


class Cause(Enum):
    """Groups of corrections; the value says which structure is missing, and the next step."""

    input_nonlinear = ('the effect of {inputs} is nonlinear: estimate a characteristic, or set '
                       'as_state')
    input_times_state = ('the effect of {inputs} depends on the state: increase '
                         'input_matrix_degree')
    input_nonlinear_times_state = ('the effect of {inputs} is nonlinear and depends on the state: '
                                   'set as_state')
    state = ('the drift lacks a function of the states: set unmeasured_states, or record more '
             'where the states are now rare')


class MissingStructure(NamedTuple):
    """The largest group of the corrections."""

    cause: Cause
    share: float  #: of the motion, as root mean squares
    text: str  #: the cause and the next step


def missing_structure(posterior: CorrectionPosterior) -> MissingStructure | None:
    """Return the largest group of corrections, or None where all of them are small."""
    shares = posterior.shares()
    name = max(shares, key=lambda one: shares[one])
    cause, inputs = Cause[name], ' or '.join(posterior.drift.box.inputs.names)
    return None if shares[name] < posterior.settings.noticeable_cause else MissingStructure(
        cause, shares[name], cause.value.format(inputs=inputs))
