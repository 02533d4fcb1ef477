# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Random step inputs that excite a plant without driving it out of a box of states."""

import contextlib
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import ArrayLike

from koopman_ros.core.arrays import Array
from koopman_ros.core.datasets import DriftSamples, Episode
from koopman_ros.plants.recovery import recoverable
from koopman_ros.plants.simulation import (
    integration_limits,
    IntegrationError,
    IntegrationFailure,
    sample_derivatives,
    simulate,
)
from koopman_ros.plants.system import checked_vector, ControlAffineSystem

# Share of the episodes that start in a corner of their box.
_AT_CORNERS = 0.2
# For each episode that is wanted, so many starts are tried.
_MOST_STARTS = 100


class ExcitationError(ValueError):
    """No input level within the bounds keeps the state inside its box."""


@dataclass(frozen=True, eq=False)
class RandomStepDesign:
    """
    Steps of random height and length, and the box of states they may not leave.

    :raises ValueError: when a time is not above 0, or no whole number of sample periods fits
        `hold_time`.
    """

    input_lower: ArrayLike  #: lowest input, a scalar or (n_u,), in input units
    input_upper: ArrayLike  #: highest input; levels are uniform between the two
    state_lower: ArrayLike  #: lower corner of the box, a scalar or (n_x,), in state units
    state_upper: ArrayLike  #: upper corner of the box
    #: how long each level is held, in time units: a number, or a shortest and a longest between
    #: which whole sample periods are equally likely
    hold_time: float | tuple[float, float]
    sample_period: float  #: time between samples, in time units
    max_redraws: int = 100  #: how many other levels are tried for a step that would leave the box
    rtol: float = 1e-10  #: relative tolerance of the simulation, as in `integration_limits`

    def __post_init__(self) -> None:
        if not 0.0 < self.sample_period < math.inf:
            raise ValueError(
                f'sample_period is {self.sample_period}, must be finite and above 0')
        if self.max_redraws < 0:
            raise ValueError(f'max_redraws is {self.max_redraws}, must not be negative')
        shortest, longest = self.hold_samples
        if not 1 <= shortest <= longest:
            raise ValueError(
                f'hold_time is {self.hold_time}, must contain a multiple of sample_period, '
                f'{self.sample_period}: choose such a value, or a wider range')

    @property
    def hold_samples(self) -> tuple[int, int]:
        """The shortest and the longest hold in whole sample periods."""
        shortest, longest = checked_vector('hold_time', self.hold_time, 2)
        # A multiple of the period need not divide to a whole number in floating point.
        return (math.ceil(shortest / self.sample_period - 1e-9),
                math.floor(longest / self.sample_period + 1e-9))


def random_steps(system: ControlAffineSystem, design: RandomStepDesign, duration: float, seed: int,
                 *, x0: ArrayLike | None = None) -> Episode:
    """
    Drive a plant through random steps of its inputs (paper, section on the reactor).

    Each step is simulated before it is taken. If the state would leave the box its level is drawn
    again, its length kept. The last step is cut short. The same seed gives the same bits.

    :param duration: length of the trajectory, in time units: a multiple of the sample period.
    :param x0: initial state (n_x,); the nominal one when None.
    :raises ValueError: when the system has no input or an argument does not fit it.
    :raises ExcitationError: when the trajectory begins outside the box, or no level that was
        tried keeps it inside.
    """
    if system.n_u == 0:
        raise ValueError(f'{system.name} has no input to excite; vary the initial states instead')
    holds = _whole_samples(duration, design.sample_period, system.time_unit)
    levels, box = _bounds(system, design)
    limits = integration_limits(system, design.rtol, *box)
    state = system.nominal_state if x0 is None else system.checked_state('x0', x0)
    if not np.all((state >= box[0]) & (state <= box[1])):
        raise ExcitationError(
            f'{system.name}: at the start {_violation(system, box, state)}; choose x0 inside the '
            'range, or a wider range')

    def safe_step(length: int) -> Episode:
        """Draw levels until one keeps the state in the box; return its step."""
        for _ in range(design.max_redraws + 1):
            level = rng.uniform(*levels)
            try:
                return simulate(
                    system, state, np.tile(level, (length, 1)), design.sample_period,
                    start_time=sample * design.sample_period, limits=limits)
            except IntegrationError as error:
                if error.failure is not IntegrationFailure.OUT_OF_BOUNDS:
                    raise
                out = error
        tried = ', '.join(
            f'{name} in [{lower:.10g}, {upper:.10g}]' + ('' if unit == '1' else f' {unit}')
            for name, unit, lower, upper in zip(
                system.input_names, system.input_units, *levels, strict=True))
        raise ExcitationError(
            f'{system.name}: {_violation(system, box, out.state)} at {out.time:.6g} '
            f'{system.time_unit} for each of {design.max_redraws + 1} random levels of {tried}; '
            'narrow the input bounds, widen the range or shorten hold_time')

    rng = np.random.default_rng(seed)
    states, inputs, sample = [state[None, :]], [], 0
    while sample < holds:
        drawn = int(rng.integers(*design.hold_samples, endpoint=True))
        step = safe_step(min(drawn, holds - sample))
        states.append(step.x[1:])
        inputs.append(step.u)
        state, sample = step.x[-1], sample + len(step.u)
    times = design.sample_period * np.arange(holds + 1, dtype=np.float64)
    return Episode(times, np.concatenate(states), times[:-1], np.concatenate(inputs))


