# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Reasons as codes with values, and the one place where they become sentences.

Programs compare codes; only people read what :class:`Words` makes of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
import string
from typing import TypeAlias

from koopman_ros.units import Displays

Value: TypeAlias = 'float | int | str | Reason | tuple[tuple[str, float, float], ...]'


class Code(Enum):
    """What is the matter; the value is the identifier in records."""

    NOT_FINITE = 'measurement_not_finite'
    OUTSIDE_SENSOR = 'measurement_outside_sensor'
    JUMPED = 'measurement_jumped'
    FROZEN = 'sensor_frozen'
    NO_MEASUREMENT = 'no_measurement'
    OUTSIDE_TRAINING = 'outside_training'
    LAW_FAILED = 'law_failed'
    HELD_TOO_LONG = 'held_too_long'
    RECOVERING = 'recovering'
    NOT_STABILISABLE = 'riccati_not_stabilisable'
    RICCATI_INACCURATE = 'riccati_inaccurate'
    GAIN_TOO_LARGE = 'riccati_gain_too_large'
    SINGULAR = 'singular'
    PREDICTED_UNSTABLE = 'predicted_unstable'
    COMMAND_NOT_FINITE = 'command_not_finite'
    SETPOINT_NOT_FINITE = 'setpoint_not_finite'
    SETPOINT_OUTSIDE = 'setpoint_outside'
    SCHEDULE_FULL = 'schedule_full'
    NOT_IN_MANUAL_MODE = 'not_in_manual_mode'
    MANUAL_NOT_FINITE = 'manual_not_finite'
    EXPERIMENT_BOUNDS = 'experiment_bounds'
    CLOCK_WENT_BACK = 'clock_went_back'
    SILENCE = 'silence'
    OTHER_PUBLISHER = 'other_publisher'
    CONTROLLER_GONE = 'controller_gone'
    NOT_FOLLOWED = 'not_followed'


@dataclass(frozen=True)
class Reason:
    """A code with its values."""

    code: Code  #: what is the matter
    #: numbers in the signal's own unit, names, and the reason behind this one as `cause`; `signal`
    #: names the signal whose unit they have
    values: Mapping[str, Value] = field(default_factory=dict)

    @property
    def cause(self) -> Reason | None:
        """The reason behind this one."""
        cause = self.values.get('cause')
        return cause if isinstance(cause, Reason) else None


def reason(code: Code, **values: Value) -> Reason:
    """Return a reason with its values by name."""
    return Reason(code, values)


