# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The free run of a model: a simulation of a whole record by its inputs alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
import math
from numbers import Integral
import os
from pathlib import Path
from typing import TypeAlias

import numpy as np
from scipy.optimize import least_squares, OptimizeResult

from koopman_ros.core.arrays import Array, expect, frozen, short_repr, show_printed
from koopman_ros.core.datasets import Episode, PlantDescription
from koopman_ros.core.plots import axis_label, drawing, time_axis, zoom
from koopman_ros.core.solvers import differences
from koopman_ros.core.units import difference_text, SECONDS_PER_TIME_UNIT, shown
from koopman_ros.learning.identification import Drift, Identified, longest_step, Segments
from koopman_ros.learning.identification.drift import Rate
from koopman_ros.learning.lift.metrics import lifted_rate
from koopman_ros.learning.lift.training import Trained
from koopman_ros.learning.model_selection import ClassComparison
from koopman_ros.model import COMMANDED, Coordinates, LiftedModel
from koopman_ros.records import Record

#: whatever has a drift
AnyModel: TypeAlias = LiftedModel | Trained | ClassComparison | Drift | Identified

FREE_RUN = 'free_run'  #: metric of a model: error of its free run of its record, by state

_GUESSES = (0.6, -0.6)  # starts of unmeasured states that are tried besides 0, in half-ranges
_EVALUATIONS = 30  # of the search from each of them
_LOST = 1e3  # error of a start that diverges, in half-ranges
# The first samples of another day err by more than so many times the usual error. A steady state
# that is a half-range elsewhere then counts as much as such an error of a sample.
_OTHER_DAY = 1.5
_INIT = 50  # samples to which a start is fitted
# A disturbance is fitted to samples of so many slowest time constants: it shows no sooner.
_MEMORIES = 2.0
# A Runge-Kutta step of a sample, as in the identification, follows motion up to this angle in it;
# of faster motion, it takes up to so many steps in two samples.
_RESOLVED, _FINEST = 2.0, 50.0
_PICTURED = 3  # episodes of a picture


