# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""First-order lags of the inputs: the applied inputs become states, with a known drift."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
import math

import numpy as np
from scipy.optimize import minimize_scalar

from koopman_ros.core.arrays import short_repr
from koopman_ros.core.characteristic import Characteristic
from koopman_ros.core.datasets import Array, cut, Episode, PlantDescription
from koopman_ros.learning.identification.chance import clearly_positive
from koopman_ros.learning.identification.drift import (
    box_of,
    Drift,
    DriftModel,
    fitted_starts,
    longest_step,
    Segments,
)
from koopman_ros.learning.identification.identify import Identified, usual_degrees
from koopman_ros.learning.identification.output_error import output_error
from koopman_ros.learning.identification.weak_form import weak_form
from koopman_ros.learning.lift.input_model import InputModel
from koopman_ros.model import APPLIED, Box, COMMANDED, Coordinates

# Times after a change, in time constants, between which an applied input is nearly linear; at the
# last one it has settled.
_KNOTS = np.arange(0.25, 8.0, 0.25)
# Time constants after which an applied input depends on nothing before.
_FADED = 4.0
# A search tries lags from an interval between samples on, with this ratio, up to this share of an
# episode, then between, to this share of the lag.
_RATIO, _SHARE, _TOLERANCE = 2.0, 30.0, 0.05
# The drift of a search: its degree, with at most so many coefficients, and samples of a window of
# the weak form that it begins with.
_DEGREE, _MOST_COEFFICIENTS, _WINDOW = 3, 60, 40
# Samples of a segment that is simulated.
_SAMPLES = 240
# Share of a lag within which two times are equal.
_ROUNDING = 1e-6
# Share of a lag within which a command that is a state changes in a record.
_RAMP = 1e-3


def lagged(episode: Episode, lag: Array, longest: float = 0.0) -> Episode | None:
    """
    Return the episode with each input as it acts behind its lag (n_u,).

    Its first samples, which depend on earlier inputs, are left out; None where nothing is left.

    :param longest: a lag for which they are left out, too.
    """
    first = np.searchsorted(episode.time, episode.input_time[0] + _FADED * max(
        longest, np.max(lag, initial=0.0)))
    if len(episode) - first < 2:
        return None
    if not lag.any():
        return episode.part(int(first), len(episode)) if longest else episode
    begin, times = episode.input_time, [episode.input_time, episode.time]
    end = np.append(begin[1:], max(begin[-1], episode.time[-1]))
    for seconds in lag[lag > 0.0].tolist():
        later = begin[:, None] + seconds * _KNOTS
        times.append(later[later < end[:, None]])
    knots = np.unique(np.concatenate(times))
    # of two that are equal but for rounding, the later one
    knots = knots[np.append(np.diff(knots) > _ROUNDING * np.min(lag[lag > 0.0]), True)]
    u, linear = episode.inputs_at(knots), list(episode.linear) or [False] * len(lag)
    for j in np.flatnonzero(lag):
        value, applied = u[0, j], [u[0, j]]
        for command, share in zip(u[:-1, j].tolist(), np.exp(-np.diff(knots) / lag[j]).tolist(),
                                  strict=True):
            value = command + share * (value - command)
            applied.append(value)
        u[:, j], linear[j] = applied, True
    return replace(episode, input_time=knots, u=u, linear=tuple(linear)).part(
        int(first), len(episode))


def _commanded(episode: Episode, lag: Array) -> Episode:
    """Return an episode of :func:`lagged` with commands as inputs, applied inputs as states."""
    u, steps, linear = episode.u.copy(), np.diff(episode.input_time), list(episode.linear)
    for j in np.flatnonzero(lag):
        share = np.exp(-steps / lag[j])
        u[:-1, j] = (u[1:, j] - share * u[:-1, j]) / (1.0 - share)
        u[-1, j], linear[j] = u[-2, j], False
    return replace(episode, u=u, linear=tuple(linear), x=np.hstack(
        (episode.x, episode.inputs_at(episode.time)[:, np.flatnonzero(lag)])))


