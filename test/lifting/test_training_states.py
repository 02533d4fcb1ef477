# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Representative states of the training data, and the distance from them."""

from dataclasses import replace
import math

import numpy as np
import pytest

from koopman_ros.learning import Growth, train
from koopman_ros.lifting import TrainingStates
from support.random_lifts import random_lift
from support.small_plants import BENT, bent_samples, TWO_STATE, two_state_samples

# an L along two sides of the box [-1, 1] x [-1, 1]
L_SHAPE = np.array([[-1.0, y] for y in np.linspace(-1.0, 1.0, 21)]
                   + [[x, -1.0] for x in np.linspace(-0.9, 1.0, 20)])
ONES = np.ones(2)


def _model():
    model = random_lift()
    return replace(model, states=replace(
        model.states, center=np.zeros(2), scale=np.array([1.0, 2.0]), lower=np.array([-1.0, -2.0]),
        upper=np.array([1.0, 2.0])), training_states=TrainingStates.of(L_SHAPE, ONES))


def test_few_states_are_all_kept_and_fill_completely():
    found = TrainingStates.of(L_SHAPE, ONES)
    assert found.fill_distance == 0.0
    assert {tuple(x) for x in found.states} == {tuple(x) for x in L_SHAPE}
    # the corner of the box that holds no data
    assert found.distance(ONES, ONES) == pytest.approx(2.0)
    assert found.distance(np.array([-1.0, -1.0]), ONES) == 0.0


def test_many_states_are_thinned_and_none_is_outside():
    states = np.random.default_rng(0).uniform(-1.0, 1.0, (3000, 2))
    states = states[states.min(axis=1) < 0.0]
    found = TrainingStates.of(states, ONES)
    assert found.states.shape == (256, 2)
    nearest = [np.min(np.max(np.abs(found.states - x), axis=1)) for x in states]
    assert found.fill_distance == max(nearest)
    # 256 squares of this half side would cover three quarters of the box
    assert 0.5 * math.sqrt(3.0 / 256.0) <= found.fill_distance < 2.0 * math.sqrt(3.0 / 256.0)
    assert max(found.distance(x, ONES) for x in states) == 0.0
    assert found.distance(np.array([0.6, 0.6]), ONES) == pytest.approx(0.6, abs=0.15)


def test_repeated_states_are_chosen_once():
    assert len(TrainingStates.of(np.zeros((9, 2)), ONES).states) == 1


def test_distance_of_a_model_is_the_larger_of_box_and_data():
    model = _model()
    # in state units, the second coordinate is scaled by 2
    assert model.distance(np.array([1.0, 2.0])) == pytest.approx(2.0)
    assert model.distance(np.array([-1.0, 1.5])) == pytest.approx(0.05)
    assert model.distance(np.array([-1.0, 5.0])) == pytest.approx(1.5)
    assert model.distance(np.array([np.nan, 0.0])) == math.inf
    boxed = replace(model, training_states=None)
    assert boxed.distance(np.array([1.0, 2.0])) == 0.0
    assert boxed.distance(np.array([-1.0, 5.0])) == model.states.violation(np.array([-1.0, 5.0]))


@pytest.mark.parametrize(('states', 'fill', 'words'), [
    (np.zeros((0, 2)), 0.0, 'M from 1 to 256'), (np.zeros((257, 2)), 0.0, 'M from 1 to 256'),
    (np.zeros(2), 0.0, 'M from 1 to 256'), (np.full((1, 2), np.nan), 0.0, 'must be finite'),
    (np.zeros((1, 2)), -1.0, 'fill_distance must be'), (np.zeros((1, 2)), math.inf, 'fill_dis')])
def test_what_does_not_fit_is_refused(states, fill, words):
    with pytest.raises(ValueError, match=words):
        TrainingStates(states, fill)


def test_states_of_another_size_do_not_fit_the_model():
    with pytest.raises(ValueError, match='incompatible training_states: expected 2 states, got 3'):
        replace(_model(), training_states=TrainingStates(np.zeros((1, 3)), 0.0))


def test_training_on_several_states_notes_them_and_on_one_does_not():
    recipe = Growth(3, hidden_first=3, max_iterations=2)
    samples = two_state_samples()
    model = train(TWO_STATE, samples, recipe, starts=1, refuse=False).model
    known = model.training_states
    assert known is not None
    assert known.states.shape == (256, 2)
    # but for rounding on the way to scaled deviations and back
    assert all(model.distance(x) < 1e-12 for x in samples.x)
    assert model.distance(np.array([-6.0, 12.0])) > 0.5
    assert train(BENT, bent_samples(), Growth(2, hidden_first=3, max_iterations=2), starts=1,
                 refuse=False).model.training_states is None