@dataclass(frozen=True)
class FreeRun:
    """A simulation of a record, with its errors after the samples that determine the start."""

    names: tuple[str, ...]  #: (n_y,) of the measured states
    units: tuple[str, ...]  #: (n_y,) their units, those of the model
    plant: PlantDescription  #: of the record
    episodes: tuple[Episode, ...]  #: of the record, the states as named and in these units
    #: (N, n_x) for each episode, simulated states at its measurements, the measured ones first;
    #: not finite after a divergence
    paths: tuple[Array, ...]
    init: int  #: first samples of each episode, to which the start is fitted
    #: (M, n_x) constant disturbances of the rates of the states, in the order of the model and its
    #: units per time unit of the record
    disturbances: Array
    rmse: Array  #: (n_y,) root mean square error after those; infinite after a divergence
    #: (n_y,) share of the motion that is explained, 1 - ||y - y_model|| / ||y - mean(y)||, in %
    fit: Array

    __repr__ = short_repr
    _repr_pretty_ = show_printed

    def __str__(self) -> str:
        """Show the errors."""
        count = sum(map(len, self.episodes))
        return '\n  '.join([
            f'free run of {count} measurements, with the start fitted to the first {self.init}:',
            *(f'{name}: {self._fit_text(i)}' if self._diverges(i) else
              f'{name}: error {difference_text(self.rmse[i], self.units[i])}, {self._fit_text(i)}'
              for i, name in enumerate(self.names))])

    def _diverges(self, i: int) -> bool:
        # an error of a hundred times the motion has no figure that tells more
        return not self.fit[i] > -1e4

    def _fit_text(self, i: int) -> str:
        return 'diverges' if self._diverges(i) else f'fit {self.fit[i]:.1f} %'

    def error_text(self) -> str:
        """Return the errors in a line."""
        return ', '.join(f'{difference_text(rmse, unit)} in {name}' for name, unit, rmse in zip(
            self.names, self.units, self.rmse, strict=True))

    @property
    def diverged(self) -> bool:
        """Whether an episode cannot be simulated to its end."""
        return not np.all(np.isfinite(self.rmse))

    @property
    def leaves(self) -> float:
        """First time at which the simulation errs by more than the measured range, or NaN."""
        n_y = len(self.names)
        measured = np.concatenate([episode.x for episode in self.episodes])
        most = np.nanmax(measured, axis=0) - np.nanmin(measured, axis=0)
        for episode, path in zip(self.episodes, self.paths, strict=True):
            near = (np.abs(path[:, :n_y] - episode.x) <= most) | np.isnan(episode.x)
            if not near.all():
                return float(episode.time[np.argmin(near.all(axis=1))])
        return np.nan

    def draw(self, path: str | os.PathLike[str], title: str = '') -> None:
        """
        Draw measurements, simulation and inputs of the first episodes, as PNG.

        A simulation that diverges is cut near the measurements.

        :param title: by default the name of the record's plant.
        :raises ImportError: without matplotlib.
        """
        episodes = self.episodes[:_PICTURED]
        inputs, n_y = self.plant.input_names, len(self.names)
        rows, columns = n_y + len(inputs), len(episodes)
        seconds = SECONDS_PER_TIME_UNIT[self.plant.time_unit]
        time_unit, second = time_axis(seconds * max(
            one.time[-1] - one.time[0] for one in episodes))
        with drawing(Path(path), rows, columns, size=(7.0 * columns, 2.2 * rows + 0.8),
                     sharex='col') as (figure, panels):
            for k, (episode, simulated) in enumerate(zip(episodes, self.paths, strict=False)):
                times = seconds / second * episode.time
                for i in range(rows):
                    axes = panels[i * columns + k]
                    if i < n_y:
                        unit = self.units[i]
                        axes.plot(times, shown(episode.x[:, i], unit), '.', color='0.6',
                                  markersize=3.0, label='measured')
                        axes.plot(times, shown(simulated[:, i], unit), color='tab:green',
                                  label='free run')
                        axes.axvspan(times[0], times[min(self.init, len(episode)) - 1],
                                     color='0.93', label='start')
                        zoom(axes, shown(episode.x[:, i], unit))
                        name = self.names[i]
                        if not k:
                            axes.set_title(self._fit_text(i), loc='left', fontsize=8)
                    else:
                        j = i - n_y
                        name, unit = inputs[j], self.plant.input_units[j]
                        axes.step(times, shown(
                            episode.inputs_at(episode.time)[:, j], unit), where='post',
                            color='tab:blue')
                    axes.set_ylabel(axis_label(name, unit))
                panels[k].legend(fontsize=8, loc='lower right', bbox_to_anchor=(1.0, 1.0), ncols=3,
                                 frameon=False)
                panels[(rows - 1) * columns + k].set_xlabel(f'time [{time_unit}]')
            figure.suptitle(title or f'Free run of {self.plant.name}', fontsize=10)


