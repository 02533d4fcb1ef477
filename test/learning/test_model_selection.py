# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The classes of models side by side: the rule of the choice, the figures, what may be asked."""

from dataclasses import replace
import math
import signal

import numpy as np
import pytest

from koopman_ros.control import Controller, Tuning
from koopman_ros.core.datasets import DriftSamples, PlantDescription, split_by_episode
from koopman_ros.evaluation.closed_loop_test import evaluate_closed_loops
from koopman_ros.learning import (
    compare,
    Edmd,
    evaluate,
    fit,
    IncrementalTraining,
    learn_lift,
    model_selection,
    ModelCandidate,
    NeuralDrift,
    simulate,
    train,
    TrainingFailed,
)
from koopman_ros.learning.identification import identify, Stopped
from koopman_ros.learning.lift.neural_drift import with_units_of
from koopman_ros.learning.model_selection import plainest
from koopman_ros.model import Box
from support.random_lifts import random_lift
from support.small_plants import (
    BENT,
    bent_samples,
    SMALL,
    TWO_STATE,
    two_state_samples,
    UNFORCED,
    unforced_samples,
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


@pytest.mark.parametrize('swapped', [
    lambda: train(bent_samples(), BENT, SMALL), lambda: compare(bent_samples(), BENT),
    lambda: identify([], BENT), lambda: learn_lift(BENT, None, 3, seed=0, starts=1),
    lambda: simulate(None, random_lift()),
    lambda: Controller(Tuning.for_model(random_lift()), random_lift())])
def test_swapped_arguments_are_named(swapped):
    with pytest.raises(TypeError, match='check the order of the arguments'):
        swapped()


@pytest.fixture(scope='module')
def bent():
    """Compare the models of the bent plant, whose drift is of degree 2."""
    return compare(BENT, bent_samples(), RECIPES, starts=1, loops=16)


@pytest.mark.parametrize(('effect', 'accepted'), [
    (lambda u: u, True), (lambda u: np.sign(u) * np.maximum(np.abs(u) - 0.5, 0.0), False),
    (lambda u: np.tanh(2.0 * u), False),
    # at rest without a torque, which an affine drift is not
    (lambda u: u ** 2, False)])
def test_a_law_is_tried_on_inputs_that_act_nonlinearly(effect, accepted):
    """Exact rates of a pendulum whose actuator has a dead zone, saturates, or squares."""
    rng = np.random.default_rng(0)
    x, u = rng.uniform(-1.5, 1.5, (900, 2)), rng.uniform(-1.4, 1.4, (900, 1))
    rate = np.column_stack([x[:, 1], effect(u[:, 0]) - np.sin(x[:, 0]) - 0.5 * x[:, 1]])
    plant = PlantDescription('pendulum', ('angle', 'speed'), ('rad', 'rad/s'), ('torque',),
                             ('N m',), 's', np.zeros(2), np.zeros(1), None)
    samples = DriftSamples(x, rate, u, np.arange(900) % 9)
    found = compare(plant, samples, {}, loops=16)
    polynomial = found.contenders[1]
    assert (not polynomial.rejection) is accepted
    assert accepted or 'the effect of torque is nonlinear' in polynomial.limit


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


@pytest.mark.parametrize(('asked', 'words'), [
    ({'alone': True}, 'choose must be one of .*, got None'),
    ({'choose': 'lift'}, "choose must be one of linear, .*, identity lift, got 'lift'"),
    ({'starts': 0}, 'starts must be at least 1, got 0')])
def test_incomparable_models_are_an_error(asked, words):
    with pytest.raises(ValueError, match=words):
        compare(BENT, bent_samples(), RECIPES, **asked)


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
    assert f'fails in {failing[2]} of 16' in found.contenders[1].rejection


def test_all_laws_are_tried_where_the_data_are(monkeypatch):
    tried = []

    def noted(model, *_, **__):
        tried.append(model.training_states)

    monkeypatch.setattr(model_selection, 'evaluate_closed_loops', noted)
    found = compare(TWO_STATE, two_state_samples(), {'drift': NeuralDrift(3, max_iterations=5)},
                    degrees=(2,), starts=1)
    assert len(tried) == 3
    for known, one in zip(tried, found.contenders, strict=True):
        np.testing.assert_array_equal(known.states, tried[-1].states)
        assert one.model.training_states is known


def test_a_plant_without_inputs_has_no_law():
    assert compare(UNFORCED, unforced_samples(), {}).chosen.law_check is None


def test_units_of_a_drift_leave_the_lift_as_it_is():
    lift, other = random_lift(2, 4), random_lift(2, 5, seed=5)
    joined = with_units_of(other, lift)
    x = np.random.default_rng(0).normal(size=(10, 2))
    np.testing.assert_allclose(joined.lift(x), lift.lift(x), rtol=0, atol=1e-14)
    np.testing.assert_allclose(joined.drift(x), lift.drift(x), rtol=0, atol=1e-12)
    phi = joined.observables.features.lift(x)
    for model, at in ((lift, slice(2, 6)), (other, slice(6, None))):
        np.testing.assert_allclose(phi[:, at], model.observables.features.lift(x)[:, 2:],
                                   rtol=0, atol=1e-14)


def test_a_lift_is_at_least_as_close_as_the_drift_before_it(bent):
    _, _, drift, lift = bent.contenders
    assert lift.rx <= 1.5 * drift.rx
    assert lift.model.readout.shape == (1, 1 + 3 + 3)


def test_starts_that_run_out_of_time_are_kept_and_said():
    recipes = {'neural drift': NeuralDrift(3), 'identity lift': replace(SMALL, n_z=3)}
    seen = []
    found = compare(BENT, bent_samples(), recipes, starts=2, loops=0, budget=1e-9,
                    watch=lambda now: seen.append((now.name, now.finished)) or False)
    linear, polynomial, *networks = found.contenders
    assert not linear.limit
    assert not polynomial.limit
    for one in networks:
        # none is left out
        assert max(count for name, count in seen if name == one.name) == (
            2 if one.name == 'neural drift' else 6)
        assert one.model is None or 'limit of processor time' in one.limit
    assert any(one.model is not None for one in networks)
    assert 'limit of processor time' in str(found)


def test_ctrl_c_in_the_training_of_a_network_ends_all_classes():
    names = []

    def press(now):
        names.append(now.name)
        if now.iteration == 3:
            signal.raise_signal(signal.SIGINT)
        return False

    kept = []
    with pytest.raises(KeyboardInterrupt):
        compare(BENT, bent_samples(), {'neural drift': NeuralDrift(3), 'identity lift': SMALL},
                starts=2, loops=0, watch=press, on_class=kept.append)
    assert set(names) == {'neural drift'}
    assert [(len(one.contenders), one.untried) for one in kept] == [
        (1, ('polynomial', 'neural drift', 'identity lift')),
        (2, ('neural drift', 'identity lift'))]
    with pytest.raises(Stopped):
        compare(BENT, bent_samples(), {'neural drift': NeuralDrift(3), 'identity lift': SMALL},
                starts=2, loops=0, watch=lambda now: now.iteration == 3)


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
