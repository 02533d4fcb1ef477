# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The study of robustness: everything that is computed for it, by name."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from koopman_ros.control import Simulation
from validation.robustness import disturbances, narrow, stability
from validation.robustness.loop import REACTOR, reactor_controller, START
from validation.robustness.stability import End, grows, Margins, margins_at

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


def study(tell: Callable[[str], None]) -> Found:
    """Compute everything in some minutes; `tell` takes a line of progress."""
    tell('margins')
    margins = {(weight, bandwidth, kelvin): margins_at(
        reactor_controller(bandwidth=bandwidth, coolant_weight=weight), kelvin)
        for weight, bandwidth, kelvin in product(COOLANT_WEIGHTS, BANDWIDTHS, TEMPERATURES)}
    tell('margins in simulation')
    controller = reactor_controller()
    at = margins_at(controller, START)
    near = {'grows_below': 1.0 - _NEAR, 'grows_above': 1.0 + _NEAR}
    verified = {
        f'gain times {at.gain:.0f}': {name: grows(
            controller, START, factor=share * at.gain, seconds=600.0)
            for name, share in near.items()},
        f'{at.delay:.1f} s of delay': {name: grows(controller, START, delay=share * at.delay)
                                       for name, share in near.items()}}
    tell('disturbances')
    cases = {case.name: disturbances.judge(case) for case in disturbances.cases()}
    tell('noise')
    noise = {bandwidth: disturbances.noise_against_speed(bandwidth)
             for bandwidth in disturbances.BANDWIDTHS}
    tell('region of attraction')
    grids = {fallback: {
        (start, setpoint): stability.end_of(start, setpoint, fallback=fallback)
        for setpoint, start in product(stability.SETPOINTS, stability.STARTS)}
        for fallback in (True, False)}
    two_state_grid = stability.two_state_grid()
    tell('hottest starts')
    boundaries = {coolant: {
        'physics_kelvin': stability.hottest_saved(coolant),
        'ladder_kelvin': stability.hottest_start(coolant, fallback=True),
        'no_ladder_kelvin': stability.hottest_start(coolant, fallback=False)}
        for coolant in stability.COOLANTS}
    tell('back from the safe coolant')
    reactors = {'unchanged': REACTOR, **disturbances.CHANGED}
    returns = {f'{name}/linear_margin={margin:g}': stability.back_from_safe(system, margin)
               for (name, system), margin in product(reactors.items(), narrow.LINEAR_MARGINS)}
    tell('lifts of narrow data')
    reactor, two_state = narrow.reactor_courses(), narrow.two_state_courses()
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
                f'linear_margin={margin:g}/bandwidth={bandwidth:g}':
                narrow.far_from_the_model(margin, bandwidth) for margin, bandwidth in product(
                    narrow.LINEAR_MARGINS, narrow.MARGIN_BANDWIDTHS)},
            'two_state': {'/'.join(key): narrow.judge_two_state(course)
                          for key, course in two_state.items()}}}
    return Found(figures, margins, noise, grids, two_state_grid, boundaries, reactor, two_state)