def simulate(model: AnyModel, record: Record, init: int | None = None, *,
             usual: Array | None = None, offsets: Array | None = None,
             picture: str | os.PathLike[str] = '') -> FreeRun:
    """
    Simulate a whole record by its inputs alone, and compare with the measurements.

    The start of each episode, unmeasured states included, is fitted to its first samples; after
    these the simulation sees no measurement. If the first samples contradict the model, e.g. on a
    day with another ambient temperature, a constant disturbance of the rates of the measured
    states is fitted, too; a controller's disturbance observer does the same.

    :param model: a model, or anything that training or identification returns.
    :param record: with all inputs and at least one state of the model, in any units.
    :param init: samples to which the start is fitted; at most half of an episode. By default 50,
        and with a disturbance as many as two of the model's slowest time constants take, if more.
    :param usual: (n_y,) root mean square error of the model's free run over a record that it was
        learned from, in its units; by default that of the model itself. The first samples
        contradict the model where they err by more than 1.5 times that. Without it there is no
        disturbance.
    :param offsets: (M, n_x) known disturbances of the rates in the episodes, in place of that, in
        the order and units of the model per time unit of the record.
    :param picture: file of a picture to draw, ending in .png; none by default.
    :raises TypeError: for a model or a record that is none.
    :raises ValueError: for a record without the model's signals.
    """
    if not isinstance(model, AnyModel):
        raise TypeError('model must be one of learn(record).model or load(file), got '
                        f'{type(model).__name__}: check the order of the arguments')
    expect(record=(record, Record))
    if init is not None and not isinstance(init, Integral):
        raise TypeError(f'init must be a number of samples, an integer, got {init!r}')
    rate, states, inputs, dead_time = _drift(model, record.plant)
    measured = [i for i, name in enumerate(states.names) if name in record.plant.state_names]
    if not measured:
        raise ValueError(f'the record has the states {", ".join(record.plant.state_names)} and '
                         f'the model {", ".join(states.names)}: read at least one of these from '
                         f"its column, as in '{states.names[0]} = COLUMN'")
    # the measured states first, where that is not their order already
    order = [*measured, *(i for i in range(len(states)) if i not in measured)]
    some = states.only([states.names[i] for i in measured])
    record = record.of(*(dict(zip(own.names, own.units, strict=True)) for own in (some, inputs)))
    episodes = tuple(late for episode in record.episodes
                     if (late := episode.delayed(dead_time)) is not None)
    if not episodes:
        raise ValueError('no episode of the record is longer than the dead time of the model, '
                         f'{max(dead_time):g} {record.plant.time_unit}')
    if init is not None and init < 1:
        raise ValueError(f'init = {init} must be at least 1 sample')
    indexed = [replace(one, x=np.arange(1.0, 1 + len(one))[:, None]) for one in episodes]
    step = _step(rate, states, episodes)
    if usual is None and offsets is None:
        usual = _usual(model, some.names)
    usual = None if usual is None else frozen(usual, 'usual', (len(measured),), finite=False)
    known = np.zeros((len(episodes), len(states))) if offsets is None else frozen(
        offsets, 'offsets', (len(episodes), len(states)))
    indexed = [replace(one, disturbance=own) for one, own in zip(indexed, known, strict=True)]
    found = [_start(rate, states, measured, one, index, init, step, usual)
             for one, index in zip(episodes, indexed, strict=True)]
    starts, disturbances = (np.array([one[k] for one in found]) for k in range(2))
    inits, disturbances = [one[2] for one in found], disturbances + known
    segments = replace(Segments.of(indexed, step), disturbance=disturbances)
    run = segments.path(rate, starts)
    paths = tuple(run[np.flatnonzero(segments.x[:, k, 0])[:len(one)], k][:, order]
                  for k, one in enumerate(episodes))
    errors, values = (np.concatenate(parts) for parts in (
        [path[count:, :len(measured)] - one.x[count:]
         for path, one, count in zip(paths, episodes, inits, strict=True)],
        [one.x[count:] for one, count in zip(episodes, inits, strict=True)]))
    missing = np.isnan(values)
    with np.errstate(over='ignore', invalid='ignore'):
        squares = np.where(missing, 0.0, errors ** 2).sum(axis=0)
    squares = np.where(np.isfinite(squares), squares, np.inf)
    spread = np.nansum((values - np.nanmean(values, axis=0)) ** 2, axis=0)
    free_run = FreeRun(some.names, some.units, record.plant, episodes, paths, max(inits),
                       disturbances,
                       np.sqrt(squares / np.sum(~missing, axis=0)),
                       100.0 * (1.0 - np.sqrt(squares / spread)))
    if picture:
        free_run.draw(picture)
    return free_run


