# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Events, which change a controller's state, and the one function that applies them.

The running controller, the simulated loop and the replay of records all call :func:`apply`, so
that a command follows from the same numbers in each.
"""

from dataclasses import dataclass
from typing import TypeAlias

from koopman_ros.control.controller import Controller
from koopman_ros.control.state import Mode, State, StepReport
from koopman_ros.core.arrays import Array
from koopman_ros.core.status import Reason, StatusCode
from koopman_ros.core.units import nanoseconds


@dataclass(frozen=True, slots=True)
class Measurement:
    """A measurement, for which a command is calculated."""

    stamp_ns: int  #: its stamp
    measured: Array  #: (n_y,) in the model's units; NaN for impossible values
    applied: Array | None = None  #: (n_u,) measured input that goes with it, or None
    #: how many of the seconds since the last stamp the rate limit may count, or None for all
    seconds: float | None = None
    #: (n_d,) measured disturbances, in the model's units; NaN for none, None where there are none
    disturbances: Array | None = None
    #: (n_d,) their ages in s, infinity for none; None where they are as new as the measurement
    ages: Array | None = None
    #: (n_y,) 0 good, 1 uncertain, more bad, which counts as missing; None for good
    quality: tuple[int, ...] | None = None


@dataclass(frozen=True, slots=True)
class Silence:
    """No measurement was received up to a time, for which a command is calculated."""

    stamp_ns: int  #: that time, in the time of the measurements' stamps
    #: why the command is held; None where it continues from the estimate
    cause: StatusCode | None = StatusCode.NO_MEASUREMENT


@dataclass(frozen=True, slots=True)
class SetpointRequest:
    """
    The operator requests a set-point.

    Of all controlled signals, or of some:

    >>> SetpointRequest(0, [0.1, 0.15]).value
    [0.1, 0.15]
    >>> SetpointRequest(0, [0.12], ('level_1',)).signals
    ('level_1',)

    :raises TypeError: for a time that is not an integer.
    """

    stamp_ns: int  #: time at which it takes effect; 0: immediately
    value: Array  #: of the signals, in the model's units
    #: which of the controlled ones are requested, others are unchanged; None for all
    signals: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        nanoseconds(self.stamp_ns)  # which says what is wrong


@dataclass(frozen=True, slots=True)
class ManualCommand:
    """The operator commands the input in manual mode."""

    value: Array  #: (n_u,) in the model's units


@dataclass(frozen=True, slots=True)
class ModeChange:
    """The operator switches between automatic and manual mode."""

    mode: Mode  #: from now on


@dataclass(frozen=True, slots=True)
class Initialisation:
    """The controller starts from the input that is applied already."""

    applied: Array  #: (n_u,) measured input in the model's units


@dataclass(frozen=True, slots=True)
class AnalysisValue:
    """A late value of a state, e.g. from a laboratory."""

    stamp_ns: int  #: of the sample
    signal: str  #: name of the state
    value: float  #: in its unit


@dataclass(frozen=True, slots=True)
class ClearSafeState:
    """The operator clears a latched safe state."""


Event: TypeAlias = (Measurement | Silence | SetpointRequest | ManualCommand | ModeChange
                    | Initialisation | AnalysisValue | ClearSafeState)


@dataclass(frozen=True, slots=True)
class EventOutcome:
    """The outcome of an event."""

    state: State  #: the new state; the old one when the event was rejected
    #: (n_u,) in the model's units, or None where the event is not answered
    command: Array | None = None
    report: StepReport | None = None  #: of the step, where there was one
    rejected: Reason | None = None  #: why the event was rejected, or None


def apply(controller: Controller, state: State, event: Event) -> EventOutcome:
    """Apply an event to a controller's state; pure, as the controller is."""
    match event:
        case Measurement():
            return EventOutcome(*controller.step(state, event.measured, event.stamp_ns,
                                                 event.applied, event.seconds,
                                                 event.disturbances, event.ages,
                                                 event.quality))
        case Silence():
            return EventOutcome(*controller.hold(state, event.stamp_ns, event.cause))
        case SetpointRequest():
            state, rejected = controller.request_setpoint(
                state, event.value, event.stamp_ns, event.signals)
            return EventOutcome(state, rejected=rejected)
        case ManualCommand():
            state, rejected = controller.request_manual_input(state, event.value)
            return EventOutcome(state, rejected=rejected)
        case ModeChange():
            return EventOutcome(controller.set_mode(state, event.mode))
        case Initialisation():
            return EventOutcome(controller.initialise(state, event.applied))
        case AnalysisValue():
            state, rejected = controller.take_analysis(
                state, event.signal, event.value, event.stamp_ns)
            return EventOutcome(state, rejected=rejected)
        case ClearSafeState():
            state, rejected = controller.clear_safe_state(state)
            return EventOutcome(state, rejected=rejected)
