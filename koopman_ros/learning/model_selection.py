# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The classes of models side by side on the same samples, and which of them to take."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import contextlib
from dataclasses import dataclass, replace
import math
import time

import numpy as np

from koopman_ros.core.arrays import expect, show_printed
from koopman_ros.core.datasets import DriftSamples, PlantDescription
from koopman_ros.core.plots import table
from koopman_ros.evaluation.closed_loop_test import ClosedLoopTest, evaluate_closed_loops, LOOPS
from koopman_ros.execution import Backend
from koopman_ros.learning.identification import Stopped
from koopman_ros.learning.lift.edmd import Edmd
from koopman_ros.learning.lift.incremental import IncrementalTraining
from koopman_ros.learning.lift.levenberg_marquardt import MinimumStatus
from koopman_ros.learning.lift.metrics import evaluate, LiftMetrics, ROUNDING
from koopman_ros.learning.lift.multistart import MultistartProgress, Recipe, Watch
from koopman_ros.learning.lift.neural_drift import NeuralDrift, with_readout, with_units_of
from koopman_ros.learning.lift.reference_drift import CorrectedRate
from koopman_ros.learning.lift.training import PreparedSamples, train, TrainingFailed
from koopman_ros.model import LiftedModel, model_file
from koopman_ros.model_classes import FREE_LIFT, IDENTITY_LIFT, LINEAR, NEURAL_DRIFT, POLYNOMIAL

DEGREES = (2, 3, 4, 5)
# A plainer model may err by this much more, in the mean square.
_FACTOR = 2.0


@dataclass(frozen=True)
class ModelCandidate:
    """A model of one class with its figures, or the reason why there is none."""

    name: str  #: of the class
    model: LiftedModel | None  #: the best of the class, None when training rejected all
    rx: float  #: relative mean-square error of its drift on the validation episodes; else infinite
    figures: LiftMetrics | None  #: its figures on the test episodes, which chose nothing
    law_check: ClosedLoopTest | None  #: its law in closed loops, where there are any
    seconds: float  #: that it took to learn
    rejection: str = ''  #: why it should not be used; empty when it may be
    #: mean-square error of its predictions of a record beyond the noise, relative to the states'
    #: scale; None where no record judges
    excess: float | None = None
    steps: int = 0  #: of minimisations, where it is a network
    limit: str = ''  #: what ended its training before it converged, where that was its time

    @property
    def error(self) -> float:
        """The error that the rule compares: on a record where there is one, else `rx`."""
        return self.rx if self.excess is None else self.excess


@dataclass(frozen=True)
class Judge:
    """Judgement of models in place of that by validation episodes and their polynomials."""

    #: completes a contender that has no law check, no `excess` and no rejection yet
    judged: Callable[[ModelCandidate], ModelCandidate]
    resolution: float  #: errors below it count as equal


@dataclass(frozen=True)
class ClassComparison:
    """The result of :func:`compare`; as text a table in Markdown."""

    contenders: tuple[ModelCandidate, ...]  #: the plainest first
    chosen: ModelCandidate  #: selected by the rule, or named by the user
    state_names: tuple[str, ...]  #: of the states, with their units
    state_units: tuple[str, ...]
    untried: tuple[str, ...] = ()  #: the classes that are still to be learned

    _repr_pretty_ = show_printed

    @property
    def model(self) -> LiftedModel:
        """The model of the chosen class."""
        assert self.chosen.model is not None
        return self.chosen.model

    @property
    def figures(self) -> LiftMetrics:
        """The figures of that model."""
        assert self.chosen.figures is not None
        return self.chosen.figures

    def with_model(self, model: LiftedModel) -> ClassComparison:
        """Return the same with another model of the chosen class."""
        chosen = replace(self.chosen, model=model)
        return replace(self, chosen=chosen, contenders=tuple(
            chosen if one is self.chosen else one for one in self.contenders))

    def __str__(self) -> str:
        """Return a row for each class; roll-outs are of the test episodes, or of the record."""
        recorded = any(one.excess is not None for one in self.contenders)
        head = ['model', 'n_z', 'rx, validation', 'rx, test', *['beyond noise'] * recorded,
                *(f'roll-out of {name}, {unit}' for name, unit in zip(
                    self.state_names, self.state_units, strict=True)),
                'loops failed', 'cost relative to linear', 's', 'remark']
        rows = []
        for one in self.contenders:
            found = one.figures
            errors = [''] * len(self.state_names) if found is None or (
                found.rollout_rmse is None) else [f'{error:.2g}' for error in found.rollout_rmse]
            law = one.law_check
            rows.append([
                one.name, '' if one.model is None else one.model.n_z,
                '' if one.model is None else f'{one.rx:.1e}',
                '' if found is None else f'{found.fit.rx:.1e}',
                *['' if one.excess is None else f'{one.excess:.1e}'] * recorded, *errors,
                *(('', '') if law is None else (f'{law.failed.sum()} of {law.loops}',
                                                f'{law.median_ratio:.3f}')), f'{one.seconds:.1f}',
                '; '.join(filter(None, [
                    'chosen' * (one is self.chosen), one.limit, one.rejection]))])
        return table(head, rows, range(1, len(head) - 1))