def _step(rate: Rate, states: Coordinates, episodes: Sequence[Episode]) -> float:
    """Return a step over which a Runge-Kutta method follows samples and the model's motion."""
    middle, half = 0.5 * (states.upper + states.lower), 0.5 * (states.upper - states.lower)
    n = len(half)
    points = middle + half * np.vstack([np.zeros(n), np.eye(n), -np.eye(n)])
    fastest = max(float(np.max(_modes(rate, states, point, episodes[0]))) for point in points)
    longest = longest_step(episodes)
    turn = fastest * longest
    return longest if turn <= 2.0 * _RESOLVED else longest / min(turn, _FINEST)


def _usual(model: AnyModel, names: Sequence[str]) -> Array | None:
    """Return the error (n_y,) of a model's free run of its record, where it is known."""
    errors: Mapping[str, float] = {}
    if isinstance(model, LiftedModel):
        errors = {name: model.provenance.metrics.get(f'{FREE_RUN}_{name}', np.nan)
                  for name in names}
    elif isinstance(model, Identified):
        errors = dict(zip(model.drift.box.states.names, model.free_run.tolist(), strict=False))
    found = np.array([errors.get(name, np.nan) for name in names])
    return None if np.any(np.isnan(found)) else found


def _drift(model: AnyModel, plant: PlantDescription
           ) -> tuple[Rate, Coordinates, Coordinates, Array]:
    """Return rate, states, inputs and dead times of a model, in the time unit of a plant."""
    seconds = SECONDS_PER_TIME_UNIT[plant.time_unit]
    if isinstance(model, Trained | ClassComparison):
        model = model.model
    if isinstance(model, LiftedModel):
        model = model.joined
        return (*_of_record(lifted_rate(model, seconds), model.states, model.inputs),
                model.dead_time / seconds)
    drift = model.drift if isinstance(model, Identified) else model
    factor = seconds / SECONDS_PER_TIME_UNIT[drift.box.time_unit]
    dead_time = model.dead_time if isinstance(model, Identified) else np.zeros(
        len(drift.box.inputs))
    return (*_of_record(lambda x, u: factor * drift.rate(x, u), drift.box.states,
                        drift.box.inputs), dead_time / factor)


def _of_record(rate: Rate, states: Coordinates, inputs: Coordinates
               ) -> tuple[Rate, Coordinates, Coordinates]:
    """Return rate and states without those that are commands, and so inputs of a record."""
    commands = {states.names.index(COMMANDED + name): j for j, name in enumerate(inputs.names)
                if COMMANDED + name in states.names}
    if not commands:
        return rate, states, inputs
    kept = [i for i in range(len(states)) if i not in commands]

    def of_others(x: Array, u: Array) -> Array:
        full = np.empty((*x.shape[:-1], len(states)))
        full[..., kept], full[..., list(commands)] = x, u[..., list(commands.values())]
        return rate(full, u)[..., kept]

    return of_others, states.only([states.names[i] for i in kept]), inputs


