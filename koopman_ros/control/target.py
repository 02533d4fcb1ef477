# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The steady state of the lifted model that holds a set-point."""

from dataclasses import dataclass
import math

import numpy as np

from koopman_ros.arrays import Array
from koopman_ros.lifting import LiftedModel


@dataclass(frozen=True)
class Target:
    """A set-point with the input that holds it, in scaled deviations."""

    x: Array  #: (n_x,) reference state
    z: Array  #: (n_z,) z_ref = N(x_ref) (paper, section on the optimal control problem)
    u: Array  #: (n_u,) input that balances the model's drift and the disturbance there
    forcing: Array  #: (n_x,) B u_ref + w, what acts on the state beside the drift
    residual: float  #: size of the rate that no input balances; 0 where x can be held


def steady_state_target(model: LiftedModel, x_ref: Array, w: Array | None = None) -> Target:
    """
    Solve f(x_ref) + B u_ref + w = 0 for u_ref by least squares, f the model's drift.

    The feed-forward comes from the lifted model: the linearisation's would leave a large
    offset far from the nominal point.

    :param model: the lift.
    :param x_ref: (n_x,) scaled deviation.
    :param w: (n_x,) disturbance of the state's rate, none by default.
    """
    return balance(model, reference(model, x_ref), np.zeros(model.n_x) if w is None else w)


@dataclass(frozen=True)
class Reference:
    """What a target has of its set-point alone, in scaled deviations."""

    x: Array  #: (n_x,) reference state
    z: Array  #: (n_z,) N(x_ref)
    drift: Array  #: (n_x,) the model's drift there


def reference(model: LiftedModel, x_ref: Array) -> Reference:
    """Evaluate the model at a set-point (n_x,), in scaled deviations."""
    return Reference(x_ref, model.lift(x_ref), model.drift(x_ref))


def balance(model: LiftedModel, at: Reference, w: Array) -> Target:
    """Complete a reference by the input that balances drift and disturbance w (n_x,)."""
    load = at.drift + w
    u = -model.input_inverse.dot(load)
    forcing = model.B.dot(u)
    rest = load + forcing
    return Target(at.x, at.z, u, forcing + w, math.sqrt(rest.dot(rest)))
