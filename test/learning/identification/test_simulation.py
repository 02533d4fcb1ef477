# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Simulations of many steps at once, compared with one step after the other."""

from collections.abc import Callable

import numpy as np
import pytest

from koopman_ros.core.arrays import Array
from koopman_ros.core.integration import runge_kutta_step
from koopman_ros.learning.identification.simulation import simulated

A = np.array([[-1.0, 2.0], [-2.0, -0.5]])
RATES: dict[str, Callable[[Array, Array], Array]] = {
    'linear': lambda x, u: x @ A.T + u,
    'cubic': lambda x, u: x @ A.T - x ** 3 + u,
    'network': lambda x, u: 3.0 * np.tanh(2.0 * x @ A.T) + u,
    'unstable': lambda x, u: 0.05 * x + 0.1 * u,
    'diverging': lambda x, u: x ** 2 + u ** 2,
    'oscillator': lambda x, u: np.stack((
        x[:, 1], 2.0 * (1.0 - x[:, 0] ** 2) * x[:, 1] - x[:, 0]), axis=-1) + u,
}


@pytest.mark.parametrize(('segments', 'count'), [(1, 700), (3, 40), (40, 20)])
@pytest.mark.parametrize('kind', RATES)
def test_states_are_those_of_steps_that_follow_each_other(kind, segments, count):
    """Steps of different lengths, 0 in the padding, from starts with or without a guess."""
    rng, evaluations = np.random.default_rng(0), [0]
    u = rng.uniform(-1.0, 1.0, (count, segments, 2))
    h = rng.choice([0.0, 0.05, 0.1], (count, segments, 1))
    starts = rng.uniform(-1.0, 1.0, (segments, 2))

    def step(rows, x):
        evaluations[0] += 1
        v, lengths = u.reshape(-1, 2)[rows], h.reshape(-1, 1)[rows]
        return runge_kutta_step(lambda x: RATES[kind](x, v), x, lengths)

    true = [starts]
    with np.errstate(all='ignore'):
        for k in range(count):
            true.append(runge_kutta_step(
                lambda x, v=u[k]: RATES[kind](x, v), true[-1], h[k]))
    true = np.array(true)
    assert np.all(np.isfinite(true)) == (kind != 'diverging')
    guess = np.nan_to_num(true) + 0.01 * rng.uniform(-1.0, 1.0, true.shape)
    for begin in (None, guess):
        found = simulated(step, starts, count, np.ones(2), begin)
        assert found == pytest.approx(true, rel=1e-9, abs=1e-9, nan_ok=True)
    if kind == 'linear' and segments < 40:
        # three for each block of steps, twice
        assert evaluations[0] <= 6 * (1 + count // 500)
