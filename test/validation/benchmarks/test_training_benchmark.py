# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The benchmark of training: its command, the figures it leaves, and solvers on one objective."""

import json

import casadi
import numpy as np
import pytest

from koopman_ros.learning import fit
from koopman_ros.learning.lift.levenberg_marquardt import normal_equations
from koopman_ros.lifting import Coordinates, LiftedModel, NetworkObservables, Provenance
from support.tensors import assert_close
from validation.benchmarks import ipopt, process, solvers
from validation.benchmarks import training as training_part
from validation.benchmarks.__main__ import main
from validation.benchmarks.problems import artificial, build
from validation.benchmarks.training import Plan, PLANS, SOLVERS
from validation.general.learners import LEARNERS

# Few samples: casadi's graphs take most of the time, and grow with them.
PLAN = Plan(((100, 8),), 0.8, 10.0, 4e3, 1, (500, 1000), (2, 3), (1, 2), ('one-state reactor',))


@pytest.fixture(scope='module')
def training(tmp_path_factory):
    """Return the figures of a short run."""
    folder = tmp_path_factory.mktemp('bench')
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PLANS, 'quick', PLAN)
        assert main(['training', '--quick', '--output', str(folder)]) == 0
    assert (folder / 'training.png').stat().st_size > 10_000
    return json.loads((folder / 'summary.json').read_text())['training']


def test_every_solver_has_a_time_or_a_reason_and_ours_reaches_the_targets(training):
    case, = training['cases']
    assert case['system'] == 'one-state reactor'
    # processor time, which is 0 where a system counts it in longer ticks
    assert 0.0 <= case['seconds']['1e-4']['ours'] <= case['seconds']['1e-6']['ours']
    assert 0.0 < case['wall_seconds']['1e-4']['ours'] <= case['wall_seconds']['1e-6']['ours']
    assert case['best_rw']['ours'] <= 1e-6
    assert (case['samples'], case['hidden'], case['parameters']) == (100, 8, 41)
    for name, times in case['seconds'].items():
        assert set(times) == set(SOLVERS)
        for solver, seconds in times.items():
            ratio = case['ratio_to_ours'][name].get(solver)
            if seconds is None:
                assert ratio is None
                assert case['notes'].get(solver) or name in case['not_asked']
            elif solver != 'ours' and times['ours']:
                assert ratio == pytest.approx(seconds / times['ours'])
    # IPOPT starts where we start
    assert case['ipopt_build_seconds'] > 0.0
    assert case['seconds_with_build']['1e-4']['ipopt'] == pytest.approx(
        case['seconds']['1e-4']['ipopt'] + case['ipopt_build_seconds'])


def test_cost_of_an_iteration(training):
    for name, sizes in (('samples', {'500', '1000'}), ('n_z', {'2', '3'}), ('n_x', {'1', '2'})):
        figures = training[f'seconds_per_iteration_by_{name}']
        assert set(figures) == sizes
        assert min(figures.values()) > 0.0
    assert set(training['peak_memory_by_samples']) == {'500', '1000'}


def test_models_of_other_classes_are_learned_beside_ours(monkeypatch):
    monkeypatch.setattr(training_part, 'LEARNERS', {
        label: LEARNERS[label] for label in ('linear', 'EDMD-5', 'SINDy-5')})
    told = {}
    training_part._learn(told.update, 'two_tanks')
    # the polynomials have the tanks' roots to some digits; no line has them
    assert told['SINDy-5']['rx'] < 1e-4 < told['linear']['rx']
    assert told['EDMD-5']['rx'] < 1e-4
    assert min(one['seconds'] for one in told.values()) > 0.0


def test_objective_of_the_first_order_solvers_is_ours():
    case = artificial(samples=70, n_x=2, n_z=4, hidden=5)
    theta = case.theta.clone().requires_grad_(True)
    cost = solvers.differentiable(case)(theta)
    cost.backward()
    ours = normal_equations(case.problem.add_residuals, case.theta)
    assert cost.item() == pytest.approx(ours.cost, rel=1e-12)
    assert_close(theta.grad, ours.gradient, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize('graph', ['expanded', 'compiled'])
def test_objective_of_ipopt_is_ours(graph, monkeypatch):
    monkeypatch.setattr(ipopt, '_COMPILER', {})
    case = artificial(samples=30, n_x=2, n_z=4, hidden=3)
    problem, derivatives = getattr(ipopt, f'_{graph}_graph')(case)
    theta = case.start
    cost = casadi.Function('cost', [problem['x']], [problem['f']])
    assert float(cost(theta)) == pytest.approx(
        normal_equations(case.problem.add_residuals, case.theta, derivatives=False).cost,
        rel=1e-12)
    if derivatives:
        plain, _ = ipopt._expanded_graph(case)
        hessian, gradient = casadi.hessian(plain['f'], plain['x'])
        exact = casadi.Function('exact', [plain['x']], [casadi.triu(hessian), gradient])(theta)
        np.testing.assert_allclose(derivatives['hess_lag'](theta, [], 1.0, []).full(),
                                   exact[0].full(), rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(derivatives['grad_f'](theta, [])[1].full(),
                                   exact[1].full(), rtol=1e-9, atol=1e-11)


def test_invariant_residual_is_that_of_validation():
    case = build('two-state example', samples=200, hidden=4)
    parts = case.layout.split(case.theta)
    plain = Coordinates(('x1', 'x2'), ('1', '1'), np.zeros(2), np.ones(2), -np.ones(2),
                        np.ones(2))
    (W, b), = parts.hidden
    model = LiftedModel(
        NetworkObservables(W.numpy(), b.numpy(), parts.V.numpy(), True),
        parts.A.numpy(), np.zeros((2, 1)), plain,
        Coordinates(('u',), ('1',), np.zeros(1), np.ones(1), -np.ones(1), np.ones(1)), 's',
        Provenance('two-state example'))
    assert case.rw(case.theta) == pytest.approx(
        fit(model, case.x, case.f, np.zeros((200, 1))).rw, rel=1e-9)


@pytest.mark.parametrize(('samples', 'megabytes', 'failure'), [
    (2_000_000, 8e3, 'stopped after 0.1 s'),
    (100_000_000, 1500.0, 'needs more than 1500 MB of memory')])
def test_a_process_that_takes_too_much_is_ended(samples, megabytes, failure, tmp_path):
    outcome = process.run(solvers.measure_cost, [(samples, 2, 8, 64)], 0.1,
                          folder=tmp_path, megabytes=megabytes)
    assert outcome.failure == failure
