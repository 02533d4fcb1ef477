# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The identification experiment: random steps on a running plant, with a way back."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property

import numpy as np

from koopman_ros.core.arrays import Array, frozen
from koopman_ros.core.status import Reason, reason, StatusCode
from koopman_ros.core.units import LATE_NANOSECONDS, NANOSECONDS
from koopman_ros.estimation.sensor_checks import out_of_range

_FOLLOWS_WITHIN = 1e-3  # of an input's range
_COMES_NEARER = 1e-5  # as well, less than any rate limit allows between two commands


class ExperimentPhase(Enum):
    """The phase of an experiment; the value is the word shown to an operator."""

    RUNNING = 'running'
    FINISHED = 'finished'
    ENDED = 'ended'
    ABORTED = 'aborted'


@dataclass(frozen=True, eq=False)
class Experiment:
    """
    Random steps (paper, section on the reactor), and the conditions that end them.

    Inputs, or set-points of a controller in automatic mode, are stepped independently: steps
    coincide only if all have the same length.

    :raises ValueError: when a number is missing, not finite, or contradicts another.
    """

    duration: float  #: s
    names: tuple[str, ...]  #: (m,) of the signals that are stepped; all in their units
    lower: Array  #: (m,) lowest levels; levels are uniform between the two
    upper: Array  #: (m,) highest levels
    rate: Array  #: (m,) largest changes per s
    #: (m,) where the signals return to: inputs that are safe whatever happened, or the set-points
    #: from before
    home: Array
    hold_shortest: float  #: shortest time of a level, in s; times are uniform between the two
    hold_longest: float  #: longest time of a level, in s
    measured: tuple[str, ...]  #: (n,) names of the measured signals
    measured_lower: Array  #: (n,) smallest values that may be measured; -infinity for any
    measured_upper: Array  #: (n,) largest values; infinity for any
    seed: int  #: of numpy's default generator; the same seed gives the same steps

    def __post_init__(self) -> None:
        for field, names in (('lower', self.names), ('upper', self.names), ('rate', self.names),
                             ('home', self.names), ('measured_lower', self.measured),
                             ('measured_upper', self.measured)):
            object.__setattr__(self, field, frozen(
                getattr(self, field), field, (len(names),), finite=names is self.names))
        for names, low, high in ((self.names, self.lower, self.upper),
                                 (self.measured, self.measured_lower, self.measured_upper)):
            for name, lower, upper in zip(names, low, high, strict=True):
                if not lower < upper:
                    raise ValueError(f'{name}: lower = {lower} must be below upper = {upper}')
        for name, rate in zip(self.names, self.rate, strict=True):
            if not rate > 0.0:
                raise ValueError(f'{name}: rate = {rate} must be above 0')
        if not 0.0 < self.hold_shortest <= self.hold_longest:
            raise ValueError(f'hold_shortest = {self.hold_shortest} s must be above 0 and at most '
                             f'hold_longest = {self.hold_longest} s')
        if not 0.0 < self.duration < np.inf:
            raise ValueError(f'duration = {self.duration} s must be finite and above 0')

    @cached_property
    def steps(self) -> tuple[tuple[Array, Array], ...]:
        """For each signal when its steps end (S,), in s after the start, and their levels (S,)."""
        rng = np.random.default_rng(self.seed)
        count = int(self.duration / self.hold_shortest) + 1
        drawn = []
        for lower, upper in zip(self.lower, self.upper, strict=True):
            ends = np.cumsum(rng.uniform(self.hold_shortest, self.hold_longest, count))
            levels = rng.uniform(lower, upper, count)
            used = int(np.searchsorted(ends, self.duration)) + 1
            drawn.append((ends[:used], levels[:used]))
        return tuple(drawn)

    def rejection(self, measured: Array) -> Reason | None:
        """Return why the experiment must not go on with a measurement (n,), or None."""
        return out_of_range(self.measured, measured, self.measured_lower, self.measured_upper,
                            StatusCode.EXPERIMENT_BOUNDS)


