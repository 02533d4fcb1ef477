# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The same bits whether work runs here or in processes: one set of workers for all."""

import contextlib
from dataclasses import replace

import numpy as np
import pytest
import torch

from koopman_ros.evaluation.closed_loop_test import evaluate_closed_loops
from koopman_ros.execution import backend_of
from koopman_ros.learning import train
from koopman_ros.learning.identification import (
    identify,
    identify_unmeasured,
    network_candidates,
)
from koopman_ros.learning.record import read_record
from koopman_ros.model import Coordinates, linearised_model, Provenance
from support.known_plants import CUBIC, methods, PAIR
from support.long_records import bags_of, source
from support.small_plants import BENT, bent_samples, bits, SMALL

# test_backends holds the others to the same results
KINDS = ('', 'joblib:2')
RECIPE = replace(SMALL, n_z=3)


def trained(backend, watch=None):
    return train(BENT, bent_samples(), RECIPE, starts=3, seed=5, loops=16, backend=backend,
                 watch=watch)


@pytest.fixture(scope='module')
def expected():
    return bits(trained(None).model)


@pytest.fixture(scope='module')
def places():
    with contextlib.ExitStack() as stack:
        yield {kind: stack.enter_context(backend_of(kind)) for kind in KINDS}


def test_the_bits_do_not_depend_on_where_starts_run(expected, places):
    threads = torch.get_num_threads()
    assert bits(trained(places['joblib:2']).model) == expected
    assert torch.get_num_threads() == threads


def test_a_start_that_fails_is_named(places):
    class Failing(type(RECIPE)):
        def start(self, *_):
            raise ValueError('no new coordinate can be started')

    for backend in places.values():
        with pytest.raises(ValueError, match='no new coordinate') as caught:
            train(BENT, bent_samples(), Failing(2), starts=1, backend=backend)
        assert caught.value.__notes__ == ['in start 1 with n_z = 2']


# Estimates, and closed loops.


def estimated(backend):
    return identify(CUBIC.plant, [CUBIC.excited(300, 0.1, noise=0.02)], degrees=(1, 2),
                    methods=methods(10), backend=backend)


def estimated_with_a_hidden_state(backend):
    whole = PAIR.excited(160, 0.1, noise=0.01)
    plant = replace(PAIR.plant, state_names=('x1',), state_units=('1',),
                    nominal_state=np.zeros(1))
    return identify_unmeasured(plant, [replace(whole, x=whole.x[:, :1])], 1, highest_degree=1,
                               dead_times=False, backend=backend)


@pytest.mark.parametrize('estimate', [estimated, estimated_with_a_hidden_state])
def test_drifts_are_estimated_side_by_side(places, estimate, monkeypatch):
    monkeypatch.setattr(network_candidates, 'UNITS', (2,))
    here, there = (estimate(places[kind]) for kind in ('', 'joblib:2'))
    rng, box = np.random.default_rng(0), here.drift.box
    xi, v = (rng.uniform(-1.0, 1.0, (9, len(own))) for own in (box.states, box.inputs))
    assert there.drift.scaled_rate(xi, v).tobytes() == here.drift.scaled_rate(xi, v).tobytes()
    assert [score.rmse.tobytes() for score in there.scores] == [
        score.rmse.tobytes() for score in here.scores]


def test_loops_run_side_by_side(places):
    """In two parts, each of which tells of its share."""
    A, B = np.array([[0.3, 1.0], [-2.0, -0.5]]), np.array([[0.0, 0.4], [1.5, 0.0]])
    states, inputs = (Coordinates(names, ('1', '1'), np.zeros(2), np.ones(2), np.full(2, -end),
                                  np.full(2, end))
                      for names, end in ((('a', 'b'), 1.0), (('u', 'v'), 9.0)))
    model = linearised_model(A, B, states, inputs, 's', Provenance('two'))

    def rate(x, u):
        # by its value, as workers do not know this module
        return x @ A.T + u @ B.T

    seen = []
    one = evaluate_closed_loops(model, rate, loops=64)
    other = evaluate_closed_loops(model, rate, loops=64, backend=places['joblib:2'],
                                  watch=seen.append)
    assert evaluate_closed_loops(model, rate, loops=64, backend=places['joblib:2'],
                                 watch=lambda _: True) is None
    for name in ('starts', 'setpoints', 'ratios', 'no_gain', 'excess'):
        assert getattr(other, name).tobytes() == getattr(one, name).tobytes()
    assert one.loops > 32
    assert seen == sorted(seen)


# Bags.


@pytest.fixture(scope='module')
def bags(tmp_path_factory):
    return bags_of(3, tmp_path_factory.mktemp('bags'))


def test_both_readers_return_the_same(bags, places):
    few, told = source(bags), []
    one = read_record(few, 3000, 7)
    other = read_record(few, 3000, 7, tick=told.append, backend=places['joblib:2'])
    assert min(told) == 0
    assert one.reduction == other.reduction
    assert one.account == other.account
    for a, b in zip(one.episodes, other.episodes, strict=True):
        np.testing.assert_array_equal(a.x, b.x)
    another = read_record(few, 3000, 8).episodes
    assert [part.x[0, 0] for part in another] != [part.x[0, 0] for part in one.episodes]


# Ends and interrupts: last, as a process that is ended at work is started anew.


def test_the_watch_follows_and_can_end_starts():
    seen = []

    def watch(now):
        seen.append(now)
        return now.finished == 4

    kept = trained(None, watch)
    # whole starts come in their order wherever they run, and steps of them before
    finished = [(now.n_z, now.finished) for now in seen]
    assert finished == sorted(finished)
    assert {(2, 1), (2, 2), (2, 3), (3, 4)} <= set(finished) <= {
        (2, 0), (2, 1), (2, 2), (2, 3), (3, 3), (3, 4)}
    assert any(now.iteration and np.isfinite(now.residual) for now in seen)
    assert kept.status.startswith('interrupted')
    assert (kept.model.n_z, kept.starts) == (3, 4)


def test_an_interrupt_keeps_the_best_that_processes_have_found(places):
    """The processes themselves ignore it."""
    def watch(now):
        if now.finished == 4:
            raise KeyboardInterrupt

    kept = trained(places['joblib:2'], watch)
    assert kept.status.startswith('interrupted')
    assert (kept.model.n_z, kept.starts) == (3, 4)
