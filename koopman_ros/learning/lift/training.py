# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Training of a lifted model from samples: split, scaling, rounds of starts, held-out report."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
import contextlib
from dataclasses import dataclass, replace
import math

import numpy as np

from koopman_ros import __version__
from koopman_ros.core.arrays import expect, short_repr, show_printed
from koopman_ros.core.datasets import DriftSamples, PlantDescription, split_by_episode
from koopman_ros.core.progress import progress_line
from koopman_ros.evaluation.closed_loop_test import (
    ClosedLoopTest,
    evaluate_closed_loops,
    LOOPS,
    Rate,
)
from koopman_ros.execution import Backend, Serial
from koopman_ros.learning.lift.data_checks import check_nominal_point, check_rates
from koopman_ros.learning.lift.edmd import Edmd
from koopman_ros.learning.lift.incremental import IncrementalTraining, TrainedLift
from koopman_ros.learning.lift.levenberg_marquardt import MinimumStatus, PATIENCE
from koopman_ros.learning.lift.metrics import (
    evaluate,
    Fit,
    fit,
    lifted_rate,
    LiftMetrics,
    ROUNDING,
)
from koopman_ros.learning.lift.multistart import Recipe, run_starts, Tracker, Watch
from koopman_ros.learning.lift.neural_drift import SMALLEST, with_readout
from koopman_ros.learning.lift.reference_drift import corrected, CorrectedRate
from koopman_ros.learning.lift.scaling import Scaling
from koopman_ros.model import Box, LiftedModel, Provenance, TrainingStates

# Polynomials on which a law is tried.
_HIGHEST_DEGREE = 5
_SAMPLES_OF_MONOMIAL = 5


@dataclass(frozen=True)
class Trained:
    """A trained model with its figures and those of the linear model."""

    #: the winner, with its figures on the untouched test episodes in its provenance
    model: LiftedModel
    figures: LiftMetrics  #: those figures
    linear: LiftMetrics  #: the figures of the linear model that fits the training episodes best
    #: closed loops of the winner's law; None without inputs, when none were wanted, and when they
    #: were interrupted
    law_check: ClosedLoopTest | None
    status: str  #: the sentence with which its training ended
    #: the winner of every round, smallest n_z first, each with its figures
    path: tuple[LiftedModel, ...]
    starts: int  #: number of starts that finished
    steps: int  #: of the minimisations of all these together

    __repr__ = short_repr
    _repr_pretty_ = show_printed

    def __str__(self) -> str:
        """Show the model."""
        return str(self.model)


class TrainingFailed(ValueError):  # noqa: N818
    """Training ended without a lift that is better than a linear model; the message says why."""


@dataclass(frozen=True)
class PreparedSamples:
    """Checked samples, split into training, validation and test episodes."""

    plant: PlantDescription  #: of the samples
    parts: tuple[DriftSamples, DriftSamples, DriftSamples]  #: for training, validation and test
    box: Box  #: of all samples
    states: TrainingStates | None  #: of all samples; None for one state, where the box says it

    @staticmethod
    def of(plant: PlantDescription, samples: DriftSamples) -> PreparedSamples:
        """Check and split samples; ValueError for times or a nominal point that do not fit."""
        parts, box = split_by_episode(samples, seed=0), Box.of(plant, samples.x, samples.u)
        check_rates(plant, samples)
        check_nominal_point(plant, samples, box)
        signals = box.states
        states = None if len(signals) == 1 else TrainingStates.of(
            signals.to_deviation(samples.x), 0.5 * (signals.upper - signals.lower) / signals.scale)
        return PreparedSamples(plant, parts, box, states)

    def linear(self) -> LiftedModel:
        """Return the linear model that fits the training episodes best."""
        return Edmd(degree=1).learn(self.plant, self.parts[0], self.box)

    def rx(self, model: LiftedModel) -> float:
        """Return the error of a model on the validation episodes."""
        part = self.parts[1]
        return fit(model, part.x, part.dxdt, part.u).rx

    def reference_drift(self, model: LiftedModel) -> Rate:
        """
        Return the drift that predicts the validation episodes best, on which a law is tried.

        Polynomials, which share nothing with the lift but its samples, or the lift's own drift
        where it is better than all of them: errors of the polynomials should not count against it.
        If it lacks much, it is corrected, so that no law is tried on a drift that is only affine.
        """
        training, validation, _ = self.parts
        candidates = [model]
        for degree in range(1, _HIGHEST_DEGREE + 1):
            # with so few samples to a monomial it would follow each of them
            if math.comb(model.n_x + degree, degree) * _SAMPLES_OF_MONOMIAL <= len(training):
                candidates.append(Edmd(degree).learn(self.plant, training, self.box))
        rates = [lifted_rate(one, one.seconds_per_time_unit) for one in candidates]
        errors = [float(np.sum(((rate(validation.x, validation.u) - validation.dxdt)
                                / self.box.states.scale) ** 2)) for rate in rates]
        return corrected(rates[int(np.argmin(errors))], self.box, training, validation)