def _start(rate: Rate, states: Coordinates, measured: Sequence[int], episode: Episode,
           indexed: Episode, init: int | None, step: float, usual: Array | None
           ) -> tuple[Array, Array, int]:
    """Return the start (n_x,) that fits the first samples best, a disturbance (n_x,), and them."""
    most, n_x = max(1, len(episode) // 2), len(states)
    count = min(_INIT if init is None else init, most)
    first = _FirstSamples(rate, states, measured, episode, indexed, count, step)
    hidden = [i for i in range(n_x) if i not in measured]
    shifts = [np.zeros(n_x), *(guess * row for row in np.eye(n_x)[hidden]
                               for guess in _GUESSES)]
    best = min((first.fitted(first.home + shift) for shift in shifts),
               key=lambda one: float(one.cost)).x
    if usual is not None and first.error(best, usual / states.scale[measured]) > _OTHER_DAY:
        memory = _memory(rate, states, states.to_physical(best), episode)
        if init is None:
            period = float(np.median(np.diff(episode.time)))
            count = max(count, min(math.ceil(_MEMORIES * memory / period), most))
        first = _FirstSamples(rate, states, measured, episode, indexed, count, step, memory)
        best = first.fitted(np.append(best, np.zeros(len(measured)))).x
    return states.to_physical(best[:n_x]), first.disturbance(best[None])[0], count


class _FirstSamples:
    """
    Errors of simulations from different starts over the first samples of an episode.

    :param memory: time constant, in which disturbances are counted.
    :ivar home: start (n_x,) as measured, in deviations.
    """

    def __init__(self, rate: Rate, states: Coordinates, measured: Sequence[int], episode: Episode,
                 indexed: Episode, count: int, step: float, memory: float = 1.0) -> None:
        self._rate, self._states, self._measured = rate, states, measured
        self._memory, self._known = memory, indexed.disturbance
        self._segments = Segments.of([indexed.part(0, max(2, count))], step)
        self._rows = np.flatnonzero(self._segments.x[:, 0, 0])[:count]
        self._y = states.only([states.names[i] for i in measured]).to_deviation(episode.x[:count])
        self._present = ~np.isnan(self._y)
        self.home = np.zeros(len(states))
        for i, column, seen in zip(measured, self._y.T, self._present.T, strict=True):
            if seen.any():
                self.home[i] = column[seen][0]

    def disturbance(self, p: Array) -> Array:
        """Return that (S, n_x) of parameters (S, n_x or n_x + n_y), in state units."""
        n_x = len(self._states)
        found = np.zeros((len(p), n_x))
        found[:, self._measured] = (p[:, n_x:] if p.shape[1] > n_x else 0.0) / self._memory
        return found * self._states.scale

    def errors(self, p: Array) -> Array:
        """Return the errors (S, m) from starts (S, n_x), side by side, in half-ranges."""
        n_x = len(self._states)
        path = replace(
            self._segments.repeated(len(p)), disturbance=self._known + self.disturbance(p)
            ).path(self._rate, self._states.to_physical(p[:, :n_x]))
        found = self._states.to_deviation(path[self._rows])[..., self._measured] - self._y[:, None]
        return np.hstack((np.clip(np.nan_to_num(
            np.swapaxes(found, 0, 1)[:, self._present], nan=_LOST), -_LOST, _LOST), p[:, n_x:]))

    def fitted(self, start: Array) -> OptimizeResult:
        """Return the best parameters near others, as SciPy does."""
        def slopes(p: Array) -> Array:
            reference, *others = self.errors(
                p + 1e-4 * np.vstack([np.zeros(len(p)), np.eye(len(p))]))
            return np.transpose(np.subtract(others, reference)) / 1e-4

        return least_squares(lambda p: self.errors(p[None])[0], start, slopes,
                             max_nfev=_EVALUATIONS)

    def error(self, start: Array, usual: Array) -> float:
        """Return the root mean square error from a start, in usual ones (n_y,) in deviations."""
        squares = np.zeros(self._present.shape)
        squares[self._present] = self.errors(start[None])[0] ** 2
        return float(np.sqrt(np.mean(np.mean(squares, axis=0) / usual ** 2)))


def _memory(rate: Rate, states: Coordinates, x: Array, episode: Episode) -> float:
    """Return the slowest time constant at a state (n_x,), at most the time of the episode."""
    duration = float(episode.time[-1] - episode.time[0])
    return 1.0 / max(float(np.min(_modes(rate, states, x, episode))), 1.0 / duration)


def _modes(rate: Rate, states: Coordinates, x: Array, episode: Episode) -> Array:
    """Return the sizes (n_x,) of the eigenvalues at a state, under the episode's first input."""
    u = np.repeat(episode.u[:1], len(states), axis=0)
    return np.abs(np.linalg.eigvals(differences(lambda y: rate(y, u), x, states.scale)))
