# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The two-state reactor held at its saddle from its temperature alone, and the cost.

Run it as ``python -m studies.saddle`` (needs the `train` and `mpc` requirements).
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
import itertools
import sys
import time
from typing import Any

import numpy as np

from koopman_ros.control import Controller, Initialisation, InputLimits, SetpointRequest
from koopman_ros.core.arrays import Array
from koopman_ros.core.plots import table
from koopman_ros.core.signals import Outputs
from koopman_ros.evaluation import at, run_loop
from koopman_ros.execution import Backend, backend_of
from koopman_ros.model import LiftedModel
from koopman_ros.plants import ControlAffineSystem, Process, steady_state, two_state_reactor
from koopman_ros.plants.library.reactor import ReactorParameters
from studies import unstable
from studies.campaign import over, read_options
from studies.general.systems import SADDLE
from studies.robustness.loop import on_plant
from studies.true_model import TrueModel
from studies.unstable import LIMITS, lost, REACHED, steady, SYSTEM

TEMPERATURE = Outputs(('temperature',), ('K',), np.array([[0.0, 1.0]]))
NOISE = 0.1  # K
WANDER = 0.1  # K of coolant in a second
FIRST_GUESS = np.array([0.2, 2.0])  # mol/L and K
# With the coolant from 278 to 305 K a fouled jacket that cools too well cannot be made up for.
WIDE = InputLimits(np.array([253.15]), np.array([373.15]), np.ones(1))
LAWS = {'mpc': ('mpc', 'sdre'), 'sdre': ('sdre',)}
PERIODS = (1.0, 5.0, 15.0, 30.0)  # s
# Set-points in K by the time in s from which they hold; then the jacket fouls.
COURSE, FOULED, END = {0.0: 350.0, 60.0: 355.0, 500.0: 345.0}, 1000.0, 1600.0
UA = ReactorParameters().heat_transfer_coefficient
FOULING = {'heat_transfer_coefficient': 0.85 * UA}
ARRIVAL = 600  # s


@dataclass(frozen=True)
class RunFigures:
    """Cost and errors of a run."""

    #: integrals of (T - T_ref)^2 + (T_c - T_c,ref)^2 in K^2 min: until the jacket fouls, and after
    costs: tuple[float, float]
    #: largest mean distances of the temperature from a set-point in the end, in K, likewise
    offsets: tuple[float, float]
    concentration: float  #: root mean square error of its estimate until then, in mol/L

    @property
    def lost(self) -> tuple[bool, bool]:
        """Whether a set-point was not reached, until the jacket fouls and after."""
        return self.offsets[0] > REACHED, self.offsets[1] > REACHED


def truth() -> TrueModel:
    """Return the reactor's own equations in the range of the lifts."""
    return TrueModel.of(SYSTEM, np.array([0.1, 325.0]), np.array([0.95, 375.0]),
                        LIMITS.lower, LIMITS.upper)


def controller(model: LiftedModel, laws: tuple[str, ...], limits: InputLimits = LIMITS, *,
               informed: bool = False, plugins: Mapping[str, Any] | None = None) -> Controller:
    """
    Return a controller of the temperature.

    :param laws: best first.
    :param informed: whether it measures the concentration, too.
    :param plugins: parameters of the laws by name, where not the default ones.
    """
    return unstable.controller(
        model, laws, limits, measured=None if informed else TEMPERATURE,
        estimator='extended_kalman_filter',
        measurement_noise=np.array([1e-4, NOISE])[0 if informed else 1:],
        disturbance_noise=np.full(1, WANDER * np.sqrt(60.0)), initial_error=FIRST_GUESS,
        plugins=plugins or {})


def reactor(constants: dict[str, float]) -> ControlAffineSystem:
    """Return the reactor with other constants."""
    return two_state_reactor(ReactorParameters(**constants), nominal_state=SADDLE)


def cost(T: Array, u: Array, value: float, system: ControlAffineSystem, period: float) -> float:
    """Return the integral of (T - T_ref)^2 + (T_c - T_c,ref)^2 in K^2 min, sampled by s."""
    u_ref = steady_state(system, {'temperature': value})[1][0]
    return float(np.sum((T - value) ** 2 + (u - u_ref) ** 2)) * period / 60.0


