# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The plants of the campaign: their signals in the units of their messages, without ROS."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
import math
from typing import Any

from koopman_ros.core.paths import model_path
from koopman_ros.core.units import unit_label
from koopman_ros.demo import reactor
from koopman_ros.model import load
from koopman_ros.parameters.controller import ControllerParameters, signals_of, table_of
from koopman_ros.parameters.plant import PlantTable
from koopman_ros.parameters.signal_topics import plant_defaults, SignalTopics
from koopman_ros.parameters.table import ParameterTable

LOCKSTEP = {'lockstep': True, 'speed': 0.0, 'lockstep_timeout': 0.5}
# While a controller is dead, the plant goes on at so many samples a second.
PATIENT = {**LOCKSTEP, 'lockstep_timeout': 0.05}


@dataclass(frozen=True, eq=False)
class FaultPlant:
    """A plant that is shipped; controlled states share a unit, and so do inputs."""

    name: str  #: by which it is called on the command line
    setpoint: tuple[float, ...]  #: of the controlled states, that it is held at
    other: tuple[float, ...]  #: that can be held, too, at each other's values as well
    by_hand: tuple[float, ...]  #: inputs that hold it somewhere
    band: float  #: distance from the set-point that counts as back
    settle: float = 240.0  #: plant time from the start until a fault, s
    afterwards: float = 360.0  #: plant time that the loop runs on after it, s
    recovery: float = 300.0  #: of this, within which the plant must be back, s
    #: parameters of both nodes, and of every controller, beside those of its file
    wired: Mapping[str, str] = field(default_factory=dict)
    tuned: Mapping[str, Any] = field(default_factory=dict)
    simulated: Mapping[str, float] = field(default_factory=dict)  #: and of every plant
    #: a set-point that no input can hold beside the others
    never: Mapping[str, float] = field(default_factory=dict)
    highest: float = math.inf  #: of the controlled states, from which on it is lost
    kind: str = ''  #: `system` of plant and controller; its name by default

    @property
    def system(self) -> str:
        """The parameter `system` of plant and controller."""
        return self.kind or self.name

    @cached_property
    def table(self) -> ParameterTable[ControllerParameters]:
        """Parameters of its controllers."""
        return table_of(load(model_path(self._model)), {**self.tuned, 'system': self.system})

    @cached_property
    def parameters(self) -> ControllerParameters:
        """Parameters of its controllers at start."""
        return self.table.snapshot({**self.wired, **self.tuned})

    def each_input(self, name: str) -> list[float]:
        """Return a parameter of each input, as people read it."""
        values = self.table.values(self.parameters)
        return [float(values[f'{signal}.{name}']) for signal in self.parameters.inputs]

    @property
    def _model(self) -> str:
        return str({**plant_defaults(self.system, 'controller'), **self.tuned}['model'])

    @cached_property
    def wiring(self) -> SignalTopics:
        """Where its signals are."""
        signals = signals_of(load(model_path(self._model)), self.parameters.tuning.controlled,
                             self.parameters.states)
        return SignalTopics.of(signals, self.parameters)

    @property
    def states(self) -> tuple[str, ...]:
        """All states that are measured."""
        return tuple(self.wiring.signals.states)

    @property
    def controlled(self) -> tuple[str, ...]:
        """Those that have a set-point."""
        return self.wiring.signals.controlled

    @property
    def inputs(self) -> tuple[str, ...]:
        """The inputs."""
        return tuple(self.wiring.signals.inputs)

    @property
    def unit(self) -> str:
        """Of the controlled states, to be read behind a difference: a kelvin is not a degree."""
        return self.wiring.signals.states[self.controlled[0]]

    @property
    def input_unit(self) -> str:
        """The same of the inputs."""
        return self.wiring.signals.inputs[self.inputs[0]]

    @property
    def shown_units(self) -> tuple[str, str]:
        """Units of the values of states and inputs."""
        return unit_label(self.unit), unit_label(self.input_unit)

    @cached_property
    def period(self) -> float:
        """Time between measurements, s."""
        return PlantTable({'system': self.system}).snapshot({}).sample_period

    @cached_property
    def rate(self) -> float:
        """Fastest change of a command, 1/s."""
        return max(self.default(f'{name}.rate_limit') for name in self.inputs) or math.inf

    def range(self, name: str) -> tuple[float, float]:
        """Return the smallest and the largest command of an input, as its topic has them."""
        return self.default(f'{name}.min'), self.default(f'{name}.max')

    def default(self, parameter: str) -> Any:
        """Return the unchanged value of a parameter of its controllers."""
        return self.tuned.get(parameter, self.table.rows[parameter].default)