# Of numbers: 'value' is one of the signal, 'change' a difference of two, with its unit; 'rate' is
# a change per second. 'ranges' are (name, lower, upper) of several signals, 'level' is the name of
# a control level. What has no such format is written as it is.
_TEMPLATES = {
    Code.NOT_FINITE: 'the measured {signal} is {value}, not finite: check the sensor',
    Code.OUTSIDE_SENSOR: (
        'the measured {signal} {value:value} is outside the range of the sensor, {lower:value} '
        'to {upper:value}: check it'),
    Code.JUMPED: (
        'the measured {signal} jumped from {before:value} to {value:value} in {seconds:.3g} s, '
        'at most {jump:change} and {rate:rate} are possible: check the sensor'),
    Code.FROZEN: (
        'the measured {signal} has been exactly {value:value} for longer than {timeout:g} s '
        'while the model moved by more than {change:change}: the sensor is frozen; check it'),
    Code.NO_MEASUREMENT: 'no measurement arrives: check sensor and plant',
    Code.OUTSIDE_TRAINING: (
        'outside the trained range ({ranges:ranges}) by more than the {margin:g} half widths that '
        'the {level:level} is allowed'),
    Code.LAW_FAILED: 'the {level:level} fails: {cause}',
    Code.HELD_TOO_LONG: '{cause}; held for longer than {timeout:g} s',
    Code.RECOVERING: '{cause} (over, waiting for it to stay so)',
    Code.NOT_STABILISABLE: (
        'no feedback gain: the Hamiltonian has no stable subspace of full size: the pair (A, B) '
        'is not stabilisable, or a mode on the imaginary axis is not weighted'),
    Code.RICCATI_INACCURATE: (
        'no feedback gain: the Riccati residual is too large to trust the gain: the pair (A, B) '
        'is nearly not stabilisable'),
    Code.GAIN_TOO_LARGE: (
        'no feedback gain: the gain exceeds its bound: the pair (A, B) is nearly not '
        'stabilisable; raise the input weight or the gain bound'),
    Code.SINGULAR: '{matrix}',
    Code.PREDICTED_UNSTABLE: (
        'the closed loop is predicted unstable at a sample every {interval:.3g} s: raise the '
        'input weight, or measure more often'),
    Code.COMMAND_NOT_FINITE: 'its command is not finite',
    Code.SETPOINT_NOT_FINITE: (
        '{signal} set-point {value:value} is not finite: the old one is kept'),
    Code.SETPOINT_OUTSIDE: (
        '{signal} set-point {value:value} is outside the trained range {lower:value} to '
        '{upper:value}: the old one is kept; choose one inside, or load a model trained over a '
        'wider range'),
    Code.SCHEDULE_FULL: (
        '{most} set-points are scheduled already: wait until some have taken effect, or send '
        'this one with stamp 0'),
    Code.NOT_IN_MANUAL_MODE: (
        'manual command refused in automatic mode: switch to manual mode first'),
    Code.MANUAL_NOT_FINITE: 'manual {signal} {value:value} is not finite: the old one is kept',
    Code.EXPERIMENT_BOUNDS: (
        'the {signal} {value:value} is outside the bounds of the experiment, {lower:value} to '
        '{upper:value}'),
    Code.CLOCK_WENT_BACK: 'the stamps of the measurements went back',
    Code.SILENCE: 'no newer measurement for more than {timeout:g} s: check sensor and plant',
    Code.OTHER_PUBLISHER: '{nodes} publishes on {topic}, too',
    Code.CONTROLLER_GONE: 'the controller is gone',
    Code.NOT_FOLLOWED: (
        'the controller commands {value:value} where {requested:value} is requested: switch it to '
        'manual mode, and choose levels within its limits'),
}

LEVELS = {'sdre': 'learned law', 'linear': 'linear law', 'hold': 'hold', 'safe': 'safe input',
          'manual': 'manual'}


def level_words(name: str) -> str:
    """Return what an operator calls a control level."""
    return LEVELS.get(name, name)


@dataclass(frozen=True)
class Words:
    """The renderer of reasons."""

    displays: Displays  #: units and digits of the signals

    def __call__(self, about: Reason | None) -> str:
        """Write a reason as a sentence; an empty string for none."""
        if about is None:
            return ''
        return _Formatter(self, about).vformat(_TEMPLATES[about.code], (), about.values)


class _Formatter(string.Formatter):
    def __init__(self, words: Words, about: Reason) -> None:
        self._words = words
        self._display = words.displays[str(about.values.get('signal', ''))]

    def format_field(self, value: object, format_spec: str) -> str:
        if isinstance(value, Reason):
            return self._words(value)
        match format_spec:
            case 'ranges':
                return ', '.join(
                    f'{name} {self._words.displays[name].text(lower)} to '
                    f'{self._words.displays[name].text(upper)}'
                    for name, lower, upper in value)  # type: ignore[attr-defined]
            case 'level':
                return level_words(str(value))
            case 'value':
                return self._display.text(float(value))  # type: ignore[arg-type]
            case 'change':
                return f'{float(value):g} {self._display.unit}'  # type: ignore[arg-type]
            case 'rate':
                return f'{float(value):.3g} {self._display.unit}/s'  # type: ignore[arg-type]
        return super().format_field(value, format_spec)
