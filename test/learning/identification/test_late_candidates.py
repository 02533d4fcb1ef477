# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Dead times of a plant that overflows, found together with a network."""

import numpy as np
import pytest

from koopman_ros.core.datasets import Episode, PlantDescription
from koopman_ros.core.integration import runge_kutta_step
from koopman_ros.execution import Serial
from koopman_ros.learning.identification import (
    identify_structure,
    network_candidates,
    structure_search,
)
from koopman_ros.learning.identification.data_split import SplitRecord
from koopman_ros.learning.identification.late_candidates import late_as_suits
from koopman_ros.learning.identification.network_candidates import add_networks, Shared
from koopman_ros.learning.identification.network_drift import NetworkDrift
from koopman_ros.learning.identification.polynomial_candidates import PolynomialSearch
from koopman_ros.learning.identification.structure_candidates import Choice
from support.known_plants import methods

PLANT = PlantDescription('overflow', ('level',), ('m',), ('flow',), ('l/s',), 's', np.zeros(1),
                         np.zeros(1), None)
PERIOD, LATE = 0.5, 5


def overflow(x, u):
    """Lose more above a level; no polynomial has the corner."""
    return u - 0.4 * x - 2.0 * np.maximum(0.0, x - 0.3)


def record(samples, dead_time):
    """Return a record with 1 % noise whose inputs act later by a number of samples."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-0.8, 0.8, samples), rng.integers(4, 20, samples))[:samples, None]
    acting = np.vstack((np.repeat(u[:1], dead_time, axis=0), u))
    x, path = np.zeros(1), []
    for held in acting[:samples]:
        path.append(x)
        x = runge_kutta_step(lambda x, held=held: overflow(x, held), x, PERIOD)
    noise = 0.01 * np.std(path)
    time = PERIOD * np.arange(samples)
    return Episode(time, path + noise * rng.standard_normal((samples, 1)), time, u)


@pytest.mark.parametrize('given', [2, 9])
def test_a_network_gets_the_dead_time_of_the_plant(given):
    whole = SplitRecord(PLANT, [record(400, LATE)], 0, hidden=True)
    search = PolynomialSearch(whole.later((given,)))
    linear = search.linear(0, lambda *_: False)
    choice = Choice(())
    add_networks(choice, Shared(
        linear, search.record.simulated(linear.start, search.samples), True, 60.0),
        {'network': (3, 0)}, lambda _: lambda *_: False, Serial())
    (network,) = choice.candidates
    assert network.late == (given,)
    found = late_as_suits(network, (True,), search.samples, lambda *_: False)
    assert found.late == (LATE,)
    assert found.score.cost < 0.5 * network.score.cost
    # a known dead time, or that of a measured disturbance, is kept
    assert late_as_suits(network, (False,), search.samples, lambda *_: False) is None


def test_dead_time_and_network_are_found_together(monkeypatch):
    monkeypatch.setattr(structure_search, 'MOST_UNMEASURED', 1)
    monkeypatch.setattr(network_candidates, 'UNITS', (3,))
    monkeypatch.setattr(network_candidates, 'STARTS', 1)
    found = identify_structure(PLANT, [record(300, LATE)], methods=methods(20))
    assert isinstance(found.drift, NetworkDrift)
    assert found.dead_time / PERIOD == pytest.approx([LATE], abs=1.0)
    # of linear models, also those whose states stand for the dead time
    assert found.free_run < 0.5 * np.min([
        score.rmse for score in found.scores if score.degree == 1])
