# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Parameters of the plant node, for any plant of the catalogue."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np

from koopman_ros.core.arrays import Array
from koopman_ros.core.declaration import group, parameter, per_signal, signal_value, UNBOUNDED
from koopman_ros.core.units import conversion, LAST_STAMP_SECONDS
from koopman_ros.parameters.signal_topics import (
    CommandedPlaces,
    DEFAULT_SYSTEM,
    LONGEST_FRAME_ID,
    MeasuredPlace,
    named_units,
    plant_defaults,
    PLANT_KINDS,
    Signals,
    SignalTopics,
    system_of,
)
from koopman_ros.parameters.table import (
    ConfigurationError,
    in_own_units,
    ParameterTable,
    Specification,
)
from koopman_ros.plants import (
    Actuator,
    build,
    constants_of,
    ControlAffineSystem,
    EquilibriumError,
    plant_class,
)
from koopman_ros.plants.simulation import integration_limits


@dataclass(frozen=True)
class StateParameters(MeasuredPlace):
    """How a state is measured."""

    measurement_noise: float = parameter(
        0.0, 'Standard deviation of the measurement noise.', '{unit}', 0.0, 1e9)
    bias: float = parameter(
        0.0, 'Offset of the measurement.', '{unit}', -UNBOUNDED, UNBOUNDED)
    resolution: float = parameter(
        0.0, 'Resolution of the measurement; 0: exact.', '{unit}', 0.0, 1e9)
    initial_offset: float = parameter(
        0.0, 'Initial offset from the steady state.', '{unit}', -UNBOUNDED, UNBOUNDED,
        read_only=True)
    analysis_period: float = parameter(
        0.0, 'Time between the samples of an analyser that measures the state; 0: a sensor that '
        'measures all the time.', 's', 0.0, 86400.0, read_only=True)
    analysis_delay: float = parameter(
        0.0, 'Time from a sample of the analyser to its value.', 's', 0.0, 86400.0,
        read_only=True)


@dataclass(frozen=True)
class InputParameters(CommandedPlaces):
    """The actuator of an input."""

    min: float = signal_value(
        -UNBOUNDED, 'Lower limit of the actuator.')
    max: float = signal_value(
        UNBOUNDED, 'Upper limit of the actuator.')
    delay: float = parameter(
        0.0, 'Delay between a command and its application, which the measured input shows.', 's',
        0.0, 3600.0)
    lag: float = parameter(
        0.0, 'Time constant of the actuator; 0: no lag.', 's', 0.0,
        3600.0)
    dead_time: float = parameter(
        0.0, 'Dead time between the applied input and its effect, which the measured input does '
        'not show.', 's', 0.0, 3600.0)
    rangeability: float = parameter(
        1.0, 'Largest by smallest gain of a valve of equal percentage from min to max; 1: linear.',
        '', 1.0, 1000.0)


@dataclass(frozen=True)
class PlantParameters:
    """Snapshot of the plant's parameters, in the units that people read."""

    system: str = parameter(
        DEFAULT_SYSTEM, 'Plant to simulate: the name of a library plant, an entry point of the '
                        'group koopman_ros.plants, or package.module:Class.', read_only=True)
    measured: tuple[str, ...] = parameter(
        ('',), 'States whose measurements must have subscribers before lock-step starts; an empty '
        'name: all.', read_only=True)
    disturbances_measured: tuple[str, ...] = parameter(
        ('',), 'Constants that are published as measured disturbances, with their units, e.g. '
        'feed_temperature [K]; an empty name: none.', read_only=True)
    autostart: bool = parameter(
        True, 'Configure and activate at start-up; false: left to a lifecycle manager.',
        read_only=True)
    sample_period: float = parameter(
        1.0, 'Time between measurements.', 's', 1e-3, 3600.0, read_only=True)
    seed: int = parameter(0, 'Seed of the measurement noise.', '', 0, 2 ** 31, read_only=True)
    speed: float = parameter(
        1.0, 'Simulated seconds per second; 0: as fast as possible.', '', 0.0, 1e6, smallest=1e-6,
        read_only=True)
    lockstep: bool = parameter(
        False, 'Lock-step: wait for the command of each measurement before the next one.',
        read_only=True)
    lockstep_timeout: float = parameter(
        5.0, 'Wall time without a command after which lock-step continues with the last '
             'one.', 's', 0.01, 3600.0,
        read_only=True)
    lockstep_subscribers: int = parameter(
        1, 'Number of subscribers to the measurements that lock-step waits for at the '
           'start.', '', 1, 1000,
        read_only=True)
    duration: float = parameter(
        0.0, 'Simulated duration; 0: unlimited.', 's', 0.0, 1e9,
        read_only=True)
    start_time: float = parameter(
        1.0, 'Stamp of the first measurement when not in real '
             'time.', 's', 1e-3, LAST_STAMP_SECONDS,
        read_only=True)
    publish_clock: bool = parameter(True, 'Publish /clock when not in real time.', read_only=True)
    frame_id: str = parameter('plant', 'frame_id of the messages.', read_only=True)
    states: Mapping[str, StateParameters] = per_signal(StateParameters)
    inputs: Mapping[str, InputParameters] = per_signal(InputParameters)
    disturbances: Mapping[str, MeasuredPlace] = per_signal(MeasuredPlace)
    #: the plant's constants, in SI
    constants: Mapping[str, float] = group()