@dataclass(frozen=True)
class LaggedDrift(Drift):
    """
    A drift behind lags of some inputs: dx/dt = f(x, v), dv/dt = (u - v) / lag.

    Behind a lag a static characteristic, or another effect that is not linear, is one of a state.
    """

    drift: Drift  #: of the applied inputs
    lag: Array  #: (n_u,) in time units, 0 for none

    __repr__ = short_repr

    @classmethod
    def of(cls, drift: Drift, lag: Array, commands: Coordinates, commanded: Collection[str] = ()
           ) -> LaggedDrift:
        """Return the drift of the states of another one and of its applied inputs."""
        own = drift.box.inputs.only([drift.box.inputs.names[j] for j in np.flatnonzero(lag)])
        applied = replace(own, names=tuple(
            (COMMANDED if name in commanded else APPLIED) + name for name in own.names))
        return cls(Box(drift.box.states.followed_by(applied), commands, drift.box.time_unit),
                   drift, lag)

    @property
    def form(self) -> str:
        """The kind of model, in words."""
        return f'{self.drift.form} behind a lag of the input'

    @property
    def varying_input_matrix(self) -> bool:
        """Whether B depends on the state."""
        return self.drift.varying_input_matrix

    @property
    def characteristics(self) -> Mapping[str, Characteristic]:
        """Those of its applied inputs, too."""
        return self.drift.characteristics

    def _applied(self, xi: Array, v: Array) -> tuple[Array, Array]:
        """Return states of the drift in its deviations, and its inputs in units."""
        n = len(self.drift.box.states)
        return xi[..., :n], np.where(
            self.lag > 0.0, self._spread(self.box.states.to_physical(xi)[..., n:]),
            self.box.inputs.to_physical(v))

    def _spread(self, values: Array) -> Array:
        """Return one value for each input (..., n_u), 0 where it has no lag."""
        return values @ np.eye(len(self.lag))[self.lag > 0.0]

    def scaled_rate(self, xi: Array, v: Array) -> Array:
        """Evaluate the rate in deviations; see :class:`Drift`."""
        behind, states, n = self.lag > 0.0, self.box.states, len(self.drift.box.states)
        x, u = self._applied(xi, v)
        ahead = self.box.inputs.to_physical(v) - u
        return np.concatenate((self.drift.scaled_rate(x, self.drift.box.inputs.to_deviation(u)), (
            ahead[..., behind] / self.lag[behind] / states.scale[n:])), axis=-1)

    def scaled_slope(self, xi: Array, v: Array | None = None) -> Array:
        """Evaluate the Jacobian of the scaled rate; see :class:`Drift`."""
        behind, n = self.lag > 0.0, len(self.drift.box.states)
        x, u = self._applied(xi, np.zeros(len(self.lag)) if v is None else v)
        slope = np.zeros((*xi.shape, xi.shape[-1]))
        inputs = self.drift.box.inputs
        own = inputs.to_deviation(u)
        slope[..., :n, :n] = self.drift.scaled_slope(x, own)
        slope[..., :n, n:] = (self.drift.scaled_input_slope(x, own)
                              * inputs.slope(u)[..., None, :])[..., behind]
        slope[..., n:, n:] = -np.diag(1.0 / self.lag[behind])
        return slope

    def scaled_input_matrix(self, xi: Array) -> Array:
        """Evaluate B(x) in deviations; see :class:`Drift`."""
        behind, n = self.lag > 0.0, len(self.drift.box.states)
        scale = self.box.inputs.scale
        B = self.drift.scaled_input_matrix(xi[..., :n]) * scale / self.drift.box.inputs.scale
        rates = np.diag(scale / np.where(behind, self.lag, 1.0))[behind] / (
            self.box.states.scale[n:, None])
        return np.concatenate((np.where(behind, 0.0, B), np.broadcast_to(
            rates, (*B.shape[:-2], *rates.shape))), axis=-2)


def _ramped(episode: Episode, columns: Sequence[int], seconds: float) -> Episode:
    """Return an episode in which some held inputs move linearly, shortly before they change."""
    columns = [j for j in columns if not any(episode.linear[j:j + 1])]
    if not columns:
        return episode
    times = episode.input_time
    short = min([seconds, *(0.5 * np.diff(times))])
    knots = np.unique(np.concatenate((
        times, times[1:] - short, [max(times[-1], episode.time[-1]) + short])))
    linear = list(episode.linear) or [False] * episode.u.shape[1]
    for j in columns:
        linear[j] = True
    return replace(episode, input_time=knots, u=episode.inputs_at(knots), linear=tuple(linear))


