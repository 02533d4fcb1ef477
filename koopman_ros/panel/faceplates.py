# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Faceplates of signals: the values of one signal in the unit in which people read it."""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import dataclass, field
import math

from koopman_ros.core.units import conversion, printed

Range = tuple[float, float]
PLANT, CONTROLLER, TRAINER = 'plant', 'controller', 'trainer'  #: roles of nodes
_LARGEST = 1e300  # on a bar: a broken sensor may send the largest number that there is
_FAR = 0.1  # of the range of an input; an applied input that differs by more is abnormal
_HELD = {'hold': 'held: the last command', 'safe': 'the safe input is commanded'}  # by level
#: kinds of values by the node without which they are old
_SENT_BY = {PLANT: ('measured', 'applied', 'predicted', 'setpoint'),
            CONTROLLER: ('command', 'predicted', 'setpoint')}
_EXACT = 1e15  # from here on not all digits of a number are known


def readable(name: str) -> str:
    """Return the name of a signal in words."""
    return name.replace('_', ' ')


def number(value: float, decimals: int) -> str:
    """Write a number, or a dash for none."""
    if not math.isfinite(value):
        return '–'
    return f'{value:z.{decimals}f}' if abs(value) < _EXACT else f'{value:.6g}'


def exact(value: float, decimals: int) -> str:
    """Write a value with the digits that a person wrote, of which there are few."""
    more = next((more for more in range(decimals, decimals + 4)
                 if math.isclose(round(value, more), value, rel_tol=1e-9, abs_tol=1e-12)),
                decimals)
    return number(value, more)


def span_text(bounds: Range, decimals: int) -> str:
    """Write a range; each number of these decimals within those written is in the range."""
    # the slack is that of converted units
    scale, slack = 10.0 ** decimals, 1e-6
    low, high = (rounded(end * scale + side * slack) / scale if math.isfinite(end) else end
                 for rounded, side, end in zip((math.ceil, math.floor), (-1, 1), bounds,
                                               strict=True))
    return f'{number(low, decimals)} to {number(high, decimals)}'


def pen(kind: str, name: str) -> str:
    """Return the name of the pen of a signal."""
    suffix = {'active_setpoints': ' set-point', 'predicted': ' predicted', 'planned': ' planned',
              'commands': ' command', 'applied': ' applied'}.get(kind, '')
    return f'{name}{suffix}'


@dataclass(frozen=True)
class Faceplate:
    """Values of a signal in the unit in which people read it; NaN for unknown ones."""

    name: str
    unit: str  #: as it is printed
    span: Range  #: of its bar
    decimals: int  #: of its numbers
    training: Range | None  #: training range of the current model
    abnormal: str  #: abnormal condition in words, or empty
    limits: Range | None  #: of the command, or of a state in the MPC
    active: str  #: active limits of the plan in words, or empty
    plan: Sequence[tuple[float, float]]  #: times and values ahead; empty without a plan
    old: frozenset[str]  #: kinds of its values that come from a node that is silent

    @property
    def label(self) -> str:
        """The name in words."""
        return readable(self.name)

    def text(self, value: float) -> str:
        """Write a value without the unit."""
        return number(value, self.decimals)

    def exact(self, value: float) -> str:
        """Write a requested value, without the unit."""
        return exact(value, self.decimals)

    def span_text(self, bounds: Range) -> str:
        """Write a range without the unit."""
        return span_text(bounds, self.decimals)

    def share(self, value: float) -> float:
        """Return the place of a value on the bar, from 0 to 1."""
        low, high = self.span
        return min(max((value - low) / (high - low), 0.0), 1.0) if math.isfinite(value) else 0.0


@dataclass(frozen=True)
class StateFaceplate(Faceplate):
    """A measured state, or a measured disturbance."""

    controlled: bool  #: whether it has a set-point
    measured: float
    setpoint: float  #: active set-point
    target: float  #: requested set-point, to which the active one moves
    predicted: float  #: the model's prediction of the measurement
    disturbance: bool = False  #: whether it is a disturbance


@dataclass(frozen=True)
class InputFaceplate(Faceplate):
    """An input."""

    command: float
    applied: float  #: measured behind the actuator
    manual: float  #: requested in manual mode, within the limits, or the command
    disturbance: float  #: as a change of the input, in the signal's own unit
    own_unit: str  #: of the disturbance
    dead_time: float  #: s until it acts


