# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Times of a step: gaps, bursts and clocks that are set back."""

from __future__ import annotations

from dataclasses import replace
import math
from typing import NamedTuple
import warnings

from koopman_ros.control.state import State
from koopman_ros.core.units import LATE_NANOSECONDS, NANOSECONDS
from koopman_ros.estimation import History
from koopman_ros.model import LiftedModel

# s that the rate limit counts at most between two commands without a measurement, unless
# measurements are usually further apart.
_LONGEST_WATCH = 1.0


class StepTime(NamedTuple):
    """The times of a step."""

    now_ns: int  #: stamp of the measurement, or up to which there was none
    command_ns: int  #: of the command
    elapsed: float  #: seconds since the last command
    counted: float  #: of these, seconds that count for ramp and rate limit
    ahead: float  #: seconds after the measurement's stamp that have counted before
    spacing: float  #: seconds between samples; 0 when they are not known
    interval: float  #: usual seconds between measurements; infinity before the second


def check_interval(model: LiftedModel, before: float, interval: float, share: float = 0.005
                   ) -> None:
    """
    Warn where measurements begin to come much closer together than in the training record.

    :param before: usual seconds between measurements so far, and `interval` with this one.
    :param share: of :attr:`LiftedModel.sample_interval` that is much closer; stamps in
        microseconds that are given as nanoseconds have a thousandth of it.
    """
    if interval < share * model.sample_interval <= before:
        warnings.warn(
            f'measurements are {interval:.3g} s apart, the model is made for '
            f'{model.sample_interval:.3g} s: check that stamps are in nanoseconds', stacklevel=3)


def usual_interval(state: State) -> float:
    """Return the usual seconds between measurements; 0 before the second."""
    return 0.0 if math.isinf(state.interval) else state.interval


def afresh(state: State, by_ns: int) -> State:
    """
    Return the state after the clock was set: without times of the former clock.

    :param by_ns: the change of the clock, by which inputs under way act at other times.
    """
    supervisor = replace(state.supervisor, bad_since_ns=None, better_since_ns=None)
    newest_ns = state.time_ns if state.former_ns is None or state.time_ns is None else max(
        state.time_ns, state.former_ns)
    return state._replace(time_ns=None, former_ns=newest_ns, commanded_ns=None, counted=0.0,
                   accepted=None,
                   applied=state.applied.shifted(by_ns), supervisor=supervisor, recovery=None,
                   disturbances=state.disturbances and state.disturbances.shifted(by_ns),
                   setpoint=replace(state.setpoint, scheduled=()), history=History())


def time_of_measurement(state: State, time_ns: int, countable: float | None
                        ) -> tuple[StepTime, int]:
    """Return the times of the step, and how many measurements were missed."""
    since_ns = state.commanded_ns
    ahead_of_stamps = since_ns is not None and since_ns > time_ns + LATE_NANOSECONDS
    if ahead_of_stamps:
        # commands during the silence were timed by a clock that these stamps do not follow
        since_ns = state.time_ns
    elapsed = 0.0 if since_ns is None else max(0.0, (time_ns - since_ns) / NANOSECONDS)
    # neither a gap nor a burst is the spacing of the samples, nor the first of them
    usual = usual_interval(state)
    spacing = min(usual, elapsed)
    counted, missed, interval, ahead = 0.0, 0, state.interval, 0.0
    if state.time_ns is not None:
        since_ns = state.time_ns
        if state.former_ns is not None and since_ns < state.former_ns < time_ns:
            # two sources would count each other's time, but for this
            since_ns = state.former_ns
        since = (time_ns - since_ns) / NANOSECONDS
        # the command has moved already while nothing was measured
        left, ahead = max(0.0, since - state.counted), max(0.0, state.counted - since)
        if elapsed > 0.0:
            if math.isfinite(state.interval):
                missed = max(0, round(since / state.interval) - 1)
            # the plant stood under the old command all through a gap
            seconds = min(since, 2.0 * state.interval)
            # a burst of measurements does not make the next regular one a gap
            interval = max(seconds, 0.5 * usual)
            counted = min(seconds, elapsed, left)
    if countable is not None:
        counted = min(counted, countable)
    return StepTime(time_ns, time_ns, elapsed, counted, ahead, spacing, interval), missed


def time_of_silence(state: State, time_ns: int) -> StepTime:
    """Return the times of a step without a measurement up to a time."""
    since_ns = time_ns if state.commanded_ns is None else state.commanded_ns
    elapsed, spacing = max(0.0, (time_ns - since_ns) / NANOSECONDS), usual_interval(state)
    # the command stood still all through a longer silence
    counted = min(elapsed, max(_LONGEST_WATCH, 2.0 * spacing))
    command_ns = max(time_ns, since_ns)
    # of another clock than the stamps', no more than has passed since the last of these
    passed = 0.0 if state.time_ns is None else (command_ns - state.time_ns) / NANOSECONDS
    ahead = min(state.counted + counted, max(passed, state.counted))
    return StepTime(time_ns, command_ns, elapsed, counted, ahead, spacing, state.interval)
