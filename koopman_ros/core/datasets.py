# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Data of a plant: names and units, episodes, samples with derivatives."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
import hashlib
import itertools

import numpy as np
from numpy.typing import ArrayLike, NDArray

from koopman_ros.core.arrays import Array, frozen, real, short_repr
from koopman_ros.core.characteristic import Characteristic
from koopman_ros.core.units import check_time_unit, checked_signals

__all__ = ['DriftSamples', 'Episode', 'PlantDescription', 'averaged', 'cut',
           'sample_interval', 'split_by_episode', 'within']

_ROUNDING = 1e-6  # share of a sample interval within which two times are equal


@dataclass(frozen=True)
class PlantDescription:
    """
    Names, units, nominal point and input matrix of a plant.

    :raises ValueError: naming the mismatch, or for an unknown unit.
    """

    name: str  #: name of the plant
    state_names: tuple[str, ...]  #: one name a state
    state_units: tuple[str, ...]  #: one unit a state
    input_names: tuple[str, ...]  #: one name an input
    input_units: tuple[str, ...]  #: one unit an input
    time_unit: str  #: ``'s'`` or ``'min'``
    #: (n_x,) steady state under the nominal input; NaN where it is not known yet
    nominal_state: Array
    nominal_input: Array  #: (n_u,) nominal input, or NaN
    #: (n_x, n_u) input matrix, in units; None to learn it; where it depends on the state, a
    #: function of states (..., n_x), in their units, to (..., n_x, n_u)
    B: Array | Callable[[Array], Array] | None
    #: degree of the polynomial B(x) that is learned where B is None; 0 for a constant one
    input_matrix_degree: int = 0
    #: inputs that are not manipulated: measured disturbances, with an effect that does not depend
    #: on the state
    disturbance_names: tuple[str, ...] = ()
    #: static characteristics of inputs by name, none of an input that acts linearly; B is the gain
    #: of their effects
    characteristics: Mapping[str, Characteristic] = field(default_factory=dict, repr=False)

    __repr__ = short_repr

    def __post_init__(self) -> None:
        check_time_unit(self.time_unit)
        for kind in ('state', 'input'):
            names, units = checked_signals(
                kind, getattr(self, f'{kind}_names'), getattr(self, f'{kind}_units'))
            nominal = real(getattr(self, f'nominal_{kind}'), f'nominal_{kind}').copy()
            if nominal.shape != (len(names),):
                raise ValueError(f'incompatible nominal_{kind}: expected one number for each of '
                                 f'{list(names)}, got {nominal.tolist()}')
            for attribute, value in ((f'{kind}_names', names), (f'{kind}_units', units),
                                 (f'nominal_{kind}', nominal)):
                object.__setattr__(self, attribute, value)
        if unknown := [name for name in self.disturbance_names if name not in self.input_names]:
            raise ValueError(f'the disturbances have {", ".join(unknown)}, must be some of the '
                             f'inputs {", ".join(self.input_names)}')
        if self.disturbance_names and (self.input_matrix_degree or callable(self.B)):
            raise ValueError(f'the effect of {", ".join(self.disturbance_names)} must not depend '
                             'on the state: give a constant B, or set input_matrix_degree to 0')
        if self.input_matrix_degree < 0 or (self.input_matrix_degree and self.B is not None):
            raise ValueError(f'input_matrix_degree is {self.input_matrix_degree}, must be at '
                             'least 0, and 0 where B is given')
        if self.B is not None and not callable(self.B):
            object.__setattr__(self, 'B', frozen(
                self.B, 'B', (len(self.state_names), len(self.input_names))))

    def input_matrix(self, x: Array) -> Array:
        """
        Return the known B at states (..., n_x), in units: (..., n_x, n_u).

        :raises ValueError: when B is left to learn, or its function gives another shape.
        """
        shape = (*np.shape(x), len(self.input_names))
        if self.B is None:
            raise ValueError('B is unknown: pass it to PlantDescription')
        if not callable(self.B):
            return np.broadcast_to(self.B, shape)
        found = np.asarray(self.B(x), dtype=np.float64)
        if found.shape != shape:
            raise ValueError(f'incompatible B(x) at x of shape {np.shape(x)}: expected {shape}, '
                             f'got {found.shape}')
        return found


