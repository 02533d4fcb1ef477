# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Drifts of halves of a record: of a plant that changes, of noise that is coloured, of neither."""

from itertools import accumulate
import re

import numpy as np
import pytest

from koopman_ros.core.datasets import Episode
from koopman_ros.core.integration import runge_kutta_step
from koopman_ros.learning.ensemble import inconsistency
from koopman_ros.learning.identification import identify
from support.known_plants import CUBIC, methods

PERIOD = 0.1


def record(count, *, change=0.0, colour=0.0, size=0.02):
    """Return a record of a plant whose input loses a share of its effect from begin to end."""
    rng = np.random.default_rng(1)
    u = np.repeat(rng.uniform(-1.0, 1.0, (count // 20, 1)), 20, axis=0)
    x, path = np.zeros(1), []
    for k, held in enumerate(u):
        path.append(x)
        acting = (1.0 - change * k / count) * held
        x = runge_kutta_step(lambda x, acting=acting: CUBIC.rate(x, acting), x, PERIOD)
    white = size * np.sqrt(1.0 - colour ** 2) * rng.standard_normal((count, 1))
    noise = list(accumulate(white, lambda last, new: colour * last + new))
    time = PERIOD * np.arange(count)
    return Episode(time, np.array(path) + noise, time, u)


@pytest.mark.parametrize(('count', 'properties', 'words'), [
    (1200, {}, ''), (1200, {'change': 0.3}, 'the plant changed during the record'),
    (600, {'colour': 0.9, 'size': 0.06}, 'differ by .* of the motion.* record longer')])
def test_halves_of_a_record_tell_changes_and_scatter(count, properties, words):
    found = identify(CUBIC.plant, [record(count, **properties)], degrees=(1, 3),
                     methods=methods(20))
    said = inconsistency(found)
    assert re.search(words, said)
    assert bool(said) == bool(words)
