# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Parameters of the plant node."""

from dataclasses import dataclass, fields
from typing import Any

from koopman_ros.parameters.table import parameter, ParameterTable
from koopman_ros.parameters.wire import LONGEST_FRAME_ID
from koopman_ros.plants import (
    Actuator,
    EquilibriumError,
    one_state_reactor,
    ReactorParameters,
    two_state_reactor,
)
from koopman_ros.plants.simulation import integration_limits
from koopman_ros.units import LAST_STAMP_SECONDS, to_kelvin

REACTORS = {'one_state': one_state_reactor, 'two_state': two_state_reactor}
_CONSTANTS = {item.name: item for item in fields(ReactorParameters)}


def _constant(name: str, description: str, **details: Any) -> Any:
    """Declare a physical constant with the default, unit and range of the reactor's own."""
    item = _CONSTANTS[name]
    return parameter(item.default, description, unit=item.metadata['unit'],
                     minimum=item.metadata['lower'], maximum=item.metadata['upper'], **details)


@dataclass(frozen=True)
class PlantParameters:
    """Snapshot of the plant's parameters, temperatures in degrees Celsius."""

    reactor: str = parameter(
        'one_state', 'one_state holds the concentration fixed, two_state lets it move',
        choices=tuple(REACTORS), read_only=True)
    sample_period: float = parameter(
        1.0, 'time between measurements', 's', 1e-3, 3600.0, read_only=True)
    noise: float = parameter(
        0.0, 'standard deviation of the measured temperature', 'K', 0.0, 100.0)
    sensor_bias: float = parameter(
        0.0, 'by how much the temperature is measured too high', 'K', -100.0, 100.0)
    sensor_resolution: float = parameter(
        0.0, 'smallest difference that the measurement shows; 0 for all', 'K', 0.0, 100.0)
    seed: int = parameter(0, 'seed of the measurement noise', '', 0, 2 ** 31, read_only=True)
    initial_temperature_offset: float = parameter(
        0.0, 'start this far from the steady state', 'K', -100.0, 100.0, read_only=True)
    speed: float = parameter(
        1.0, 'simulated seconds per second; 0 for as fast as it can', '', 0.0, 1e6, smallest=1e-6,
        read_only=True)
    lockstep: bool = parameter(
        False, 'advance only when the command for the last measurement has arrived',
        read_only=True)
    lockstep_timeout: float = parameter(
        5.0, 'wall time after which lock-step goes on with the command held', 's', 0.01, 3600.0,
        read_only=True)
    lockstep_subscribers: int = parameter(
        1, 'subscribers of the temperature that lock-step waits for before it starts', '', 1, 1000,
        read_only=True)
    duration: float = parameter(
        0.0, 'simulated time after which the plant stands still; 0 for endless', 's', 0.0, 1e9,
        read_only=True)
    start_time: float = parameter(
        1.0, 'time of the first measurement when not in real time', 's', 1e-3, LAST_STAMP_SECONDS,
        read_only=True)
    publish_clock: bool = parameter(True, 'publish /clock when not in real time', read_only=True)
    frame_id: str = parameter('reactor', 'frame_id of the messages', read_only=True)
    coolant_min: float = parameter(
        -20.0, 'lowest coolant temperature that the actuator reaches', 'degC', -50.0, 150.0)
    coolant_max: float = parameter(
        100.0, 'highest coolant temperature that the actuator reaches', 'degC', -50.0, 150.0)
    command_delay: float = parameter(
        0.0, 'how much later a command takes effect; the sample_period for one sample', 's', 0.0,
        3600.0)
    coolant_lag: float = parameter(
        0.0, 'time constant with which the coolant follows its command; 0 for at once', 's', 0.0,
        3600.0)
    flow_rate: float = _constant('flow_rate', 'feed and product flow', read_only=True)
    volume: float = _constant('volume', 'volume of the liquid', read_only=True)
    density: float = _constant('density', 'density of the liquid', read_only=True)
    heat_capacity: float = _constant(
        'heat_capacity', 'heat capacity of the liquid', read_only=True)
    reaction_enthalpy: float = _constant(
        'reaction_enthalpy', 'enthalpy of reaction, negative as heat is released',
        read_only=True)
    activation_temperature: float = _constant(
        'activation_temperature', 'activation energy over the gas constant', read_only=True)
    pre_exponential_factor: float = _constant(
        'pre_exponential_factor', 'rate constant at infinite temperature', read_only=True)
    heat_transfer_coefficient: float = _constant(
        'heat_transfer_coefficient', 'coefficient times area of the cooling jacket')
    feed_temperature: float = parameter(76.85, 'temperature of the feed', 'degC', -20.0, 200.0)
    feed_concentration: float = _constant(
        'feed_concentration', 'reactant in the feed (two_state)')
    concentration: float = _constant(
        'concentration', 'reactant in the reactor (one_state)')

    def actuator(self) -> Actuator:
        """Return what stands before the coolant, in the plant's units."""
        return Actuator(to_kelvin(self.coolant_min), to_kelvin(self.coolant_max),
                        self.command_delay, self.coolant_lag)

    def constants(self) -> ReactorParameters:
        """Return the physical constants in the plant's units."""
        values = {name: getattr(self, name) for name in _CONSTANTS}
        return ReactorParameters(
            **{**values, 'feed_temperature': to_kelvin(self.feed_temperature)})


def _cross_check(values: PlantParameters) -> str:
    if values.start_time + values.duration > LAST_STAMP_SECONDS:
        return (f'start_time + duration = {values.start_time + values.duration:.10g} s must be at '
                f'most {LAST_STAMP_SECONDS} s, where the stamps of messages end: choose a smaller '
                'start_time')
    if len(values.frame_id) > LONGEST_FRAME_ID:
        return (f'frame_id has {len(values.frame_id)} characters, must have at most '
                f'{LONGEST_FRAME_ID}: shorten it')
    return ''


def _build(values: PlantParameters) -> None:
    """Build what a plant starts with, down to the tolerances of its integration."""
    values.actuator()
    build, constants = REACTORS[values.reactor], values.constants()
    try:
        system = build(constants)
    except EquilibriumError:
        # it then starts from the nominal state
        system = build(constants, nominal_state=build().nominal_state)
    integration_limits(system)


TABLE = ParameterTable(PlantParameters, _cross_check, _build, (('coolant_min', 'coolant_max'),))
