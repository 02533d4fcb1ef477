# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The study of robustness: all computations, by name."""

from collections.abc import Callable, Iterable
from itertools import product
import sys
from typing import Any, TypeAlias

import numpy as np

from koopman_ros.evaluation import LoopRun
from koopman_ros.execution import Backend
from studies.campaign import over
from studies.robustness import disturbances, narrow, stability
from studies.robustness.loop import REACTOR, reactor_controller
from studies.robustness.stability import margins_at

BANDWIDTHS = (0.0, 2.0, 4.0, 6.0, 10.0)  # 1/min
COOLANT_WEIGHTS = (1.0, 0.1)  # 1/K^2
Courses: TypeAlias = dict[tuple[str, str], LoopRun]  # by trial and kind of lift
TEMPERATURES = tuple(map(float, np.linspace(305.5, 326.5, 8)))  # K


def margin_name(coolant_weight: float, bandwidth: float, kelvin: float) -> str:
    """Return the name of the margins at a set-point in the figures."""
    return f'coolant_weight={coolant_weight:g}/bandwidth={bandwidth:g}/{kelvin:g}K'


def study(backend: Backend | None = None) -> tuple[dict[str, Any], Courses]:
    """Compute everything in some minutes; return all figures, and courses of the narrow lift."""
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
    return {
        'margins': {margin_name(*key): found._asdict() for key, found in margins.items()},
        'disturbances': disturbed,
        'wrong_dead_time': {
            f'known {known:g} s, {share:g} times as long, {name}': found
            for (known, share, name), found in late.items()},
        'noise': {f'bandwidth={bandwidth:g}': m for bandwidth, m in noise.items()},
        'attraction': {
            'hottest_cooled_kelvin': stability.hottest_cooled(),
            'hottest_start': {f'coolant={u:g}K': m for u, m in boundaries.items()},
            **{f'fallback={fallback}': {
                f'{start:g}K to {goal:g}K': end.value
                for (other, goal, start), end in ends.items() if other is fallback}
               for fallback in (True, False)},
            'from_the_safe_coolant': {f'{name}/linear_model_margin={margin:g}': found
                                      for (name, margin), found in back.items()},
            'two_state': {f'{kelvin:g}K, {c:.3g}mol/L': end.value
                          for (kelvin, c), end in two_state_grid.items()}},
        'narrow': {
            'reactor': {'/'.join(key): narrow.judge_reactor(course)
                        for key, course in courses.items()},
            'heat_transfer_-40%': {
                f'linear_model_margin={margin:g}/bandwidth={bandwidth:g}': judged
                for (margin, bandwidth), judged in far.items()}}}, courses
