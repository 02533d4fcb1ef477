# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Reasons: codes with values, which programs compare, and the sentences that people read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
import string
from typing import TypeAlias

from koopman_ros.core.units import Displays

Value: TypeAlias = (
    'float | int | str | Reason | tuple[tuple[str, float], ...] '
    '| tuple[tuple[str, float, float], ...]')


class StatusCode(Enum):
    """
    The reason of a condition: its identifier in records, and its sentence for people.

    Of numbers in a sentence, 'value' is one of the signal, 'change' a difference of two, with its
    unit; 'rate' is a change per second. 'ranges' are (name, lower, upper) of several signals,
    'values' (name, value); 'level' is the name of a control level. Values without a format are
    written unchanged.
    """

    template: str

    def __new__(cls, identifier: str, template: str = '') -> StatusCode:
        """Keep the identifier as the value, by which a code is found."""
        code = object.__new__(cls)
        code._value_ = identifier
        code.template = template
        return code

    NOT_FINITE = 'measurement_not_finite', (
        'the measured {signal} is {value}, not finite: check the sensor')
    OUTSIDE_SENSOR = 'measurement_outside_sensor', (
        'the measured {signal} {value:value} is outside the range of the sensor, {lower:value} to '
        '{upper:value}: check the sensor')
    JUMPED = 'measurement_jumped', (
        'the measured {signal} jumped from {before:value} to {value:value} in {seconds:.3g} s, '
        'at most {jump:change} and {rate:rate} are possible: check the sensor')
    FROZEN = 'sensor_frozen', (
        'the measured {signal} has been exactly {value:value} for longer than {timeout:g} s while '
        'the model moved by more than {change:change}: the sensor may be stuck; check it')
    BAD_QUALITY = 'bad_quality', (
        'the quality of the measured {signal} is bad: check the sensor')
    DISTURBANCE_SILENT = 'disturbance_silent', (
        'no measurement of {signal} for more than {timeout:g} s: its last value {held:value} is '
        'assumed; check the sensor')
    DISTURBANCE_UNKNOWN = 'disturbance_unknown', (
        'no measurement of {signal} yet: its nominal value {held:value} is assumed; check the '
        'sensor')
    NO_MEASUREMENT = 'no_measurement', 'no measurement received: check sensor and plant'
    STAMPS_STAND = 'stamps_do_not_advance', (
        'measurements are received, but their stamps do not advance: check the clock of the '
        'sensor')
    TWO_SOURCES = 'two_sources', (
        'two nodes publish the measurement, or its stamps keep going back: stop one of the '
        'publishers, and check the clock of the sensor')
    OUTSIDE_TRAINING = 'outside_training', (
        'the state is further from the training data than the {margin:g} half-ranges allowed for '
        'the {level:level} (the data span {ranges:ranges})')
    LAW_FAILED = 'law_failed', 'the {level:level} failed: {cause}'
    HELD_TOO_LONG = 'held_too_long', '{cause}; held for longer than {timeout:g} s'
    RECOVERING = 'recovering', (
        '{cause}: this has ended; the better law acts again when it has stayed away for '
        '{recovery_time:g} s')
    SAFE_LATCHED = 'safe_latched', (
        '{cause}; the safe state is latched: remove the cause, then clear it on the panel or by '
        'the service clear_safe_state')
    LATCH_CLEARABLE = 'latch_clearable', (
        '{cause} (gone); the safe state is latched: clear it on the panel or by the service '
        'clear_safe_state')
    LATCHED_BEFORE = 'latched_before', 'the safe state was reached before the restart'
    NOT_LATCHED = 'not_latched', 'the safe state is not latched: there is nothing to clear'
    LATCH_KEPT = 'latch_kept', (
        'the safe state stays latched until a control law has been possible for '
        '{recovery_time:g} s: {cause}')
    LOST_HERE = 'lost_here', (
        'in the acceptance test the {level:level} did not reach the set-point from a state like '
        'this one, but a linear law did')
    NOT_STABILISABLE = 'riccati_not_stabilisable', (
        'no feedback gain: the Hamiltonian has no stable subspace of full size: the pair (A, B) '
        'is not stabilisable, or a mode on the imaginary axis is not weighted')
    RICCATI_INACCURATE = 'riccati_inaccurate', (
        'no feedback gain: the Riccati residual is too large to trust the gain: the pair (A, B) '
        'is nearly not stabilisable')
    GAIN_TOO_LARGE = 'riccati_gain_too_large', (
        'no feedback gain: the gain exceeds its bound: the pair (A, B) is nearly not '
        'stabilisable; raise the input weight or the gain bound')
    SINGULAR = 'singular', '{matrix}'
    PREDICTED_UNSTABLE = 'predicted_unstable', (
        'the closed loop is predicted unstable at a sample every {interval:.3g} s: raise the '
        'input weight, or measure more often')
    PACKAGE_MISSING = 'package_missing', (
        'it needs {package}, which is not installed: pip install {package}')
    NO_PI_GAIN = 'no_pi_gain', (
        'no signal has a PI gain: set pi.<signal>.gain of the controlled signals')
    PLAN_NOT_SOLVED = 'plan_not_solved', (
        'no plan within the input limits was found ({flag})')
    PLAN_MOVES = 'plan_moves', 'the plan did not converge in {iterations} iterations'
    PLAN_OUTSIDE = 'plan_outside', (
        'the plan leaves the training data by {outside:.2g} half-ranges; {margin:g} are allowed')
    TOO_LATE = 'too_late', (
        'the plan took {seconds:.3g} s; {deadline:.3g} s are allowed')
    COMMAND_NOT_FINITE = 'command_not_finite', 'the command is not finite'
    CALCULATION_FAILED = 'calculation_failed', (
        'the calculation failed ({error}): the estimate restarts from the next measurement')
    LAW_RAISED = 'law_raised', 'calculation failed ({error})'
    SETPOINT_NOT_FINITE = 'setpoint_not_finite', (
        '{signal} set-point {value:value} is not finite: the previous set-point is kept')
    SETPOINT_UNMEASURED = 'setpoint_unmeasured', (
        '{signal} set-point {value:value} cannot be tracked, because {cause}: the previous '
        'set-point is kept; send it again when measurements return, or command the input in '
        'manual mode')
    SETPOINT_OUTSIDE = 'setpoint_outside', (
        '{signal} set-point {value:value} is outside the trained range {lower:value} to '
        '{upper:value}: the previous set-point is kept; choose one inside, or load a model '
        'trained over a wider range')
    SETPOINT_NOT_TRIED = 'setpoint_not_tried', (
        'the check whether the set-point can be held failed ({error}): the previous set-point is '
        'kept')
    SETPOINT_NOT_HELD = 'setpoint_not_held', (
        '{signal} set-point {value:value} cannot be held, because {cause}: the previous '
        'set-point is kept; the nearest that can be held is {held:values}')
    NO_SETPOINT_HELD = 'no_setpoint_held', (
        '{signal} set-point {value:value} cannot be held, because {cause}, and no nearby one can: '
        'the previous set-point is kept; check the range of the inputs')
    INPUT_NEEDED = 'input_needed', (
        '{signal} would have to be {value:value}, but its range is {lower:value} to {upper:value}')
    STATE_LEAVES = 'state_leaves', (
        '{signal} would go to {value:value}, outside the trained range {lower:value} to '
        '{upper:value}')
    NOT_PREDICTED = 'not_predicted', (
        'the model diverges {seconds:.3g} s ahead, before the command acts: check dead_time')
    NO_STEADY_STATE = 'no_steady_state', 'the model has no steady state there'
    SCHEDULE_FULL = 'schedule_full', (
        '{most} set-points are already scheduled, the maximum: wait until some have taken effect, '
        'or send this one with stamp 0')
    ANALYSIS_REJECTED = 'analysis_rejected', (
        'the value {value:.6g} of {signal}, {age:.4g} s old, cannot correct the estimate, which '
        'reaches back {reach:.4g} s: check the analyser, its stamp, analysis_delay and estimator')
    NOT_IN_MANUAL_MODE = 'not_in_manual_mode', (
        'manual command rejected in automatic mode: switch to manual mode first')
    MANUAL_NOT_FINITE = 'manual_not_finite', (
        'manual {signal} {value:value} is not finite: the previous command is kept')
    EXPERIMENT_BOUNDS = 'experiment_bounds', (
        'the {signal} {value:value} is outside the bounds of the experiment, {lower:value} to '
        '{upper:value}')
    CLOCK_WENT_BACK = 'clock_went_back', 'the stamps of the measurements went back'
    SILENCE = 'silence', 'no newer measurement for more than {timeout:g} s: check sensor and plant'
    OTHER_PUBLISHER = 'other_publisher', '{nodes} sends values on {topic}, too'
    ENDED_EARLY = 'ended_early', 'it was stopped before the first measurement'
    CONTROLLER_GONE = 'controller_gone', 'the controller no longer runs'
    NOT_FOLLOWED = 'not_followed', (
        'the controller commands {value:value} instead of the requested {requested:value}: switch '
        'it to manual mode, and choose levels within its limits')
    NOT_TRACKED = 'not_tracked', (
        'the controller tracks {value:value} instead of the requested {requested:value}: choose '
        'set-points that it can hold')
    IN_MANUAL_MODE = 'in_manual_mode', (
        'the controller is in manual mode: switch it to automatic mode')
    NOTHING_TRACKED = 'nothing_tracked', (
        'the active set-points have been unknown for {timeout:g} s: switch the controller to '
        'automatic mode, and check sensor and plant')


