# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The study of robustness: everything that is computed for it, by name."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import product
from typing import Any, TypeVar

import numpy as np

from koopman_ros.control import Simulation
from koopman_ros.execution import Backend
from koopman_ros.plants import ControlAffineSystem
from validation.options import over
from validation.paper.datasets import Metrics
from validation.robustness import disturbances, narrow, stability
from validation.robustness.loop import REACTOR, reactor_controller, START
from validation.robustness.stability import End, grows, Margins, margins_at

Key = TypeVar('Key')
Result = TypeVar('Result')

BANDWIDTHS = (0.0, 2.0, 4.0, 6.0, 10.0)  # 1/min
COOLANT_WEIGHTS = (1.0, 0.1)  # 1/K^2
TEMPERATURES = tuple(map(float, np.linspace(305.5, 326.5, 8)))  # K
_NEAR = 0.03  # share of a margin by which it is missed and passed in simulation


@dataclass(frozen=True)
class Found:
    """What the study found."""

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
    two_state: dict[tuple[str, str], Simulation]  #: courses of the two-state example


def study(tell: Callable[[str], None], backend: Backend | None = None) -> Found:
    """Compute everything in some minutes; `tell` takes a line of progress."""
    def spread(function: Callable[[Key], Result], keys: Iterable[Key], line: str
               ) -> dict[Key, Result]:
        tell(line)
        return over(backend, function, keys)

    margins = spread(_margins, product(COOLANT_WEIGHTS, BANDWIDTHS, TEMPERATURES), 'margins')
    at = margins_at(reactor_controller(), START)
    near = {'grows_below': 1.0 - _NEAR, 'grows_above': 1.0 + _NEAR}
    grown = spread(_grows, [(share * factor, share * delay) for factor, delay in (
        (at.gain, 0.0), (0.0, at.delay)) for share in near.values()], 'margins in simulation')
    verified = {
        f'gain times {at.gain:.0f}': {
            name: grown[share * at.gain, 0.0] for name, share in near.items()},
        f'{at.delay:.1f} s of delay': {
            name: grown[0.0, share * at.delay] for name, share in near.items()}}
    cases = spread(_disturbed, [case.name for case in disturbances.cases()], 'disturbances')
    noise = spread(disturbances.noise_against_speed, disturbances.BANDWIDTHS, 'noise')
    ends = spread(_end, product((True, False), stability.SETPOINTS, stability.STARTS),
                  'region of attraction')
    grids = {fallback: {
        (start, setpoint): ends[fallback, setpoint, start]
        for setpoint, start in product(stability.SETPOINTS, stability.STARTS)}
        for fallback in (True, False)}
    two_state_grid = spread(stability.two_state_end, stability.two_state_starts(),
                            'region of attraction of the two-state reactor')
    boundaries = spread(_boundary, stability.COOLANTS, 'hottest starts')
    found_back = spread(_back, product(_reactors(), narrow.LINEAR_MARGINS),
                        'back from the safe coolant')
    returns = {f'{name}/linear_margin={margin:g}': found
               for (name, margin), found in found_back.items()}
    courses = spread(_narrow, ('reactor', 'two_state'), 'lifts of narrow data')
    reactor, two_state = courses['reactor'], courses['two_state']
    far = spread(_far, product(narrow.LINEAR_MARGINS, narrow.MARGIN_BANDWIDTHS),
                 'far from the model')
    figures = {
        'margins': {
            f'coolant_weight={weight:g}/bandwidth={bandwidth:g}/{kelvin:g}K': {
                'gain': m.gain, 'phase_degrees': m.phase,
                'delay_seconds': m.delay, 'distance': m.distance}
            for (weight, bandwidth, kelvin), m in margins.items()},
        'verified': verified, 'disturbances': cases,
        'noise': {f'bandwidth={bandwidth:g}': m for bandwidth, m in noise.items()},
        'attraction': {
            'hottest_cooled_kelvin': stability.hottest_cooled(),
            'hottest_start': {f'coolant={u:g}K': m for u, m in boundaries.items()},
            **{f'ladder={fallback}': {f'{start:g}K to {goal:g}K': end.value
                                      for (start, goal), end in grid.items()}
               for fallback, grid in grids.items()},
            'from_the_safe_coolant': returns,
            'two_state': {f'{kelvin:g}K, {c:.3g}mol/L': end.value
                          for (kelvin, c), end in two_state_grid.items()}},
        'narrow': {
            'reactor': {'/'.join(key): narrow.judge_reactor(course)
                        for key, course in reactor.items()},
            'heat_transfer_-40%': {
                f'linear_margin={margin:g}/bandwidth={bandwidth:g}': judged
                for (margin, bandwidth), judged in far.items()},
            'two_state': {'/'.join(key): narrow.judge_two_state(course)
                          for key, course in two_state.items()}}}
    return Found(figures, margins, noise, grids, two_state_grid, boundaries, reactor, two_state)


def _margins(key: tuple[float, float, float]) -> Margins:
    weight, bandwidth, kelvin = key
    return margins_at(reactor_controller(bandwidth=bandwidth, coolant_weight=weight), kelvin)


def _grows(key: tuple[float, float]) -> bool:
    """Simulate a gain times so much, or so many s of delay."""
    factor, delay = key
    return grows(reactor_controller(), START, **(
        {'delay': delay} if delay else {'factor': factor, 'seconds': 600.0}))


def _disturbed(name: str) -> Metrics:
    return disturbances.judge(next(
        case for case in disturbances.cases() if case.name == name))


def _end(key: tuple[bool, float, float]) -> End:
    fallback, setpoint, start = key
    return stability.end_of(start, setpoint, fallback=fallback)


def _boundary(coolant: float) -> dict[str, float]:
    return {'physics_kelvin': stability.hottest_saved(coolant),
            'ladder_kelvin': stability.hottest_start(coolant, fallback=True),
            'no_ladder_kelvin': stability.hottest_start(coolant, fallback=False)}


def _reactors() -> dict[str, ControlAffineSystem]:
    return {'unchanged': REACTOR, **disturbances.CHANGED}


def _back(key: tuple[str, float]) -> Metrics:
    name, margin = key
    return stability.back_from_safe(_reactors()[name], margin)


def _narrow(name: str) -> dict[tuple[str, str], Simulation]:
    return {'reactor': narrow.reactor_courses, 'two_state': narrow.two_state_courses}[name]()


def _far(key: tuple[float, float]) -> Metrics:
    return narrow.far_from_the_model(*key)
