# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The plants, their measurements, and the task of every controller."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from koopman_ros.control import InputLimits, Tuning
from koopman_ros.control.laws.base import Target
from koopman_ros.control.mpc import MPCParameters
from koopman_ros.control.steady_state import steady_state_target
from koopman_ros.core.arrays import Array
from koopman_ros.core.paths import model_path
from koopman_ros.core.signals import Outputs
from koopman_ros.core.solvers import solve_riccati
from koopman_ros.evaluation.optimal_cost import Task
from koopman_ros.model import LiftedModel, load
from koopman_ros.plants import ControlAffineSystem, steady_state
from studies.shipped_models import library_system
from studies.true_model import TrueModel

_ENDLESS = 1e9  # bound on a gain in physical units, whatever these are


@dataclass(frozen=True, eq=False)
class PartialCase:
    """Rest at a set-point, a step of it, and a load in the end, on a plant of the library."""

    plant: str  #: its name in the catalogue, and that of its shipped lift
    measured: tuple[str, ...]  #: (n_y,) names of the states that are
    noise: Array  #: (n_y,) standard deviations, in state units
    disturbance_noise: Array  #: (n_u,) of an unknown influence in a second, in input units
    initial_error: Array  #: (n_x,) how wrong a first guess may be, in state units
    Q: Array  #: (n_x,) weights of squared state errors
    R: Array  #: (n_u,) weights of squared input deviations
    lower: Array  #: (n_u,) range of the inputs, to `upper` (n_u,)
    upper: Array
    period: float  #: between samples, in s
    begin: dict[str, float]  #: where some states rest, and are to rest, before the step
    setpoint: dict[str, float]  #: where they are to go, in the model's order
    reached: float  #: offset from which a run counts as lost, in the unit of the last set-point
    load: Array  #: (n_u,) unknown offset of the inputs in the end
    stepped_at: float  #: when the set-point steps, in s
    loaded_at: float  #: when the load begins, in s
    duration: float  #: of it all, in s
    state_upper: Array = field(default_factory=lambda: np.zeros(0))  #: (n_x,), empty for none

    @cached_property
    def system(self) -> ControlAffineSystem:
        """The plant."""
        return library_system(self.plant)

    @cached_property
    def loaded(self) -> ControlAffineSystem:
        """The plant under its load."""
        system = self.system
        return replace(system, drift=lambda x: system.derivative(x, self.load),
                       drift_jacobian=lambda x: system.slope(x, np.broadcast_to(
                           self.load, (*x.shape[:-1], system.n_u))))

    @cached_property
    def lift(self) -> LiftedModel:
        """The shipped lift."""
        return load(model_path(self.plant))

    @cached_property
    def truth(self) -> TrueModel:
        """The plant's own equations in the range of the lift."""
        box, inputs = self.lift.states, self.lift.inputs
        return TrueModel.of(self.system, box.lower, box.upper, inputs.lower, inputs.upper)

    @cached_property
    def limits(self) -> InputLimits:
        """The range of the inputs, which change at once."""
        return InputLimits(self.lower, self.upper, np.full(len(self.lower), np.inf))

    @cached_property
    def rows(self) -> list[int]:
        """Where the measured states are."""
        return [self.system.state_names.index(name) for name in self.measured]

    @cached_property
    def outputs(self) -> Outputs:
        """The measured outputs."""
        return Outputs(self.measured, tuple(self.system.state_units[i] for i in self.rows),
                       np.eye(self.system.n_x)[self.rows])

    @cached_property
    def directions(self) -> Array:
        """(n_x, n_y) rates by which an unknown influence is estimated: as inputs, or outputs."""
        if len(self.measured) == self.system.n_u:
            return self.system.input_matrix(self.system.nominal_state)
        return np.eye(self.system.n_x)[:, self.rows]

    @property
    def shown(self) -> str:
        """The last state with a set-point, in whose unit offsets are."""
        return list(self.setpoint)[-1]

    @cached_property
    def unit(self) -> str:
        """Its unit."""
        return dict(zip(self.system.state_names, self.system.state_units, strict=True))[self.shown]

    @cached_property
    def start(self) -> tuple[Array, Array]:
        """State and input before the step."""
        return steady_state(self.system, self.begin)

    def wanted(self, seconds: float) -> Array:
        """Return the set-point (n_c,) at a time."""
        return np.array(list((self.begin if seconds < self.stepped_at else self.setpoint
                              ).values()))

    def goal(self, system: ControlAffineSystem) -> tuple[Array, Array]:
        """Return state and input that hold the set-point."""
        return steady_state(system, self.setpoint)

    @cached_property
    def cost_to_go(self) -> Array:
        """Cost matrix (n_x, n_x) of the sampled regulator about the set-point."""
        x, u = self.goal(self.system)
        return solve_riccati(
            self.system.slope(x, u), self.system.input_matrix(x), np.diag(self.Q),
            np.diag(self.R), interval=self.period / self.system.seconds_per_time_unit,
            max_gain=_ENDLESS).P

    def task(self, x0: Array) -> Task:
        """Return the step alone from a state (n_x,), all known."""
        x_ref, u_ref = self.goal(self.system)
        return Task(self.system, x0, x_ref, u_ref, self.Q, self.R,
                    self.period / self.system.seconds_per_time_unit,
                    round((self.loaded_at - self.stepped_at) / self.period), 10)

    def tuning(self, model: LiftedModel, **others: Any) -> Tuning:
        """Return the tuning of a controller of this package; `others` replace values by name."""
        return Tuning.for_model(model, **{
            'state_weight': self.Q, 'input_weight': self.R, 'limits': self.limits,
            'controlled': tuple(self.setpoint), 'bumpless_transfer_time': 0.0,
            'estimator': 'extended_kalman_filter', 'measurement_noise': self.noise,
            'disturbance_noise': self.disturbance_noise * np.sqrt(60.0),
            'initial_error': self.initial_error,
            'plugins': {'mpc': MPCParameters(upper=self.state_upper) if len(self.state_upper)
                        else MPCParameters()}, **others})

    def target(self, setpoint: Array, w: Array) -> tuple[Array, Array]:
        """Return the state and the input that hold a set-point (n_c,) under rates w (n_x,)."""
        model = self.truth
        states, inputs, names = model.states, model.inputs, tuple(self.setpoint)
        found: Target | None = steady_state_target(
            model, states.only(names).to_deviation(setpoint), w / states.scale,
            controlled=np.array([states.names.index(name) for name in names], dtype=np.intp),
            limits=(inputs.to_deviation(self.lower), inputs.to_deviation(self.upper)))
        if found is None:
            raise ValueError(f'{self.plant}: nothing holds the set-point under {w.tolist()}')
        return states.to_physical(found.x), inputs.to_physical(found.u)


