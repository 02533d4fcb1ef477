# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The plant that a plant node simulates: equations, actuators, sensors and their parameters."""

from collections import deque
from dataclasses import replace

import numpy as np

from koopman_ros import plants
from koopman_ros.core.arrays import Array
from koopman_ros.core.message_fields import base_name
from koopman_ros.core.units import values_by_name
from koopman_ros.parameters.plant import PlantParameters, PlantTable
from koopman_ros.ros.signals import SignalPublisher
from koopman_ros.ros.time_conversion import stamp_message


class SimulatedPlant:
    """
    A plant at its initial state, in its units.

    :ivar process: the simulation in its present state.
    :ivar note: why it does not start from a steady state of its own, or an empty string.
    """

    def __init__(self, table: PlantTable, parameters: PlantParameters, time_ns: int) -> None:
        self._table, self._parameters = table, parameters
        self.signals, self.note = table.described, ''
        try:
            system = table.system(parameters)
        except plants.EquilibriumError as error:
            nominal = table.system(table.snapshot({})).nominal_state
            system = table.system(parameters, nominal)
            self.note = f'{error}; the plant starts at {system.describe_state(nominal)} instead'
        self.process = self._initial(system, time_ns)

    def _initial(self, system: plants.ControlAffineSystem, time_ns: int) -> plants.Process:
        x = system.nominal_state + self._column('initial_offset')
        actuator = self._table.actuator(self._parameters)
        u = actuator.position(system.nominal_input)
        return plants.Process(system, time_ns, x, u, actuator, u)

    def _column(self, attribute: str) -> Array:
        """Return a parameter of all states (n_x,)."""
        return np.array([getattr(self._parameters.states[name], attribute)
                         for name in self.signals.states])

    def advance(self, time_ns: int) -> None:
        """Simulate up to an instant; raise IntegrationError for a plant that runs away."""
        self.process = self.process.until(time_ns)

    def skip_to(self, time_ns: int) -> None:
        """Set its time, which did not advance."""
        self.process = replace(self.process, time_ns=max(time_ns, self.process.time_ns))

    def command(self, values: Array) -> None:
        """Command the inputs (n_u,)."""
        self.process = self.process.commanded(values, self.process.time_ns)

    def reset(self) -> None:
        """Put it back to its initial state; time goes on."""
        self.process = self._initial(self.process.system, self.process.time_ns)

    def tune(self, parameters: PlantParameters) -> None:
        """Take over other parameters; the nominal point stays the same, for :meth:`reset`."""
        self._parameters, before = parameters, self.process.system
        try:
            system = self._table.system(parameters)
        except plants.EquilibriumError:
            system = self._table.system(parameters, before.nominal_state)
        self.process = replace(
            self.process, actuator=self._table.actuator(parameters), system=replace(
                system, nominal_state=before.nominal_state, nominal_input=before.nominal_input))

    def measure(self, sample: int) -> tuple[Array, Array, Array]:
        """Return measurement, variance and resolution of all states (n_x,) for a sample."""
        noise, resolution = self._column('measurement_noise'), self._column('resolution')
        drawn = np.array([plants.sensor_noise(one, self._parameters.seed, sample, i)
                          for i, one in enumerate(noise.tolist())])
        # the steps of the scale have the variance of a uniform error
        variance = noise ** 2 + resolution ** 2 / 12.0
        return self.process.x + drawn + self._column('bias'), variance, resolution

    def figures(self) -> dict[str, float]:
        """Return states and inputs with their names and units."""
        inputs = {base_name(name, unit): unit for name, unit in self.signals.inputs.items()}
        return {**values_by_name(self.signals.states, self.process.x.tolist()),
                **values_by_name(inputs, self.process.applied.tolist())}


class Analyser:
    """
    An analyser that measures a state rarely, and knows its value late.

    :param index: of the state.
    :param period_ns: from sample to sample.
    :param delay_ns: from a sample to its value, which has the stamp of the sample.
    """

    def __init__(self, publisher: SignalPublisher, index: int, period_ns: int, delay_ns: int
                 ) -> None:
        self._publisher, self._index = publisher, index
        self._period_ns, self._delay_ns = period_ns, delay_ns
        self._due_ns = 0
        self._samples: deque[tuple[int, float]] = deque()

    def sample(self, time_ns: int, measured: Array, frame_id: str) -> None:
        """Take a sample of the states (n_x,) if one is due; publish the values known by now."""
        if time_ns >= self._due_ns:
            self._due_ns = time_ns + self._period_ns
            self._samples.append((time_ns, float(measured[self._index])))
        while self._samples and self._samples[0][0] + self._delay_ns <= time_ns:
            stamp_ns, value = self._samples.popleft()
            self._publisher.send(np.array([value]), stamp_message(stamp_ns), frame_id)
