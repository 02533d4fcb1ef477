# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The control levels of a controller: a name, a model, a law and an estimator each."""

from dataclasses import dataclass, field

import numpy as np

from koopman_ros.arrays import Array
from koopman_ros.control.laws import Law, LawResult, LAWS, Tuning, Weights
from koopman_ros.control.limits import InputLimits
from koopman_ros.control.settings import Settings
from koopman_ros.control.target import balance, Reference, reference, Target
from koopman_ros.estimation import Estimate, Estimator, ESTIMATORS
from koopman_ros.lifting import LiftedModel
from koopman_ros.plugs import plug


@dataclass(frozen=True)
class Level:
    """One level."""

    name: str  #: of its law
    law: Law  #: with its model
    estimator: Estimator  #: on the same model
    _references: list[Reference] = field(default_factory=list, init=False, compare=False)

    @property
    def model(self) -> LiftedModel:
        """The model of law and estimator."""
        return self.law.model

    def target(self, setpoint: Array, estimate: Estimate) -> Target:
        """
        Return where to go under the estimated disturbance.

        :param setpoint: (n_x,) in state units.
        """
        x_ref = self.model.states.to_deviation(setpoint)
        # a memory of the last set-point only; what comes out does not depend on it
        known = self._references[0] if self._references else None
        if known is None or not (known.x == x_ref).all():
            known = reference(self.model, x_ref)
            self._references[:] = [known]
        return balance(self.model, known, estimate.w)

    def compute(self, setpoint: Array, estimate: Estimate, limits: InputLimits, memory: object,
                interval: float) -> tuple[Target, LawResult]:
        """
        Evaluate the law.

        :param setpoint: (n_x,) in state units.
        :param estimate: in terms of the level's model.
        :param limits: of the inputs.
        :param memory: of the law.
        :param interval: seconds between samples; 0 when they are not known.
        """
        target = self.target(setpoint, estimate)
        return target, self.law.compute(estimate, target, limits, memory, interval)


def levels_of(model: LiftedModel, settings: Settings) -> dict[str, Level]:
    """
    Build the levels that the settings name, best first.

    :raises ValueError: for a law or an estimator that there is not.
    """
    # the cost in the model's scaled deviations
    weights = Weights(np.diag(settings.state_weight * model.states.scale ** 2),
                      np.diag(settings.input_weight * model.inputs.scale ** 2))
    tuning = Tuning(weights, settings.max_gain, settings.max_residual)
    levels = {}
    for level in settings.supervisor.levels:
        law = plug(level.law, 'law', LAWS)(model, tuning)
        levels[level.law] = Level(level.law, law, _estimator(law.model, settings))
    return levels


def _estimator(model: LiftedModel, settings: Settings) -> Estimator:
    name = settings.estimator or (
        'disturbance_observer' if settings.observer_bandwidth > 0.0 else 'measured_state')
    return plug(name, 'estimator', ESTIMATORS)(
        model, settings.observer_bandwidth, settings.max_disturbance / model.inputs.scale)
