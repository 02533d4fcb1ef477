# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Closed loops where a model's data are, in which its law is compared with others."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import contextlib
from dataclasses import dataclass, replace
import math

import numpy as np
from numpy.typing import NDArray

from koopman_ros.control.laws import Law, StateDependentRiccati, Weights
from koopman_ros.core.arrays import Array
from koopman_ros.core.solvers import solve_riccati
from koopman_ros.evaluation.closed_loop_batch import (
    DriftPlant,
    judge_loops,
    LoopBatch,
    Rate,
)
from koopman_ros.evaluation.closed_loop_settings import ClosedLoopSettings, SETTINGS
from koopman_ros.execution import Backend, Serial
from koopman_ros.model import Coordinates, LiftedModel, VerifiedLoops
from koopman_ros.model.training_data import MAX_TRIED_LOOPS
from koopman_ros.tuning import InputLimits, Tuning

#: Closed loops that a law is judged by.
LOOPS = SETTINGS.loops


@dataclass(frozen=True, eq=False)
class ClosedLoopTest:
    """N closed loops under a model's law from states to set-points where its data are."""

    states: Coordinates  #: names and units
    starts: Array  #: (N, n_x) where they began, in state units
    setpoints: Array  #: (N, n_x) where they were to go
    #: (N,) cost over that of the better of two linear laws, that of the plant's linearisation and
    #: that of the model's; infinite where the law does not arrive and 0 where these do not
    ratios: Array
    no_gain: NDArray[np.bool_]  #: (N,) whether the law had no gain somewhere on the way
    #: (N,) cost over that of the averaged law that knows the drift; infinite where the law does
    #: not arrive but that one does, and 0 where that one does not or needs the last fifth of the
    #: inputs' range
    excess: Array
    #: loops in which no law arrives within the inputs' limits; they are judged without these, and
    #: do not count where none arrives then
    hopeless: int
    settings: ClosedLoopSettings = SETTINGS

    @property
    def poor(self) -> NDArray[np.bool_]:
        """Whether each loop (N,) had no gain, no arrival, or over 1.1 times a linear cost."""
        return np.asarray(~(self.ratios <= self.settings.most_cost))

    @property
    def failed(self) -> NDArray[np.bool_]:
        """Whether in each loop (N,) a perfect model would cost clearly less, by 1.05."""
        return np.asarray(~(self.excess <= self.settings.most_excess))

    @property
    def lost(self) -> NDArray[np.bool_]:
        """Whether each loop (N,) had no gain or failed to reach it, where a linear law does."""
        return np.isinf(self.ratios)

    @property
    def tried(self) -> VerifiedLoops | None:
        """The loops as a model keeps them, so that another law acts in the lost ones; or None."""
        lost = self.lost[:MAX_TRIED_LOOPS]
        if not lost.any():
            return None
        starts, setpoints = (self.states.to_deviation(x[:MAX_TRIED_LOOPS])
                             for x in (self.starts, self.setpoints))
        return VerifiedLoops(starts, setpoints, lost)

    @property
    def loops(self) -> int:
        """Number of loops that count, N."""
        return len(self.ratios)

    @property
    def arrived(self) -> int:
        """Number of those that reached their set-point."""
        return int(np.sum(np.isfinite(self.ratios) & np.isfinite(self.excess)))

    @property
    def share_failed(self) -> float:
        """Share of the loops that failed by the model; 1 where none counts."""
        return float(np.mean(self.failed)) if self.loops else 1.0

    @property
    def accepted(self) -> bool:
        """Whether the model may control: at most 1 % of the loops failed by its fault."""
        return self.share_failed <= self.settings.most_failures

    @property
    def median_ratio(self) -> float:
        """Median of the ratios of costs; NaN without loops."""
        return float(np.median(self.ratios)) if self.loops else math.nan

    @property
    def worst_ratio(self) -> float:
        """Largest ratio of costs; NaN without loops."""
        return float(np.max(self.ratios)) if self.loops else math.nan

    @property
    def region(self) -> str:
        """Return the ranges of starts and set-points of failed loops; empty where none failed."""
        failed = self.failed
        return '' if not failed.any() else (
            f'from {self._ranges(self.starts[failed])} to set-points '
            f'{self._ranges(self.setpoints[failed])}')

    def _ranges(self, x: Array) -> str:
        step = self.settings.rounded * (self.states.upper - self.states.lower)
        # round 1e-17 and -0 to 0
        low, high = (step * np.round(end / step) + 0.0 for end in (x.min(axis=0), x.max(axis=0)))
        return ', '.join(
            f'{name} {a:.4g}{f" to {b:.4g}" if b > a else ""} {unit}'.rstrip()
            for name, unit, a, b in zip(self.states.names, self.states.units, low, high,
                                        strict=True))

    def __str__(self) -> str:
        """Return in one clause how many loops failed, how, and where."""
        if not self.loops:
            return ('no law, not even a linear one, reaches the set-point in any of '
                    f'{self.hopeless} closed loops' if self.hopeless else
                    'no closed loop could be tried: no steady state within the limits of the '
                    'inputs is far enough from the starts; record several steady states, or '
                    'widen the limits')
        text = (f'the controller fails in {np.sum(self.failed)} of {self.loops} simulated closed '
                'loops')
        if not self.failed.any():
            sound = self.ratios[~self.poor]
            worst = float(np.max(sound)) if len(sound) else math.nan
            rest = '' if not self.poor.any() else (
                f', except in {np.sum(self.poor)} loops that are costly with a perfect model as '
                'well')
            return f'{text}; its cost is at most {worst:.3g} times that of a linear law{rest}'
        failed, lost = self.failed, np.isinf(self.excess)
        counts = ((int(np.sum(failed & self.no_gain)), 'it has no gain'),
                  (int(np.sum(failed & lost & ~self.no_gain)), 'it does not reach the set-point'),
                  (int(np.sum(failed & ~lost)),
                   f'it costs over {self.settings.most_excess:g} times as much as with a perfect '
                   'model'))
        how = ', '.join(f'in {n} {what}' for n, what in counts if n)
        return f'{text} ({how}), {self.region}'

    def __repr__(self) -> str:
        """Keep the arrays out."""
        return f'<ClosedLoopTest: {self}>'