def box_episodes(system: ControlAffineSystem, design: RandomStepDesign, episodes: int,
                 duration: float, seed: int, starts: tuple[Array, Array] | None = None, *,
                 keep_recoverable: bool = False) -> DriftSamples:
    """
    Simulate short episodes of random input steps from random states within a box.

    A fifth of them starts in corners of the box, so that no part of it is left to extrapolation.

    :param duration: of each, in the plant's time unit.
    :param seed: of the initial states and of the steps.
    :param starts: corners of that box, each (n_x,); by default the box that they may not leave.
    :param keep_recoverable: whether only episodes are kept from whose end the input, within the
        bounds of the steps, can bring the plant back; see
        :func:`~koopman_ros.plants.recovery.recoverable`. For unstable plants, which are not to be
        learned where they are lost.
    :raises ExcitationError: when hardly any start can be kept in the box.
    :raises ValueError: as :func:`random_steps` and :func:`~koopman_ros.plants.recoverable`.
    """
    rng = np.random.default_rng(seed)
    lower, upper = (np.broadcast_to(bound, system.n_x) for bound in starts or (
        design.state_lower, design.state_upper))
    found: list[Episode] = []
    tried = 0
    while len(found) < episodes and tried < _MOST_STARTS * episodes:
        batch: list[Episode] = []
        while len(batch) < episodes - len(found) and tried < _MOST_STARTS * episodes:
            tried += 1
            x0, step_seed = rng.uniform(lower, upper), int(rng.integers(2 ** 31))
            if rng.random() < _AT_CORNERS:
                x0 = np.where(rng.random(system.n_x) < 0.5, lower, upper)
            # no input within the bounds keeps some states inside the box
            with contextlib.suppress(ExcitationError):
                batch.append(random_steps(system, design, duration, step_seed, x0=x0))
        if keep_recoverable and batch:
            # from there back, all states on the way there are recoverable as well
            levels, box = _bounds(system, design)
            back = recoverable(system, np.stack([episode.x[-1] for episode in batch]),
                               input_lower=levels[0], input_upper=levels[1],
                               state_lower=box[0], state_upper=box[1])
            batch = [batch[i] for i in np.flatnonzero(back)]
        found += batch
    if len(found) < episodes:
        raise ExcitationError(
            f'{system.name}: from {_MOST_STARTS * episodes} initial states {len(found)} episodes '
            f'stayed in the range for {duration} {system.time_unit}, {episodes} are needed; '
            'shorten the episodes, or widen the input bounds or the range')
    return sample_derivatives(system, found)


def _bounds(system: ControlAffineSystem, design: RandomStepDesign
            ) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Return ranges of the levels and of the states, as far as the model holds there."""
    lower = np.maximum(
        system.checked_bound('state_lower', design.state_lower), system.state_lower)
    upper = np.minimum(
        system.checked_bound('state_upper', design.state_upper), system.state_upper)
    levels = (checked_vector('input_lower', design.input_lower, system.n_u),
              checked_vector('input_upper', design.input_upper, system.n_u))
    for name, low, high in (('state', lower, upper), ('input', *levels)):
        if not np.all(low < high):
            raise ValueError(f'{name}_lower {low} must lie below {name}_upper {high}')
    return levels, (lower, upper)


def _whole_samples(duration: float, sample_period: float, time_unit: str) -> int:
    count = duration / sample_period
    if not (math.isfinite(count) and round(count) >= 1
            and abs(count - round(count)) <= 1e-9 * count):
        raise ValueError(
            f'duration is {duration} {time_unit}, must be a multiple of the sample period of '
            f'{sample_period} {time_unit}')
    return round(count)


def _violation(system: ControlAffineSystem, box: tuple[Array, Array], state: Array
               ) -> str:
    """Name the first state variable that is outside the box, its value and its range."""
    lower, upper = box
    i = int(np.argmax((state < lower) | (state > upper)))
    unit = '' if system.state_units[i] == '1' else f' {system.state_units[i]}'
    return (f'{system.state_names[i]} reached {state[i]:.6g}{unit}, outside the range '
            f'[{lower[i]:.10g}, {upper[i]:.10g}]{unit}')
