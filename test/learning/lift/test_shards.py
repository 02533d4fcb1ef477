# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Sums over samples that stay with the workers that read them."""

import contextlib
from dataclasses import replace
import pickle

import numpy as np
import pytest
import torch

from koopman_ros.jobs.backends import Here
from koopman_ros.learning import Growth, read_samples, train, write_samples
from koopman_ros.learning.lift.levenberg_marquardt import normal_equations
from koopman_ros.learning.lift.network import Layout
from koopman_ros.learning.lift.neural_drift import DriftProblem
from koopman_ros.learning.lift.residuals import LiftProblem, ResidualWeights
from koopman_ros.learning.lift.scaling import Scaling
from koopman_ros.learning.lift.shards import KeptShards
from koopman_ros.lifting import Box
from support.small_plants import (
    BENT,
    bent_samples,
    bits,
    shards_of,
    SMALL,
    TWO_STATE,
    two_state_samples,
)
from support.tensors import assert_close


def problems(plant, samples):
    """Return the least-squares problems of all kinds on samples, with random parameters."""
    n_x = samples.x.shape[1]
    box = Box.of(plant, samples.x, samples.u)
    scaling = Scaling.of(plant, box, samples, None)
    data = scaling.data(samples, 'cpu')
    n_u = 0 if data.u is None else data.u.shape[1]
    weights = ResidualWeights(whitening=1.0, decoder=0.1)
    layouts = [Layout(n_x, n_x + 2, hidden, True, n_u=n_u) for hidden in ((5,), (4, 3))]
    layouts.append(replace(layouts[0], identity=False, decoder=3))
    found = [LiftProblem(layout, data, weights if layout.decoder else replace(
        weights, decoder=0.0)) for layout in layouts]
    found.append(DriftProblem(Layout(n_x, n_x, (6,), False, n_u=n_u), data))
    generator = torch.Generator().manual_seed(1)
    return scaling, [(problem, torch.randn(problem.layout.size, generator=generator,
                                           dtype=torch.float64)) for problem in found]


@pytest.mark.parametrize('learned', [False, True], ids=['B known', 'B learned'])
def test_sums_of_parts_are_the_sum(tmp_path, learned):
    """Whatever the problem, up to rounding; only its order differs."""
    samples = two_state_samples(400)
    scaling, given = problems(replace(TWO_STATE, B=None) if learned else TWO_STATE, samples)
    with contextlib.closing(KeptShards(Here(), shards_of(samples, tmp_path))) as kept:
        kept.scaled(scaling, 'cpu', 1)
        assert len(kept) == len(samples)
        for problem, theta in given:
            apart = problem.on(replace(problem.data, elsewhere=kept))
            for derivatives in (True, False):
                one, other = (normal_equations(each.add_residuals, theta, derivatives=derivatives)
                              for each in (problem, apart))
                assert other.cost == pytest.approx(one.cost, rel=1e-13)
                assert_close(other.gradient, one.gradient, rtol=1e-11, atol=1e-11)
                assert_close(other.matrix, one.matrix, rtol=1e-11, atol=1e-11)


class Counting:
    """A backend that measures what it passes on, in bytes."""

    def __init__(self, backend):
        self.backend, self.sent, self.received = backend, [], []

    def keep(self, load, items):
        self.sent.append(len(pickle.dumps(items)))
        self.kept = self.backend.keep(load, items)
        return self

    def run(self, function, argument):
        self.sent.append(len(pickle.dumps((function, argument))))
        found = self.kept.run(function, argument)
        self.received.append(len(pickle.dumps(found)))
        return found

    def close(self):
        self.kept.close()


def test_what_goes_and_comes_does_not_grow_with_the_samples(tmp_path):
    """Neither the samples nor a view of them is in what is pickled."""
    sizes = {}
    for count in (300, 3000):
        samples = two_state_samples(count)
        counting = Counting(Here())
        train(TWO_STATE, two_state_samples(300), Growth(3, max_iterations=3), starts=1, loops=0,
              refuse=False, backend=counting, shards=shards_of(samples, tmp_path))
        sizes[count] = max(counting.sent), max(counting.received)
    assert sizes[3000] == pytest.approx(sizes[300], rel=0.01)
    assert sizes[3000][0] < 10_000
    # three shards, each of fewer numbers than (2 h (n_x + 2) + n_x + h + 1)^2
    assert sizes[3000][1] < 3 * 8 * 75 ** 2 + 5000


def test_it_learns_from_the_shards(tmp_path):
    """The samples here reach less far and their drift is another one: it is that of the shards."""
    wide = bent_samples(length=200, seed=3)
    some = bent_samples()
    drift = some.dxdt - 2.0 * (some.u - 0.5)
    wrong = replace(some, dxdt=some.dxdt + 0.2 * drift).where(np.abs(some.x[:, 0] - 3.0) < 0.8)
    found = train(BENT, wrong, SMALL, starts=1, loops=0, refuse=False, backend=Here(),
                  shards=shards_of(wide, tmp_path))
    assert found.model.states.upper == wide.x.max()
    x = np.linspace(2.2, 4.2, 9)[:, None]
    rate = found.model.drift(found.model.states.to_deviation(x)) * found.model.states.scale
    np.testing.assert_allclose(rate, (3.0 - x) - 0.3 * (x - 3.0) ** 2, rtol=0.1, atol=0.02)
    assert found.model.provenance.data_digest != train(
        BENT, wrong, SMALL, starts=1, loops=0, refuse=False).model.provenance.data_digest


def test_a_file_keeps_samples(tmp_path):
    samples = replace(bent_samples(), time=np.tile(np.arange(30.0), 6))
    write_samples(tmp_path / 'some.npz', samples)
    assert read_samples(tmp_path / 'some.npz').digest() == samples.digest()
    np.testing.assert_array_equal(read_samples(tmp_path / 'some.npz').time, samples.time)


@pytest.mark.parametrize('device', ['cpu', 'cpu:0'])
def test_a_device_by_name(device):
    found = train(BENT, bent_samples(), SMALL, starts=1, loops=0, device=device)
    assert bits(found.model) == bits(train(BENT, bent_samples(), SMALL, starts=1, loops=0).model)


def test_a_device_that_there_is_not(monkeypatch):
    for device, text in (('cuda', 'finds no GPU'), ('gpu', "device is 'gpu'")):
        monkeypatch.setattr(torch.cuda, 'is_available', lambda: False)
        if device == 'cuda' and torch.version.cuda:
            continue
        with pytest.raises(ValueError, match=text):
            train(BENT, bent_samples(), SMALL, device=device)
