# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The benchmark: all sides solve one problem, and are timed."""

import json
from pathlib import Path
import shutil

import numpy as np
import pytest

from benchmarks import __main__ as benchmark
from benchmarks import planning
from benchmarks.sqp import solver_of, Sqp, SqpProblem
from studies.equations import EQUATIONS


def test_every_side_has_its_figures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(benchmark, 'QUICK_SAMPLES', 12)
    monkeypatch.setattr(planning, 'SETPOINTS', {'pendulum': planning.SETPOINTS['pendulum']})
    assert benchmark.main(['--quick', '--output', str(tmp_path)]) == 0
    figures = json.loads((tmp_path / 'summary.json').read_text())
    assert set(benchmark.MEANING) <= set(figures)
    plan = figures['plan']['pendulum']
    for side in ('do_mpc', 'sqp'):
        assert plan['agreement'][side] < planning.TOLERANCE[side]
        assert plan[f'{side}_cpu_median_us'] > 0.0
    assert set(figures['pending_us']) == {'sdre', 'mpc', 'linear'}


def test_plans_that_differ_are_not_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    rates = EQUATIONS['pendulum']
    monkeypatch.setitem(EQUATIONS, 'pendulum', lambda x, u: rates(x, 0.8 * u))
    with pytest.raises(ValueError, match='pendulum'):
        planning.compare('pendulum', 5, None)


def test_the_plan_of_an_integrator_is_the_known_one_within_its_limits(tmp_path: Path) -> None:
    problem = SqpProblem(lambda x, u: u, np.full(2, 0.5), np.zeros(1), np.ones(1), np.eye(1),
                         np.array([-1.5]), np.array([1.5]), (np.full(1, 2.0), np.full(1, 3.0)))
    for compiler in [None, *filter(None, [shutil.which('cc')])]:
        one = Sqp(problem, solver_of(problem, tmp_path, compiler))
        # least of u^2 T + (x + u T)^2 with T = 1: u = -x / 2
        for x, u in ((1.0, -0.5), (-2.0, 1.0), (8.0, -1.5)):
            assert one.step(np.array([x]), np.zeros(1), np.zeros(1)) == pytest.approx(u, abs=1e-6)
