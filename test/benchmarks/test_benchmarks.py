# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The benchmarks: both sides solve one problem, and each part leaves its ratios."""

import json
from pathlib import Path
import shutil
from typing import Any
import warnings

import numpy as np
import pytest
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Temperature

from benchmarks import loop, planning, recording, training
from benchmarks.__main__ import main
from benchmarks.sqp import solver_of, Sqp, SqpProblem
from studies.equations import EQUATIONS


@pytest.fixture(scope='module')
def figures(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Return the figures of a short run of all parts, beside those of another part."""
    folder = tmp_path_factory.mktemp('bench')
    (folder / 'summary.json').write_text('{"another": {"kept": true}}')
    with warnings.catch_warnings(), pytest.MonkeyPatch.context() as patch:
        # the parser of the type support imports a module that Python deprecated
        warnings.simplefilter('ignore', DeprecationWarning)
        serialize_message(Temperature())
        warnings.simplefilter('error')
        # few samples: casadi's graphs take most of the time, and grow with them
        patch.setitem(training.PLANS, 'quick', training.TrainingPlan(
            ((100, 8),), 0.8, 10.0, 4e3, 1, ('one-state reactor',)))
        patch.setattr(training, 'SOLVERS', {
            name: training.SOLVERS[name] for name in ('ours', 'ipopt', 'adam')})
        patch.setitem(loop.PLANS, 'quick', loop.LoopPlan(12, False))
        patch.setattr(planning, 'SETPOINTS', {'pendulum': planning.SETPOINTS['pendulum']})
        patch.setitem(recording.PLANS, 'quick', recording.RecordingPlan(1.0, 3000, 1))
        assert main(['--quick', '--output', str(folder)]) == 0
    return json.loads((folder / 'summary.json').read_text())


def test_every_part_leaves_its_figures(figures: dict[str, Any]) -> None:
    assert figures['another'] == {'kept': True}
    found = figures['loop']
    assert set(loop.MEANING) <= set(found)
    plan = found['plan']['pendulum']
    for side in ('do_mpc', 'sqp'):
        assert plan['agreement'][side] < planning.TOLERANCE[side]
        assert found[f'plan_ratio_to_{side}']['pendulum']['median'] == pytest.approx(
            plan[f'{side}_cpu_median_us'] / plan['law_cpu_median_us'])
    assert set(found['pending_ratio']) == {'sdre', 'mpc', 'linear'}
    steady = figures['recording']['steady']
    assert (steady['sent'], steady['recorded'], steady['lost']) == (1000, 1000, 0)
    assert steady['in_order']


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
