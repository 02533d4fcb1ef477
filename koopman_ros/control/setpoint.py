# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The set-point: requested by the operator, at once or for a later time, checked and ramped."""

from dataclasses import dataclass, replace
import math

import numpy as np

from koopman_ros.core.arrays import Array, change_within
from koopman_ros.core.status import Reason, StatusCode
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.estimation.sensor_checks import out_of_range
from koopman_ros.model import Coordinates

# A stamp further ahead than this comes from another clock and is no schedule.
HORIZON_NANOSECONDS = 3600 * NANOSECONDS
MAX_SCHEDULED = 1000
MAX_AHEAD = 30  # set-points that a law looks ahead to


@dataclass(frozen=True, slots=True)
class Setpoint:
    """The state of the set-point."""

    #: (n_c,) where the active set-point goes, or None before the first request; NaN, before the
    #: first measurement, for signals without a request
    requested: Array | None = None
    #: (n_c,) active set-point, on its ramp to the requested value; None at first
    active: Array | None = None
    #: (time in ns, (n_c,) value) of requests that take effect later, in time order; NaN for what
    #: they do not ask for
    scheduled: tuple[tuple[int, Array], ...] = ()
    #: (n_c,) where the ramp is, which the filter follows; None for where it is
    ramped: Array | None = None
    #: (n_c,) which signals an operator has requested by now; empty before the first request
    asked: tuple[bool, ...] = ()


def rejection(box: Coordinates, value: Array) -> Reason | None:
    """Return why a set-point (n,), in the units of the box, is outside of it, or None."""
    return out_of_range(box.names, value, box.lower, box.upper, StatusCode.SETPOINT_OUTSIDE,
                        StatusCode.SETPOINT_NOT_FINITE)


def request(setpoint: Setpoint, value: Array, effective_ns: int, now_ns: int | None) -> Setpoint:
    """
    Take over an accepted request, at once or when its time has come.

    A request without a schedule cancels the scheduled ones of its signals.

    :param value: (n_c,) accepted value, in state units; NaN for signals that are not requested.
    :param effective_ns: time from which it holds; 0 or past means at once, and a time more than
        an hour ahead is taken for the stamp of another clock and means at once, too.
    :param now_ns: time of the last measurement, or None before the first.
    """
    if not lies_ahead(effective_ns, now_ns):
        left = ((time_ns, np.where(np.isnan(value), later, np.nan))
                for time_ns, later in setpoint.scheduled)
        return replace(
            setpoint, requested=overlaid(setpoint.requested, value), asked=_asked(setpoint, value),
            scheduled=tuple(entry for entry in left if not np.isnan(entry[1]).all()))
    # the later request for the same time replaces the earlier one
    entries = dict(setpoint.scheduled)
    entries[effective_ns] = overlaid(entries.get(effective_ns), value)
    return replace(setpoint, scheduled=tuple(sorted(entries.items(), key=lambda item: item[0])))


def overlaid(earlier: Array | None, later: Array) -> Array:
    """Return a request (n_c,) updated by a later one (n_c,)."""
    left_open = np.isnan(later)
    if earlier is None or not left_open.any():
        return later
    return np.where(left_open, earlier, later)


def _asked(setpoint: Setpoint, value: Array) -> tuple[bool, ...]:
    """Return which signals (n_c,) were requested, with those of a request (n_c,)."""
    given = np.isfinite(value)
    return tuple((given | setpoint.asked if setpoint.asked else given).tolist())


def at_its_time(setpoint: Setpoint, effective_ns: int, now_ns: int | None) -> Array:
    """Return the set-point (n_c,) when a request takes effect; NaN for signals without one."""
    goal = None if setpoint.requested is None or not setpoint.asked else np.where(
        setpoint.asked, setpoint.requested, np.nan)
    if lies_ahead(effective_ns, now_ns):
        for time_ns, value in setpoint.scheduled:
            if time_ns <= effective_ns:
                goal = overlaid(goal, value)
    assert goal is not None  # of a request that was taken over
    return goal


def lies_ahead(effective_ns: int, now_ns: int | None) -> bool:
    """Whether a stamp is a schedule: later than the last measurement, by at most an hour."""
    if now_ns is None:
        # not known yet; the first measurement decides
        return effective_ns > 0
    return now_ns < effective_ns <= now_ns + HORIZON_NANOSECONDS


def ahead(setpoint: Setpoint, box: Coordinates, ramp: Array, lag: float, now_ns: int,
          horizon: float) -> list[tuple[float, Array]]:
    """
    Return the active set-points (n_c,) of the next seconds, if one is scheduled for then.

    :param box: as `ramp` and `lag` of :func:`advance`.
    :return: seconds from now, at most :data:`MAX_AHEAD`, with the set-point from then on.
    """
    times = np.array([(at_ns - now_ns) / NANOSECONDS for at_ns, _ in setpoint.scheduled])
    times = times[(times > 0.0) & (times <= horizon)]
    if setpoint.active is None or not len(times):
        return []
    if lag > 0.0 or np.isfinite(ramp).any() or len(times) > MAX_AHEAD:
        times = horizon * np.arange(1, MAX_AHEAD + 1) / MAX_AHEAD
    found, before, active = [], 0.0, setpoint.active
    for seconds in times.tolist():
        setpoint = advance(setpoint, active, box, ramp, now_ns + round(seconds * NANOSECONDS),
                           seconds - before, lag)
        assert setpoint.active is not None
        found.append((seconds, setpoint.active))
        before = seconds
    return found


def advance(setpoint: Setpoint, measured: Array, box: Coordinates, ramp: Array, now_ns: int,
            seconds: float, lag: float = 0.0) -> Setpoint:
    """
    Bring the set-point to the present time.

    Before the first request the first measured state is held, so that a controller that starts on
    a running plant does not move it.

    :param measured: (n_c,) measured of the controlled states, in their units.
    :param box: of the controlled states, which bounds the first set-point.
    :param ramp: (n_c,) largest change per second, in state units; infinity for steps.
    :param seconds: time since the last measurement; 0 at the first.
    :param lag: time constant in seconds of the filter behind the ramp; 0 for none.
    """
    if (setpoint.active is setpoint.requested is not None and setpoint.ramped is None
            and not setpoint.scheduled):
        return setpoint
    due = [entry for entry in setpoint.scheduled if not lies_ahead(entry[0], now_ns)]
    if due:
        kept = tuple(entry for entry in setpoint.scheduled if lies_ahead(entry[0], now_ns))
        for _, value in due:
            setpoint = replace(setpoint, requested=overlaid(setpoint.requested, value),
                               asked=_asked(setpoint, value))
        setpoint = replace(setpoint, scheduled=kept)
    active = setpoint.active
    if active is None:
        active = np.clip(measured, box.lower, box.upper)
    requested = active if setpoint.requested is None else overlaid(active, setpoint.requested)
    ramped = active if setpoint.ramped is None or lag <= 0.0 else setpoint.ramped
    reach = change_within(ramp, seconds)
    ramped = np.minimum(np.maximum(requested, ramped - reach), ramped + reach)
    if lag <= 0.0:
        arrived = ramped.tolist() == requested.tolist()
        return replace(setpoint, requested=requested, active=requested if arrived else ramped,
                       ramped=None)
    share = -math.expm1(-seconds / lag)
    return replace(setpoint, requested=requested, ramped=ramped,
                   active=active + share * (ramped - active))