class PlantTable(ParameterTable[PlantParameters]):
    """
    The table of a plant.

    :param given: known values, of which `system` is used.
    :raises ConfigurationError: for an unknown system, or one that cannot be constructed.
    """

    def __init__(self, given: Mapping[str, Any] = MappingProxyType({})) -> None:
        system = system_of(given)
        try:
            self.plant = plant_class(system)
            reference = build(self.plant, {})
        except ValueError as error:
            raise ConfigurationError(f'system = {system!r}: {error}') from error
        preset = plant_defaults(system, 'plant')
        disturbances = named_units(tuple(filter(None, given.get(
            'disturbances_measured', preset.get('disturbances_measured', ())))))
        self._si = {item.name: item.unit for item in constants_of(self.plant)}
        for name, unit in disturbances.items():
            if name not in self._si:
                raise ConfigurationError(
                    f'disturbances_measured names {name}, which is not a constant of {system}: '
                    f'choose from {", ".join(self._si) or "none"}')
            try:
                conversion(self._si[name], unit)
            except ValueError as error:
                raise ConfigurationError(f'disturbances_measured: {name}: {error}') from error
        self.described = signals = Signals(
            dict(zip(reference.state_names, reference.state_units, strict=True)),
            dict(zip(reference.input_names, reference.input_units, strict=True)), (),
            disturbances=disturbances)
        own = {name: value for name, value in signals.defaults().items()
               if name.rpartition('.')[2] in ('topic', 'command_topic')}
        super().__init__(
            PlantParameters, partial(_cross_check, signals), self._build, (('min', 'max'),),
            signals={'states': signals.states, 'inputs': signals.inputs,
                     'disturbances': disturbances},
            groups={'constants': [Specification(
                item.name, item.default, item.unit, item.description, item.lower, item.upper)
                for item in constants_of(self.plant)]},
            defaults={**own, **preset, 'system': system})

    def system(self, values: PlantParameters, nominal_state: Array | None = None
               ) -> ControlAffineSystem:
        """Build the plant's equations; EquilibriumError where it has no steady state to start."""
        return build(self.plant, values.constants, nominal_state)

    def measured_disturbances(self, values: PlantParameters) -> Array:
        """Return the constants (n_d,) that are measured, in the units of the signals."""
        return np.array([conversion(self._si[name], unit)(values.constants[name])
                         for name, unit in self.described.disturbances.items()])

    def actuator(self, values: PlantParameters) -> Actuator:
        """Return the actuators of the inputs, in the plant's units."""
        units = self.described.inputs
        tuned = values.inputs
        return Actuator(in_own_units(tuned, 'min', units), in_own_units(tuned, 'max', units),
                        *(np.array([getattr(tuned[name], one) for name in units])
                          for one in ('delay', 'lag', 'dead_time', 'rangeability')))

    def _build(self, values: PlantParameters) -> None:
        """Build the plant's process, including the tolerances of its integration."""
        self.actuator(values)
        try:
            system = self.system(values)
        except EquilibriumError:
            # it then starts from the nominal state
            system = self.system(values, build(self.plant, {}).nominal_state)
        integration_limits(system)


def _cross_check(signals: Signals, values: PlantParameters) -> str:
    if values.start_time + values.duration > LAST_STAMP_SECONDS:
        return (f'start_time + duration = {values.start_time + values.duration:.10g} s must be at '
                f'most {LAST_STAMP_SECONDS} s, the largest message stamp: choose a smaller '
                'start_time')
    if len(values.frame_id) > LONGEST_FRAME_ID:
        return (f'frame_id has {len(values.frame_id)} characters, the maximum is '
                f'{LONGEST_FRAME_ID}: shorten it')
    for name, given in values.inputs.items():
        if given.rangeability > 1.0 and not -UNBOUNDED < given.min < given.max < UNBOUNDED:
            return (f'{name}.rangeability = {given.rangeability:.10g} needs the range of the '
                    f'valve: set {name}.min and {name}.max')
    if unknown := set(filter(None, values.measured)) - set(signals.states):
        return (f'measured = {list(values.measured)} names {", ".join(sorted(unknown))}: choose '
                f'from the states {", ".join(signals.states)}')
    return SignalTopics.of(signals, values, PLANT_KINDS).check()
