# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Whether a controller can run with a model, for its acceptance and for its loading."""

import math

from koopman_ros.core.message_fields import SIGNAL_NAME
from koopman_ros.core.units import Display, display_unit
from koopman_ros.model import LiftedModel


def unusable(model: LiftedModel) -> str:
    """Say which name, nominal value or range keeps a controller from running, or nothing."""
    inputs = model.joined.inputs
    if wrong := [name for name in (*model.states.names, *inputs.names)
                 if not SIGNAL_NAME.fullmatch(name)]:
        return (f'{wrong[0]!r} is the name of a signal, used in topics and parameters: train the '
                'model again with a name of letters, digits and _, beginning with a letter')
    if taken := set(model.states.names) & set(inputs.names):
        return (f'a state and an input are both named {min(taken)}: train the model again with '
                'different names')
    for kind, signals in (('state', model.states), ('input', inputs)):
        for name, unit, low, center, high in zip(
                signals.names, signals.units, signals.lower.tolist(), signals.center.tolist(),
                signals.upper.tolist(), strict=True):
            text = Display(unit, display_unit(unit), '.4g').text
            if low <= (0.0 if unit == 'K' else -math.inf):
                return (f'the trained range of {name} begins at {low:.4g} {unit}, which is '
                        'impossible: train the model again from other data')
            if not low <= center <= high:
                remedy = ('record data around a state that the plant can '
                          'hold' if kind == 'state' else
                          f'record {name} {"down" if center < low else "up"} to {text(center)}')
                return (f'the nominal {name}, {text(center)}, is outside its trained range, '
                        f'{text(low)} to {text(high)}: {remedy} and train the model again')
    return ''