@dataclass(frozen=True)
class _Undisturbed:
    """A rate of states and manipulated inputs, the measured disturbances at nominal values."""

    rate: Rate
    model: LiftedModel  # that has them as disturbances
    order: tuple[int, ...]  # of the inputs of the rate among inputs, then disturbances

    def __call__(self, x: Array, u: Array) -> Array:
        d = np.broadcast_to(self.model.disturbances.center,
                            (*u.shape[:-1], len(self.model.disturbances)))
        return self.rate(x, np.concatenate([u, d], axis=-1)[..., self.order])


def evaluate_closed_loops(model: LiftedModel, rate: Rate, *, tuning: Tuning | None = None,
                          law: type[Law] = StateDependentRiccati,
                          limits: InputLimits | None = None, interval: float = 0.0,
                          noise: Array | None = None, loops: int | None = None, seed: int = 0,
                          watch: Callable[[float], bool] = lambda _: False,
                          backend: Backend | None = None, disturbances: Sequence[str] = (),
                          settings: ClosedLoopSettings = SETTINGS) -> ClosedLoopTest | None:
    """
    Test a model's law in closed loops on a drift that the model was not learned from.

    A loop fails if it costs more than 1.05 times as much as with the averaged law that knows that
    drift, or does not reach the set-point although that law does, also with four fifths of the
    range of the inputs: a better model would do better. It is poor if the law has no gain, does
    not reach the set-point, or costs more than 1.1 times the better of two linear laws, without
    failing: a better model would not help.

    Starts and set-points are drawn at random near the data, within the distance of training states
    from each other; without these, from the box. Set-points are steady states of that drift under
    an input within its limits; if none is near the data, the nearest ones are used. All laws know
    that input, as with a disturbance observer at rest. Inputs are held from sample to sample, and
    act after the dead time of the model, which the law predicts as in operation; the other laws
    know the state at which each input acts. If no law reaches the set-point within the limits,
    they run again without limits, which must not hide a model that is wrong far from the data.

    :param rate: dx/dt (M, n_x) of states (M, n_x) and inputs (M, n_u), in state and input units
        and per time unit of the model; affine in the input.
    :param tuning: of all laws; by default with weights of 1 on scaled deviations.
    :param limits: of the inputs; by default those of the tuning.
    :param interval: seconds between samples; by default, and at least, half of the fastest
        time constant of the linear loop.
    :param noise: (n_x,) standard deviation of the measured states, in state units; by default 0.
    :param loops: closed loops to run, by default those of the settings; fewer where these take
        many samples.
    :param seed: of the random starts and set-points.
    :param watch: called with the share that is done; True ends the check.
    :param backend: where the loops run, 32 of them side by side; this process by default.
    :param disturbances: inputs that are measured and not manipulated; they keep their nominal
        values.
    :param settings: the other numbers of the test.
    :return: None where `watch` ended it.
    :raises ValueError: for a model without inputs.
    """
    if disturbances:
        names, model = model.inputs.names, model.with_disturbances(disturbances)
        rate = _Undisturbed(rate, model, tuple(map(model.joined.inputs.names.index, names)))
    if model.n_u == 0:
        raise ValueError('a plant without inputs cannot be controlled')
    tuning = tuning or Tuning.for_model(model, max_gain=settings.largest_gain)
    limits = limits or tuning.limits
    plant = DriftPlant(model, rate)
    linear = plant.linearised
    slowest, fastest = _closed_loop_rates(linear, Weights.physical(
        linear, tuning.state_weight, tuning.input_weight), settings)
    interval = max(interval / model.seconds_per_time_unit, 1.0 / (settings.samples * fastest))
    dead_time = float(np.max(model.dead_time)) / model.seconds_per_time_unit
    # rounding adds no sample and no step where the slowest mode is the fastest, too
    samples = math.ceil(
        (settings.duration / slowest + dead_time) / interval - settings.resolution)
    loops = min(loops or settings.loops,
                max(settings.most_calls // samples, settings.fewest_loops))
    starts, targets, inputs = _cases(plant, limits, loops, seed, settings)
    given = LoopBatch(plant, replace(tuning, limits=limits), law, interval, samples,
                      math.ceil(settings.steps * interval * fastest - settings.resolution),
                      np.zeros(model.n_x) if noise is None else noise / model.states.scale,
                      settings)
    parts = {}
    for first in range(0, max(1, len(starts)), settings.part):
        rows = slice(first, first + settings.part)
        parts[f'loops from {first + 1} on'] = starts[rows], targets[rows], inputs[rows]
    shares = dict.fromkeys(parts, 0.0)

    def watching(name: str, share: float | None) -> bool:
        if share is not None:
            shares[name] = share
        return watch(sum(shares.values()) / len(parts))

    found = []
    with contextlib.closing((backend or Serial()).run(
            judge_loops, parts, shared=given, watch=watching)) as judged:
        for name, part in judged:
            shares[name] = 1.0
            found.append(part)
    if len(found) < len(parts) or None in found:
        return None
    own, ratios, no_gain, excess, hopeless = (
        np.concatenate(of_parts) for of_parts in zip(*filter(None, found), strict=True))
    # a law that does not arrive counts where another one does
    counts = np.isfinite(own) | np.isinf(ratios) | np.isinf(excess)
    x0, x_ref = (model.states.to_physical(x[counts]) for x in (starts, targets))
    return ClosedLoopTest(model.states, x0, x_ref, ratios[counts], no_gain[counts], excess[counts],
                          int(np.sum(hopeless)), settings)


def _closed_loop_rates(linear: LiftedModel, weights: Weights, settings: ClosedLoopSettings
                       ) -> tuple[float, float]:
    """Return the slowest and the fastest rate of a linear model under its own law."""
    # not of the open loop: an integrator never settles by itself
    riccati = solve_riccati(linear.A, linear.B, weights.Q, weights.R)
    rates = np.abs(np.linalg.eigvals(linear.A - linear.B @ riccati.K).real)
    fastest = max(float(rates.max()), settings.resolution)
    # samples are as short as the fastest mode, so that the span of rates bounds the work
    return max(float(rates.min()), settings.slowest * fastest), fastest


def _cases(plant: DriftPlant, limits: InputLimits, loops: int, seed: int,
           settings: ClosedLoopSettings) -> tuple[Array, Array, Array]:
    """Return starts (M, n_x), set-points (M, n_x) and the inputs (M, n_u) that hold these."""
    model = plant.model
    n, m = model.n_x, model.n_u
    rng = np.random.default_rng(seed)
    starts = _within_data(model, loops, rng)
    anchors = _within_data(model, settings.attempts * loops, rng)
    # the nominal point, too, lest there be none
    x, v = plant.steady_states(
        np.vstack([np.zeros(n), anchors]),
        np.vstack([np.zeros(m), _between(model.inputs, rng.random((len(anchors), m)))]))
    u = model.inputs.to_physical(v)
    slack = settings.resolution * model.inputs.scale
    held = ((u >= limits.lower - slack) & (u <= limits.upper + slack)).all(axis=1)
    x, v = x[held], v[held]
    distance = model.distances(x)
    near = distance <= settings.resolution
    if len(x) and not near.any():
        # a plant that never rested in the record: at the steady states nearest to it
        near = distance <= np.quantile(distance, settings.nearest)
    x, v = x[near], v[near]
    chosen: list[tuple[int, int]] = []
    for k, start in enumerate(starts):
        apart = np.flatnonzero(np.max(np.abs(x - start), axis=1, initial=0.0) >= settings.apart)
        if len(apart):
            chosen.append((k, int(rng.choice(apart))))
    first, second = np.array(chosen, dtype=np.int64).reshape(-1, 2).T
    return starts[first], x[second], v[second]


def _between(box: Coordinates, shares: Array) -> Array:
    """Return scaled deviations at these shares (M, n) of the way through a box."""
    return box.to_deviation(box.lower + shares * (box.upper - box.lower))


def _within_data(model: LiftedModel, count: int, rng: np.random.Generator) -> Array:
    """Draw states (M, n_x) where the data are: in the box, or around training states in it."""
    known, shares = model.training_states, rng.random((count, model.n_x))
    if known is None:
        return _between(model.states, shares)
    states = model.states
    lower, upper = states.to_deviation(states.lower), states.to_deviation(states.upper)
    around = (2.0 * shares - 1.0) * known.fill_distance * 0.5 * (upper - lower)
    places = known.states[rng.integers(len(known.states), size=count)]
    return np.clip(places + around, lower, upper)
