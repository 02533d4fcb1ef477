# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Whether a controller can run with a model, for its acceptance and for its loading."""

from collections.abc import Callable
import math
import time

from koopman_ros.control.controller import Controller
from koopman_ros.control.state import State
from koopman_ros.core.message_fields import SIGNAL_NAME
from koopman_ros.core.status import StatusCode
from koopman_ros.core.units import Display, display_unit, NANOSECONDS
from koopman_ros.model import LiftedModel, model_file
from koopman_ros.tuning import Tuning

# Processor time of a control step, in s: the largest model that is read takes some milliseconds,
# and measurements come once a second.
_LONGEST_STEP = 0.1
_TRIALS = 3


def _with_own_tuning(model: LiftedModel) -> Controller:
    return Controller(model, Tuning.for_model(model))


def unusable(model: LiftedModel,
             build: Callable[[LiftedModel], Controller] = _with_own_tuning) -> str:
    """
    Say why a controller cannot run with a model, or nothing.

    :param build: returns the controller that is tried for a few steps at the nominal point.
    """
    try:
        model_file.check(model)
    except (TypeError, ValueError) as error:
        return str(error)
    if reason := _unusable_signals(model):
        return reason
    try:
        controller = build(model)
    except ValueError as error:
        return f'no controller can be built with the model ({error}): train it again'
    return _failing_step(controller)


def _failing_step(controller: Controller) -> str:
    """Say that a control step fails or takes too long, or nothing."""
    model, state, needed = controller.model, State(), []
    for k in range(1, _TRIALS + 1):
        # of this thread alone, for a busy machine says nothing of a model
        begun = time.thread_time()
        try:
            state, _, report = controller.step(
                state, controller.measured.of(model.states.center), k * NANOSECONDS)
            if report.reason is not None and report.reason.code is StatusCode.CALCULATION_FAILED:
                raise ValueError(report.reason.values['error'])
            controller.equivalent_bias(state)
        except (ArithmeticError, ValueError) as error:
            return f'a control step with the model fails ({error}): train it again'
        needed.append(time.thread_time() - begun)
    if min(needed) > _LONGEST_STEP:
        return (f'a control step with the model takes {min(needed):.3g} s of processor time, more '
                f'than the allowed {_LONGEST_STEP:g} s: reduce lifted_dimension (now n_z = '
                f'{model.n_z}) and train again')
    return ''


def _unusable_signals(model: LiftedModel) -> str:
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
            # a signal that stood at an end of its range has this mean but for rounding
            rounding = 1e-9 * (high - low)
            if not low - rounding <= center <= high + rounding:
                remedy = ('record data around a steady state' if kind == 'state' else
                          f'record {name} {"down" if center < low else "up"} to {text(center)}')
                return (f'the nominal {name}, {text(center)}, is outside its trained range, '
                        f'{text(low)} to {text(high)}: {remedy} and train the model again')
    return ''
