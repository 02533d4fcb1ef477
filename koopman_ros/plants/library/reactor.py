# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The continuous stirred tank reactor (CSTR) with a cooling jacket, of one state and of two."""

from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import ArrayLike

from koopman_ros.core.arrays import along_last, Array
from koopman_ros.plants.constants import constant, Constants
from koopman_ros.plants.system import ArrayFunction, ControlAffineSystem, EquilibriumError

# The coolant temperature, in K, around which both reactors are run.
NOMINAL_COOLANT_TEMPERATURE = 300.0
# Temperatures, in K, outside which neither the liquid nor its heat of reaction is what the model
# says; the highest that the two-state reactor can reach by itself is 559 K.
TEMPERATURE_RANGE = (200.0, 1000.0)
# The fold is looked for on a grid of 0.04 K, which misses its heat balance by less than 1e-4
# K/min.
_SCAN_POINTS = 20001


@dataclass(frozen=True)
class ReactorParameters(Constants):
    """
    The physical constants of the reactor; the defaults are the benchmark's.

    Source of the values: the CSTR of Seborg, Edgar and Mellichamp, *Process Dynamics and Control*,
    as in Henson and Seborg, *Nonlinear Process Control*; the paper, eq. 36, lists none.

    :raises ValueError: when a value is not a number or outside its range.
    """

    flow_rate: float = constant(
        100.0, 'L/min', 1.0, 1e4, 'feed and product flow q', si='m^3/s', factor=6e4)
    volume: float = constant(
        100.0, 'L', 1.0, 1e5, 'volume V of the liquid', si='m^3', factor=1e3)
    density: float = constant(
        1000.0, 'g/L', 100.0, 1e4, 'density rho of the liquid', si='kg/m^3')
    heat_capacity: float = constant(
        0.239, 'J/(g K)', 0.01, 100.0, 'heat capacity C_p of the liquid', si='J/(kg K)',
        factor=1e-3)
    reaction_enthalpy: float = constant(
        -5e4, 'J/mol', -1e6, -1.0, 'enthalpy of reaction Delta H_R, negative as heat is released',
        estimated=(-2e5, -1e4))
    activation_temperature: float = constant(
        8750.0, 'K', 2e3, 1e5, 'activation energy over the gas constant, E_A/R',
        estimated=(7e3, 1.1e4))
    pre_exponential_factor: float = constant(
        7.2e10, '1/min', 0.0, 1e30, 'rate constant k at infinite temperature', si='1/s',
        factor=60.0, estimated=(7.2e8, 7.2e12))
    heat_transfer_coefficient: float = constant(
        5e4, 'J/(min K)', 0.0, 1e7, 'coefficient times area of the cooling jacket, UA', si='W/K',
        factor=60.0, estimated=(1e4, 2e5))
    feed_temperature: float = constant(
        350.0, 'K', 250.0, 500.0, 'temperature T_i of the feed', si='degC')
    feed_concentration: float = constant(
        1.0, 'mol/L', 0.0, 100.0, 'reactant C_Af in the feed (two-state reactor only)',
        si='mol/m^3', factor=1e-3)
    #: by default that of the two-state reactor's stable steady state at a coolant of 300 K
    concentration: float = constant(
        0.87725294608097, 'mol/L', 0.0, 100.0,
        'constant reactant C_A (one-state reactor only)', si='mol/m^3', factor=1e-3)

    @cached_property
    def dilution_rate(self) -> float:
        """The flow rate over the volume, q/V, in 1/min."""
        return self.flow_rate / self.volume

    @cached_property
    def cooling_rate(self) -> float:
        """The input gain UA/(rho C_p V), in 1/min."""
        return self.heat_transfer_coefficient / (self.density * self.heat_capacity * self.volume)

    @cached_property
    def heating_per_conversion(self) -> float:
        """The temperature rise by reaction, -Delta H_R/(rho C_p), in K per mol/L."""
        return -self.reaction_enthalpy / (self.density * self.heat_capacity)

    def _rate(self, temperature: Array) -> Array:
        """Evaluate the Arrhenius law k exp(-E_A/(R T)), in 1/min."""
        return self.pre_exponential_factor * np.exp(-self.activation_temperature / temperature)

    def _rate_slope(self, temperature: Array) -> Array:
        steepness = self.activation_temperature / (temperature * temperature)
        return self._rate(temperature) * steepness

    def _heat_flow(self, temperature: Array) -> Array:
        """Evaluate the heating by feed and a jacket at 0 K, in K/min; B u adds the coolant."""
        feed = self.dilution_rate * (self.feed_temperature - temperature)
        return feed - self.cooling_rate * temperature

    def _one_state_drift(self, x: Array) -> Array:
        reaction = self.concentration * self._rate(x)
        return self._heat_flow(x) + self.heating_per_conversion * reaction

    def _one_state_jacobian(self, x: Array) -> Array:
        heating = self.heating_per_conversion * (self.concentration * self._rate_slope(x))
        slope: Array = -self.dilution_rate - self.cooling_rate + heating
        return slope[..., None]

    def _two_state_drift(self, x: Array) -> Array:
        concentration, temperature = x[..., 0], x[..., 1]
        reaction = concentration * self._rate(temperature)
        supply = self.dilution_rate * (self.feed_concentration - concentration)
        heating = self.heating_per_conversion * reaction
        return along_last(supply - reaction, self._heat_flow(temperature) + heating)

    def _two_state_jacobian(self, x: Array) -> Array:
        rate, steepening = self._rate(x[..., 1]), x[..., 0] * self._rate_slope(x[..., 1])
        heating = self.heating_per_conversion
        jacobian: Array = np.stack([
            along_last(-self.dilution_rate - rate, -steepening),
            along_last(heating * rate,
                       -self.dilution_rate - self.cooling_rate + heating * steepening)], axis=-2)
        return jacobian

    def _with_steady_concentration(self, temperature: Array) -> Array:
        supply = self.dilution_rate * self.feed_concentration
        return along_last(supply / (self.dilution_rate + self._rate(temperature)), temperature)