@dataclass(frozen=True)
class _Candidate:
    grown: TrainedLift
    model: LiftedModel  # its drift read off the rate of z or out of its features
    # of a lift by the rate of z, since features hide that z has lost a state; of a drift its own
    fit: Fit

    @property
    def score(self) -> float:
        """Figure that starts are compared by: rw alone does not see a state that is lost."""
        return self.fit.rw + self.fit.rx


def train(plant: PlantDescription, samples: DriftSamples, recipe: Recipe, *, seed: int = 0,
          starts: int = 4, watch: Watch | None = None, reject: bool = True, loops: int = LOOPS,
          device: str = 'cpu', backend: Backend | None = None,
          begin: LiftedModel | None = None, budget: float = math.inf) -> Trained:
    """
    Learn a lifted model in rounds of starts, of which validation episodes choose the best.

    A fifth of the episodes chooses the winner of each round and another fifth, touched by nothing
    else, gives the figures reported. The result does not depend on the backend. An interrupt from
    the keyboard ends the training and keeps the best so far.

    :param plant: names, units, nominal point, and B where it is known.
    :param samples: at least three episodes.
    :param starts: number of starts in each round; their seeds are drawn from `seed`.
    :param watch: called with the progress; True ends the training with the best lift so far. By
        default a terminal shows the progress on one line.
    :param reject: whether a lift that is no better than the linear model, or whose law fails, is
        rejected.
    :param loops: closed loops in which the law is tried before, see
        :func:`~koopman_ros.evaluation.closed_loop_test.evaluate_closed_loops`; 0 for none.
    :param device: that evaluates the residuals, as torch names it, on every worker.
    :param backend: of starts and closed loops, see :func:`~koopman_ros.execution.backend_of`; this
        process by default.
    :param begin: a lift of a plant of the same kind that the training begins from: its coordinates
        are fitted to the samples in one start, further ones are added as usual. None to begin from
        nothing.
    :param budget: processor time in s, of which each start gets an equal part.
    :raises TrainingFailed: when no start gives a lift that can be judged, or none that beats the
        linear model on validation episodes, or when its law fails in closed loop.
    :raises ValueError: on too few episodes, held-out episodes that hardly move, a recipe or a lift
        to begin from that does not fit, times that contradict the derivatives, a nominal point
        where the plant moves, or an unknown device.
    :raises KeyboardInterrupt: when interrupted before the first start finished.
    :raises WorkerLost: when workers of the backend are lost and none takes over.
    :raises SchedulerLost: when its scheduler is.
    """
    expect(plant=(plant, PlantDescription), samples=(samples, DriftSamples))
    if starts < 1:
        raise ValueError(f'starts must be at least 1, got {starts}')
    rounds = recipe.rounds(samples.x.shape[1])
    if begin is not None:
        rounds = _further(recipe, rounds, begin)
    prepared = PreparedSamples.of(plant, samples)
    parts, box = prepared.parts, prepared.box
    backend = backend or Serial()
    scaling = Scaling.of(plant, box, parts[0],
                         recipe.pre_feedback if isinstance(recipe, IncrementalTraining) else None)
    data = scaling.data(parts[0], device)
    about = {'training_states': prepared.states,
             'provenance': Provenance(plant.name, seed, samples.digest(), {}, __version__)}
    first = (scaling.planted(recipe, begin, data)
             if begin is not None and isinstance(recipe, IncrementalTraining) else None)

    def run(n_z: int, parent: TrainedLift | None) -> Generator[tuple[str, TrainedLift | str]]:
        count = 1 if parent is None and first is not None else starts
        return run_starts(backend, recipe, data, n_z, parent or first, seed, count, tracker,
                          budget / (starts * len(rounds)))

    def judge(grown: TrainedLift | str) -> _Candidate | str:
        return _judged(grown, lambda found: scaling.model(found, **about), parts)

    with progress_line() as report:
        tracker = Tracker(
            watch or (lambda now: bool(report(now.finished / now.total, now.text))),
            starts * len(rounds) - (starts - 1) * (begin is not None))
        path, interrupted = _run_rounds(rounds, tracker, run, judge)
        return _conclude(prepared, path, interrupted, tracker, loops if reject else 0, reject,
                         backend)


