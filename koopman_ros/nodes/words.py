# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The words of the nodes: reasons as an operator reads them, temperatures in degrees Celsius."""

from koopman_ros.lifting import LiftedModel
from koopman_ros.reasons import Words
from koopman_ros.units import Display, Displays

_SHOWN = {'K': Display('K', 'degC', '.2f')}
OPERATOR = Words(Displays({'temperature': 'K', 'coolant_temperature': 'K'}, _SHOWN))


def words_of(model: LiftedModel) -> Words:
    """Return the words for the signals of a model."""
    return Words(Displays({name: unit for signals in (model.states, model.inputs)
                           for name, unit in zip(signals.names, signals.units, strict=True)},
                          _SHOWN))
