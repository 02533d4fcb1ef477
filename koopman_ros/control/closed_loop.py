# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A feedback law in continuous time on any plant: what it costs and where it ends."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from koopman_ros.arrays import Array
from koopman_ros.control.laws import Feedback, feedback, Weights
from koopman_ros.control.target import steady_state_target, Target
from koopman_ros.lifting import LiftedModel
from koopman_ros.reasons import Code, reason, Words
from koopman_ros.units import Displays

FeedbackFunction = Callable[..., Feedback]
# dx/dt (n_x,) of a state (n_x,) and an input (n_u,), all in units
Rate = Callable[[Array, Array], Array]


@dataclass(frozen=True)
class ClosedLoop:
    """A plant under a law."""

    times: Array  #: (K,) in the model's time unit
    states: Array  #: (K, n_x) in state units, up to a failure
    inputs: Array  #: (K, n_u) in input units
    cost: float  #: integral of e' Q e + v' R v; infinite when the loop failed
    failure: str = ''  #: why it ended early, empty when it did not

    def distance(self, model: LiftedModel) -> float:
        """Return how far the path leaves the training box, in halves of its width."""
        return max(model.states.violation(x) for x in self.states)

WORDS = Words(Displays({}))


class _Failed(Exception):  # noqa: N818
    """The loop cannot go on; the message says why."""


def run_closed_loop(model: LiftedModel, rate: Rate, x0: Array, x_ref: Array, weights: Weights,
                    duration: float, *, law: FeedbackFunction = feedback, samples: int = 301,
                    rtol: float = 1e-8, u_ref: Array | None = None, escape: float = 10.0,
                    max_evaluations: int = 20_000) -> ClosedLoop:
    """
    Integrate a plant under a continuous law and the law's cost with it.

    :param model: the lift that the law uses.
    :param rate: the plant, e.g. ``ControlAffineSystem.derivative``.
    :param x0: (n_x,) start, in state units.
    :param x_ref: (n_x,) set-point, in state units.
    :param weights: weights of the law and of the cost, on the model's scaled deviations.
    :param duration: in the model's time unit.
    :param law: feedback(model, x, target, weights).
    :param samples: number of times to return.
    :param rtol: relative tolerance of the integration.
    :param u_ref: (n_u,) input from which the cost counts, in input units; by default the one
        that the model takes to hold the set-point.
    :param escape: the loop has failed when a state is further than this from the nominal point,
        in units of its scale.
    :param max_evaluations: of the law, after which the loop has failed: it chatters or is stiff.
    """
    # in here: no node needs it, and it would make a fourth of their start
    from scipy.integrate import DOP853

    target = steady_state_target(model, model.states.to_deviation(np.asarray(x_ref)))
    v_ref = target.u if u_ref is None else model.inputs.to_deviation(np.asarray(u_ref))

    def act(x: Array) -> tuple[Array, Array]:
        xi = model.states.to_deviation(x)
        found = law(model, xi, target, weights)
        if not found.solved:
            raise _Failed(WORDS(reason(Code(found.riccati.status.value))))
        return xi, found.u

    def flow(_: float, y: Array) -> Array:
        x = y[:-1]
        xi, u = act(x)
        return np.append(rate(x, model.inputs.to_physical(u)),
                         _stage_cost(xi, u, target, v_ref, weights))

    times = np.linspace(0.0, duration, samples)
    states = [np.asarray(x0, dtype=np.float64)]
    inputs: list[Array] = []
    cost, failure = np.inf, ''
    try:
        inputs.append(model.inputs.to_physical(act(states[0])[1]))
        solver = DOP853(flow, 0.0, np.append(states[0], 0.0), duration, rtol=rtol,
                        atol=1e-3 * rtol)
        while solver.status == 'running':
            message = solver.step()
            if solver.status == 'failed':
                raise _Failed(f'the integration failed: {message}')
            path = solver.dense_output()
            while len(states) < samples and times[len(states)] <= solver.t:
                x = path(times[len(states)])[:-1]
                inputs.append(model.inputs.to_physical(act(x)[1]))
                states.append(x)
            if np.max(np.abs(model.states.to_deviation(solver.y[:-1]))) > escape:
                raise _Failed('the state escaped')
            if solver.nfev > max_evaluations:
                raise _Failed(f'the law was evaluated {max_evaluations} times before the end')
        cost = float(solver.y[-1])
    except _Failed as error:
        failure = str(error)
        inputs = inputs or [np.full(model.n_u, np.nan)]
    return ClosedLoop(times[:len(states)], np.array(states), np.array(inputs), cost, failure)


def _stage_cost(xi: Array, u: Array, target: Target, v_ref: Array, weights: Weights) -> float:
    e, v = xi - target.x, u - v_ref
    return float(e @ weights.Q @ e + v @ weights.R @ v)