def one_state_reactor(parameters: ReactorParameters | None = None,
                      nominal_state: ArrayLike | None = None) -> ControlAffineSystem:
    """
    Build the reactor of the paper (eq. 36): temperature as state, concentration held fixed.

    Its nominal input is a coolant at 300 K.

    :param parameters: the benchmark's when None.
    :param nominal_state: (n_x,); the stable steady state on the cold branch at the nominal input
        when None. Give it where that may not exist, as when a running plant changes.
    :raises ValueError: when `nominal_state` is none of this reactor.
    :raises EquilibriumError: when `nominal_state` is None and there is no stable steady state.
    """
    constants = parameters or ReactorParameters()
    return _reactor('one-state reactor', constants, constants._one_state_drift,
                    constants._one_state_jacobian, partial(np.expand_dims, axis=-1), nominal_state)


def two_state_reactor(parameters: ReactorParameters | None = None,
                      nominal_state: ArrayLike | None = None) -> ControlAffineSystem:
    """
    Build the benchmark reactor of Seborg and Henson: concentration and temperature as states.

    dC_A/dt = q/V (C_Af - C_A) - k exp(-E_A/(R T)) C_A; the temperature as in the paper's eq. 36.
    Parameters and errors are those of :func:`one_state_reactor`.
    """
    constants = parameters or ReactorParameters()
    return _reactor('two-state reactor', constants, constants._two_state_drift,
                    constants._two_state_jacobian, constants._with_steady_concentration,
                    nominal_state, ('concentration',), ('mol/L',))


def fed_reactor(parameters: ReactorParameters | None = None,
                nominal_state: ArrayLike | None = None) -> ControlAffineSystem:
    """
    Build the two-state reactor with its feed flow as a second input.

    The effect of the flow q depends on the state: q/V (C_Af - C_A) and q/V (T_i - T). Parameters
    and errors are those of :func:`one_state_reactor`; the flow rate is the nominal one.
    """
    constants = parameters or ReactorParameters()
    fixed = two_state_reactor(constants, nominal_state=nominal_state)
    feed = np.array([constants.feed_concentration, constants.feed_temperature])

    def input_matrix(x: Array) -> Array:
        B = np.zeros((*x.shape, 2))
        B[..., 0] = (feed - x) / constants.volume
        B[..., 1, 1] = constants.cooling_rate
        return B

    return replace(
        fixed, name='fed reactor', input_names=('feed_flow', *fixed.input_names),
        input_units=('L/min', *fixed.input_units),
        drift=lambda x: fixed.drift(x) - constants.dilution_rate * (feed - x),
        drift_jacobian=lambda x: fixed.drift_jacobian(x) + constants.dilution_rate * np.eye(2),
        B=input_matrix, nominal_input=np.array([constants.flow_rate, *fixed.nominal_input]))


