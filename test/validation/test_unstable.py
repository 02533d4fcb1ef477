# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The study of the reactor about its saddle, with few data and steps."""

from dataclasses import replace

import numpy as np
import pytest

from koopman_ros.learning import NeuralDrift, NoUsefulLift
from koopman_ros.plants import recoverable
from validation import unstable


def test_samples_fill_the_range_and_stay_where_the_coolant_can_go():
    x = unstable.samples(0, 60).x
    design = unstable.DESIGN
    assert np.all((x >= design.state_lower) & (x <= design.state_upper))
    assert np.ptp(x[:, 1]) > 48.0
    found = recoverable(unstable.SYSTEM, x, input_lower=design.input_lower,
                        input_upper=design.input_upper, state_lower=design.state_lower,
                        state_upper=design.state_upper)
    # the law may be lost where a path that was taken is not
    assert np.mean(found) > 0.98
    # hot and full of reactant, it ignites
    assert not np.any((x[:, 0] > 0.6) & (x[:, 1] > 365.0))


def test_a_row_of_a_lift_that_was_learned_in_a_hurry(monkeypatch, capsys):
    monkeypatch.setattr(unstable, 'EPISODES', 150)
    monkeypatch.setattr(unstable, 'FRESH_EPISODES', 50)
    monkeypatch.setattr(unstable, 'STEPS', unstable.STEPS[:1])
    monkeypatch.setattr(unstable, 'STARTS', 1)
    monkeypatch.setattr(unstable, 'RECIPES', {
        'neural drift': NeuralDrift(12, max_iterations=150),
        'free lift': replace(unstable.LIFT, hidden_first=24, max_iterations=250)})
    monkeypatch.setattr(unstable, 'LIMITED_STARTS', 1)
    monkeypatch.setattr(unstable, 'LIMITED_SAMPLES', 120)
    assert unstable.main(['--seeds', '1']) == 0
    lines = capsys.readouterr().out.splitlines()
    row = lines[2].strip('| ').split(' | ')
    seed, rw, rx, cond, by_rates, cost, _ = map(float, row)
    assert seed == 0
    assert rw < 1e-4
    assert rx < 1e-5 < by_rates < 0.1
    assert cond < 5.0
    # the law weighs the coolant itself: else it would be far from the least cost
    assert 1.0 - 1e-3 < cost < 1.01
    laws = {law: float(cost) for law, cost, _ in (
        line.strip('| ').split(' | ') for line in lines[-2:])}
    # what is planned costs no more than what is cut
    assert laws['mpc'] <= 1.005 * laws['sdre'] < 50.0


def test_a_seed_without_a_lift_is_told(monkeypatch, capsys):
    def learn(seed):
        raise NoUsefulLift('no start gave a usable lift')

    monkeypatch.setattr(unstable, 'learn', learn)
    assert unstable.main(['--seeds', '2']) == 1
    assert 'seed 1: no start gave a usable lift' in capsys.readouterr().err


def test_no_seeds(capsys):
    with pytest.raises(SystemExit):
        unstable.main(['--seeds', '0'])
    assert '--seeds is 0, must be at least 1' in capsys.readouterr().err