CASES = {case.plant: case for case in (
    # millimetres of noise on the lower tanks, the upper ones are not measured
    PartialCase('quadruple_tank', ('level_1', 'level_2'), np.full(2, 1e-3), np.full(2, 0.01),
         np.array([1e-3, 1e-3, 1e-2, 1e-2]), np.array([1e4, 1e4, 0.0, 0.0]), np.ones(2),
         np.zeros(2), np.full(2, 10.0), 12.0, {'level_1': 0.10, 'level_2': 0.15},
         {'level_1': 0.15, 'level_2': 0.12}, 0.01, np.array([-0.3, 0.0]), 300.0, 900.0, 1800.0),
    # the motor holds it 57 degrees from upright
    PartialCase('pendulum', ('angle',), np.array([2e-3]), np.array([0.1]), np.array([2e-3, 0.5]),
                np.array([1.0, 0.1]), np.ones(1), np.array([-15.0]), np.array([15.0]), 0.0625,
                {'angle': 1.0}, {'angle': 0.0}, 0.1, np.array([0.5]), 1.5625, 5.3125, 10.5),
    # the hotter, the quicker it converts: without its limit it goes to 326.6 K
    PartialCase('fed_reactor', ('concentration', 'temperature'), np.array([2e-3, 0.1]),
                np.array([0.5, 0.05]), np.array([2e-3, 0.1]), np.array([1e5, 0.1]),
                np.full(2, 0.1), np.array([60.0, 278.15]), np.array([150.0, 305.15]), 9.0,
                {'concentration': 0.95, 'temperature': 315.0},
                {'concentration': 0.88, 'temperature': 322.0}, 1.0, np.array([0.0, 1.0]), 225.0,
                675.0, 1440.0, np.array([np.inf, 322.5])),
)}
