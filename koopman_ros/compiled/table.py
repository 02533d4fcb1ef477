# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What takes the place of which function in numpy; see :mod:`koopman_ros.kernels`."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from koopman_ros.arrays import Array
from koopman_ros.compiled import estimation, horizon, laws
from koopman_ros.control import target as targets
from koopman_ros.control.laws import base, riccati, shooting
from koopman_ros.estimation import kalman
from koopman_ros.kernels import Kernels
from koopman_ros.lifting import LiftedModel
from koopman_ros.solvers import RiccatiSolution, RiccatiStatus


def _solution(P: Array, K: Array, residual: float, size: float, max_residual: float,
              max_gain: float) -> RiccatiSolution | None:
    """Return a solution that is good beyond doubt, of a K with this Frobenius norm."""
    gain = size if min(K.shape) == 1 else float(np.linalg.norm(K, 2))
    if not (residual <= max_residual and gain <= max_gain):
        return None
    return RiccatiSolution(P, K, residual, gain, RiccatiStatus.SOLVED)


def _regulator(model: LiftedModel, A: Array, B: Array, Q: Array, R: Array, *, interval: float,
               max_residual: float = 1e-8, max_gain: float = 1e6) -> RiccatiSolution | None:
    if not interval > 0.0:
        return None
    sure, P, K, residual, size = laws.solve(
        np.ascontiguousarray(A), np.ascontiguousarray(B), Q, R, interval)
    return _solution(P, K, residual, size, max_residual, max_gain) if sure else None


def _feedback(found: tuple[Any, ...], form: riccati.Form, max_residual: float, max_gain: float
              ) -> riccati.Feedback | None:
    sure, u, P, K, residual, size, drift, action = found
    solution = _solution(P, K, residual, size, max_residual, max_gain) if sure else None
    return None if solution is None else riccati.Feedback(u, form, solution, drift, action)


def _recentred(model: LiftedModel, x: Array, target: base.Target, weights: base.Weights, *,
               interval: float = 0.0, max_gain: float = 1e6, max_residual: float = 1e-8
               ) -> riccati.Feedback | None:
    layout = model.layout
    if layout is None or not model.identity or not interval > 0.0:
        return None
    return _feedback(laws.recentred(
        layout.sizes, layout.numbers, x, target.x, target.z, target.u, target.forcing, weights.Q,
        weights.R, interval), riccati.Form.RECENTRED, max_residual, max_gain)


def _averaged(model: LiftedModel, x: Array, target: base.Target, weights: base.Weights, *,
              interval: float = 0.0, max_gain: float = 1e6, max_residual: float = 1e-8
              ) -> riccati.Feedback | None:
    layout = model.layout
    if layout is None or model.readout is None or not interval > 0.0:
        return None
    return _feedback(laws.averaged(
        layout.sizes, layout.numbers, x, target.x, target.u, weights.Q, weights.R, interval),
        riccati.Form.AVERAGED, max_residual, max_gain)


def _growth(model: LiftedModel, found: riccati.Feedback, interval: float) -> float | None:
    if len(found.drift) != 2 or not interval > 0.0:
        return None
    return float(laws.growth(np.ascontiguousarray(found.drift), np.ascontiguousarray(
        found.action), interval))


def _moved(model: LiftedModel, x: Array, w: Array, u: Array, h: float, steps: int
           ) -> Array | None:
    layout = model.layout
    if layout is None:
        return None
    found: Array = estimation.moved(layout.sizes, layout.numbers, x, w, u, h, steps)
    return found


def _propagated(model: LiftedModel, x: Array, w: Array, P: Array, u: Array, h: float, steps: int
                ) -> tuple[Array, Array] | None:
    layout = model.layout
    if layout is None or model.readout is None:
        return None
    found: tuple[Array, Array] = estimation.propagated(
        layout.sizes, layout.numbers, x, w, P, u, h, steps)
    return found


def _corrected(model: LiftedModel, H: Array, R: Array, P: Array, difference: Array
               ) -> kalman.Correction | None:
    sure, *found = estimation.corrected(H, R, P, difference)
    return kalman.Correction(*found) if sure else None


def _equilibrium(model: LiftedModel, w: Array, start: Array, free: NDArray[np.bool_],
                 anchor: Array, reach: Array) -> Array | None:
    layout, places = model.layout, np.flatnonzero(free)
    if layout is None or model.readout is None or len(places) != model.n_x:
        return None
    sure, found = estimation.equilibrium(
        layout.sizes, layout.numbers, w, start, places, targets.MOST_STEPS, targets.LONGEST_STEP,
        targets.RESOLUTION)
    return found if sure else None


def _program(model: LiftedModel, plan: shooting.Horizon, u: Array, x: Array
             ) -> shooting.Program | None:
    layout = model.layout
    if layout is None or model.readout is None:
        return None
    finite, *found = horizon.program(
        layout.sizes, layout.numbers, u, x, plan.start, plan.w, plan.x_ref, plan.u_ref,
        plan.lengths, plan.steps, plan.Q, plan.R, plan.terminal)
    return shooting.Program(*found) if finite else None


KERNELS: Kernels = {
    'averaged': _averaged, 'corrected': _corrected, 'equilibrium': _equilibrium,
    'growth': _growth, 'moved': _moved, 'program': _program, 'propagated': _propagated,
    'recentred': _recentred, 'regulator': _regulator}
