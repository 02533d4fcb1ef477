# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Identification of dx/dt = f(x, u), where some inputs do not act linearly."""

from __future__ import annotations

from collections.abc import Sequence
import contextlib
from dataclasses import replace
import math
from typing import Any

import numpy as np

from koopman_ros.core.datasets import Episode, PlantDescription
from koopman_ros.learning.identification.drift import Drift, DriftModel
from koopman_ros.learning.identification.identify import Identified, identify, usual_degrees
from koopman_ros.learning.identification.input_functions import Legendre, NonAffineDrift
from koopman_ros.learning.identification.structure_candidates import compared
from koopman_ros.learning.identification.structure_search import free_run_errors
from koopman_ros.model import Box, Coordinates

_HIGHEST_FUNCTION, _MOST_FUNCTIONS = 7, 20  # degree in the inputs, and number
_HIGHEST_DEGREE = 4  # of the drift without them


def identify_non_affine(plant: PlantDescription, episodes: Sequence[Episode],
                        names: Sequence[str], **options: Any) -> Identified:
    """
    Estimate dx/dt = f(x, u) as :func:`identify`, f a polynomial in x and in some inputs.

    Legendre of the inputs have factors of degree 1 in x, or 2 where simulations then err less.

    :param plant: without B; see :func:`identify`, like the options.
    :param names: inputs that do not act linearly.
    :raises ValueError: as :func:`identify`, and for a known B.
    """
    if plant.B is not None:
        raise ValueError(f'the input matrix is given, by which {", ".join(names)} would act '
                         'linearly: give no input_matrix')
    linear = identify(plant, episodes, **{**options, 'degrees': (1,)})
    functions = _functions(linear.drift.box.inputs, names)
    m, k = len(plant.input_names), len(functions.arguments)
    more = replace(
        plant, input_names=functions.coordinates().names, input_units=(
            *plant.input_units, *('1',) * k), nominal_input=np.full(m + k, np.nan))
    options = {'degrees': [degree for degree in usual_degrees(len(plant.state_names))
                           if degree <= _HIGHEST_DEGREE], **options}
    added = [functions.added(one) for one in episodes]
    found = identify(replace(more, input_matrix_degree=1), added, **options)
    # of many coefficients the simulations may diverge
    with contextlib.suppress(ValueError):
        other = identify(replace(more, input_matrix_degree=2), added, **options)
        if compared(free_run_errors(other)[0], free_run_errors(found)[0])[0]:
            found = other

    def of_inputs(drift: Drift) -> NonAffineDrift:
        assert isinstance(drift, DriftModel)
        box = drift.box
        return NonAffineDrift(
            Box(box.states, box.inputs.only(plant.input_names), box.time_unit), drift, functions)

    return found.mapped(
        of_inputs, lambda one: replace(one, u=one.u[:, :m], linear=one.linear[:m]),
        linear=linear.drift, dead_time=np.zeros(()), warnings=linear.warnings)


def _functions(inputs: Coordinates, names: Sequence[str]) -> Legendre:
    """Return polynomials of some inputs, to the highest degree with few enough of them."""
    count = len(names)
    return Legendre.of(inputs, names, max(
        degree for degree in range(2, _HIGHEST_FUNCTION + 1)
        if degree == 2 or math.comb(count + degree, degree) - 1 - count <= _MOST_FUNCTIONS))
