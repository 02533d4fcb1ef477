# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What is found out about a run at the saddle afterwards, on runs of which all is known."""

import numpy as np
import pytest

from koopman_ros.control import at, Initialisation, SetpointRequest, simulate
from koopman_ros.demo.loop import Row
from koopman_ros.lifting import Coordinates, linearised_model, Provenance
from koopman_ros.plants import Process
from koopman_ros.testing import HarnessError
from studies import saddle_act
from studies.saddle import becomes, FOULING, reactor, truth
from studies.unstable import steady

FOULED = 40


@pytest.fixture(scope='module')
def loop():
    x0, u0 = steady(350.0)
    return simulate(
        saddle_act._laws(truth(), ('sdre',)), Process(reactor({}), 0, x0, u0),
        [at(0.0, Initialisation(u0)), at(0.0, SetpointRequest(0, np.array([350.0]))),
         at(10.0, SetpointRequest(0, np.array([352.0]))),
         at(float(FOULED), becomes(reactor(FOULING)))],
        duration=90.0, C=np.array([[0.0, 1.0]]), noise=np.array([0.1]), seed=1)


def rows(loop, noise=1.0):
    measured = loop.states[:, 1] + noise * (loop.measured[:, 0] - loop.states[:, 1])
    return [Row(float(t), {'concentration': float(x[0]), 'temperature': float(y)},
                {'temperature': float(r[0])}, {'coolant_temperature': float(u[0])})
            for t, x, y, r, u in zip(loop.times, loop.states, measured, loop.setpoints,
                                     loop.commands, strict=True)]


def test_temperatures_are_found_behind_their_noise(loop):
    run = saddle_act._reconstructed(rows(loop), {}, truth(),
                                    [('lift', 0.0), ('fouling', float(FOULED))])
    assert np.std(loop.measured[:, 0] - loop.states[:, 1]) > 0.08
    # the last one has no sample after it that would tell
    assert run.states[:-1] == pytest.approx(loop.states[:-1], abs=1e-4)
    assert run.noise[:-1] == pytest.approx((loop.measured[:, 0] - loop.states[:, 1])[:-1],
                                           abs=1e-4)
    assert run.fouled == FOULED


def test_a_record_that_the_plant_does_not_explain_is_no_result(loop):
    with pytest.raises(HarnessError, match='K of the record, which has'):
        saddle_act._reconstructed(rows(loop, 3.0), {}, truth(),
                                  [('lift', 0.0), ('fouling', float(FOULED))])


def test_heat_tells_the_concentration():
    """Where a model has the temperature at rest, it is that of the steady state."""
    x0, u0 = steady(350.0)
    states, inputs = (
        Coordinates.spanning(*of) for of in (
            (('temperature', 'hidden_1'), ('K', '1'), np.array([340.0, -1.0]),
             np.array([360.0, 1.0]), np.array([350.0, 0.2])),
            (('coolant_temperature',), ('K',), np.array([280.0]), np.array([310.0]), u0)))
    model = linearised_model(-np.eye(2), np.ones((2, 1)), states, inputs, 's', Provenance('rest'))
    said = {'estimated_temperature [degC]': 350.0 - 273.15, 'estimated_hidden_1 [1]': 0.2}
    assert saddle_act._concentration(model, said) == pytest.approx(x0[0], abs=1e-9)
    # a warming of 1 K/s more is the heat of more of it, by 1/(60 of the heat of 1 mol/L a minute)
    said['estimated_temperature [degC]'] -= 1.0
    low = saddle_act._concentration(model, said)
    none, one = (float(saddle_act._usual().derivative(np.array([c, 349.0]), u0)[1])
                 for c in (0.0, 1.0))
    assert none + low * (one - none) == pytest.approx(60.0, rel=1e-9)
    assert np.isnan(saddle_act._concentration(model, {}))