#: Why the command is held where nothing is measured.
UNMEASURED = (StatusCode.NO_MEASUREMENT, StatusCode.STAMPS_STAND, StatusCode.TWO_SOURCES)


@dataclass(frozen=True)
class Reason:
    """A code with its values."""

    code: StatusCode
    #: numbers in the signal's own unit, names, and the reason behind this one as `cause`; `signal`
    #: names the signal whose unit they have
    values: Mapping[str, Value] = field(default_factory=dict)

    def __str__(self) -> str:
        """Write it as a sentence, without units, which it does not know."""
        return StatusFormatter(Displays({}))(self)

    @property
    def cause(self) -> Reason | None:
        """The reason behind this one."""
        cause = self.values.get('cause')
        return cause if isinstance(cause, Reason) else None


def reason(code: StatusCode, **values: Value) -> Reason:
    """Return a reason with its values by name."""
    return Reason(code, values)


LEVELS = {'mpc': 'predictive law', 'sdre': 'learned law', 'linear': 'linear law', 'pi': 'PI law',
          'hold': 'hold', 'safe': 'safe input', 'manual': 'manual'}


def level_words(name: str) -> str:
    """Return the name of a control level for operators."""
    return LEVELS.get(name, name)


@dataclass(frozen=True)
class StatusFormatter:
    """The renderer of reasons."""

    displays: Displays  #: units and digits of the signals

    def __call__(self, about: Reason | None) -> str:
        """Write a reason as a sentence; an empty string for none."""
        if about is None:
            return ''
        return _Formatter(self, about).vformat(about.code.template, (), about.values)


class _Formatter(string.Formatter):
    def __init__(self, words: StatusFormatter, about: Reason) -> None:
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
            case 'values':
                return ', '.join(f'{name} {self._words.displays[name].text(number)}'
                                 for name, number in value)  # type: ignore[attr-defined]
            case 'level':
                return level_words(str(value))
            case 'value':
                return self._display.text(float(value))  # type: ignore[arg-type]
            case 'change':
                return f'{float(value):g} {self._display.unit}'  # type: ignore[arg-type]
            case 'rate':
                return f'{float(value):.3g} {self._display.unit}/s'  # type: ignore[arg-type]
        return super().format_field(value, format_spec)
