# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The classes of models side by side: the rule of the choice, the figures, what may be asked."""

from dataclasses import replace
import math

import numpy as np
import pytest

from koopman_ros.core.datasets import split_by_episode
from koopman_ros.evaluation.closed_loop_test import evaluate_closed_loops
from koopman_ros.learning import (
    compare,
    Edmd,
    evaluate,
    fit,
    IncrementalTraining,
    model_selection,
    ModelCandidate,
    NeuralDrift,
    TrainingFailed,
)
from koopman_ros.learning.model_selection import plainest
from koopman_ros.model import Box
from support.small_plants import (
    BENT,
    bent_samples,
    SMALL,
    TWO_STATE,
    two_state_samples,
)

RECIPES = {'neural drift': NeuralDrift(3, max_iterations=40), 'identity lift': SMALL}


def contender(name, rx, rejection=''):
    return ModelCandidate(name, None, rx, None, None, 0.0, rejection)


@pytest.mark.parametrize(('errors', 'rejected', 'chosen'), [
    ([1e-2, 1e-4, 1e-6], (), 2), ([1e-2, 1.9e-6, 1e-6], (), 1), ([1e-2, 2.1e-6, 1e-6], (), 2),
    ([1.9e-6, 1.9e-6, 1e-6], (), 0), ([1e-2, 1e-4, 1e-6], (2,), 1),
    ([1e-2, 1e-4, 1e-6], (1, 2), 0),
    # rounding
    ([1e-30, 1e-33, 0.0], (), 0), ([1e-2, 1.9e-20, 1e-33], (), 1),
    ([1e-2, math.inf, 1e-6], (1,), 2)])
def test_the_plainest_within_a_factor_of_two_is_taken(errors, rejected, chosen):
    those = [contender(str(i), rx, 'rejected' if i in rejected else '')
             for i, rx in enumerate(errors)]
    assert plainest(those) is those[chosen]


@pytest.fixture(scope='module')
def bent():
    """Compare the models of the bent plant, whose drift is of degree 2."""
    return compare(BENT, bent_samples(), RECIPES, starts=1, loops=16)


def test_a_polynomial_drift_is_found_and_taken(bent):
    linear, polynomial, drift, lift = bent.contenders
    assert [one.name for one in bent.contenders] == ['linear', 'polynomial', *RECIPES]
    assert bent.chosen is polynomial
    assert bent.model is polynomial.model
    # the smallest of the degrees that are exact
    assert polynomial.model.n_z == 2
    assert polynomial.rx < 1e-25 < drift.rx < linear.rx
    assert lift.rx < linear.rx
    training, validation, test = split_by_episode(bent_samples(), 0)
    for one in bent.contenders:
        assert one.figures.fit == evaluate(one.model, test).fit
        assert one.rx == fit(one.model, validation.x, validation.dxdt, validation.u).rx
        assert one.model.provenance.metrics == one.figures.metrics(('level',))
        assert one.law_check.loops == 16
        assert one.law_check.accepted or one is linear
    box = Box.of(BENT, bent_samples().x, bent_samples().u)
    np.testing.assert_array_equal(linear.model.A, Edmd(1).learn(BENT, training, box).A)


def test_a_class_that_cannot_be_learned_has_its_reason():
    found = compare(BENT, bent_samples(), {'lift': IncrementalTraining(1)}, degrees=(40,),
                    starts=1, loops=0)
    assert found.chosen.name == 'linear'
    assert [one.model is None for one in found.contenders] == [False, True, True]
    assert 'is too small for 1 states' in found.contenders[2].rejection
    with pytest.raises(TrainingFailed, match='a model: a: is none; b: is none'):
        plainest([contender(name, math.inf, 'is none') for name in ('a', 'b')])


@pytest.mark.parametrize(('failing', 'chosen'), [
    ({2: 16}, 'linear'), ({1: 8, 2: 5}, 'polynomial'), ({1: 5, 2: 5}, 'linear')])
def test_a_model_whose_law_fails_is_not_taken(monkeypatch, failing, chosen):
    """However close it is; where all fail, which fails least often."""
    def fails(model, rate, loops, **_):
        excess = np.ones(16)
        excess[:failing.get(model.n_z, 0)] = np.inf
        return replace(evaluate_closed_loops(model, rate, loops=loops), excess=excess)

    monkeypatch.setattr(model_selection, 'evaluate_closed_loops', fails)
    found = compare(BENT, bent_samples(), {}, loops=16)
    assert found.chosen.name == chosen
    assert f'the law fails in {failing[2]} of 16' in found.contenders[1].rejection


def test_a_polynomial_has_fewer_monomials_than_there_are_samples(monkeypatch):
    tried = []
    learn = Edmd.learn
    monkeypatch.setattr(Edmd, 'learn', lambda self, *given: (
        tried.append(self.degree), learn(self, *given))[1])
    samples = two_state_samples()
    part = samples.take(np.unique(samples.episode)[:5])
    few = len(split_by_episode(part, 0)[0])
    compare(TWO_STATE, part, {}, degrees=(2, few), loops=0)
    assert max(tried) == 2
