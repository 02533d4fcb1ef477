# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The sentence about the plant: the same in console, report, node and panel."""

import numpy as np

from koopman_ros.core.arrays import Array
from koopman_ros.evaluation.closed_loop_settings import SETTINGS
from koopman_ros.learning.acceptance.plant_test import PlantTest
from koopman_ros.model import Coordinates


def statement(test: PlantTest, error: Array, states: Coordinates, time_unit: str) -> str:
    """
    Return the result of the closed loops, with the bound for the plant and the error of its rate.

    :param error: (n_x,) of the rates, in state units per time unit.
    """
    bound = 100.0 * test.share[1]
    rates = ', '.join(f'{value:.2g} {unit}/{time_unit}' + f' in {name}' * (len(states) > 1)
                      for name, unit, value in zip(states.names, states.units, error, strict=True))
    return (f'On {len(test.loops)} plants that the record cannot distinguish from yours, '
            f'{int(np.sum(test.failed))} of {int(np.sum(test.loops))} loops cost over '
            f'{SETTINGS.most_excess:g} times the best or did not arrive; on yours at most '
            f'{float(f"{bound:.2g}"):g} % do ({100.0 * test.settings.confidence:g} % confidence). '
            f'Where data are, the rate may be wrong by up to {rates}')
