# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Courses of a plant that acts late, against the same plant without dead time."""

from dataclasses import replace

import numpy as np
import pytest

from koopman_ros.demo.late_input import FirstOrder, LateRun, pi_law, Piece
from koopman_ros.plants import Actuator, ControlAffineSystem, Process

TAU, GAIN, LATE, N = 20.0, 2.0, 5, 80  # s; dead time in samples of 1 s
LINEAR = ControlAffineSystem(
    name='linear', state_names=('x',), state_units=('1',), input_names=('u',), input_units=('1',),
    time_unit='s', drift=lambda x: -x / TAU, B=np.array([[GAIN / TAU]]),
    nominal_state=np.zeros(1), nominal_input=np.zeros(1))


def run(late):
    process = Process(LINEAR, 0, np.zeros(1), np.zeros(1), Actuator(dead_time=float(late)),
                      np.zeros(1))
    return LateRun(process, [Piece(0, LINEAR, {'x': 0.0}), Piece(10, LINEAR, {'x': 1.0})], 1.0, N,
                   np.ones(1), np.array([0.1]), np.zeros((N, 1)))


def test_the_optimum_is_that_without_dead_time_later():
    late, at_once = run(LATE).optimum(), run(0).optimum()
    np.testing.assert_allclose(late.states[LATE:, 0], at_once.states[:-LATE, 0], atol=1e-3)
    # at rest a dead time longer
    waited = LATE * (1.0 + 0.1 / GAIN ** 2)
    assert late.cost == pytest.approx(at_once.cost + waited, rel=1e-3)


def test_a_plant_has_its_own_first_order_model_and_a_valve_its_gain():
    found = FirstOrder.of(run(LATE).start, 'x', 1.0)
    assert (found.gain, found.dead_time) == pytest.approx((GAIN, LATE + 0.5))
    assert found.time_constant == pytest.approx(TAU, rel=0.02)
    valve = replace(run(0).start, u=np.array([0.5]),
                    actuator=Actuator(0.0, 1.0, rangeability=20.0))
    assert FirstOrder.of(valve, 'x', 1.0).gain == pytest.approx(
        GAIN * np.log(20.0) * 20.0 ** 0.5 / 19.0, rel=1e-6)


@pytest.mark.parametrize('predicts', [False, True])
def test_pi_control_is_tuned_by_simc_and_the_smith_predictor_acts_as_without_dead_time(predicts):
    model = FirstOrder(GAIN, TAU, float(LATE))

    def course(late, predicting, known=model):
        return run(late).under(pi_law(known, (-10.0, 10.0), (0.0, 0.0), 0,
                                      lambda n: float(n >= 10), 1.0, predicts=predicting))

    found = course(LATE, predicts)
    wanted = LATE if predicts else 2 * LATE
    gain = TAU / (GAIN * wanted)
    assert found.commands[10, 0] == pytest.approx(
        gain * (1.0 + 1.0 / min(TAU, 4.0 * wanted)))
    assert found.states[-1, 0] == pytest.approx(1.0, abs=0.02)
    if predicts:
        # Smith's principle: the commands are those without dead time
        same = replace(model, dead_time=0.5 * LATE)  # with as much gain without a predictor
        np.testing.assert_allclose(found.commands, course(0, False, same).commands, atol=1e-9)
