# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Time of a plan of the law `mpc`, of do-mpc with IPOPT, and of casadi's generated SQP."""

from collections.abc import Callable
from pathlib import Path
import tempfile
from time import thread_time_ns
from typing import Any, TypeAlias

import numpy as np

from benchmarks.sqp import solver_of, Sqp, SqpProblem
from koopman_ros.control import Controller, SetpointRequest, State
from koopman_ros.control.laws.base import Target
from koopman_ros.control.mpc import RecedingHorizon
from koopman_ros.core.arrays import Array
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.estimation import Estimate
from koopman_ros.evaluation import at, run_loop
from koopman_ros.evaluation.loop import after_a_second
from koopman_ros.plants import Process
from studies.equations import EQUATIONS
from studies.partly_measured.cases import CASES, PartialCase

# A state (n_x,) and its target, and what answers them.
Call: TypeAlias = tuple[Array, Target]
Answer: TypeAlias = Callable[[Array, Target], Array]

# Lifts of two states and of four, whose horizon is thirty samples, each with its set-points, of
# which each holds for so many samples, and the noise of all states, in their units.
SETPOINTS = {'pendulum': ((0.0,), (0.5,), (-0.3,), (0.8,)),
             'quadruple_tank': ((0.15, 0.12), (0.12, 0.14), (0.14, 0.10), (0.11, 0.13))}
_NOISE = {'pendulum': (2e-3, 1e-2), 'quadruple_tank': (1e-3, 1e-3, 5e-4, 5e-4)}
_HELD, _BLOCK = 40, 20
# Until then a controller does not know the time between samples, and plans nothing.
_UNTIMED = 2
_MARGIN = 0.3  # half-ranges of the training box by which the law may leave that
_UNIFORM = 0.02  # of a sample, by which intervals of the horizon may differ from one
#: of the range of an input, between the commands of each and those of the law. The lift's drift is
#: not quite the plant's, which the others have; do-mpc counts the cost at the samples alone.
TOLERANCE = {'step': 1e-3, 'sqp': 2e-3, 'do_mpc': 0.03}
INTERVALS = 30


def compare(plant: str, samples: int, compiler: str | None) -> dict[str, Any]:
    """
    Time all sides on one course, block by block in turns, once they are seen to agree.

    :param compiler: command of a C compiler for the others, or None.
    :return: by side its processor times in microseconds; `agreement`, the largest distance of its
        commands from the law's as a share of the input's range.
    :raises ValueError: where the sides do not solve one problem.
    """
    case = CASES[plant]
    controller = _controller(case)
    calls, commanded, requested = _course(case, controller, samples)
    # each twice: what one run remembers would help the next
    problem = _problem(case, controller)
    with tempfile.TemporaryDirectory() as name:
        solver = solver_of(problem, Path(name), compiler)
        sides, again = (_sides(case, controller, Sqp(problem, solver)) for _ in range(2))
    commands = {'step': commanded, **{side: np.array([answer(*call) for call in calls])
                                      for side, answer in sides.items()}}
    apart = {side: float(np.max(np.abs(commands[side] - commands['law'])[_UNTIMED:]
                                / (case.upper - case.lower))) for side in TOLERANCE}
    for side, most in TOLERANCE.items():
        if not apart[side] <= most:
            raise ValueError(f'{plant}: the commands of {side} and of the law differ by '
                             f'{apart[side]:.2g} of the range, at most {most:g} is explained: '
                             'the sides do not solve one problem')
    state = State()
    taken: dict[str, list[int]] = {side: [] for side in ('step', *again)}
    for block in range(0, samples, _BLOCK):
        for side, times in taken.items():
            for k in range(block, min(block + _BLOCK, samples)):
                if side == 'step' and k in requested:
                    state, _ = controller.request_setpoint(state, requested[k])
                start = thread_time_ns()
                if side == 'step':
                    state, _, _ = controller.step(
                        state, calls[k][0], after_a_second(round(k * case.period * NANOSECONDS)))
                else:
                    again[side](*calls[k])
                times.append(thread_time_ns() - start)
    return {'steps': samples, 'states': case.system.n_x, 'compiled': compiler is not None,
            'agreement': apart, **{
                f'{side}_cpu_{label}_us': 1e-3 * float(np.percentile(times[_UNTIMED:], percent))
                for side, times in taken.items()
                for label, percent in (('median', 50), ('p99', 99))}}


