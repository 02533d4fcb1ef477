# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What the watch of a training sees, and what is kept when it or the keyboard interrupts."""

from dataclasses import replace
import itertools
import math
import signal

import pytest
import torch

from koopman_ros.learning import NoUsefulLift, train
from koopman_ros.learning.levenberg_marquardt import MinimumStatus
from support.small_plants import bits, SMALL, UNFORCED, unforced_samples

RECIPE = replace(SMALL, n_z=3)


def watched(stop=lambda now: False, recipe=RECIPE, starts=2):
    """Train; return the result and what the watch saw."""
    seen = []

    def watch(now):
        seen.append(now)
        return stop(now)

    return train(UNFORCED, unforced_samples(), recipe, starts=starts, watch=watch), seen


def test_the_watch_sees_rounds_starts_and_steps():
    _, seen = watched()
    assert {now.total for now in seen} == {4}
    assert [now.n_z for now in seen] == sorted(now.n_z for now in seen)
    assert {now.n_z for now in seen} == {2, 3}
    steps = [now for now in seen if now.iteration]
    for finished, here in itertools.groupby(steps, lambda now: now.finished):
        iterations = [now.iteration for now in here]
        assert iterations == list(range(1, len(iterations) + 1)), finished
    assert all(now.residual > 0.0 for now in steps)


def test_the_watch_sees_the_best_start_so_far():
    trained, seen = watched()
    ends = [now for now in seen if not now.iteration]
    assert [(now.n_z, now.finished) for now in ends] == [(2, 1), (2, 2), (3, 3), (3, 4)]
    assert all(math.isnan(now.residual) for now in ends)
    assert ends[1].rw <= ends[0].rw
    assert ends[3].rw <= ends[2].rw
    assert trained.starts == 4
    # before the first start has finished there is none
    assert all(math.isnan(now.rw) for now in seen[:seen.index(ends[0])])
    between = seen[seen.index(ends[0]) + 1:seen.index(ends[1])]
    assert {now.rw for now in between} == {ends[0].rw}


def press_interrupt(now):
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        signal.raise_signal(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize('act', [lambda now: True, press_interrupt],
                         ids=['the watch', 'the keyboard'])
@pytest.mark.parametrize(('place', 'n_z', 'starts'), [
    ((2, 0, 30), 2, 1), ((2, 1, 0), 2, 1), ((2, 1, 5), 2, 2), ((2, 2, 0), 2, 2),
    ((3, 2, 39), 3, 3), ((3, 3, 0), 3, 3)], ids=str)
def test_an_interrupt_keeps_the_best_so_far(act, place, n_z, starts):
    def stop(now):
        return (now.n_z, now.finished, now.iteration) == place and act(now)

    trained, seen = watched(stop)
    assert trained.model.n_z == n_z
    assert trained.starts == starts
    assert trained.status == MinimumStatus.INTERRUPTED.value
    assert trained.model.provenance.metrics['rw'] < 3e-3
    assert (seen[-1].n_z, seen[-1].finished) <= (place[0], place[1] + 1)


def test_the_watch_is_not_asked_again():
    _, seen = watched(lambda now: now.iteration == 30)
    assert seen[-1].iteration == 30


def test_an_interrupt_keeps_the_bits_of_the_starts_that_finished():
    one = train(UNFORCED, unforced_samples(), SMALL, starts=1)
    kept, _ = watched(lambda now: now.finished == 1, SMALL, starts=3)
    assert bits(kept.model) == bits(one.model)
    assert kept.model.provenance == one.model.provenance


class CutShort:
    """A recipe whose second round ends at once, by what is raised or with a useless lift."""

    def __init__(self, error=None):
        self.error = error

    def rounds(self, n_x):
        return (2, 3)

    def start(self, data, n_z, parent, seed, monitor=None):
        if n_z == 2:
            return SMALL.start(data, n_z, parent, seed, monitor)
        if self.error:
            raise self.error
        grown = replace(RECIPE, max_iterations=0).start(data, n_z, parent, seed)
        spoiled = grown.theta.clone()
        spoiled[-3:] = 5.0
        return replace(grown, theta=spoiled, status=MinimumStatus.INTERRUPTED)


@pytest.mark.parametrize('recipe', [CutShort(), CutShort(KeyboardInterrupt())],
                         ids=['useless', 'none'])
def test_a_start_cut_short_does_not_displace_the_round_before(recipe):
    trained = train(UNFORCED, unforced_samples(), recipe, starts=2)
    assert trained.model.n_z == 2
    assert [model.n_z for model in trained.path] == [2]
    assert trained.status == MinimumStatus.INTERRUPTED.value
    assert bits(trained.model) == bits(train(UNFORCED, unforced_samples(), SMALL, starts=2).model)


class Interrupted:
    """A recipe during which the keyboard interrupts before there is anything to keep."""

    def rounds(self, n_x):
        return (2,)

    def start(self, data, n_z, parent, seed, monitor=None):
        raise KeyboardInterrupt


def test_an_interrupt_before_the_first_result_passes_on():
    threads = torch.get_num_threads()
    with pytest.raises(KeyboardInterrupt):
        train(UNFORCED, unforced_samples(), Interrupted(), starts=3)
    assert torch.get_num_threads() == threads


def test_an_interrupt_may_leave_nothing_of_use():
    with pytest.raises(NoUsefulLift):
        watched(lambda now: True, replace(SMALL, hidden_first=1, ridge=1e6))
