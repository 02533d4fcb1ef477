# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Samples whose times or nominal point contradict the plant are rejected, noisy ones are not."""

from dataclasses import replace

import numpy as np
import pytest

from koopman_ros.core.datasets import DriftSamples, PlantDescription
from koopman_ros.learning import train
from koopman_ros.learning.lift.data_checks import check_rates
from support.small_plants import BENT, bent_samples, SMALL, TWO_STATE, two_state_samples

# dx/dt = -2 (x - 3) + u - 0.5
DECAY = PlantDescription('decay', ('level',), ('m',), ('flow',), ('m/s',), 's', np.array([3.0]),
                         np.array([0.5]), np.array([[1.0]]))


def decaying(noise=0.0, rate_noise=0.0):
    """Return five episodes of the exact motion under steps, a sample every 0.1 s."""
    rng = np.random.default_rng(0)
    x, u = np.empty((5, 60)), 0.5 + np.repeat(rng.uniform(-2.0, 2.0, (5, 6)), 10, axis=1)
    x[:, 0] = rng.uniform(2.0, 4.0, 5)
    for k in range(59):
        rest = 3.0 + 0.5 * (u[:, k] - 0.5)
        x[:, k + 1] = rest + np.exp(-0.2) * (x[:, k] - rest)
    rate = -2.0 * (x - 3.0) + u - 0.5
    x, rate = x + noise * rng.normal(size=x.shape), rate + rate_noise * rng.normal(size=x.shape)
    return DriftSamples(x.reshape(-1, 1), rate.reshape(-1, 1), u.reshape(-1, 1),
                        np.repeat(np.arange(5), 60), np.tile(0.1 * np.arange(60), 5))


@pytest.mark.parametrize('samples', [
    decaying(), replace(decaying(), time=None), decaying(noise=0.1), decaying(rate_noise=2.0),
    # each step as long as the time constant is resolved coarsely, and yet no contradiction
    DriftSamples(*(a[np.arange(300) % 60 % 5 == 0] for a in (
        decaying().x, decaying().dxdt, decaying().u, decaying().episode, decaying().time)))],
    ids=['exact', 'no times', 'noisy states', 'noisy rates', 'coarse'])
def test_times_that_do_not_contradict_the_rates(samples):
    check_rates(DECAY, samples)


@pytest.mark.parametrize('noise', [0.0, 0.005])
@pytest.mark.parametrize('factor', [10.0, 1.0 / 60.0, -1.0])
def test_times_or_rates_in_another_unit_are_rejected(factor, noise):
    samples = decaying(noise)
    # times that are too long, or rates that are too small
    wrong = replace(samples, time=factor * samples.time) if factor > 1.0 else (
        replace(samples, dxdt=factor * samples.dxdt))
    with pytest.raises(ValueError, match='times as much from sample to sample') as error:
        train(DECAY, wrong, SMALL, starts=1)
    assert float(str(error.value).split()[2]) == pytest.approx(1.0 / factor, rel=0.1)
    assert 'give time in s and dxdt in m per s, or another time_unit' in str(error.value)


RISING = replace(bent_samples(), dxdt=bent_samples().dxdt + 20.0)


@pytest.mark.parametrize(('plant', 'samples', 'words'), [
    # -0.1 - 0.3 * 0.1^2 = -0.103 m/s, which 0.0515 m/s of flow make up for
    *((replace(BENT, nominal_state=[3.1], B=B), bent_samples(),
       r'-0\.103 m/s of level: .* nominal_state = \[3\.1\] and nominal_input = \[0\.5515\]$')
      for B in (BENT.B, None)),
    # dx1/dt = -0.1 x1 stands still at x1 = 0 alone, dx2/dt = x2 - x1^2 + u wherever u = -x2
    (replace(TWO_STATE, nominal_state=[0.5, 0.0]), two_state_samples(),
     r'-0\.05 1/s of x1, .* nominal_state = \[0\.0, '),
    (BENT, RISING, '20 m/s of level: excite the plant around a')],
    ids=['known B', 'learned B', 'more states than inputs', 'no steady state'])
def test_a_nominal_point_where_the_plant_moves_is_rejected(plant, samples, words):
    with pytest.raises(ValueError, match=f'moves with {words}'):
        train(plant, samples, replace(SMALL, n_z=3), starts=1)