def _controller(case: PartialCase) -> Controller:
    """Return a controller that measures every state, its law alone on the shipped lift."""
    model = case.lift
    return Controller(model, case.tuning(
        model, estimator='measured_state', measurement_noise=0.0, disturbance_noise=0.0,
        initial_error=0.0, fallback_order=('mpc',), learned_model_margin=_MARGIN))


def _course(case: PartialCase, controller: Controller, samples: int
            ) -> tuple[list[Call], Array, dict[int, Array]]:
    """Let the controller lead the true plant; return calls, commands, set-points by sample."""
    wanted = SETPOINTS[case.plant]
    requested = {k: np.array(wanted[k // _HELD % len(wanted)]) for k in range(0, samples, _HELD)}
    loop = run_loop(controller, Process(case.system, 0, *case.start), [
        at(k * case.period, SetpointRequest(0, value)) for k, value in requested.items()],
        duration=(samples - 1) * case.period, period=case.period,
        noise=np.array(_NOISE[case.plant]))
    if set(loop.levels) != {'mpc'}:
        raise ValueError(f'{case.plant}: the law does not act at every sample')
    level, model = controller.levels['mpc'], controller.model
    targets = {tuple(value): level.target(value, np.zeros(model.n_x), None)
               for value in requested.values()}
    calls = []
    for y, setpoint in zip(loop.measured, loop.setpoints, strict=True):
        target = targets[tuple(setpoint)]
        assert target is not None
        calls.append((y, target))
    return calls, loop.commands, requested


def _problem(case: PartialCase, controller: Controller) -> SqpProblem:
    """Return the plan of the law, with the plant's own equations."""
    model, law = controller.model, controller.levels['mpc'].law
    assert isinstance(law, RecedingHorizon) and law.planner is not None
    interval = case.period / case.system.seconds_per_time_unit
    lengths = law.planner.grid(case.period).lengths
    if len(lengths) != INTERVALS or not np.ptp(lengths) <= _UNIFORM * interval:
        raise ValueError(f'{case.plant}: the horizon has {len(lengths)} intervals of '
                         f'{lengths.min():g} to {lengths.max():g}, must be {INTERVALS} samples')
    return SqpProblem(EQUATIONS[case.plant], lengths, case.Q, case.R, case.cost_to_go, case.lower,
                      case.upper, (model.states.scale, model.inputs.scale))


def _sides(case: PartialCase, controller: Controller, sqp: Sqp) -> dict[str, Answer]:
    """Return the planners of a state and its target: the law alone, SQP, and do-mpc."""
    # here, because do-mpc is optional
    from studies.partly_measured.dompc import DoMpcPlanner

    model, law = controller.model, controller.levels['mpc'].law
    planner, none = DoMpcPlanner(case), np.zeros(case.directions.shape[1])
    memory: object = None

    def own(y: Array, target: Target) -> Array:
        nonlocal memory
        result = law.compute(Estimate(model.states.to_deviation(y), np.zeros(model.n_x)), target,
                             memory, case.period, None)
        memory = result.memory
        assert result.u is not None
        return result.u

    def other(y: Array, target: Target) -> Array:
        planner.aim(model.states.to_physical(target.x), model.inputs.to_physical(target.u), none)
        return planner.step(y)

    return {'law': own, 'do_mpc': other, 'sqp': lambda y, target: sqp.step(
        y, model.states.to_physical(target.x), model.inputs.to_physical(target.u))}
