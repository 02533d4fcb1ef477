# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The two-state reactor about its saddle, learned under a pre-feedback: figures, closed loops.

Run it as ``python -m studies.unstable`` (needs the `train` and `bench` requirements).
"""

from collections.abc import Iterator
from dataclasses import replace
import sys
import time
from typing import Any

import numpy as np

from koopman_ros.control import Controller, Initialisation, InputLimits, SetpointRequest, Tuning
from koopman_ros.core.arrays import Array
from koopman_ros.core.datasets import DriftSamples
from koopman_ros.core.plots import table
from koopman_ros.core.signals import Outputs
from koopman_ros.evaluation import at, run_loop
from koopman_ros.evaluation.loop import LoopRun
from koopman_ros.evaluation.optimal_cost import cost_along, OptimalTrajectory, optimum, Task
from koopman_ros.execution import Backend, backend_of, Notify
from koopman_ros.learning import compare, fit, IncrementalTraining, NeuralDrift, TrainingFailed
from koopman_ros.learning.lift.multistart import Recipe
from koopman_ros.model import LiftedModel
from koopman_ros.plants import (
    box_episodes,
    describe,
    Process,
    RandomStepDesign,
    steady_state,
    two_state_reactor,
)
from studies.campaign import read_options
from studies.equations import EQUATIONS
from studies.general.systems import SADDLE
from studies.least import least_course

# the range about the saddle, in mol/L and K, holds another steady state with its coolant of 300 K,
# an unstable focus
SYSTEM = two_state_reactor(nominal_state=SADDLE)
DESIGN = RandomStepDesign(
    input_lower=278.15, input_upper=305.15, state_lower=[0.1, 325.0], state_upper=[0.95, 375.0],
    hold_time=(0.02, 0.05), sample_period=0.02, max_redraws=20, rtol=1e-9)
EPISODES, DURATION = 400, 0.1  # in min
# A feedback under which the range has one steady state makes as many free coordinates as states
# enough.
LIFT = IncrementalTraining(2, identity=False, hidden_first=32, decoder=0, max_iterations=1000,
                           pre_feedback=0.05, other_whitenings=(10.0,))
RECIPES: dict[str, Recipe] = {'neural drift': NeuralDrift(16), 'free lift': LIFT}
STARTS = 2
UNLIMITED = InputLimits(np.array([200.0]), np.array([400.0]), np.full(1, np.inf))
# With these the laws are compared, also from where they may lose the plant.
LIMITS = InputLimits(np.array([278.15]), np.array([305.15]), np.ones(1))
FRESH_EPISODES = 200  # that a lift is judged on
LIMITED_SAMPLES, LIMITED_STARTS, MARGIN = 400, 40, 0.3
SADDLE_TEMPERATURE, REACHED = 350.0, 1.0  # K
# From one temperature to another, in K.
STEPS = ((350.0, 345.0), (350.0, 355.0), (340.0, 350.0), (365.0, 350.0))
PERIOD, SAMPLES = 1.0, 240  # of a loop, in s


def samples(seed: int, episodes: int) -> DriftSamples:
    """Simulate episodes from whose ends the coolant can bring the reactor back to the saddle."""
    return box_episodes(SYSTEM, DESIGN, episodes, DURATION, seed, keep_recoverable=True)


def learn(seed: int) -> LiftedModel:
    """Learn the free lift, and units for its drift."""
    return compare(describe(SYSTEM), samples(seed, EPISODES), RECIPES, degrees=(2,),
                   choose='free lift', seed=seed, starts=STARTS, loops=0).model


def cost_ratio(model: LiftedModel, begin: float, end: float) -> float:
    """
    Step the temperature, in K, by the law of a model on the true reactor, sampled each second.

    :return: the integral of (T - T_ref)^2 + (T_c - T_c,ref)^2 over the least a held input can.
    """
    task = _task(begin, end, SAMPLES)
    loop = run(controller(model, ('sdre',), UNLIMITED, 0.1), begin, end, SAMPLES)
    if set(loop.levels) != {'sdre'}:
        return float('inf')
    return cost_along(task, loop.states, loop.commands[:-1]) / optimum(task).cost


def controller(model: LiftedModel, laws: tuple[str, ...], limits: InputLimits = LIMITS,
               margin: float = MARGIN, measured: Outputs | None = None, **others: Any
               ) -> Controller:
    """
    Return a controller of the temperature.

    :param laws: best first.
    :param margin: half-ranges of the training box by which they may leave that.
    :param measured: the outputs; all states when None.
    :param others: of the tuning.
    """
    return Controller(model, Tuning.for_model(
        model, state_weight=np.array([0.0, 1.0]), input_weight=np.ones(1), limits=limits,
        controlled=('temperature',), bumpless_transfer_time=0.0, fallback_order=laws,
        learned_model_margin=margin, linear_model_margin=margin, **others), measured)


def run(one: Controller, begin: float, end: float, samples: int, x0: Array | None = None,
        **others: Any) -> LoopRun:
    """
    Run a controller on the true reactor, sampled each second, to a temperature.

    :param begin: in K; its coolant is on before.
    :param x0: (2,) in mol/L and K; the steady state at `begin` when None.
    :param others: of the simulation.
    """
    rest, before = steady(begin)
    return run_loop(
        one, Process(SYSTEM, 0, rest if x0 is None else x0, before),
        [at(0.0, Initialisation(before)), at(0.0, SetpointRequest(0, steady(end)[0][1:]))],
        period=PERIOD, duration=PERIOD * samples, **others)


def lost(one: Controller, samples: int, noise: Array | None = None) -> list[int]:
    """Return which of the starts about the steady states do not come to the saddle."""
    found = []
    for start, x0 in enumerate(random_starts(LIMITED_STARTS, 0)):
        loop = run(one, float(x0[1]), SADDLE_TEMPERATURE, samples, x0, noise=noise, seed=start)
        if loop.failure or {'hold', 'safe'} & set(loop.levels) or not (
                abs(loop.states[-1, 1] - SADDLE_TEMPERATURE) < REACHED):
            found.append(start)
    return found


def limited(model: LiftedModel, laws: tuple[str, ...]) -> list[str]:
    """
    Return the cost of laws in each step under limits, and the number of starts that they lose.

    The cost is in K^2 min, infinite where the set-point is not reached.
    """
    costs, one = [], controller(model, laws)
    for begin, end in STEPS:
        loop = run(one, begin, end, LIMITED_SAMPLES)
        costs.append(cost_along(_task(begin, end, LIMITED_SAMPLES), loop.states,
                                loop.commands[:-1]) if abs(loop.states[-1, 1] - end) < REACHED
                     else float('inf'))
    return [laws[0], *(f'{cost:.2f}' for cost in costs),
            f'{len(lost(one, LIMITED_SAMPLES))} of {LIMITED_STARTS}']


def least_costs(model: LiftedModel) -> list[str]:
    """Return the least cost of each step under limits, found from the course of the law `mpc`."""
    costs = []
    for begin, end in STEPS:
        loop = run(controller(model, ('mpc', 'sdre')), begin, end, LIMITED_SAMPLES)
        costs.append(least_course(
            _task(begin, end, LIMITED_SAMPLES), EQUATIONS['two_state'], LIMITS.lower,
            LIMITS.upper, step=PERIOD * LIMITS.rate,
            guess=OptimalTrajectory(loop.states, loop.commands[:LIMITED_SAMPLES], 0.0)).cost)
    return ['the least', *(f'{cost:.2f}' for cost in costs), '']


def _task(begin: float, end: float, samples: int) -> Task:
    return Task(SYSTEM, steady(begin)[0], *steady(end), np.array([0.0, 1.0]), np.ones(1),
                PERIOD / SYSTEM.seconds_per_time_unit, samples)


def random_starts(count: int, seed: int) -> Iterator[Array]:
    """Yield states (2,) from 335 to 370 K, up to 0.2 mol/L from the steady concentration."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        kelvin = float(rng.uniform(335.0, 370.0))
        yield np.array([steady(kelvin)[0][0] + rng.uniform(-0.2, 0.2), kelvin])


