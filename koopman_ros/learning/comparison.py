# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The classes of models side by side on the same samples, and which of them to take."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
import math
import time

import numpy as np

from koopman_ros.control.law_check import check_law, LawCheck, LOOPS
from koopman_ros.learning.baselines import Edmd
from koopman_ros.learning.drift import NeuralDrift, with_readout, with_units_of
from koopman_ros.learning.growth import Growth
from koopman_ros.learning.training import (
    NoUsefulLift,
    Recipe,
    reference_drift,
    train,
    training_states,
    Watch,
)
from koopman_ros.learning.validation import evaluate, Figures, fit, ROUNDING
from koopman_ros.lifting import bounds, Box, LiftedModel
from koopman_ros.plant_data import Plant, Samples, split_by_episode
from koopman_ros.reports import table

LINEAR, POLYNOMIAL = 'linear', 'polynomial'
DEGREES = (2, 3, 4, 5)
# A plainer model may err by this much more, in the mean square.
_FACTOR = 2.0


@dataclass(frozen=True)
class Contender:
    """A model of one class with its figures, or the reason why there is none."""

    name: str  #: of the class
    model: LiftedModel | None  #: the best of the class, None when training refused all
    rx: float  #: relative mean-square error of its drift on the validation episodes; else infinite
    figures: Figures | None  #: its figures on the test episodes, which chose nothing
    law_check: LawCheck | None  #: its law in closed loops, where there are any
    seconds: float  #: that it took to learn
    refusal: str = ''  #: why it should not be used; empty when it may be


@dataclass(frozen=True)
class Comparison:
    """What :func:`compare` has found; as text a table in Markdown."""

    contenders: tuple[Contender, ...]  #: the plainest first
    chosen: Contender  #: by the rule, or as it was asked for
    state_names: tuple[str, ...]  #: of the states, with their units
    state_units: tuple[str, ...]

    @property
    def model(self) -> LiftedModel:
        """The model of the chosen class."""
        assert self.chosen.model is not None
        return self.chosen.model

    def __str__(self) -> str:
        """Return a row for each class; roll-out errors are those of the test episodes."""
        head = ['model', 'n_z', 'rx, validation', 'rx, test',
                *(f'roll-out of {name}, {unit}' for name, unit in zip(
                    self.state_names, self.state_units, strict=True)),
                'loops failed', 'cost beside linear', 's', 'remark']
        rows = []
        for one in self.contenders:
            found = one.figures
            errors = [''] * len(self.state_names) if found is None or (
                found.rollout_rmse is None) else [f'{error:.2g}' for error in found.rollout_rmse]
            law = one.law_check
            rows.append([
                one.name, '' if one.model is None else one.model.n_z,
                '' if one.model is None else f'{one.rx:.1e}',
                '' if found is None else f'{found.fit.rx:.1e}', *errors,
                *(('', '') if law is None else (f'{law.failed.sum()} of {law.loops}',
                                                f'{law.median_ratio:.3f}')), f'{one.seconds:.1f}',
                '; '.join(filter(None, ['chosen' * (one is self.chosen), one.refusal]))])
        return table(head, rows, range(1, len(head) - 1))


def usual_recipes(n_x: int) -> dict[str, Recipe]:
    """Return the networks that are tried for a plant of `n_x` states, plainest first."""
    units = 8 if n_x == 1 else 16
    return {
        'neural drift': NeuralDrift((units,)),
        'identity lift': Growth(n_x + 3, hidden_first=units, max_iterations=300),
        'free lift': Growth(n_x, identity=False, hidden_first=units, max_iterations=300)}


