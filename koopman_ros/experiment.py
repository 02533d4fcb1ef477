# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The identification experiment: random steps of the input on a running plant, with a way back."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property

import numpy as np

from koopman_ros.arrays import Array
from koopman_ros.reasons import Code, Reason, reason
from koopman_ros.units import LATE_NANOSECONDS, NANOSECONDS

_FOLLOWS_WITHIN = 0.01  # in the input's unit
_COMES_NEARER = 1e-4  # likewise, less than any rate limit allows


class Phase(Enum):
    """What an experiment is doing; the value is the word an operator reads."""

    RUNNING = 'running'
    FINISHED = 'finished'
    ENDED = 'ended'
    ABORTED = 'aborted'


@dataclass(frozen=True)
class Experiment:
    """Steps of random height and length (paper, section on the reactor), and what ends them."""

    duration: float  #: s
    input_lower: float  #: lowest level, in the input's unit; levels are uniform between the two
    input_upper: float  #: highest level
    hold_shortest: float  #: shortest time of a level, in s; times are uniform between the two
    hold_longest: float  #: longest time of a level, in s
    rate: float  #: largest change of the input, per s
    state_lower: float  #: smallest state that may be measured, in its unit
    state_upper: float  #: largest state
    safe_input: float  #: input that is safe whatever happened
    seed: int  #: of numpy's default generator; the same seed gives the same steps
    state: str = 'state'  #: name of the measured state

    def __post_init__(self) -> None:
        for low, high in (('input_lower', 'input_upper'), ('state_lower', 'state_upper')):
            if not getattr(self, low) < getattr(self, high):
                raise ValueError(f'{low} = {getattr(self, low)} must be below {high} = '
                                 f'{getattr(self, high)}')
        if not 0.0 < self.hold_shortest <= self.hold_longest:
            raise ValueError(f'hold_shortest = {self.hold_shortest} s must be above 0 and not '
                             f'above hold_longest = {self.hold_longest} s')
        for name in ('duration', 'rate'):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(f'{name} = {getattr(self, name)} must be finite and above 0')

    @cached_property
    def steps(self) -> tuple[Array, Array]:
        """When each step ends (S,), in s after the start, and its level (S,)."""
        rng = np.random.default_rng(self.seed)
        count = int(self.duration / self.hold_shortest) + 1
        ends = np.cumsum(rng.uniform(self.hold_shortest, self.hold_longest, count))
        levels = rng.uniform(self.input_lower, self.input_upper, count)
        used = int(np.searchsorted(ends, self.duration)) + 1
        return ends[:used], levels[:used]

    def refusal(self, measured: float) -> Reason | None:
        """Return why the experiment must not go on with a measurement, or None."""
        if not np.isfinite(measured):
            return reason(Code.NOT_FINITE, signal=self.state, value=measured)
        return None if self.state_lower <= measured <= self.state_upper else reason(
            Code.EXPERIMENT_BOUNDS, signal=self.state, value=measured,
            lower=self.state_lower, upper=self.state_upper)


@dataclass(frozen=True)
class Progress:
    """How far an experiment is; it goes on commanding the safe input when it is over."""

    start_ns: int  #: stamp of the measurement it started with
    time_ns: int  #: stamp of the last measurement
    command: float  #: last input
    interval: float = np.inf  #: usual seconds between measurements; infinity before the second
    phase: Phase = Phase.RUNNING
    reason: Reason | None = None  #: why it was aborted

    @property
    def elapsed(self) -> float:
        """Seconds since the start."""
        return (self.time_ns - self.start_ns) / NANOSECONDS


def begin(experiment: Experiment, time_ns: int) -> Progress:
    """Start with the safe input, at the stamp of the first measurement."""
    return Progress(time_ns, time_ns, experiment.safe_input)


def end(progress: Progress, phase: Phase, why: Reason | None = None) -> Progress:
    """End the steps, unless they are over; the input then goes back to the safe one."""
    if progress.phase is not Phase.RUNNING:
        return progress
    return replace(progress, phase=phase, reason=why)


def advance(experiment: Experiment, progress: Progress, measured: float | None, time_ns: int
            ) -> Progress:
    """
    Answer a measurement of the state, or the passing of time without one.

    As in the control step, a stamp that is not later moves nothing, and the rate limit counts a
    gap in the measurements as twice the interval before it.
    """
    ahead = time_ns - progress.time_ns
    if measured is not None and (why := experiment.refusal(measured)):
        progress = end(progress, Phase.ABORTED, why)
    if ahead < -LATE_NANOSECONDS:
        progress = end(progress, Phase.ABORTED, reason(Code.CLOCK_WENT_BACK))
        return replace(progress, time_ns=time_ns)
    if ahead <= 0:
        return progress
    seconds = min(ahead / NANOSECONDS, 2.0 * progress.interval)
    usual = 0.0 if np.isinf(progress.interval) else 0.5 * progress.interval
    progress = replace(progress, time_ns=time_ns, interval=max(seconds, usual))
    if progress.elapsed >= experiment.duration:
        progress = end(progress, Phase.FINISHED)
    reach = experiment.rate * seconds
    change = level(experiment, progress) - progress.command
    return replace(progress, command=progress.command + min(max(change, -reach), reach))


def level(experiment: Experiment, progress: Progress) -> float:
    """Return where the input goes now."""
    if progress.phase is not Phase.RUNNING:
        return experiment.safe_input
    ends, levels = experiment.steps
    return float(levels[np.searchsorted(ends, progress.elapsed, side='right')])


@dataclass(frozen=True)
class Following:
    """Whether a controller in manual mode passes the input on, within limits of its own."""

    heard: float | None = None  #: what it commanded last, or None at first
    astray: int = 0  #: how many times in a row that was not, nor came nearer to, what was asked
    since: float = 0.0  #: time of the first of these, in s

    def after(self, heard: float, asked: float, now: float) -> Following:
        """Return the same after the controller commanded `heard` where `asked` was asked."""
        gap = abs(heard - asked)
        nearer = self.heard is None or gap < abs(self.heard - asked) - _COMES_NEARER
        if gap <= _FOLLOWS_WITHIN or nearer:
            return Following(heard, 0, now)
        return Following(heard, self.astray + 1, self.since if self.astray else now)