def steady(temperature: float) -> tuple[Array, Array]:
    """Return the state and the coolant that hold a temperature, in K."""
    return steady_state(SYSTEM, {'temperature': temperature})


def main(args: list[str] | None = None) -> int:
    """Learn from several seeds and print a row for each, judged on fresh samples."""
    options = read_options(
        args, 'studies.unstable', 'Learn the two-state reactor about its saddle under a '
        'pre-feedback.', seeds=10, scheduler='')
    with backend_of(options.scheduler) as backend:
        return _report(options.seeds, backend)


def judged(_: None, seed: int, __: Notify) -> tuple[LiftedModel, list[str]] | str:
    """Learn from a seed; return the lift and its row, or why there is none."""
    begin = time.process_time()
    try:
        model, fresh = learn(seed), samples(1000 + seed, FRESH_EPISODES)
    except TrainingFailed as rejection:
        return f'seed {seed}: {rejection}'
    seconds = time.process_time() - begin
    found, by_rates = (fit(one, fresh.x, fresh.dxdt, fresh.u)
                       for one in (model, replace(model, readout=None)))
    return model, [str(seed), f'{found.rw:.0e}', f'{found.rx:.0e}', f'{found.cond:.1f}',
                   f'{by_rates.rx:.0e}', *(f'{cost_ratio(model, *step):.4f}' for step in STEPS),
                   f'{seconds:.0f}']


def _report(seeds: int, backend: Backend) -> int:
    """Print the tables; return the exit status, 1 where a seed gave no lift."""
    rows, rejected, first = [], False, None
    for _, outcome in backend.run(judged, {f'seed {seed}': seed for seed in range(seeds)}):
        if isinstance(outcome, str):
            print(outcome, file=sys.stderr)
            rejected = True
            continue
        model, row = outcome
        first = first or model
        rows.append(row)
        print(*row, sep='\t', file=sys.stderr, flush=True)
    steps = [f'{begin:.0f} to {end:.0f} K' for begin, end in STEPS]
    head = ['seed', 'rw', 'rx', 'cond', 'rx by the rates of z', *steps, 's']
    print(table(head, rows, range(len(head))))
    if first is not None:
        print(f'\nThe first of them, coolant from {LIMITS.lower[0]:g} to {LIMITS.upper[0]:g} K at '
              f'{LIMITS.rate[0]:g} K/s: cost in K^2 min, and starts that were lost\n')
        head = ['law', *steps, 'lost']
        print(table(head, [least_costs(first), *(
            limited(first, laws) for laws in (('mpc', 'sdre'), ('sdre',)))], range(1, len(head))))
    return int(rejected)


if __name__ == '__main__':
    sys.exit(main())