def usual_recipes(n_x: int) -> dict[str, Recipe]:
    """Return the networks that are tried for a plant of `n_x` states, plainest first."""
    units = 8 if n_x == 1 else 16
    return {
        NEURAL_DRIFT: NeuralDrift(units),
        IDENTITY_LIFT: IncrementalTraining(n_x + 3, hidden_first=units, max_iterations=300),
        FREE_LIFT: IncrementalTraining(n_x, identity=False, hidden_first=units,
                                       max_iterations=300)}


def compare(plant: PlantDescription, samples: DriftSamples,
            recipes: Mapping[str, Recipe] | None = None, *,
            degrees: Sequence[int] = DEGREES, choose: str | None = None, alone: bool = False,
            seed: int = 0, starts: int = 2, watch: Watch | None = None,
            loops: int = LOOPS, judge: Judge | None = None, device: str = 'cpu',
            backend: Backend | None = None, begin: LiftedModel | None = None,
            budget: float = math.inf,
            on_class: Callable[[ClassComparison], None] = lambda _: None) -> ClassComparison:
    """
    Learn a model of each class from the same episodes and choose one by a stated rule.

    In order of plainness: linear, polynomial, and the recipes, by default a neural drift, a lift
    with identity coordinates and a free one. Rejected are networks whose `rx` on validation
    episodes is not below the linear one's, models whose law fails in closed loops, and classes of
    which no model can be learned. Of the others the plainest is taken whose `rx` there is at most
    twice the smallest; below 1e-20 it is rounding and counts as equal. Where every law fails, it
    is the one that does in the smallest share of the loops. The degree of the polynomial is chosen
    by the same rule from `rx`. The read-out of a lift after a neural drift may use the units of
    that, too.

    :param recipes: those of the networks by name, in the order of the choice; the usual ones by
        default. Other arguments as in :func:`train`.
    :param choose: the name of the class to take whatever the rule says.
    :param alone: whether it is the only one to be learned.
    :param judge: of the models, in place of validation episodes and `loops`.
    :param begin: as in :func:`train`, for the lifts of its kind, of which one has to be learned.
    :param budget: processor time in s of the networks of each class, see :func:`train`.
    :param on_class: called after each class with the comparison so far, once there is a model.
    :raises TrainingFailed: when no model of the requested class was learned, or none at all.
    :raises ValueError: for an unknown name; otherwise as :func:`train`, where the class was
        requested or the cause is in the samples.
    :raises Stopped: when `watch` requested it.
    :raises KeyboardInterrupt: at an interrupt from the keyboard.
    """
    expect(plant=(plant, PlantDescription), samples=(samples, DriftSamples))
    n_x = samples.x.shape[1]
    recipes = usual_recipes(n_x) if recipes is None else recipes
    names: tuple[str, ...] = (LINEAR, POLYNOMIAL, *recipes)
    if choose not in (*names, *[None] * (not alone)):
        raise ValueError(f'choose must be one of {", ".join(names)}, got {choose!r}')
    if alone:
        names = tuple(name for name in names if name == choose)
    if starts < 1:
        raise ValueError(f'starts must be at least 1, got {starts}')
    continuing = [name for name in names if begin is not None and _of_kind(recipes, name, begin)]
    if begin is not None and not continuing:
        raise ValueError(f'no class of {", ".join(names)} can start from a lift '
                         f'{"with" if begin.identity else "without"} identity coordinates: set '
                         f'model_class to {IDENTITY_LIFT if begin.identity else FREE_LIFT}, or '
                         'leave warm_start_model empty')
    prepared = PreparedSamples.of(plant, samples)
    judge = judge or _judge(prepared, loops, backend)
    counts = {name: starts * _rounds(recipes[name], n_x) for name in names if name in recipes}
    found: list[ModelCandidate] = []
    drift: LiftedModel | None = None

    def so_far() -> ClassComparison:
        named = next((one for one in found if one.name == choose), None)
        return ClassComparison(
            tuple(found), named or plainest(found, judge.resolution), plant.state_names,
            plant.state_units, names[len(found):])

    for name in names:
        since, steps, limit = time.perf_counter(), 0, ''
        try:
            if name in recipes:
                trained = train(
                    plant, samples, recipes[name], seed=seed, starts=starts,
                    loops=0, watch=_among(watch, name, counts),
                    device=device, backend=backend,
                    begin=begin if name in continuing else None, budget=budget)
                if trained.status == MinimumStatus.INTERRUPTED.value:
                    # from the keyboard: a start cut short is no model to compare
                    raise KeyboardInterrupt
                steps = trained.steps
                if trained.status == MinimumStatus.OUT_OF_TIME.value:
                    limit = trained.status
                model = trained.model if drift is None else _with_units_of(
                    drift, trained.model, prepared)
                if isinstance(recipes[name], NeuralDrift):
                    drift = model
            else:
                model = prepared.linear() if name == LINEAR else _polynomial(prepared, degrees)
            seconds = time.perf_counter() - since
            model = replace(model, training_states=prepared.states)
            figures = evaluate(model, prepared.parts[2])
            one = judge.judged(ModelCandidate(name, model, prepared.rx(model), figures, None,
                                              seconds, steps=steps, limit=limit))
            found.append(replace(one, model=_noted(model, one)))
        except (ValueError, np.linalg.LinAlgError) as rejection:
            if name == choose:
                raise
            found.append(ModelCandidate(name, None, math.inf, None, None,
                                        time.perf_counter() - since, str(rejection)))
        if any(one.model is not None for one in found):
            on_class(so_far())
    return so_far()


