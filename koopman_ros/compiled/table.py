# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What takes the place of which function in numpy; see :mod:`koopman_ros.kernels`."""

from functools import partial
import math

import numpy as np
from numpy.typing import NDArray

from koopman_ros.arrays import Array
from koopman_ros.compiled import estimation, horizon, laws
from koopman_ros.compiled import regular as steps
from koopman_ros.compiled.riccati import regulator
from koopman_ros.control import target as targets
from koopman_ros.control.laws import base, riccati, shooting
from koopman_ros.control.regular import Answered, Regular
from koopman_ros.estimation import Estimate, kalman
from koopman_ros.kernels import Kernels
from koopman_ros.lifting import LiftedModel
from koopman_ros.solvers import RiccatiSolution, RiccatiStatus

# The word of an enumeration takes as long as some products.
_RECENTRED, _AVERAGED = riccati.Form.RECENTRED.value, riccati.Form.AVERAGED.value


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
    sure, P, K, residual, size = regulator(
        np.ascontiguousarray(A), np.ascontiguousarray(B), Q, R, interval)
    return _solution(P, K, residual, size, max_residual, max_gain) if sure else None


def _law(model: LiftedModel, x: Array, target: base.Target, weights: base.Weights,
         form: riccati.Form, interval: float) -> tuple[Array, int] | None:
    """Return what the compiled law gives, and its number of coordinates; None where not sure."""
    layout, recentred = model.layout, form is riccati.Form.RECENTRED
    if layout is None or not (model.identity if recentred else model.readout is not None) or not (
            interval > 0.0):
        return None
    found = laws.law(
        layout.sizes, layout.numbers, x, target.x, target.z, target.u, target.forcing, weights.Q,
        weights.R, interval, recentred)
    return (found, model.n_z if recentred else model.n_x) if found[0] < math.inf else None


def _feedback(form: riccati.Form, model: LiftedModel, x: Array, target: base.Target,
              weights: base.Weights, *, interval: float = 0.0, max_gain: float = 1e6,
              max_residual: float = 1e-8) -> riccati.Feedback | None:
    whole = _law(model, x, target, weights, form, interval)
    if whole is None:
        return None
    (found, k), n, m = whole, model.n_x, model.n_u
    residual, size = found[:2].tolist()
    u, P, K, drift, action, _ = np.split(
        found[laws.LAW:], np.cumsum((m, k * k, m * k, n * n, n * n)))
    solution = _solution(P.reshape(k, k), K.reshape(m, k), residual, size, max_residual, max_gain)
    return None if solution is None else riccati.Feedback(
        u, form, solution, drift.reshape(n, n), action.reshape(n, n))


def _answer(model: LiftedModel, x: Array, target: base.Target, tuning: base.Tuning,
            interval: float) -> riccati.Answer | None:
    form = riccati.Form.RECENTRED if riccati.closed(model) else riccati.Form.AVERAGED
    whole = _law(model, x, target, tuning.weights, form, interval)
    if whole is None:
        return None
    (found, k), m = whole, model.n_u
    residual, gain, growth = found[:laws.LAW].tolist()
    if min(m, k) > 1:
        start = laws.LAW + m + k * k
        gain = float(np.linalg.norm(found[start:start + m * k].reshape(m, k), 2))
    # of more than two states the reference tells how their error grows
    if not (residual <= tuning.max_residual and gain <= tuning.max_gain
            and growth == growth):
        return None
    return riccati.Answer(found[laws.LAW:laws.LAW + m],
                          base.Figures(form.value, residual, gain, growth), RiccatiStatus.SOLVED)


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
    return found if math.isfinite(found[0]) else None


def _propagated(model: LiftedModel, x: Array, w: Array, P: Array, u: Array, h: float, steps: int
                ) -> tuple[Array, Array] | None:
    layout = model.layout
    if layout is None:
        return None
    found: tuple[Array, Array] = estimation.propagated(
        layout.sizes, layout.numbers, x, w, P, u, h, steps)
    return found if math.isfinite(found[0][0]) else None


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
    if layout is None:
        return None
    finite, *found = horizon.program(
        layout.sizes, layout.numbers, u, x, plan.start, plan.w, plan.x_ref, plan.u_ref,
        plan.lengths, plan.steps, plan.Q, plan.R, plan.terminal)
    return shooting.Program(*found) if finite else None


def _distances(model: LiftedModel, x: Array) -> Array | None:
    known = model.training_states
    if x.shape[1:] != (model.n_x,):
        return None
    found: Array = horizon.distances(
        x, model.states.corners, model.states.half_widths,
        np.empty((0, model.n_x)) if known is None else known.states,
        0.0 if known is None else known.fill_distance)
    return found


def _slope_at(model: LiftedModel, x: Array) -> Array | None:
    layout = model.layout
    if layout is None:
        return None
    found: Array = horizon.slope(layout.sizes, layout.numbers, x)
    return found


def _step(model: LiftedModel, regular: Regular, y: Array, last: Array, before: Estimate,
          acted: Array, command: Array, known: base.Target, elapsed: float, since: float,
          seconds: float, spacing: float) -> Answered | None:
    """Answer with one input and at most two states, of which there is a compiled growth."""
    layout, recentred = model.layout, riccati.closed(model)
    n, m = model.n_x, model.n_u
    if layout is None or m > 1 or n > 2 or not (recentred or model.readout is not None):
        return None
    found = steps.step(
        layout.sizes, layout.numbers, regular.numbers, regular.states, regular.inputs,
        regular.training, regular.tuning.weights.Q, regular.tuning.weights.R, regular.inverse,
        np.ascontiguousarray(y), np.ascontiguousarray(last), before.x, before.w, acted, command,
        known.x, known.z, known.drift, elapsed, since, seconds, spacing, recentred)
    residual, gain, growth, rest, outside, at_range, at_rate = found[:steps.FIGURES].tolist()
    if not residual < math.inf:
        return None
    found.setflags(write=False)
    at = steps.FIGURES + 3 * n
    x, w, expected = found[steps.FIGURES:at - 2 * n], found[at - 2 * n:at - n], found[at - n:at]
    u, forcing = found[at:at + m], found[at + m:at + m + n]
    asked, command = found[at + m + n:at + 2 * m + n], found[at + 2 * m + n:]
    return Answered(
        Estimate(x, w), expected, base.Target(known.x, known.z, known.drift, u, forcing, rest),
        base.Figures(_RECENTRED if recentred else _AVERAGED, residual, gain, growth), asked,
        command, at_range > 0.0, at_rate > 0.0, outside)


KERNELS: Kernels = {
    'answer': _answer, 'averaged': partial(_feedback, riccati.Form.AVERAGED),
    'corrected': _corrected, 'distances': _distances, 'equilibrium': _equilibrium,
    'growth': _growth, 'moved': _moved, 'program': _program, 'propagated': _propagated,
    'recentred': partial(_feedback, riccati.Form.RECENTRED), 'regulator': _regulator,
    'regular_step': _step, 'slope_at': _slope_at}