def _further(recipe: Recipe, rounds: Sequence[int], begin: LiftedModel) -> tuple[int, ...]:
    """Return the rounds from those of a lift to begin from on."""
    if not isinstance(recipe, IncrementalTraining):
        raise ValueError('only IncrementalTraining can start from a lift: use it, or pass no '
                         'initial lift')
    if begin.n_z not in rounds:
        raise ValueError(f'the initial lift has {begin.n_z} coordinates, must have {rounds[0]} to '
                         f'{rounds[-1]} for a lift of {rounds[-1]}')
    return tuple(n_z for n_z in rounds if n_z >= begin.n_z)


def _run_rounds(rounds: Sequence[int], tracker: Tracker,
                run: Callable[[int, TrainedLift | None], Generator[tuple[str, TrainedLift | str]]],
                judge: Callable[[TrainedLift | str], _Candidate | str]
                ) -> tuple[list[_Candidate], bool]:
    """Return the winners of the rounds, and whether they were interrupted."""
    path: list[_Candidate] = []
    reasons: list[str] = []
    for n_z in rounds:
        tracker.n_z = n_z
        parent = path[-1].grown if path else None
        best: _Candidate | None = None
        interrupted = False
        try:
            with contextlib.closing(run(n_z, parent)) as finds:
                for _, grown in finds:
                    if not isinstance(grown, str):
                        tracker.steps += grown.iterations
                    candidate = judge(grown)
                    if isinstance(candidate, str):
                        reasons.append(candidate)
                    elif best is None or candidate.score < best.score:
                        best = candidate
                    tracker.finish(best.fit.rw if best else math.nan)
                    if tracker.stop or (not isinstance(grown, str)
                                        and grown.status is MinimumStatus.INTERRUPTED):
                        interrupted = True
                        break
            # elsewhere none may have come
            interrupted = interrupted or tracker.stop
        except KeyboardInterrupt:
            if best is None and not path:
                raise
            interrupted = True
        if best is None and not interrupted:
            raise TrainingFailed(f'no start gave a usable lift with n_z = {n_z}: {reasons[-1]}')
        # a start that was cut short may be worse than the round before
        if best is not None and not (interrupted and path and best.score >= path[-1].score):
            path.append(best)
        if interrupted:
            break
    if not path:
        raise TrainingFailed(reasons[-1] if reasons else 'stopped before a start finished')
    return path, interrupted