@dataclass(frozen=True)
class Episode:
    """
    Uninterrupted measurements of a plant, with the inputs that acted.

    A command is held until the next one; an input that was measured behind a slow actuator is
    linear from sample to sample.

    :raises ValueError: on unequal lengths, times that do not rise, values that are infinite,
        times at which no state was measured, or an input that is not known at the first one.
    """

    time: Array  #: (N,) times of the measurements, rising, in time units
    #: (N, n_x) measured states, in state units, with their noise; NaN where one was not measured
    x: Array
    #: (M,) times from which each input was held, or at which it was measured, rising, the first
    #: not later than the first measurement
    input_time: Array
    u: Array  #: (M, n_u) those inputs, in input units
    #: (n_u,) whether each is linear between those times; empty where all are held
    linear: tuple[bool, ...] = ()
    #: (n_x,) constant disturbance of the rates, in state units per time unit; empty for none
    disturbance: Array = field(default_factory=lambda: np.zeros(0))

    __repr__ = short_repr

    def __post_init__(self) -> None:
        for times, values in (('time', 'x'), ('input_time', 'u')):
            t = np.ascontiguousarray(real(getattr(self, times), times))
            v = np.ascontiguousarray(real(getattr(self, values), values))
            if (t.ndim, v.ndim) == (2, 1):
                raise ValueError(f'{times} has shape {t.shape} and {values} {v.shape}: the '
                                 'arguments are swapped; pass the times first')
            if (t.ndim, v.ndim) == (1, 1):
                raise ValueError(f'{values} has shape {v.shape}: pass one column per signal, '
                                 f'{values}[:, None] for a single one')
            if t.ndim != 1 or v.ndim != 2 or len(t) != len(v) or len(t) == 0:
                raise ValueError(f'incompatible {times} and {values}: expected (n,) and (n, m) '
                                 f'with n > 0, got {t.shape} and {v.shape}')
            missing = np.all(np.isnan(v), axis=1) if values == 'x' else np.isnan(v)
            if not np.all(np.isfinite(t)) or np.any(missing) or np.any(np.isinf(v)):
                raise ValueError(f'{times} or {values} contain values that are not finite: remove '
                                 'those samples')
            if not np.all(np.diff(t) > 0.0):
                raise ValueError(f'{times} must increase: sort the samples and remove repeated '
                                 'ones')
            object.__setattr__(self, times, t)
            object.__setattr__(self, values, v)
        if self.input_time[0] > self.time[0]:
            raise ValueError('the input at the first measurement is unknown: begin the episode '
                             'with the first measurement after an input')
        if self.linear and len(self.linear) != self.u.shape[1]:
            raise ValueError(f'linear = {self.linear} must have one entry for each of '
                             f'{self.u.shape[1]} inputs')

    def __len__(self) -> int:
        return len(self.time)

    def interpolated(self) -> Array:
        """Return the states (N, n_x), lines where one was not measured; 0 where it never was."""
        x = self.x.copy()
        for j in np.flatnonzero(np.isnan(x).any(axis=0)):
            known = ~np.isnan(x[:, j])
            x[:, j] = np.interp(self.time, self.time[known], x[known, j]) if known.any() else 0.0
        return x

    def inputs_at(self, times: Array) -> Array:
        """Return the inputs (n, n_u) that act from `times` (n,) on."""
        u: Array = self.u[np.searchsorted(self.input_time, times, side='right') - 1]
        for j in np.flatnonzero(self.linear):
            u[:, j] = np.interp(times, self.input_time, self.u[:, j])
        return u

    def inputs_between(self, edges: Array) -> tuple[Array, Array]:
        """Return the inputs (n - 1, n_u) at begin and end of intervals that no change divides."""
        begin = self.inputs_at(edges[:-1])
        return begin, self._later(begin, edges[1:])

    def input_integral(self, times: Array) -> Array:
        """Return the integral of u (n, n_u) from the first measurement to `times` (n,)."""
        knots = np.concatenate((self.time[:1], self.input_time[self.input_time > self.time[0]]))
        begin, end = self.inputs_between(np.append(knots, knots[-1]))
        areas = np.vstack((np.zeros((1, begin.shape[1])), np.cumsum(
            np.diff(knots)[:, None] * (0.5 * (begin + end))[:-1], axis=0)))
        last = np.maximum(np.searchsorted(knots, times, side='right') - 1, 0)
        mean = 0.5 * (begin[last] + self._later(begin[last], times))
        return areas[last] + (times - knots[last])[:, None] * mean

    def _later(self, u: Array, times: Array) -> Array:
        """Return the inputs (n, n_u) at `times` (n,), before any other change."""
        return np.where(self.linear, self.inputs_at(times), u) if any(self.linear) else u

    def delayed(self, dead_time: Array) -> Episode | None:
        """
        Return the episode with each input as it acts, later by its dead time (n_u,).

        It begins where all inputs are known; None where nothing is left of it.
        """
        if not np.any(dead_time):
            return self
        shifted = self.input_time[:, None] + dead_time
        # a change at a measurement stays there, whatever the rounding
        near = _ROUNDING * np.min(np.diff(self.time), initial=np.inf)
        at = self.time[np.minimum(np.searchsorted(self.time, shifted - near), len(self) - 1)]
        shifted = np.where(np.abs(shifted - at) <= near, at, shifted)
        first = np.searchsorted(self.time, shifted[0].max())
        if len(self) - first < 2:
            return None
        knots = np.unique(shifted)
        knots = knots[knots >= shifted[0].max()]
        u = np.empty((len(knots), self.u.shape[1]))
        for j, own in enumerate(shifted.T):
            u[:, j] = np.interp(knots, own, self.u[:, j]) if any(self.linear[j:j + 1]) else (
                self.u[np.searchsorted(own, knots, side='right') - 1, j])
        return replace(self, time=self.time[first:], x=self.x[first:], input_time=knots, u=u)

    def part(self, start: int, stop: int) -> Episode:
        """Return the measurements `start` to `stop` with the inputs that acted on them."""
        time = self.time[start:stop]
        first = np.searchsorted(self.input_time, time[0], side='right') - 1
        # a line needs its end, too
        last = np.searchsorted(self.input_time, time[-1], side='left') + any(self.linear)
        keep = slice(first, max(first + 1, last))
        return replace(self, time=time, x=self.x[start:stop], input_time=self.input_time[keep],
                       u=self.u[keep])


