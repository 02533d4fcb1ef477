# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Training of a lifted model from samples: split, scaling, rounds of starts, held-out report."""

from __future__ import annotations

from collections.abc import Callable, Generator
import contextlib
from dataclasses import dataclass, replace
from functools import cached_property
import math
import multiprocessing
import signal
import warnings

import joblib
import numpy as np
import torch

from koopman_ros import __version__
from koopman_ros.arrays import brief
from koopman_ros.control.law_check import check_law, LawCheck, LOOPS, Rate
from koopman_ros.learning.baselines import Algorithm1, Edmd
from koopman_ros.learning.contradictions import check_nominal_point, check_rates
from koopman_ros.learning.drift import NeuralDrift, SMALLEST, with_readout
from koopman_ros.learning.frame import Frame
from koopman_ros.learning.growth import Grown, Growth, Monitor
from koopman_ros.learning.inputs import InputModel
from koopman_ros.learning.levenberg_marquardt import MinimumStatus, PATIENCE
from koopman_ros.learning.residuals import deviations, ScaledSamples
from koopman_ros.learning.validation import evaluate, Figures, Fit, fit, lifted_rate, ROUNDING
from koopman_ros.lifting import Box, LiftedModel, NetworkObservables, Provenance, TrainingStates
from koopman_ros.plant_data import Array, Plant, Samples, split_by_episode

# Polynomials on which a law is tried.
_HIGHEST_DEGREE = 5
_SAMPLES_OF_MONOMIAL = 5

Recipe = Growth | Algorithm1 | NeuralDrift


@dataclass(frozen=True)
class Progress:
    """Progress of a training."""

    n_z: int  #: coordinates being learned
    finished: int  #: starts that finished, over all rounds
    total: int  #: starts in all
    iteration: int  #: step within a start that is under way in this process, else 0
    residual: float  #: root mean square of the residuals there, else NaN
    rw: float  #: best validation figure so far, NaN before the first
    checked: float = 0.0  #: share that is done of the closed loops, which come last
    name: str = ''  #: of the class that is being learned, where several are compared


# Called after every step and start; True ends the training with the best so far.
Watch = Callable[[Progress], bool]


@dataclass(frozen=True)
class Trained:
    """A trained model with its figures and those of the linear model."""

    #: the winner, with its figures on the untouched test episodes in its provenance
    model: LiftedModel
    figures: Figures  #: those figures
    linear: Figures  #: the figures of the linear model that fits the training episodes best
    #: closed loops of the winner's law; None without inputs, when none were wanted, and when they
    #: were interrupted
    law_check: LawCheck | None
    status: str  #: the sentence with which its training ended
    #: the winner of every round, smallest n_z first, each with its figures
    path: tuple[LiftedModel, ...]
    starts: int  #: number of starts that finished

    __repr__ = brief


class NoUsefulLift(ValueError):  # noqa: N818
    """Training ended without a lift that is better than a linear model; the message says why."""

    law_check: LawCheck | None = None  #: the closed loops of a lift whose law failed


@dataclass(frozen=True)
class _Candidate:
    grown: Grown
    model: LiftedModel  # its drift read off the rate of z or out of its features
    # of a lift by the rate of z, since features hide that z has lost a state; of a drift its own
    fit: Fit

    @property
    def score(self) -> float:
        """Figure that starts are compared by: rw alone does not see a state that is lost."""
        return self.fit.rw + self.fit.rx