def run(one: Controller, seed: int, period: float = 1.0) -> RunFigures:
    """Take the temperature along its course, and let the jacket foul."""
    x0, u0 = steady(COURSE[0.0])
    fouled = reactor(FOULING)
    loop = run_loop(one, Process(SYSTEM, 0, x0, u0), [
        at(0.0, Initialisation(u0)), at(FOULED, on_plant(system=fouled)),
        *(at(when, SetpointRequest(0, np.array([value]))) for when, value in COURSE.items())],
        duration=END, period=period, noise=_noise(one.measured.all_states), seed=seed)
    T, t, u = loop.states[:, 1], loop.times, loop.commands[:, 0]
    costs, offsets = [0.0, 0.0], [0.0, 0.0]
    for begin, end in itertools.pairwise([*COURSE, FOULED, END]):
        part, after = (t >= begin) & (t < end), begin == FOULED
        value = COURSE.get(begin, COURSE[max(COURSE)])
        costs[after] += cost(T[part], u[part], value, fouled if after else SYSTEM, period)
        if begin:
            # what is left after two thirds of the time
            late = part & (t >= end - (end - begin) / 3.0)
            left = abs(float(np.mean(T[late])) - value) if late.any() else np.inf
            offsets[after] = max(offsets[after], left)
    known = np.array([np.nan if report.estimate is None else report.estimate.state[0]
                      for report in loop.reports])
    error = (known - loop.states[:, 0])[(t > 60.0) & (t < FOULED)]
    return RunFigures((costs[0], costs[1]), (offsets[0], offsets[1]),
                      float(np.sqrt(np.mean(error ** 2))))


def _noise(informed: bool) -> Array:
    return np.array([0.0, NOISE])[0 if informed else 1:]


def course_rows(models: list[LiftedModel], periods: Iterable[float] = PERIODS,
                backend: Backend | None = None) -> list[list[str]]:
    """Return a row for each law and time between samples, over all models."""
    periods = tuple(periods)

    def three(key: tuple[str, float, int]) -> list[RunFigures]:
        name, period, seed = key
        return [run(controller(model, LAWS[name], informed=informed), seed, period)
                for model, informed in ((models[seed], False), (truth(), False), (truth(), True))]

    found_by = over(backend, three, itertools.product(LAWS, periods, range(len(models))))
    rows = []
    for name in LAWS:
        for period in periods:
            runs = [found_by[name, period, seed] for seed in range(len(models))]
            own = [found[0] for found in runs]
            over_true, over_full = ([found[0].costs[0] / found[k].costs[0] for found in runs]
                                    for k in (1, 2))
            fouled = [found[0].costs[1] / found[1].costs[1] for found in runs
                      if not (found[0].lost[1] or found[1].lost[1])]
            rows.append([
                name, f'{period:g}', f'{np.mean(over_true):.4f}', f'{np.max(over_true):.4f}',
                f'{np.mean(over_full):.4f}', f'{np.max(over_full):.4f}',
                f'{max(found.offsets[0] for found in own):.3f}',
                f'{max(found.concentration for found in own):.4f}',
                f'{sum(found.lost[0] for found in own)} of {len(own)}',
                f'{np.mean(fouled):.4f}' if fouled else '',
                *(f'{sum(found[k].lost[1] for found in runs)} of {len(runs)}' for k in (0, 2))])
            print(*rows[-1], sep='\t', file=sys.stderr, flush=True)
    return rows


def main(args: list[str] | None = None) -> int:
    """Learn from several seeds and print the tables."""
    options = read_options(
        args, 'studies.saddle', 'Hold the two-state reactor at its saddle from its temperature '
        'alone.', seeds=10, scheduler='')
    with backend_of(options.scheduler) as backend:
        _report(options.seeds, backend)
    return 0


def _report(seeds: int, backend: Backend) -> None:
    begin = time.monotonic()
    models = list(over(backend, unstable.learn, range(seeds)).values())
    print(f'learned {seeds} lifts, {time.monotonic() - begin:.0f} s', file=sys.stderr, flush=True)
    head = ['law', 'sample [s]', 'cost / true model', 'worst', 'cost / full information', 'worst',
            'offset [K]', 'error of C_A [mol/L]', 'lost', 'fouling: cost / true model', 'lost',
            'lost with full information']
    print(f'{seeds} lifts, 0.1 K of noise, 350 -> 355 -> 345 K, then UA -15 %; coolant '
          f'from {LIMITS.lower[0]:g} to {LIMITS.upper[0]:g} K at 1 K/s\n')
    print(table(head, course_rows(models, backend=backend), range(1, len(head))))
    print(f'\nOf {unstable.LIMITED_STARTS} starts from 335 to 370 K, C_A up to 0.2 mol/L from '
          'steady, do not come to 350 K (coolant from 253 to 373 K):\n')

    def losses(law: str) -> list[int]:
        return [len(lost(controller(model, LAWS[law], WIDE, informed=informed), ARRIVAL,
                         _noise(informed)))
                for model, informed in ((models[0], False), (truth(), True))]

    rows = [[name, *found] for name, found in over(backend, losses, LAWS).items()]
    print(table(['law', 'from T alone', 'true model, full information'], rows, (1, 2)))


if __name__ == '__main__':
    sys.exit(main())
