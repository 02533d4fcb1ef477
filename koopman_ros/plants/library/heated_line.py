# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A stirred tank that is heated from far away: hot water is mixed at the other end of a line."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from koopman_ros.core.arrays import along_last, Array
from koopman_ros.plants.constants import constant, Constants
from koopman_ros.plants.system import ControlAffineSystem

_NOMINAL_TEMPERATURE = 323.15  # K


@dataclass(frozen=True)
class HeatedLine(Constants):
    """
    A continuous stirred tank in which a component decomposes, heated by a jacket.

    dC/dt = q/V (C_f - C) - k(T) C, rho c_p V dT/dt = rho c_p q (T_f - T) + UA (T_w - T) + H V k(T)
    C with k(T) = k0 exp(-E/T). A valve mixes the water of the jacket from a cold and a hot supply,
    T_w = T_cold + u (T_hot - T_cold). The line to the jacket is a dead time of the input, and the
    characteristic of the valve one of its actuator. Reaction: as the hydrolysis of acetic
    anhydride, of which half is left after 4.4 min at 25 °C, E/R = 5650 K and H = 58 kJ/mol.
    """

    flow_rate: float = constant(0.5e-3, 'm^3/s', 1e-5, 1.0, 'feed and product flow q')
    volume: float = constant(0.3, 'm^3', 1e-3, 1e3, 'volume V of the liquid')
    heat_capacity: float = constant(
        4.18e6, 'J/(m^3 K)', 1e5, 1e7, 'heat capacity rho c_p of the liquid by volume')
    heat_transfer_coefficient: float = constant(
        3e3, 'W/K', 1.0, 1e6, 'coefficient times area of the jacket, UA', estimated=(1e3, 1e4))
    hot_temperature: float = constant(
        368.15, 'K', 313.15, 473.15, 'temperature T_hot of the hot supply', si='degC')
    cold_temperature: float = constant(
        288.15, 'K', 273.15, 303.15, 'temperature T_cold of the cold supply', si='degC')
    feed_temperature: float = constant(
        293.15, 'K', 273.15, 373.15, 'temperature T_f of the feed', si='degC')
    feed_concentration: float = constant(
        2.0, 'mol/L', 0.0, 10.0, 'concentration C_f in the feed', si='mol/m^3', factor=1e-3)
    reaction_heat: float = constant(
        5.8e4, 'J/mol', 0.0, 1e6, 'heat H released by the reaction')
    activation_temperature: float = constant(
        5650.0, 'K', 1e3, 2e4, 'activation energy over the gas constant, E/R')
    pre_exponential_factor: float = constant(
        4.41e5, '1/s', 0.0, 1e20, 'rate constant k0 at infinite temperature')

    def system(self) -> ControlAffineSystem:
        """Build it, nominal at 50 °C; concentration in mol/L, valve in percent of hot water."""
        gain = 0.01 * self._exchange * (self.hot_temperature - self.cold_temperature)
        # held where the concentration does not change
        rate = float(self._rate(np.array(_NOMINAL_TEMPERATURE)))
        kept = self.dilution_rate / (self.dilution_rate + rate)
        x = np.array([self.feed_concentration * kept, _NOMINAL_TEMPERATURE])
        return ControlAffineSystem(
            name='heated line',
            state_names=('concentration', 'temperature'),
            state_units=('mol/L', 'K'),
            input_names=('valve',),
            input_units=('percent',),
            time_unit='s',
            drift=self._drift,
            drift_jacobian=self._drift_jacobian,
            B=np.array([[0.0], [gain]]),
            nominal_state=x,
            nominal_input=-self._drift(x)[1:] / gain,
            state_lower=np.array([0.0, 200.0]),
            state_upper=np.array([np.inf, 1000.0]),
        )

    @cached_property
    def dilution_rate(self) -> float:
        """The flow rate over the volume, q/V, in 1/s."""
        return self.flow_rate / self.volume

    @cached_property
    def _exchange(self) -> float:
        """The coefficient of the jacket over the heat capacity of the tank, in 1/s."""
        return self.heat_transfer_coefficient / (self.heat_capacity * self.volume)

    @cached_property
    def _warming(self) -> float:
        """The temperature rise by reaction, in K per mol/L."""
        return 1e3 * self.reaction_heat / self.heat_capacity

    def _rate(self, temperature: Array) -> Array:
        """Evaluate the rate constant, in 1/s."""
        return self.pre_exponential_factor * np.exp(-self.activation_temperature / temperature)

    def _drift(self, x: Array) -> Array:
        reaction = self._rate(x[..., 1]) * x[..., 0]
        feed = np.array([self.feed_concentration, self.feed_temperature])
        heating = self._exchange * (self.cold_temperature - x[..., 1])
        return self.dilution_rate * (feed - x) + along_last(
            -reaction, self._warming * reaction + heating)

    def _drift_jacobian(self, x: Array) -> Array:
        rate = self._rate(x[..., 1])
        slope = along_last(rate, rate * x[..., 0] * self.activation_temperature / x[..., 1] ** 2)
        jacobian: Array = np.stack([-slope, self._warming * slope], axis=-2) - np.diag(
            [self.dilution_rate, self.dilution_rate + self._exchange])
        return jacobian
