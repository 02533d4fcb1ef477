# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The study of robustness: everything that is computed for it, by name."""

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np

from koopman_ros.control import Simulation
from validation.paper.datasets import Metrics
from validation.robustness import attraction, disturbances, narrow
from validation.robustness.attraction import End
from validation.robustness.loop import (
    REACTOR,
    reactor_controller,
    shipped_model,
    START,
)
from validation.robustness.margins import grows, Margins, margins_at

BANDWIDTHS = (0.0, 2.0, 4.0, 6.0, 10.0)  # 1/min
COOLANT_WEIGHTS = (1.0, 0.1)  # 1/K^2
TEMPERATURES = tuple(np.linspace(305.5, 326.5, 8))  # K
_NEAR = 0.03  # share of a margin by which it is missed and passed in simulation


@dataclass
class Found:
    """What the study found."""

    #: by (coolant weight, bandwidth in 1/min, set-point in K)
    margins: dict[tuple[float, float, float], Margins] = field(default_factory=dict)
    #: those of the loop on the lift itself, likewise
    model_margins: dict[tuple[float, float, float], Margins] = field(default_factory=dict)
    #: whether the loop at 3 % below and above a margin grows, by what was raised
    verified: dict[str, tuple[bool, bool]] = field(default_factory=dict)
    cases: dict[str, Metrics] = field(default_factory=dict)  #: figures by name of the case
    noise: dict[float, Metrics] = field(default_factory=dict)  #: figures by bandwidth in 1/min
    #: ends by start and set-point in K, with and without fallback
    grids: dict[bool, dict[tuple[float, float], End]] = field(default_factory=dict)
    #: ends by temperature in K and concentration in mol/L
    two_state_grid: dict[tuple[float, float], End] = field(default_factory=dict)
    #: hottest starts by the applied coolant at the start, in K
    boundaries: dict[float, Metrics] = field(default_factory=dict)
    #: figures of the way back from the safe coolant, by plant and `linear_margin`
    returns: dict[tuple[str, float], Metrics] = field(default_factory=dict)
    #: courses of the lift of narrow data
    reactor: dict[tuple[str, str], Simulation] = field(default_factory=dict)
    #: figures after UA -40 % by `linear_margin` and bandwidth in 1/min
    far: dict[tuple[float, float], Metrics] = field(default_factory=dict)
    #: those of the two-state example
    two_state: dict[tuple[str, str], Simulation] = field(default_factory=dict)

    def summary(self) -> dict[str, Any]:
        """Return the figures by name; those that are infinite have none in JSON."""
        return {
            'margins': {
                f'coolant_weight={weight:g}/bandwidth={bandwidth:g}/{kelvin:g}K': {
                    'gain': m.gain, 'phase_degrees': m.phase,
                    'delay_seconds': m.delay, 'distance': m.distance}
                for (weight, bandwidth, kelvin), m in self.margins.items()},
            'verified': {name: {'grows_below': below, 'grows_above': above}
                         for name, (below, above) in self.verified.items()},
            'disturbances': self.cases,
            'noise': {f'bandwidth={bandwidth:g}': m for bandwidth, m in self.noise.items()},
            'attraction': {
                'hottest_cooled_kelvin': attraction.hottest_cooled(),
                'hottest_start': {f'coolant={u:g}K': m for u, m in self.boundaries.items()},
                **{f'ladder={fallback}': {f'{start:g}K to {end:g}K': found.value
                                        for (start, end), found in grid.items()}
                   for fallback, grid in self.grids.items()},
                'from_the_safe_coolant': {f'{name}/linear_margin={margin:g}': m
                                          for (name, margin), m in self.returns.items()},
                'two_state': {f'{kelvin:g}K, {c:.3g}mol/L': found.value
                              for (kelvin, c), found in self.two_state_grid.items()}},
            'narrow': {
                'reactor': {f'{name}/{kind}': narrow.judge_reactor(course)
                            for (name, kind), course in self.reactor.items()},
                'heat_transfer_-40%': {
                    f'linear_margin={margin:g}/bandwidth={bandwidth:g}': m
                    for (margin, bandwidth), m in self.far.items()},
                'two_state': {f'{name}/{kind}': narrow.judge_two_state(course)
                              for (name, kind), course in self.two_state.items()}}}


def study(tell: Callable[[str], None]) -> Found:
    """
    Compute everything; some minutes.

    :param tell: takes a line of progress.
    """
    found = Found()
    tell('margins')
    for weight in COOLANT_WEIGHTS:
        for bandwidth in BANDWIDTHS:
            controller = reactor_controller(bandwidth=bandwidth, coolant_weight=weight)
            for kelvin in TEMPERATURES:
                key = (weight, bandwidth, float(kelvin))
                found.margins[key] = margins_at(controller, float(kelvin))
                found.model_margins[key] = margins_at(controller, float(kelvin), of_model=True)
    tell('margins in simulation')
    controller = reactor_controller()
    at = margins_at(controller, START)
    below, above = 1.0 - _NEAR, 1.0 + _NEAR
    found.verified = {
        f'gain times {at.gain:.0f}': (
            grows(controller, START, factor=below * at.gain, seconds=600.0),
            grows(controller, START, factor=above * at.gain, seconds=600.0)),
        f'{at.delay:.1f} s of delay': (grows(controller, START, delay=below * at.delay),
                                       grows(controller, START, delay=above * at.delay))}
    for case in disturbances.cases():
        tell(case.name)
        found.cases[case.name] = disturbances.judge(case)
    for bandwidth in disturbances.BANDWIDTHS:
        tell(f'noise, observer at {bandwidth:g} 1/min')
        found.noise[bandwidth] = disturbances.noise_against_speed(bandwidth)
    for fallback in (True, False):
        tell(f'region of attraction, {"with" if fallback else "without"} fallback')
        found.grids[fallback] = attraction.grid(fallback=fallback)
    for coolant in attraction.COOLANTS:
        tell(f'hottest start with the coolant at {coolant:g} K')
        found.boundaries[coolant] = attraction.boundary(coolant)
    tell('region of attraction, two-state reactor')
    found.two_state_grid = attraction.two_state_grid()
    tell('back from the safe coolant')
    for (name, system), margin in product(
            {'unchanged': REACTOR, **disturbances.CHANGED}.items(), narrow.LINEAR_MARGINS):
        found.returns[name, margin] = attraction.back_from_safe(system, margin)
    tell('lifts of narrow data')
    found.reactor = narrow.reactor_courses(narrow.narrow_lift())
    for margin, bandwidth in product(narrow.LINEAR_MARGINS, narrow.MARGIN_BANDWIDTHS):
        found.far[margin, bandwidth] = narrow.far_from_the_model(margin, bandwidth)
    found.two_state = narrow.two_state_courses(narrow.two_state_models())
    return found


def trained_range() -> tuple[float, float]:
    """Return the range of the shipped lift, in K."""
    states = shipped_model().states
    return float(states.lower[0]), float(states.upper[0])
