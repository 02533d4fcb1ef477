# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Which start and lift a training takes and rejects, what its watch sees, what interrupts keep."""

from dataclasses import replace
import itertools
import math
import signal

import numpy as np
import pytest

from koopman_ros.core.datasets import split_by_episode
from koopman_ros.learning import fit, IncrementalTraining, train, TrainingFailed
from koopman_ros.learning.lift.levenberg_marquardt import MinimumStatus
from support import small_plants
from support.small_plants import BENT, bent_samples, SMALL, UNFORCED, unforced_samples

RECIPE = replace(SMALL, n_z=3)


class Recorded:
    """A recipe that does as another and keeps what its starts find."""

    def __init__(self, recipe):
        self.recipe, self.found = recipe, {}
        self.rounds = recipe.rounds

    def start(self, data, n_z, parent, seed, monitor=None):
        grown = self.recipe.start(data, n_z, parent, seed, monitor)
        self.found.setdefault(n_z, []).append((seed, parent, grown))
        return grown


class Given:
    """A recipe that has the results of its rounds already: lifts, errors, or other recipes."""

    def __init__(self, *results):
        self.results = results

    def rounds(self, n_x):
        return tuple(range(2, 2 + len(self.results)))

    def start(self, data, n_z, parent, seed, monitor=None):
        result = self.results[n_z - 2]
        if isinstance(result, BaseException):
            raise result
        start = getattr(result, 'start', None)
        return start(data, n_z, parent, seed, monitor) if start else result


def test_the_next_round_extends_the_best_start():
    recorded, everything = Recorded(RECIPE), unforced_samples()
    trained = train(UNFORCED, everything, recorded, starts=4, seed=3)
    assert len({seed for n_z in (2, 3) for seed, _, _ in recorded.found[n_z]}) == 8
    assert all(parent is None for _, parent, _ in recorded.found[2])
    parents = {id(parent) for _, parent, _ in recorded.found[3]}
    assert parents < {id(grown) for _, _, grown in recorded.found[2]}
    assert len(parents) == 1
    validation = split_by_episode(everything, 0)[1]

    def score(model):
        figures = fit(model, validation.x, validation.dxdt, validation.u)
        return figures.rw + figures.rx

    # each of the starts alone, by a recipe that gives its result
    scores = [score(train(UNFORCED, everything, Given(grown), starts=1).model)
              for _, _, grown in recorded.found[2]]
    assert score(trained.path[0]) == min(scores)


def test_a_lift_that_loses_a_state_is_rejected_whatever_its_rw():
    """Two free coordinates can be x1 and x1^2, whose rw is 0 and which do not hold x2."""
    plant, samples = small_plants.TWO_STATE, small_plants.two_state_samples(400)
    exact = IncrementalTraining(3, identity=False, decoder=0, max_iterations=150)
    with pytest.raises(TrainingFailed, match='or use identity coordinates'):
        train(plant, samples, replace(exact, n_z=2), starts=1)
    # with the states as its first coordinates the same data are enough
    kept = train(plant, samples, replace(exact, identity=True), starts=1, loops=0)
    assert kept.figures.fit.rx < 1e-6


@pytest.mark.parametrize(('recipe', 'remedies'), [
    (RECIPE, 'a smaller n_z, more'), (
        replace(SMALL, identity=False), 'identity coordinates, a smaller n_z, more')])
def test_a_lift_whose_law_reaches_no_setpoint_is_rejected(recipe, remedies):
    """The drift x + 0.3 x^2 runs away, and the input does nothing to it."""
    samples = bent_samples()
    x = samples.x - 3.0
    runaway = replace(samples, dxdt=x + 0.3 * x * x)
    with pytest.raises(TrainingFailed, match=(
            f'n_z = {recipe.n_z} does not control the plant: .*{remedies}')):
        train(replace(BENT, B=np.zeros((1, 1))), runaway, recipe, starts=1, loops=16)


# Watching, and interrupting.


def watched(stop=lambda now: False, recipe=RECIPE, starts=2):
    """Train; return the result and what the watch saw."""
    seen = []

    def watch(now):
        seen.append(now)
        return stop(now)

    return train(UNFORCED, unforced_samples(), recipe, starts=starts, watch=watch), seen


def test_the_watch_sees_rounds_starts_steps_and_the_best_so_far():
    trained, seen = watched()
    assert {now.total for now in seen} == {trained.starts} == {4}
    steps, ends = ([now for now in seen if bool(now.iteration) is under_way]
                   for under_way in (True, False))
    for finished, here in itertools.groupby(steps, lambda now: now.finished):
        iterations = [now.iteration for now in here]
        assert iterations == list(range(1, len(iterations) + 1)), finished
    assert all(now.residual > 0.0 for now in steps)
    assert [(now.n_z, now.finished) for now in ends] == [(2, 1), (2, 2), (3, 3), (3, 4)]
    assert ends[1].rw <= ends[0].rw
    assert ends[3].rw <= ends[2].rw
    # there is no best one before the first start has finished
    assert all(math.isnan(now.rw) for now in steps if not now.finished)
    assert {now.rw for now in steps if now.finished == 1} == {ends[0].rw}


def press_interrupt(now):
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        signal.raise_signal(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, before)


interrupts = pytest.mark.parametrize('act', [lambda now: True, press_interrupt],
                                     ids=['the watch', 'the keyboard'])


@interrupts
@pytest.mark.parametrize(('place', 'n_z', 'starts'), [
    ((2, 0, 30), 2, 1), ((2, 1, 0), 2, 1), ((2, 1, 5), 2, 2), ((3, 2, 39), 3, 3)], ids=str)
def test_an_interrupt_keeps_the_best_so_far(act, place, n_z, starts):
    def stop(now):
        return (now.n_z, now.finished, now.iteration) == place and act(now)

    trained, seen = watched(stop)
    assert trained.model.n_z == n_z
    assert trained.starts == starts
    assert trained.status == MinimumStatus.INTERRUPTED.value
    assert trained.model.provenance.metrics['rw'] < 3e-3
    # the watch is not asked again after it has ended the training
    last = (seen[-1].n_z, seen[-1].finished, seen[-1].iteration)
    assert last == place or (act is press_interrupt and last[:2] <= (place[0], place[1] + 1))