def train(plant: Plant, samples: Samples, recipe: Recipe, *, seed: int = 0, starts: int = 4,
          split_seed: int = 0, watch: Watch | None = None, refuse: bool = True,
          loops: int = LOOPS, device: str = 'cpu', threads: int = 1) -> Trained:
    """
    Learn a lifted model in rounds of starts, of which validation episodes choose the best.

    A fifth of the episodes chooses the winner of each round and another fifth, touched by nothing
    else, gives the figures reported. The starts of a round run through joblib: within
    ``joblib.parallel_config(...)`` they run in processes, or on a Dask cluster, and give the same
    model as one after the other. An interrupt from the keyboard ends the training and keeps the
    best so far.

    :param plant: names, units, nominal point, and B where it is known.
    :param samples: at least three episodes.
    :param starts: number of starts in each round; their seeds are drawn from `seed`.
    :param split_seed: seed of the split into training, validation and test episodes.
    :param refuse: whether a lift that is no better than the linear model, or whose law fails, is
        refused.
    :param loops: closed loops in which the law is tried before, see
        :func:`~koopman_ros.control.law_check.check_law`; 0 for none.
    :param device: where the residuals are evaluated, as torch names it.
    :param threads: torch's threads for each start, for a number of which the bits are the same.
    :raises NoUsefulLift: when no start gives a lift that can be judged, or none that beats the
        linear model on validation episodes, or when its law fails in closed loop.
    :raises ValueError: on too few episodes, held-out episodes that hardly move, a recipe that
        does not fit, times that contradict the derivatives, or a nominal point where the plant
        moves.
    :raises KeyboardInterrupt: when interrupted before the first start finished.
    """
    if starts < 1:
        raise ValueError(f'starts must be at least 1, got {starts}')
    rounds = recipe.rounds(samples.x.shape[1])
    parts = split_by_episode(samples, split_seed)
    box = Box.of(plant, samples.x, samples.u)
    check_rates(plant, samples)
    check_nominal_point(plant, samples, box)
    assembly = _Assembly(plant, box, parts[0], samples.digest(), seed,
                         training_states(box, samples),
                         recipe.pre_feedback if isinstance(recipe, Growth) else None)
    data = assembly.data(device)
    tracker = _Tracker(watch, starts * len(rounds))
    path: list[_Candidate] = []
    reasons: list[str] = []
    for n_z in rounds:
        tracker.n_z = n_z
        parent = path[-1].grown if path else None
        best: _Candidate | None = None
        interrupted = False
        try:
            with contextlib.closing(_run_starts(recipe, data, n_z, parent, seed, starts,
                                                threads, tracker)) as finds:
                for grown in finds:
                    candidate = _judged(assembly, grown, parts[1])
                    if isinstance(candidate, str):
                        reasons.append(candidate)
                    elif best is None or candidate.score < best.score:
                        best = candidate
                    tracker.finish(best.fit.rw if best else math.nan)
                    if tracker.stop or (not isinstance(grown, str)
                                        and grown.status is MinimumStatus.INTERRUPTED):
                        interrupted = True
                        break
        except KeyboardInterrupt:
            if best is None and not path:
                raise
            interrupted = True
        if best is None and not interrupted:
            raise NoUsefulLift(f'no start gave a usable lift with n_z = {n_z}: {reasons[-1]}')
        # a start that was cut short may be worse than the round before
        if best is not None and not (interrupted and path and best.score >= path[-1].score):
            path.append(best)
        if interrupted:
            break
    if not path:
        raise NoUsefulLift(reasons[-1] if reasons else 'stopped before a start finished')
    return _conclude(plant, parts, path, interrupted, tracker, loops if refuse else 0, refuse)


def _conclude(plant: Plant, parts: tuple[Samples, Samples, Samples], path: list[_Candidate],
              interrupted: bool, tracker: _Tracker, loops: int, refuse: bool) -> Trained:
    """Compare the winner with the linear model and report on the untouched episodes."""
    winner = path[-1]
    box = Box(winner.model.states, winner.model.inputs, plant.time_unit)
    linear = Edmd(degree=1).learn(plant, parts[0], box)
    rx = fit(linear, parts[1].x, parts[1].dxdt, parts[1].u).rx
    if refuse and not winner.fit.rx + ROUNDING < rx:
        raise NoUsefulLift(
            f'the lift with n_z = {winner.model.n_z} does not predict the motion better than a '
            f'linear model (relative error rx = {winner.fit.rx:.2g} against {rx:.2g} on '
            'validation episodes): keep the linear model, or excite the plant over a wider range'
            + ('' if winner.model.identity else ', or use identity coordinates'))
    law_check = None
    if loops and winner.model.n_u:
        # one that was ended before gets its loops all the same
        watch = (lambda _: False) if tracker.stop else tracker.check
        with contextlib.suppress(KeyboardInterrupt):
            law_check = check_law(winner.model, reference_drift(plant, box, parts, winner.model),
                                  loops=loops, watch=watch)
        interrupted = interrupted or law_check is None
        if law_check is not None and not law_check.accepted:
            refusal = NoUsefulLift(
                f'the lift with n_z = {winner.model.n_z} is no controller: {law_check}: use '
                f'{_remedies(winner.model)}')
            refusal.law_check = law_check
            raise refusal
    models, figures = [], []
    for candidate in path:
        figures.append(evaluate(candidate.model, parts[2]))
        metrics = figures[-1].metrics(candidate.model.states.names)
        models.append(replace(candidate.model, provenance=replace(
            candidate.model.provenance, metrics=metrics)))
    if law_check is not None:
        models[-1] = replace(models[-1], tried_loops=law_check.tried)
    return Trained(models[-1], figures[-1], evaluate(linear, parts[2]), law_check,
                   _ending(winner.grown, interrupted), tuple(models), tracker.finished)