def compare(plant: Plant, samples: Samples, recipes: Mapping[str, Recipe] | None = None, *,
            degrees: Sequence[int] = DEGREES, choose: str | None = None, seed: int = 0,
            starts: int = 2, split_seed: int = 0, watch: Watch | None = None,
            loops: int = LOOPS) -> Comparison:
    """
    Learn a model of each class from the same episodes and choose one by a stated rule.

    In order of plainness: linear, polynomial, and the recipes, by default a neural drift, a lift
    with identity coordinates and a free one. Refused are networks whose `rx` on validation
    episodes is not below the linear one's, and models whose law fails in closed loops. Of the
    others the plainest is taken whose `rx` there is at most twice the smallest; below 1e-20 it is
    rounding and counts as equal. Where every law fails, it is the one that does in the smallest
    share of the loops. The degree of the polynomial is chosen by the same rule from `rx`. The
    read-out of a lift after a neural drift may use the units of that, too.

    :param recipes: those of the networks by name, in the order of the choice; the usual ones by
        default. Other arguments as in :func:`train`.
    :param choose: the name of the class to take whatever the rule says.
    :raises NoUsefulLift: when there is no model of the class that was asked for.
    :raises ValueError: for a name that there is not; otherwise as :func:`train`.
    """
    recipes = usual_recipes(samples.x.shape[1]) if recipes is None else recipes
    names = (LINEAR, POLYNOMIAL, *recipes)
    if choose is not None and choose not in names:
        raise ValueError(f'choose must be one of {", ".join(names)}, got {choose!r}')
    judge = _Judge(plant, samples, split_seed, loops)
    found = [judge.linear_contender(), judge.polynomial(degrees)]
    drift: LiftedModel | None = None
    for name, recipe in recipes.items():
        begin = time.perf_counter()
        try:
            trained = train(plant, samples, recipe, seed=seed, starts=starts,
                            split_seed=split_seed, watch=watch, loops=0)
            model = trained.model if drift is None else judge.with_units_of(drift, trained.model)
        except NoUsefulLift as refusal:
            found.append(Contender(name, None, math.inf, None, None,
                                   time.perf_counter() - begin, str(refusal)))
            continue
        if isinstance(recipe, NeuralDrift):
            drift = model
        found.append(judge.contender(name, model, begin))
    chosen = plainest(found)
    if choose is not None:
        chosen = found[names.index(choose)]
        if chosen.model is None:
            raise NoUsefulLift(chosen.refusal)
    return Comparison(tuple(found), chosen, plant.state_names, plant.state_units)


def plainest(contenders: Sequence[Contender]) -> Contender:
    """
    Return of those that pass the first whose error is at most twice the smallest.

    Where none passes, the one whose law fails in the smallest share of its closed loops.
    """
    able = [one for one in contenders if not one.refusal]
    if not able:
        tried = [one for one in contenders if one.law_check is not None]
        return min(tried, key=lambda one: one.law_check.share_failed if one.law_check else 1.0)
    limit = _FACTOR * max(min(one.rx for one in able), ROUNDING)
    return next(one for one in able if one.rx <= limit)


class _Judge:
    """What all contenders are learned from and judged by."""

    def __init__(self, plant: Plant, samples: Samples, split_seed: int, loops: int) -> None:
        self._plant, self._loops = plant, loops
        self._parts = split_by_episode(samples, split_seed)
        self._training, self._validation, self._test = self._parts
        self._box = Box.of(plant, samples.x, samples.u)
        self._known = training_states(self._box, samples)
        self._begin = time.perf_counter()
        self._linear = Edmd(degree=1).learn(plant, self._training, self._box)

    def rx(self, model: LiftedModel) -> float:
        """Return the error on the validation episodes."""
        return fit(model, self._validation.x, self._validation.dxdt, self._validation.u).rx

    def linear_contender(self) -> Contender:
        """Return the linear model."""
        return self.contender(LINEAR, self._linear, self._begin)

    def polynomial(self, degrees: Sequence[int]) -> Contender:
        """Choose the degree; those with too many monomials to tell apart or to save fall out."""
        begin, tried, refusal = time.perf_counter(), [], 'no degree was to be tried'
        for degree in degrees:
            try:
                model = Edmd(degree).learn(self._plant, self._training, self._box)
                bounds.check(model)
                tried.append(Contender(POLYNOMIAL, model, self.rx(model), None, None, 0.0))
            except (ValueError, np.linalg.LinAlgError) as error:
                refusal = str(error)
        best = plainest(tried).model if tried else None
        if best is None:
            return Contender(POLYNOMIAL, None, math.inf, None, None,
                             time.perf_counter() - begin, refusal)
        return self.contender(POLYNOMIAL, best, begin)

    def with_units_of(self, drift: LiftedModel, lift: LiftedModel) -> LiftedModel:
        """Let a lift's read-out use a drift's units as well, where that is closer."""
        try:
            joined = with_readout(with_units_of(drift, lift), self._training)
        except ValueError:
            # of another kind
            return lift
        return min((lift, joined), key=self.rx)

    def contender(self, name: str, model: LiftedModel, begin: float) -> Contender:
        """Judge a model, and note its figures in it."""
        seconds = time.perf_counter() - begin
        law_check, refusal = None, ''
        if self._loops and model.n_u:
            law_check = check_law(model, reference_drift(
                self._plant, self._box, self._parts, model), loops=self._loops)
            if law_check is not None and not law_check.accepted:
                refusal = f'no controller: {law_check}'
        figures = evaluate(model, self._test)
        model = replace(
            model, training_states=self._known,
            tried_loops=None if law_check is None else law_check.tried,
            provenance=replace(
                model.provenance, metrics=figures.metrics(model.states.names)))
        return Contender(name, model, self.rx(model), figures, law_check, seconds, refusal)