@dataclass
class SignalValues:
    """Last values of a signal by the kind of their topic, in the unit in which people read it."""

    name: str
    unit: str
    read: str  #: unit in which people read it
    values: dict[str, float] = field(default_factory=dict)
    before: dict[str, float] = field(default_factory=dict)  # other values before these
    training: Range | None = None
    active: str = ''
    plan: tuple[tuple[float, float], ...] = ()

    def shown(self, value: float) -> float:
        """Return a value in the unit in which people read it."""
        return float(conversion(self.unit, self.read)(float(value)))

    def get(self, kind: str, default: float = math.nan) -> float:
        """Return the last value of a kind."""
        return self.values.get(kind, default)

    def state(self, controlled: bool, limits: Range | None, sensor: Range | None,
              silent: Container[str], quality: str, disturbance: bool = False) -> StateFaceplate:
        """
        Return the faceplate of a state, or disturbance, with limits and range of the sensor.

        :param silent: roles of nodes.
        :param quality: of the measurement for the controller, in words; empty for good.
        """
        measured, setpoint = self.get('measured'), self.get('active_setpoints')
        span = _span([self.training, sensor], [measured, setpoint, *(limits or ())])
        abnormal = ''
        if PLANT in silent or math.isnan(measured):
            abnormal = 'no measurement'
        elif quality:
            abnormal = f'measurement {quality}'
        elif self.training and not self.training[0] <= measured <= self.training[1]:
            side = 'above' if measured > self.training[1] else 'below'
            abnormal = f'{side} the trained range'
        return StateFaceplate(
            self.name, printed(self.read), span, _decimals(span), self.training, abnormal, limits,
            self.active, self.plan, _old(silent), controlled, measured, setpoint,
            self.get('target', setpoint), self.get('predicted'), disturbance)

    def input(self, limits: Range | None, silent: Container[str], level: str, dead_time: float
              ) -> InputFaceplate:
        """
        Return the faceplate of an input with its limits.

        :param silent: roles of nodes.
        :param level: name of the control level.
        :param dead_time: s until it acts, NaN if unknown.
        """
        command, applied = self.get('commands'), self.get('applied')
        span = _span([limits, self.training], [command, applied])
        slack = 1e-6 * (span[1] - span[0])
        abnormal = ''
        if CONTROLLER in silent and math.isfinite(command):
            abnormal = 'last command, the controller is silent'
        elif PLANT not in silent and abs(applied - command) > _FAR * (span[1] - span[0]):
            abnormal = 'applied differs from the command'
        elif level in _HELD:
            abnormal = _HELD[level]
        elif limits and command >= limits[1] - slack:
            abnormal = 'at its upper limit'
        elif limits and command <= limits[0] + slack:
            abnormal = 'at its lower limit'
        return InputFaceplate(
            self.name, printed(self.read), span, _decimals(span), self.training, abnormal, limits,
            self.active, self.plan, _old(silent), command, applied, self.get('manual', command),
            self.get('disturbance'), self.unit, dead_time)


def _old(silent: Container[str]) -> frozenset[str]:
    return frozenset(kind for role, kinds in _SENT_BY.items() if role in silent for kind in kinds)


def _span(ranges: Sequence[Range | None], values: Sequence[float]) -> Range:
    """Return the range of a bar: the first finite one, a little wider, with all values in it."""
    known = next((one for one in ranges if one and math.hypot(*one) < _LARGEST), None)
    finite = [min(max(value, -_LARGEST), _LARGEST) for value in values if math.isfinite(value)]
    low, high = known or (min(finite, default=0.0), max(finite, default=1.0))
    margin = 0.1 * (high - low) or max(1.0, 0.1 * abs(high))
    # a range of positive numbers begins at zero at most
    begin = max(low - margin, 0.0) if low >= 0.0 else low - margin
    return min([begin, *finite]), max([high + margin, *finite])


def _decimals(span: Range) -> int:
    """Return the decimals that tell two of some two hundred marks on a bar apart."""
    return min(max(2 - math.floor(math.log10(span[1] - span[0])), 0), 6)