def _each(names: tuple[str, ...], **values: float) -> dict[str, float]:
    return {f'{name}.{item}': value for name in names for item, value in values.items()}


REACTOR = FaultPlant(
    # 5 K below the steady state that it starts from; its operating points end below 54 degC
    reactor.SYSTEM, setpoint=(46.0,), other=(44.0,), by_hand=(20.0,), band=0.3, highest=60.0)
# Two levels and two pumps, each on a topic of its own: samples are put together by their stamps.
TWO_TANKS = FaultPlant(
    'two_tanks', setpoint=(0.1, 0.15), other=(0.09, 0.14), by_hand=(7.0, 2.0), band=0.002,
    settle=80.0, afterwards=200.0, recovery=180.0, never={'level_2': 0.08}, highest=0.35, tuned={
        **_each(('level_1', 'level_2'), max_rate=0.03, max_step=0.01),
        **_each(('pump_1', 'pump_2'), rate_limit=2.0), 'bumpless_transfer_time': 10.0})
# Four levels in one message, two of them controlled.
_LEVELS = ('level_1', 'level_2', 'level_3', 'level_4')
QUADRUPLE_TANK = FaultPlant(
    'quadruple_tank', setpoint=(0.15, 0.1), other=(0.14, 0.11), by_hand=(3.2, 2.8), band=0.002,
    settle=200.0, afterwards=300.0, recovery=270.0, never={'level_2': 0.042}, highest=0.25,
    wired={f'{name}.topic': 'levels' for name in _LEVELS}, tuned={
        **_each(_LEVELS, max_rate=0.01, max_step=0.005),
        **_each(('pump_1', 'pump_2'), rate_limit=1.0), 'bumpless_transfer_time': 10.0})
# The reactor of two states where no coolant that is held holds it, its concentration estimated.
SADDLE = FaultPlant(
    'saddle', kind='two_state', setpoint=(76.85,), other=(73.85,), by_hand=(26.85,), band=0.5,
    settle=120.0, afterwards=420.0, recovery=300.0, highest=110.0,
    simulated={'concentration.initial_offset': -0.37733466,
               'temperature.initial_offset': 25.53008526,
               'temperature.measurement_noise': 0.05}, tuned={
        'model': 'two_state_saddle', 'states_measured': ('temperature [K]',),
        'fallback_order': ('mpc', 'sdre', 'pi'), 'temperature.measurement_noise': 0.05,
        'concentration.initial_error': 0.2, 'temperature.max_rate': 2.0,
        'temperature.max_step': 2.0, 'pi.temperature.gain': 6.0,
        'pi.temperature.integral_time': 60.0,
        **_each(('coolant_temperature',), disturbance_noise=0.775, min=-20.0, max=100.0,
                rate_limit=1.0)})
# It falls where nothing acts; its rate is estimated from the angle.
PENDULUM = FaultPlant(
    'pendulum', setpoint=(0.0,), other=(0.1,), by_hand=(0.0,), band=math.inf, settle=4.0,
    afterwards=2.0, recovery=2.0, tuned={'states_measured': ('angle [rad]',)})
# It acts late, a disturbance is measured, and one of its states comes from an analyser.
HEATED_LINE = FaultPlant(
    'heated_line', setpoint=(55.0,), other=(50.0,), by_hand=(70.0,), band=0.5, highest=75.0,
    settle=400.0, afterwards=1500.0, recovery=1200.0)
PLANTS = {plant.name: plant for plant in (
    REACTOR, TWO_TANKS, QUADRUPLE_TANK, SADDLE, PENDULUM, HEATED_LINE)}
