# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Whether a controller can run with a model, for its acceptance and for its loading."""

import math

from koopman_ros.lifting import LiftedModel
from koopman_ros.units import Display, display_unit


def unusable(model: LiftedModel) -> str:
    """Say which nominal value or range of a model keeps a controller from running, or nothing."""
    for kind, signals in (('state', model.states), ('input', model.inputs)):
        for name, unit, low, center, high in zip(
                signals.names, signals.units, signals.lower.tolist(), signals.center.tolist(),
                signals.upper.tolist(), strict=True):
            text = Display(unit, display_unit(unit), '.4g').text
            if low <= (0.0 if unit == 'K' else -math.inf):
                return (f'the trained range of {name} begins at {low:.4g} {unit}, which cannot be: '
                        'train the model again from other data')
            if not low <= center <= high:
                remedy = (f'record {name} {"down" if center < low else "up"} to {text(center)} and '
                          'train the model again' if kind == 'input' else
                          'record around a state that the plant can hold and train the model again')
                return (f'the nominal {name}, {text(center)}, is outside its trained range, '
                        f'{text(low)} to {text(high)}: {remedy}')
    return ''