def with_lag(found: Identified, lag: Array, commanded: Collection[str] = ()) -> Identified:
    """
    Return an estimate on episodes of :func:`lagged` with the commands as inputs.

    The applied inputs follow the unmeasured states. The linear drift has no characteristic of a
    state.

    :param lag: (n_u,) in time units, 0 for none.
    :param commanded: inputs without a lag in the record whose command becomes a state; the input
        of the model is then a command behind that lag, whose pulses move the state at once.
    """
    inputs = found.drift.box.inputs
    moved = [inputs.names.index(name) for name in commanded]

    def with_commands(one: Episode) -> Episode:
        return _commanded(_ramped(one, moved, _RAMP * lag[moved].min(initial=np.inf)), lag)

    u = np.vstack([with_commands(one).u for one in found.episodes])
    u[:, moved] = np.clip(u[:, moved], inputs.lower[moved], inputs.upper[moved])
    commands = replace(
        Coordinates.spanning(inputs.names, inputs.units, u.min(axis=0), u.max(axis=0)),
        characteristics={name: one for name, one in inputs.characteristics.items()
                         if not lag[inputs.names.index(name)]})
    count, zeros = int(np.count_nonzero(lag)), np.zeros

    def of_commands(drift: Drift) -> LaggedDrift:
        return LaggedDrift.of(drift, lag, commands, commanded)

    linear = found.linear.box.inputs
    return found.mapped(
        of_commands, with_commands, linear=of_commands(replace(found.linear, box=replace(
            found.linear.box, inputs=replace(
                linear, characteristics=commands.characteristics)))),
        noise=np.append(found.noise, zeros(count)), hidden=found.hidden + count,
        offsets=np.hstack((found.offsets, zeros((len(found.offsets), count)))) if (
            len(found.offsets)) else found.offsets)


class _DivergedError(Exception):
    """A simulation of a search diverges."""


def find_lags(plant: PlantDescription, episodes: Sequence[Episode], lag: Array,
              searched: Sequence[int], *, watch: Callable[[], object] = lambda: None) -> Array:
    """
    Find the lags (n_u,) of inputs by simulations of a record of all states.

    A polynomial drift is refined by output error for each lag of a search, one input after the
    other. The lag with the least mean squared error is taken if it errs less than none by more
    than two standard errors of the difference, over segments of the record.

    :param lag: (n_u,) those that are known, in time units.
    :param searched: indices of the inputs whose lag is to be found.
    :param watch: called now and then; it may raise to end the search.
    """
    lag = lag.copy()
    step = longest_step(episodes)
    longest = max(one.time[-1] - one.time[0] for one in episodes) / _SHARE

    def cut_behind(lag: Array) -> list[Episode]:
        return cut([late for one in episodes if (
            late := lagged(replace(one, x=one.interpolated()), lag, longest)) is not None],
            _SAMPLES)

    parts = cut_behind(0.0 * lag)
    box = box_of(plant, parts)
    inputs = InputModel.of(plant, box, np.concatenate([one.x for one in parts]))
    n_x = len(box.states)
    degree = max(d for d in usual_degrees(n_x) if d <= _DEGREE and (
        d == 1 or n_x * math.comb(n_x + d, d) <= _MOST_COEFFICIENTS))
    drift: DriftModel | None = None

    def squares(j: int, tried: float) -> Array:
        """Return the mean squared errors (M,) of segments, simulated by a drift that is fitted."""
        nonlocal drift
        watch()
        behind = np.where(np.arange(len(lag)) == j, tried, lag)
        parts = cut_behind(behind)
        segments = Segments.of(parts, step)
        start = drift or weak_form(parts, box, degree, inputs.weights, _WINDOW, inputs.degree)
        refined = output_error(start, segments, learn_input_matrix=inputs.weights is None)
        found = np.mean(fitted_starts(refined.rate, segments, box.states.scale)[1]
                        / box.states.scale ** 2, axis=1)
        if np.isfinite(found).all():
            drift = refined
        elif degree > 1:
            raise _DivergedError
        return found

    def search(j: int) -> float:
        """Return the lag of an input, 0 for none."""
        best = tried = 0.5 * step
        without = squares(j, 0.0)
        least = np.inf
        while tried <= longest:
            if (cost := float(np.mean(squares(j, tried)))) < least:
                least, best = cost, tried
            elif tried > _RATIO ** 2 * best:
                break
            tried *= _RATIO
        found = best * math.exp(minimize_scalar(
            lambda log: np.mean(squares(j, best * math.exp(log))),
            bounds=(-math.log(_RATIO), math.log(min(_RATIO, longest / best))), method='bounded',
            options={'xatol': _TOLERANCE}).x)
        errors = squares(j, found)
        if not clearly_positive(without - errors):
            return 0.0
        assert drift is not None
        # a linear plant may exchange the lag for a time constant: the actuator is the faster one
        times = 1.0 / np.maximum(-np.linalg.eigvals(drift.slope(box.states.center)).real, 1e-9)
        return next((other for other in sorted(times.tolist()) if step / 4.0 < other < found
                     and not clearly_positive(squares(j, other) - errors)), found)

    for j in searched:
        while True:
            try:
                lag[j] = search(j)
                break
            except _DivergedError:
                # one of lower degree does not, and lags are compared by one degree
                degree, drift = degree - 1, None
    return lag
