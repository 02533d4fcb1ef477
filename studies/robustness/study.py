# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The study of robustness: all computations, by name."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import product
import sys
from typing import Any

import numpy as np

from koopman_ros.evaluation import Simulation
from koopman_ros.execution import Backend
from studies.campaign import over
from studies.robustness import disturbances, narrow, stability
from studies.robustness.loop import REACTOR, reactor_controller
from studies.robustness.stability import End, Margins, margins_at

BANDWIDTHS = (0.0, 2.0, 4.0, 6.0, 10.0)  # 1/min
COOLANT_WEIGHTS = (1.0, 0.1)  # 1/K^2
TEMPERATURES = tuple(map(float, np.linspace(305.5, 326.5, 8)))  # K


@dataclass(frozen=True)
class Found:
    """The results of the study."""

    figures: dict[str, Any]  #: all by name; infinite ones become null in JSON
    #: by (coolant weight, bandwidth in 1/min, set-point in K)
    margins: dict[tuple[float, float, float], Margins]
    noise: dict[float, dict[str, Any]]  #: figures by bandwidth in 1/min
    #: ends by start and set-point in K, with and without fallback
    grids: dict[bool, dict[tuple[float, float], End]]
    #: ends by temperature in K and concentration in mol/L
    two_state_grid: dict[tuple[float, float], End]
    #: hottest starts by the applied coolant at the start, in K
    boundaries: dict[float, dict[str, Any]]
    reactor: dict[tuple[str, str], Simulation]  #: courses of the lift of narrow data


def study(backend: Backend | None = None) -> Found:
    """Compute everything in some minutes."""
    def spread(line: str, function: Callable[..., Any], keys: Iterable[Any]) -> dict[Any, Any]:
        print(line, file=sys.stderr, flush=True)
        return over(backend, function, keys)

    margins = spread('margins', lambda key: margins_at(
        reactor_controller(coolant_weight=key[0], bandwidth=key[1]), key[2]),
        product(COOLANT_WEIGHTS, BANDWIDTHS, TEMPERATURES))
    cases = {case.name: case for case in disturbances.cases()}
    disturbed = spread('disturbances', lambda name: disturbances.judge(cases[name]), cases)
    plants = {'unchanged': REACTOR, **disturbances.CHANGED}
    late = spread('wrong dead times', lambda key: disturbances.late(
        key[0], key[1], plants[key[2]]), product(
            disturbances.DEAD_TIMES, disturbances.SHARES, ('unchanged', 'UA −20 %')))
    noise = spread('noise', disturbances.noise_against_speed, disturbances.BANDWIDTHS)
    ends = spread('region of attraction', lambda key: stability.end_of(
        key[2], key[1], fallback=key[0]),
        product((True, False), stability.SETPOINTS, stability.STARTS))
    grids = {fallback: {
        (start, setpoint): ends[fallback, setpoint, start]
        for setpoint, start in product(stability.SETPOINTS, stability.STARTS)}
        for fallback in (True, False)}
    two_state_grid = spread('region of attraction of the two-state reactor',
                            stability.two_state_end, stability.two_state_starts())
    boundaries = spread('hottest starts', lambda coolant: {
        'physics_kelvin': stability.hottest_saved(coolant),
        'fallback_kelvin': stability.hottest_start(coolant, fallback=True),
        'no_fallback_kelvin': stability.hottest_start(coolant, fallback=False)},
        stability.COOLANTS)
    back = spread('back from the safe coolant', lambda key: stability.back_from_safe(
        plants[key[0]], key[1]), product(plants, narrow.LINEAR_MARGINS))
    print('a lift of narrow data', file=sys.stderr, flush=True)
    courses = narrow.reactor_courses()
    far = spread('far from the model', lambda key: narrow.far_from_the_model(*key),
                 product(narrow.LINEAR_MARGINS, narrow.MARGIN_BANDWIDTHS))
    figures = {
        'margins': {
            f'coolant_weight={weight:g}/bandwidth={bandwidth:g}/{kelvin:g}K': {
                'gain': m.gain, 'phase_degrees': m.phase, 'delay_seconds': m.delay}
            for (weight, bandwidth, kelvin), m in margins.items()},
        'disturbances': disturbed,
        'wrong_dead_time': {
            f'known {known:g} s, {share:g} times as long, {name}': found
            for (known, share, name), found in late.items()},
        'noise': {f'bandwidth={bandwidth:g}': m for bandwidth, m in noise.items()},
        'attraction': {
            'hottest_cooled_kelvin': stability.hottest_cooled(),
            'hottest_start': {f'coolant={u:g}K': m for u, m in boundaries.items()},
            **{f'fallback={fallback}': {f'{start:g}K to {goal:g}K': end.value
                                        for (start, goal), end in grid.items()}
               for fallback, grid in grids.items()},
            'from_the_safe_coolant': {f'{name}/linear_model_margin={margin:g}': found
                                      for (name, margin), found in back.items()},
            'two_state': {f'{kelvin:g}K, {c:.3g}mol/L': end.value
                          for (kelvin, c), end in two_state_grid.items()}},
        'narrow': {
            'reactor': {'/'.join(key): narrow.judge_reactor(course)
                        for key, course in courses.items()},
            'heat_transfer_-40%': {
                f'linear_model_margin={margin:g}/bandwidth={bandwidth:g}': judged
                for (margin, bandwidth), judged in far.items()}}}
    return Found(figures, margins, noise, grids, two_state_grid, boundaries, courses)
