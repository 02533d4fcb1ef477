# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The benchmarks: both sides solve one problem, and each part leaves its ratios."""

import json
from pathlib import Path
import shutil
from typing import Any
import warnings

import casadi
import numpy as np
import pytest
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Temperature

from benchmarks import ipopt, loop, planning, recording, solvers, training
from benchmarks.__main__ import main
from benchmarks.problems import build
from benchmarks.sqp import solver_of, Sqp, SqpProblem
from koopman_ros.learning.lift.levenberg_marquardt import normal_equations
from studies.equations import EQUATIONS
from studies.general.learners import LEARNERS
from support.tensors import assert_close


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


def test_every_solver_has_a_time_or_a_reason_and_ours_reaches_the_targets(
        figures: dict[str, Any]) -> None:
    case, = figures['training']['cases']
    assert case['best_rw']['ours'] <= 1e-6
    for name, times in case['seconds'].items():
        assert set(times) == {'ours', 'ipopt', 'adam'}
        for solver, seconds in times.items():
            ratio = case['ratio_to_ours'][name].get(solver)
            if seconds is None:
                assert ratio is None
                assert case['notes'].get(solver) or name in case['not_asked']
            elif solver != 'ours' and times['ours']:
                assert ratio == pytest.approx(seconds / times['ours'])


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


def test_all_solvers_have_one_objective(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ipopt, '_COMPILER', {})
    case = build('two-state example', samples=30, hidden=4)
    theta = case.theta.clone().requires_grad_(True)
    cost = solvers.differentiable(case)(theta)
    cost.backward()
    ours = normal_equations(case.problem.add_residuals, case.theta)
    assert cost.item() == pytest.approx(ours.cost, rel=1e-12)
    assert_close(theta.grad, ours.gradient, rtol=1e-10, atol=1e-12)
    plain, _ = ipopt._expanded_graph(case)
    assert float(casadi.Function('cost', [plain['x']], [plain['f']])(case.start)) == pytest.approx(
        ours.cost, rel=1e-12)
    _, derivatives = ipopt._compiled_graph(case)
    hessian, gradient = casadi.hessian(plain['f'], plain['x'])
    exact = casadi.Function('exact', [plain['x']], [casadi.triu(hessian), gradient])(case.start)
    for found, true in ((derivatives['hess_lag'](case.start, [], 1.0, []), exact[0]),
                        (derivatives['grad_f'](case.start, [])[1], exact[1])):
        np.testing.assert_allclose(found.full(), true.full(), rtol=1e-9, atol=1e-11)


def test_the_benchmark_also_trains_models_of_other_classes(
        monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training, 'LEARNERS', {
        label: LEARNERS[label] for label in ('linear', 'SINDy-5')})
    told: dict[str, Any] = {}
    training._learn(told.update, 'two_tanks')
    # the polynomials have the tanks' roots to some digits; no line has them
    assert told['SINDy-5']['rx'] < 1e-4 < told['linear']['rx']