@dataclass(frozen=True)
class OneStateReactor(ReactorParameters):
    """The reactor of the paper as a plant of the catalogue."""

    system = one_state_reactor


@dataclass(frozen=True)
class TwoStateReactor(ReactorParameters):
    """The benchmark reactor as a plant of the catalogue."""

    system = two_state_reactor


@dataclass(frozen=True)
class FedReactor(ReactorParameters):
    """The benchmark reactor, its feed flow an input, as a plant of the catalogue."""

    system = fed_reactor


def _reactor(name: str, constants: ReactorParameters, drift: ArrayFunction,
             jacobian: ArrayFunction, state_at: ArrayFunction, nominal_state: ArrayLike | None,
             others: tuple[str, ...] = (), units: tuple[str, ...] = ()) -> ControlAffineSystem:
    """Build a reactor whose states are `others`, not negative, and the temperature."""
    if nominal_state is None:
        nominal_state = _cold_stable_state(constants, drift, jacobian, state_at)
    lowest, highest = TEMPERATURE_RANGE
    return ControlAffineSystem(
        name=name,
        state_names=(*others, 'temperature'),
        state_units=(*units, 'K'),
        input_names=('coolant_temperature',),
        input_units=('K',),
        time_unit='min',
        drift=drift,
        drift_jacobian=jacobian,
        B=np.array([*([0.0] for _ in others), [constants.cooling_rate]]),
        nominal_state=np.asarray(nominal_state, dtype=np.float64),
        nominal_input=np.array([NOMINAL_COOLANT_TEMPERATURE]),
        state_lower=np.array([*(0.0 for _ in others), lowest]),
        state_upper=np.array([*(np.inf for _ in others), highest]),
    )


def _cold_stable_state(constants: ReactorParameters, drift: ArrayFunction,
                       jacobian: ArrayFunction, state_at: ArrayFunction) -> Array:
    """
    Find the stable steady state at the nominal input on the cold branch of the heat balance.

    From the cold end the balance falls with temperature, until at the first fold the reaction
    steepens more than the cooling does: the state wanted lies below that fold.

    :param state_at: temperatures (...) to the states (..., n_x) at which all but the last of the
        rates, that of the temperature, vanish.
    """
    def heat_balance(temperature: Array) -> Array:
        coolant = constants.cooling_rate * NOMINAL_COOLANT_TEMPERATURE
        balance: Array = drift(state_at(temperature))[..., -1] + coolant
        return balance

    grid = np.linspace(*TEMPERATURE_RANGE, _SCAN_POINTS)
    balance = heat_balance(grid)
    rising = np.flatnonzero(np.diff(balance) > 0.0)
    end = rising[0] if rising.size else -1
    if balance[0] > 0.0 > balance[end]:
        from scipy.optimize import brentq  # slow to import

        temperature = brentq(
            lambda trial: heat_balance(np.asarray(trial)), grid[0], grid[end],
            xtol=1e-300, rtol=1e-15)
        state = state_at(np.asarray(temperature))
        if np.all(np.linalg.eigvals(jacobian(state)).real < 0.0):
            return state
    raise EquilibriumError(
        'the reactor has no stable steady state on its cold branch at a coolant temperature of '
        f'{NOMINAL_COOLANT_TEMPERATURE:.10g} K: with heat_transfer_coefficient = '
        f'{constants.heat_transfer_coefficient:.10g} J/(min K) and feed_temperature = '
        f'{constants.feed_temperature:.10g} K the cooling cannot hold the reaction; give '
        'nominal_state, or increase the cooling')