@dataclass(frozen=True, eq=False)
class ExperimentProgress:
    """How far an experiment is; it goes on commanding the way home when it is over."""

    start_ns: int  #: stamp of the measurement it started with
    time_ns: int  #: stamp of the last measurement
    command: Array  #: (m,) last values of the signals that are stepped
    interval: float = np.inf  #: usual seconds between measurements; infinity before the second
    phase: ExperimentPhase = ExperimentPhase.RUNNING
    reason: Reason | None = None  #: why it was aborted

    @property
    def elapsed(self) -> float:
        """Seconds since the start."""
        return (self.time_ns - self.start_ns) / NANOSECONDS


def begin(experiment: Experiment, time_ns: int, start: Array | None = None) -> ExperimentProgress:
    """
    Start at the stamp of the first measurement.

    :param start: (m,) present values of the signals; at home by default.
    """
    return ExperimentProgress(time_ns, time_ns, experiment.home if start is None else start)


def end(progress: ExperimentProgress, phase: ExperimentPhase,
        why: Reason | None = None) -> ExperimentProgress:
    """End the steps, unless they are over; the signals then go home."""
    if progress.phase is not ExperimentPhase.RUNNING:
        return progress
    return replace(progress, phase=phase, reason=why)


def advance(experiment: Experiment, progress: ExperimentProgress, measured: Array | None,
            time_ns: int
            ) -> ExperimentProgress:
    """
    Answer a measurement (n,), or the passing of time without one.

    As in the control step, a stamp that is not later moves nothing, and the rate limit counts a
    gap in the measurements as twice the interval before it.
    """
    ahead = time_ns - progress.time_ns
    if measured is not None and (why := experiment.rejection(measured)):
        progress = end(progress, ExperimentPhase.ABORTED, why)
    if ahead < -LATE_NANOSECONDS:
        progress = end(progress, ExperimentPhase.ABORTED, reason(StatusCode.CLOCK_WENT_BACK))
        return replace(progress, time_ns=time_ns)
    if ahead <= 0:
        return progress
    seconds = min(ahead / NANOSECONDS, 2.0 * progress.interval)
    usual = 0.0 if np.isinf(progress.interval) else 0.5 * progress.interval
    progress = replace(progress, time_ns=time_ns, interval=max(seconds, usual))
    if progress.elapsed >= experiment.duration:
        progress = end(progress, ExperimentPhase.FINISHED)
    reach = experiment.rate * seconds
    change = level(experiment, progress) - progress.command
    return replace(progress, command=progress.command + np.clip(change, -reach, reach))


def level(experiment: Experiment, progress: ExperimentProgress) -> Array:
    """Return where the signals go now (m,)."""
    if progress.phase is not ExperimentPhase.RUNNING:
        return experiment.home
    return np.array([levels[np.searchsorted(ends, progress.elapsed, side='right')]
                     for ends, levels in experiment.steps])


@dataclass(frozen=True)
class TrackingMonitor:
    """Whether a controller passes on one of the signals, within limits of its own."""

    span: float  #: width of the signal's range, in its unit
    last: float | None = None  #: its last command, or None at first
    deviations: int = 0  #: commands in a row that neither were the request nor came nearer to it
    since: float = 0.0  #: time of the first of these, in s

    def after(self, command: float, request: float, now: float) -> TrackingMonitor:
        """Return the monitor after a command of the controller where another was requested."""
        gap = abs(command - request)
        nearer = self.last is None or (
            gap < abs(self.last - request) - _COMES_NEARER * self.span)
        if gap <= _FOLLOWS_WITHIN * self.span or nearer:
            return TrackingMonitor(self.span, command, 0, now)
        return TrackingMonitor(self.span, command, self.deviations + 1,
                               self.since if self.deviations else now)