def plainest(contenders: Sequence[ModelCandidate], resolution: float = ROUNDING) -> ModelCandidate:
    """
    Return of those that pass the first whose error is at most twice the smallest.

    Where none passes, the one whose law fails in the smallest share of its closed loops.

    :param resolution: errors below it count as equal.
    :raises TrainingFailed: when there is no model of any class.
    """
    able = [one for one in contenders if not one.rejection]
    if not able:
        tried = [one for one in contenders if one.model is not None]
        if not tried:
            raise TrainingFailed('no class gave a model: ' + '; '.join(
                f'{one.name}: {one.rejection}' for one in contenders))
        return min(tried, key=lambda one: one.law_check.share_failed if one.law_check else 1.0)
    limit = _FACTOR * max(min(one.error for one in able), resolution)
    return next(one for one in able if one.error <= limit)


def _of_kind(recipes: Mapping[str, Recipe], name: str, lift: LiftedModel) -> bool:
    """Return whether a class is that of a lift, as far as its coordinates tell."""
    recipe = recipes.get(name)
    return isinstance(recipe, IncrementalTraining) and recipe.identity == lift.identity


def _rounds(recipe: Recipe, n_x: int) -> int:
    """Return the number of rounds of a recipe; 0 where it does not fit, as training will say."""
    with contextlib.suppress(ValueError):
        return len(recipe.rounds(n_x))
    return 0


def _among(watch: Watch | None, name: str, counts: Mapping[str, int]) -> Watch | None:
    """Return a watch that counts the starts of one class among those of all, and ends all."""
    if watch is None:
        return None
    before = sum(counts[other] for other in list(counts)[:list(counts).index(name)])

    def on_progress(now: MultistartProgress) -> bool:
        if watch(replace(now, name=name, finished=before + now.finished,
                         total=sum(counts.values()))):
            raise Stopped
        return False

    return on_progress


def _noted(model: LiftedModel, one: ModelCandidate) -> LiftedModel:
    """Return a model with the figures of its candidate in it."""
    assert one.figures is not None
    return replace(model, verified_loops=None if one.law_check is None else one.law_check.tried,
                   provenance=replace(model.provenance,
                                      metrics=one.figures.metrics(model.states.names)))


def _polynomial(prepared: PreparedSamples, degrees: Sequence[int]) -> LiftedModel:
    """Choose the degree; those with too many monomials to tell apart or to save fall out."""
    tried, rejection = [], 'no degree was given'
    training = prepared.parts[0]
    for degree in degrees:
        count = math.comb(training.x.shape[1] + degree, degree)
        if count >= len(training):
            rejection = f'{len(training)} samples do not determine {count} monomials'
            continue
        try:
            model = Edmd(degree).learn(prepared.plant, training, prepared.box)
            model_file.check(model)
            tried.append(ModelCandidate(POLYNOMIAL, model, prepared.rx(model), None, None, 0.0))
        except (ValueError, np.linalg.LinAlgError) as error:
            rejection = str(error)
    if not tried:
        raise TrainingFailed(rejection)
    best = plainest(tried).model
    assert best is not None
    return best


def _with_units_of(drift: LiftedModel, lift: LiftedModel, prepared: PreparedSamples
                   ) -> LiftedModel:
    """Let a lift's read-out use a drift's units as well, where that is closer."""
    try:
        joined = with_readout(with_units_of(drift, lift), prepared.parts[0])
    except ValueError:
        # of another kind
        return lift
    return min((lift, joined), key=prepared.rx)


def _judge(prepared: PreparedSamples, loops: int, backend: Backend | None) -> Judge:
    """Return the judge by closed loops on the drift that predicts validation episodes best."""
    def judged(one: ModelCandidate) -> ModelCandidate:
        model = one.model
        if not loops or model is None or not model.n_u:
            return one
        reference = prepared.reference_drift(model)
        law_check = evaluate_closed_loops(model, reference, loops=loops,
                                          backend=backend,
                                          disturbances=prepared.plant.disturbance_names)
        rejected = law_check is not None and not law_check.accepted
        cause = reference.cause if isinstance(reference, CorrectedRate) else ''
        return replace(
            one, law_check=law_check, limit='; '.join(filter(None, [one.limit, cause])),
            rejection=f'does not control the plant: {law_check}' if rejected else '')

    return Judge(judged, ROUNDING)