def _remedies(model: LiftedModel) -> str:
    """Say what else can be tried than this lift."""
    identity = [] if model.identity else ['identity coordinates']
    smaller = ['a smaller n_z'] if model.n_z > model.n_x + model.identity else []
    return ', '.join([*identity, *smaller, 'more starts, or a narrower range'])


def _ending(grown: Grown, interrupted: bool) -> str:
    """Say how a training ended, and where at a limit how far it was from its end."""
    if interrupted:
        return MinimumStatus.INTERRUPTED.value
    return grown.status.value + ('' if math.isnan(grown.decrease) else (
        f'; with n_z = {grown.layout.n_z} the last {PATIENCE} steps took '
        f'{100.0 * grown.decrease:.2g} % off the cost'))


def reference_drift(plant: Plant, box: Box, parts: tuple[Samples, Samples, Samples],
                    model: LiftedModel) -> Rate:
    """
    Return the drift that predicts the validation episodes best, on which a law is tried.

    Polynomials, which share nothing with the lift but its samples, or the lift's own drift where
    it is better than all of them: errors of the polynomials should not count against it.
    """
    candidates = [model]
    for degree in range(1, _HIGHEST_DEGREE + 1):
        # with so few samples to a monomial it would follow each of them
        if math.comb(model.n_x + degree, degree) * _SAMPLES_OF_MONOMIAL <= len(parts[0]):
            candidates.append(Edmd(degree).learn(plant, parts[0], box))
    rates = [lifted_rate(one, one.seconds_per_time_unit) for one in candidates]
    errors = [float(np.sum(((rate(parts[1].x, parts[1].u) - parts[1].dxdt) / box.states.scale
                            ) ** 2)) for rate in rates]
    return rates[int(np.argmin(errors))]


def training_states(box: Box, samples: Samples) -> TrainingStates | None:
    """Return where the data are, held-out ones included; None for one state: its box says it."""
    states = box.states
    return None if len(states) == 1 else TrainingStates.of(
        states.to_deviation(samples.x), 0.5 * (states.upper - states.lower) / states.scale)


def _judged(assembly: _Assembly, grown: Grown | str, validation: Samples) -> _Candidate | str:
    """Return the candidate of a start, or why it has none."""
    if isinstance(grown, str):
        return grown
    if grown.status is MinimumStatus.STALLED:
        return grown.status.value
    try:
        model = assembly.model(grown)
        readings = [model, *(with_readout(model, assembly.samples, smallest)
                             for smallest in SMALLEST)]
        fits = [fit(reading, validation.x, validation.dxdt, validation.u) for reading in readings]
        best = int(np.nanargmin([found.rx for found in fits]))
    except (ValueError, np.linalg.LinAlgError) as error:
        return str(error)
    found = fits[best if grown.drift_alone else 0]
    if not math.isfinite(found.rw + found.rx):
        return 'its figures are not finite: check the data and try another seed'
    return _Candidate(grown, readings[best], found)


class _Tracker:
    """Reports progress to `watch`, and remembers whether it asked to stop."""

    def __init__(self, watch: Watch | None, total: int) -> None:
        self._watch, self._total = watch, total
        self.n_z, self.finished, self.stop = 0, 0, False
        self._rw = math.nan

    def step(self, iteration: int, cost: float) -> bool:
        return self._report(iteration, math.sqrt(2.0 * cost))

    def finish(self, rw: float) -> None:
        self.finished, self._rw = self.finished + 1, rw
        self._report(0, math.nan)

    def check(self, share: float) -> bool:
        return self._report(0, math.nan, share)

    def _report(self, iteration: int, residual: float, checked: float = 0.0) -> bool:
        if self._watch is not None and not self.stop:
            self.stop = self._watch(Progress(self.n_z, self.finished, self._total, iteration,
                                             residual, self._rw, checked))
        return self.stop