def _conclude(prepared: PreparedSamples, path: list[_Candidate], interrupted: bool,
              tracker: Tracker, loops: int, reject: bool, backend: Backend) -> Trained:
    """Compare the winner with the linear model and report on the untouched episodes."""
    winner, test = path[-1], prepared.parts[2]
    linear = prepared.linear()
    rx = prepared.rx(linear)
    if reject and not winner.fit.rx + ROUNDING < rx:
        raise TrainingFailed(
            f'the lift with n_z = {winner.model.n_z} does not predict the motion better than a '
            f'linear model (relative error rx = {winner.fit.rx:.2g} against {rx:.2g} on '
            'validation episodes): set model_class to linear, or excite the plant over a wider '
            'range'
            + ('' if winner.model.identity else ', or use identity coordinates'))
    law_check = None
    if loops and winner.model.n_u:
        # one that was ended before gets its loops all the same
        watch = (lambda _: False) if tracker.stop else tracker.check
        with contextlib.suppress(KeyboardInterrupt):
            reference = prepared.reference_drift(winner.model)
            law_check = evaluate_closed_loops(
                winner.model, reference, loops=loops, watch=watch, backend=backend,
                disturbances=prepared.plant.disturbance_names)
        interrupted = interrupted or law_check is None
        if law_check is not None and not law_check.accepted:
            raise TrainingFailed(f'the lift with n_z = {winner.model.n_z} does not control the '
                                 f'plant: {law_check}: use {_remedies(winner.model)}'
                                 + (reference.cause if isinstance(reference, CorrectedRate)
                                    else ''))
    models, figures = [], []
    for candidate in path:
        figures.append(evaluate(candidate.model, test))
        metrics = figures[-1].metrics(candidate.model.states.names)
        models.append(replace(candidate.model, provenance=replace(
            candidate.model.provenance, metrics=metrics)))
    if law_check is not None:
        models[-1] = replace(models[-1], verified_loops=law_check.tried)
    return Trained(models[-1], figures[-1], evaluate(linear, test), law_check,
                   _ending(winner.grown, interrupted), tuple(models), tracker.finished,
                   tracker.steps)


def _remedies(model: LiftedModel) -> str:
    """Return alternatives to this lift, in words."""
    identity = [] if model.identity else ['identity coordinates']
    smaller = ['a smaller n_z'] if model.n_z > model.n_x + model.identity else []
    return ', '.join([*identity, *smaller, 'more starts, or a narrower range'])


def _ending(grown: TrainedLift, interrupted: bool) -> str:
    """Say how a training ended, and where at a limit how far it was from its end."""
    if interrupted:
        return MinimumStatus.INTERRUPTED.value
    return grown.status.value + ('' if math.isnan(grown.decrease) else (
        f'; with n_z = {grown.layout.n_z} the last {PATIENCE} steps took '
        f'{100.0 * grown.decrease:.2g} % off the cost'))


def _judged(grown: TrainedLift | str, model_of: Callable[[TrainedLift], LiftedModel],
            parts: tuple[DriftSamples, DriftSamples, DriftSamples]) -> _Candidate | str:
    """Return the candidate of a start, or the reason why there is none."""
    if isinstance(grown, str):
        return grown
    if grown.status is MinimumStatus.STALLED:
        return grown.status.value
    validation = parts[1]
    try:
        model = model_of(grown)
        readings = [model, *(with_readout(model, parts[0], smallest) for smallest in SMALLEST)]
        fits = [fit(reading, validation.x, validation.dxdt, validation.u) for reading in readings]
        best = int(np.nanargmin([found.rx for found in fits]))
    except (ValueError, np.linalg.LinAlgError) as error:
        return str(error)
    found = fits[best if grown.drift_alone else 0]
    if not math.isfinite(found.rw + found.rx):
        return 'its figures are not finite: check the data and try another seed'
    return _Candidate(grown, readings[best], found)
