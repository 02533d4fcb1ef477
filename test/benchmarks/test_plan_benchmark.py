# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The benchmark of plans: the sides solve one problem, or it says that they do not."""

import shutil

import numpy as np
import pytest

from benchmarks import planning
from benchmarks.sqp import Problem, solver_of, Sqp
from studies.equations import EQUATIONS


@pytest.mark.parametrize(('plant', 'states'), [('pendulum', 2), ('quadruple_tank', 4)])
def test_the_sides_agree_and_have_their_times(plant, states):
    found = planning.compare(plant, 12, None)
    assert (found['steps'], found['states'], found['compiled']) == (12, states, False)
    assert found['agreement'].keys() == planning.TOLERANCE.keys()
    for side in ('step', 'law', 'do_mpc', 'sqp'):
        for clock in ('', 'cpu_'):
            median, p99 = (found[f'{side}_{clock}{label}_us'] for label in ('median', 'p99'))
            assert 0.0 < median <= p99


def test_sides_with_another_plant_are_not_compared(monkeypatch):
    same = EQUATIONS['pendulum']
    monkeypatch.setitem(EQUATIONS, 'pendulum', lambda x, u: same(x, 0.8 * u))
    with pytest.raises(ValueError, match=r'pendulum: the commands of .* do not solve one problem'):
        planning.compare('pendulum', 5, None)


def problem():
    """Return a short plan of an integrator, for which the answer is known."""
    return Problem(lambda x, u: u, np.full(2, 0.5), np.zeros(1), np.ones(1), np.eye(1),
                   np.array([-1.5]), np.array([1.5]), (np.full(1, 2.0), np.full(1, 3.0)))


def test_the_plan_of_an_integrator_is_the_known_one_within_its_limits(tmp_path):
    compilers = [None, *filter(None, [shutil.which('cc')])]
    for compiler in compilers:
        one = Sqp(problem(), solver_of(problem(), tmp_path, compiler))
        zero = np.zeros(1)
        # least of u^2 T + (x + u T)^2 with T = 1: u = -x / 2
        for x, u in ((1.0, -0.5), (-2.0, 1.0), (8.0, -1.5)):
            assert one.step(np.array([x]), zero, zero) == pytest.approx(u, abs=1e-6)