@dataclass(frozen=True)
class _Assembly:
    """Conversion of samples to the scaled problem, and of its solution to a model."""

    plant: Plant
    box: Box
    samples: Samples
    digest: str
    seed: int
    training_states: TrainingStates | None
    pre_feedback: float | None  # weight of the input, where there is to be one

    @cached_property
    def pace(self) -> float:
        """Root mean square of the scaled rates, by which time is scaled, in 1/time unit."""
        # rates of order one put the residuals of the dynamics beside the others
        rate = self.given[1] if self.frame else deviations(self.box, self.samples)[1]
        return float(np.sqrt(np.mean(rate ** 2))) or 1.0

    @cached_property
    def inputs(self) -> InputModel:
        """What is known of B."""
        return InputModel.of(self.plant, self.box, self.samples.x)

    @cached_property
    def plain(self) -> tuple[Array, Array, Array | None]:
        """States, rates without what is known of the inputs, and the regressors of the rest."""
        x, rate, u = deviations(self.box, self.samples)
        return x, *self.inputs.apart(x, rate, u)

    @cached_property
    def frame(self) -> Frame | None:
        """In which the lift is learned; None for that of the samples."""
        return None if self.pre_feedback is None else Frame.of(
            self.inputs, *self.plain, self.pre_feedback)

    @cached_property
    def given(self) -> tuple[Array, Array, Array | None]:
        """The same as `plain` in the frame."""
        return self.frame.enter(*self.plain) if self.frame else self.plain

    def data(self, device: str) -> ScaledSamples:
        x, f, regressors = self.given
        arrays = (x, f / self.pace, *([] if regressors is None else [regressors]))
        return ScaledSamples(*(torch.from_numpy(a).to(device) for a in arrays))

    def model(self, grown: Grown) -> LiftedModel:
        parts = grown.layout.split(grown.theta.cpu())
        A, B = self.pace * parts.A.numpy(), None if parts.B is None else (
            self.pace * parts.B.numpy())
        alone = grown.drift_alone
        observables = NetworkObservables(
            tuple((W.numpy(), b.numpy()) for W, b in parts.hidden),
            parts.V.numpy()[:0 if alone else None], alone or grown.layout.identity,
            grown.layout.activation)
        if self.frame:
            observables, A, B = self.frame.leave(observables, A, B)
        constant, terms = self.inputs.matrix(B)
        origin = Provenance(self.plant.name, self.seed, self.digest, {}, __version__)
        return LiftedModel(observables, A, constant, self.box.states, self.box.inputs,
                           self.box.time_unit, origin, self.training_states, input_terms=terms,
                           pre_feedback=self.frame.K if self.frame else None)


def _run_starts(recipe: Recipe, data: ScaledSamples, n_z: int, parent: Grown | None, seed: int,
                starts: int, threads: int, tracker: _Tracker) -> Generator[Grown | str]:
    """Run one round; yield what each start has found, in their order."""
    seeds = [int(n) for n in np.random.SeedSequence([seed, n_z]).generate_state(starts)]
    monitor = tracker.step if _runs_here() else None
    results = joblib.Parallel(return_as='generator')(
        joblib.delayed(_start)(recipe.of_start(i) if isinstance(recipe, Growth) else recipe, data,
                               n_z, parent, number, threads, monitor)
        for i, number in enumerate(seeds))
    try:
        # not `yield from`, which would close the results where their warning is not silenced
        for found in results:  # noqa: UP028
            yield found
    finally:
        with warnings.catch_warnings():
            # that what is under way gets cancelled is meant
            warnings.filterwarnings('ignore', '.* tasks (have been|which were)', UserWarning)
            results.close()


def _runs_here() -> bool:
    """Return whether joblib runs the starts in this process, where their steps are reported."""
    backend, jobs = joblib.parallel.get_active_backend()
    return jobs in (None, 1) and isinstance(
        backend, joblib.parallel.LokyBackend | joblib.parallel.SequentialBackend)


def _start(recipe: Recipe, data: ScaledSamples, n_z: int, parent: Grown | None, seed: int,
           threads: int, monitor: Monitor | None) -> Grown | str:
    if multiprocessing.current_process().name.startswith('LokyProcess'):
        # an interrupt of the terminal reaches the whole group: the process that waits answers it
        # and ends its workers, which between two starts would only print where they were
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        return recipe.start(data, n_z, parent, seed, monitor)
    except torch.linalg.LinAlgError as error:
        return f'a start is degenerate ({error}): check that all states move on their own'
    finally:
        torch.set_num_threads(before)