def sample_interval(episodes: Sequence[Episode]) -> float:
    """Return the median time between the samples of episodes, in their time unit."""
    return float(np.median(np.concatenate([np.diff(episode.time) for episode in episodes])))


def cut(episodes: Sequence[Episode], samples: int) -> list[Episode]:
    """Cut into nearly equal segments of at most `samples`, each beginning where the last ends."""
    if samples < 2:
        raise ValueError(f'a segment needs at least 2 samples, got {samples}')
    parts = []
    for episode in episodes:
        count = max(1, -(-(len(episode) - 1) // (samples - 1)))
        edges = np.round(np.linspace(0, len(episode) - 1, count + 1)).astype(int)
        parts += [episode.part(a, b + 1) for a, b in itertools.pairwise(edges) if b > a]
    return parts


def averaged(episode: Episode, count: int) -> Episode:
    """
    Return the means of `count` measurements in a row each, at the means of their times.

    The integral of the input from one to the next is kept: its changes, or where there are more of
    them than means, as in a loop that commands at each measurement, its own mean between two
    times.

    :raises ValueError: for an episode without two such groups.
    """
    n = len(episode) // count
    if n < 2:
        raise ValueError(f'an episode of {len(episode)} measurements has no two groups of {count}')
    time = episode.time[:n * count].reshape(n, count).mean(axis=1)
    x = episode.x[:n * count].reshape(n, count, -1).mean(axis=1)
    changes = np.sum((episode.input_time > time[0]) & (episode.input_time < time[-1]))
    if not any(episode.linear) and changes <= n:
        return replace(episode, time=time, x=x).part(0, n)
    u = np.diff(episode.input_integral(time), axis=0) / np.diff(time)[:, None]
    return replace(episode, time=time, x=x, input_time=time[:-1], u=u, linear=())


def within(episodes: Sequence[Episode], lower: ArrayLike, upper: ArrayLike, samples: int = 2
           ) -> list[Episode]:
    """
    Cut episodes where a state leaves a range, for a training box that ends there.

    :param lower: lower corner of the range, a scalar or (n_x,), in state units; upper: the upper
        corner.
    :param samples: the least of a part; shorter ones are left out.
    :raises ValueError: when nothing is left.
    """
    low, high = (np.asarray(corner, dtype=np.float64) for corner in (lower, upper))
    parts: list[Episode] = []
    for episode in episodes:
        inside = np.all((episode.x >= low) & (episode.x <= high), axis=1)
        edges = np.flatnonzero(np.diff(inside, prepend=False, append=False)).reshape(-1, 2)
        parts += [episode.part(a, b) for a, b in edges.tolist() if b - a >= samples]
    if not parts:
        raise ValueError(f'no {samples} consecutive samples lie between {low} and {high}: choose '
                         'a wider range, or record more data in this one')
    return parts


@dataclass(frozen=True)
class DriftSamples:
    """
    States, their derivatives and the inputs that acted, from one or more episodes.

    :raises ValueError: on unequal lengths, values that are not finite, or times that do not rise.
    """

    x: Array  #: (N, n_x) states, in state units
    dxdt: Array  #: (N, n_x) derivatives, in state units per time unit
    u: Array  #: (N, n_u) inputs, in input units
    episode: np.ndarray  #: (N,) number of the episode that each sample belongs to
    #: (N,) times of the samples, in time units, rising within an episode, where the input of a
    #: sample was held until the next one; None when samples do not follow each other (then no
    #: roll-out can be judged)
    time: Array | None = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        episode = np.ascontiguousarray(self.episode)
        if episode.ndim != 1 or not np.array_equal(episode, episode.astype(np.int64)):
            raise ValueError('episode must hold one integer per sample, the number of its '
                             f'episode, got an array {episode.shape} of {episode.dtype}')
        object.__setattr__(self, 'episode', episode)
        for name in ('x', 'dxdt', 'u'):
            array = np.ascontiguousarray(real(getattr(self, name), name))
            if array.ndim != 2 or len(array) != len(self):
                raise ValueError(
                    f'incompatible {name}: expected ({len(self)}, n), got {array.shape}: pass one '
                    f'row per sample and one column per signal, {name}[:, None] for a single one')
            if count := np.count_nonzero(~np.isfinite(array)):
                raise ValueError(
                    f'{name} contains {count} values that are not finite: remove those samples')
            object.__setattr__(self, name, array)
        if self.x.shape != self.dxdt.shape:
            raise ValueError(f'incompatible dxdt: expected {self.x.shape}, got {self.dxdt.shape}')
        if self.time is not None:
            time = np.ascontiguousarray(self.time, dtype=np.float64)
            if time.shape != (len(self),):
                raise ValueError(f'incompatible time: expected ({len(self)},), got {time.shape}')
            # an episode's samples need not lie side by side
            order = np.argsort(self.episode, kind='stable')
            within = np.diff(np.asarray(self.episode)[order]) == 0
            if not (np.all(np.isfinite(time)) and np.all(np.diff(time[order])[within] > 0.0)):
                raise ValueError('time must increase from sample to sample within an episode: '
                                 'sort the samples and remove repeated ones')
            object.__setattr__(self, 'time', time)

    def __len__(self) -> int:
        return len(self.episode)

    def take(self, episodes: np.ndarray) -> DriftSamples:
        """Return the samples of some episodes."""
        return self.where(np.isin(self.episode, episodes))

    def where(self, keep: NDArray[np.bool_]) -> DriftSamples:
        """Return the samples that a mask (N,) keeps."""
        return DriftSamples(self.x[keep], self.dxdt[keep], self.u[keep], self.episode[keep],
                            None if self.time is None else self.time[keep])

    def digest(self) -> str:
        """Return the SHA-256 of the samples, in hexadecimal."""
        sha = hashlib.sha256()
        for array in (self.x, self.dxdt, self.u, np.asarray(self.episode, dtype=np.int64)):
            sha.update(np.ascontiguousarray(array).astype('<f8').tobytes())
        return sha.hexdigest()


def split_by_episode(samples: DriftSamples, seed: int) -> tuple[DriftSamples, DriftSamples,
                                                                DriftSamples]:
    """
    Split samples into training (three fifths), validation and test by whole episodes.

    :raises ValueError: with fewer than three episodes.
    """
    episodes = np.unique(samples.episode)
    if len(episodes) < 3:
        raise ValueError('training needs at least 3 episodes, because some are held out, got '
                         f'{len(episodes)}: record more, or split the record into episodes')
    order = np.random.default_rng(seed).permutation(episodes)
    held = max(1, len(episodes) // 5)
    return (samples.take(order[2 * held:]), samples.take(order[:held]),
            samples.take(order[held:2 * held]))
