# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Which start and which lift a training takes, and what it refuses."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from koopman_ros.learning import fit, Growth, NoUsefulLift, train
from koopman_ros.learning.levenberg_marquardt import MinimumStatus
from koopman_ros.plant_data import split_by_episode
from support.small_plants import (
    BENT,
    bent_samples,
    SMALL,
    TWO_STATE,
    two_state_samples,
    UNFORCED,
    unforced_samples,
)


class Recorded:
    """A recipe that does as another and keeps what its starts find."""

    def __init__(self, recipe):
        self.recipe, self.found = recipe, {}

    def rounds(self, n_x):
        return self.recipe.rounds(n_x)

    def start(self, data, n_z, parent, seed, monitor=None):
        grown = self.recipe.start(data, n_z, parent, seed, monitor)
        self.found.setdefault(n_z, []).append((seed, parent, grown))
        return grown


def test_the_best_start_wins_and_is_what_the_next_round_extends():
    recorded, everything = Recorded(replace(SMALL, n_z=3)), unforced_samples()
    trained = train(UNFORCED, everything, recorded, starts=4, seed=3)
    seeds = [seed for n_z in (2, 3) for seed, _, _ in recorded.found[n_z]]
    assert len(set(seeds)) == 8
    assert all(parent is None for _, parent, _ in recorded.found[2])
    parents = {id(parent) for _, parent, _ in recorded.found[3]}
    winner = [grown for _, _, grown in recorded.found[2] if id(grown) in parents]
    assert len(parents) == len(winner) == 1
    validation = split_by_episode(everything, 0)[1]

    def score(model):
        figures = fit(model, validation.x, validation.dxdt, validation.u)
        return figures.rw + figures.rx

    # each of the starts alone, by a recipe that gives its result
    scores = [score(train(UNFORCED, everything, Given(grown), starts=1).model)
              for _, _, grown in recorded.found[2]]
    assert score(trained.path[0]) == min(scores)


class Given:
    """A recipe that has its result already, or an error."""

    def __init__(self, *results):
        self.results = list(results)

    def rounds(self, n_x):
        return tuple(range(2, 2 + len(self.results)))

    def start(self, data, n_z, parent, seed, monitor=None):
        result = self.results[n_z - 2]
        if isinstance(result, BaseException):
            raise result
        return result


def test_a_degenerate_start_is_no_candidate():
    error = torch.linalg.LinAlgError('singular')
    # a ValueError to whoever does not know it
    assert issubclass(NoUsefulLift, ValueError)
    with pytest.raises(NoUsefulLift, match=r'no start gave a usable lift with n_z = 2: a start is '
                                           r'degenerate \(singular\): check that all states'):
        train(UNFORCED, unforced_samples(), Given(error), starts=2)


@pytest.mark.parametrize('change', [
    {'status': MinimumStatus.STALLED},
    {'theta': torch.full((15,), torch.nan, dtype=torch.float64)}])
def test_a_start_without_a_result_is_no_candidate(change):
    recorded = Recorded(SMALL)
    train(UNFORCED, unforced_samples(), recorded, starts=1)
    grown = replace(recorded.found[2][0][2], **change)
    with pytest.raises(NoUsefulLift, match='no start gave a usable lift with n_z = 2: '):
        train(UNFORCED, unforced_samples(), Given(grown), starts=2)


def test_a_linear_plant_needs_no_lift_and_gets_one_where_it_is_asked_for():
    samples = bent_samples()
    linear = replace(samples, dxdt=-(samples.x - 3.0) + 2.0 * (samples.u - 0.5))
    with pytest.raises(NoUsefulLift, match=r'the lift with n_z = 2 does not predict the motion '
                                           r'better than a linear model \(relative error rx = '
                                           r'[0-9.e-]+ against [0-9.e-]+ on validation'):
        train(BENT, linear, SMALL, starts=1)
    trained = train(BENT, linear, SMALL, starts=1, refuse=False)
    assert trained.figures.fit.rx > trained.linear.fit.rx
    assert trained.closed_loop is None


def test_a_held_out_episode_at_rest():
    at_rest = bent_samples(5)
    x = np.array(at_rest.x)
    x[at_rest.episode == split_by_episode(at_rest, 0)[1].episode[0]] = 3.3
    with pytest.raises(ValueError, match='30 samples do not tell 2 coordinates apart'):
        train(BENT, replace(at_rest, x=x), SMALL)


@pytest.mark.parametrize(('recipe', 'starts', 'words'), [
    (SMALL, 0, 'starts must be at least 1, got 0'),
    (Growth(1), 1, 'n_z = 1 is too small for 1 states')])
def test_what_cannot_be_trained(recipe, starts, words):
    with pytest.raises(ValueError, match=words):
        train(BENT, bent_samples(), recipe, starts=starts)


def test_a_lift_that_loses_a_state_is_refused_whatever_its_rw():
    """Two free coordinates can be x1 and x1^2, whose rw is 0 and which do not hold x2."""
    samples = two_state_samples(400)
    exact = Growth(3, identity=False, decoder=0, max_iterations=150)
    with pytest.raises(NoUsefulLift, match='does not predict the motion better than a linear'):
        train(TWO_STATE, samples, replace(exact, n_z=2), starts=1)
    # with the states as its first coordinates the same data are enough
    kept = train(TWO_STATE, samples, replace(exact, identity=True), starts=1)
    assert kept.figures.fit.rx < 1e-6
