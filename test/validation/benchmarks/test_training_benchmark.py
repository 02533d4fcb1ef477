# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The benchmark of training: its command, the figures it leaves, and solvers on one objective."""

import json

import numpy as np
import pytest
import torch

from koopman_ros.learning import fit
from koopman_ros.learning.levenberg_marquardt import normal_equations
from koopman_ros.lifting import Coordinates, LiftedModel, NetworkObservables, Provenance
from validation.benchmarks.__main__ import main
from validation.benchmarks.options import Extent
from validation.benchmarks.training import process
from validation.benchmarks.training.plan import Plan, PLANS, SOLVERS
from validation.benchmarks.training.problems import artificial, invariant_residual, two_state
from validation.benchmarks.training.torch_solvers import differentiable

# Few samples: casadi's graphs take most of the time, and grow with them.
PLAN = Plan(((200, 8),), 2.0, 10.0, 4e3, 1, (500, 1000), (2, 3), (1, 2))


@pytest.fixture(scope='module')
def summary(tmp_path_factory):
    """Return what a short run leaves beside the figures of another part."""
    folder = tmp_path_factory.mktemp('bench')
    (folder / 'summary.json').write_text('{"loop": {"kept": true}}')
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PLANS, Extent.QUICK, PLAN)
        assert main(['training', '--quick', '--output', str(folder)]) == 0
    assert (folder / 'training.png').stat().st_size > 10_000
    return json.loads((folder / 'summary.json').read_text())


def test_one_part_leaves_the_figures_of_the_others(summary):
    assert summary['loop'] == {'kept': True}


def test_every_solver_has_a_time_or_a_reason_and_ours_reaches_the_targets(summary):
    cases = summary['training']['cases']
    assert [case['system'] for case in cases] == ['two-state example', 'one-state reactor']
    for case in cases:
        assert 0.0 < case['seconds']['1e-4']['ours'] <= case['seconds']['1e-6']['ours']
        assert case['best_rw']['ours'] <= 1e-6
        assert (case['samples'], case['hidden'], case['parameters']) == (200, 8, 41)
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


def test_cost_of_an_iteration(summary):
    training = summary['training']
    for name, sizes in (('samples', {'500', '1000'}), ('n_z', {'2', '3'}), ('n_x', {'1', '2'})):
        figures = training[f'seconds_per_iteration_by_{name}']
        assert set(figures) == sizes
        assert min(figures.values()) > 0.0
    assert set(training['peak_memory_by_samples']) == {'500', '1000'}


def test_objective_of_the_first_order_solvers_is_ours():
    case = artificial(samples=70, n_x=2, n_z=4, hidden=5)
    theta = case.theta.clone().requires_grad_(True)
    cost = differentiable(case)(theta)
    cost.backward()
    ours = normal_equations(case.problem.add_residuals, case.theta)
    assert cost.item() == pytest.approx(ours.cost, rel=1e-12)
    torch.testing.assert_close(theta.grad, ours.gradient, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize('graph', ['expanded', 'compiled'])
def test_objective_of_ipopt_is_ours(graph, monkeypatch):
    import casadi

    from validation.benchmarks.training import ipopt

    monkeypatch.setattr(ipopt, '_COMPILER', {})
    case = artificial(samples=30, n_x=2, n_z=4, hidden=3)
    problem, derivatives = getattr(ipopt, f'_{graph}_graph')(case)
    theta = case.theta.numpy()
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
    case = two_state(samples=200, hidden=4)
    parts = case.layout.split(case.theta)
    plain = Coordinates(('x1', 'x2'), ('1', '1'), np.zeros(2), np.ones(2), -np.ones(2),
                        np.ones(2))
    (W, b), = parts.hidden
    model = LiftedModel(
        NetworkObservables(((W.numpy(), b.numpy()),), parts.V.numpy(), True, 'tanh'),
        parts.A.numpy(), np.zeros((2, 1)), plain,
        Coordinates(('u',), ('1',), np.zeros(1), np.ones(1), -np.ones(1), np.ones(1)), 's',
        Provenance('two-state example'))
    x, f = case.data.x.numpy(), case.data.f.numpy()
    assert invariant_residual(case.layout, case.data, case.theta) == (
        pytest.approx(fit(model, x, f, np.zeros((200, 1))).rw, rel=1e-9))


def test_a_process_that_takes_too_long_is_ended(tmp_path):
    case = tmp_path / 'case.npz'
    two_state(samples=300, hidden=4).save(case)
    job = {'do': 'solve', 'solver': 'adam', 'path': str(case), 'targets': [1e-30], 'limit': 1e9}
    outcome = process.run(job, build_limit=1.0, limit=-4.8, megabytes=4e3)
    assert outcome.failure.startswith('stopped after')
    assert outcome.find('rw') > 0.0


def test_a_process_that_takes_too_much_memory_is_ended(tmp_path):
    job = {'do': 'measure', 'sizes': [{'samples': 1000, 'n_x': 2, 'n_z': 3, 'hidden': 16,
                                       'iterations': 10 ** 6}]}
    outcome = process.run(job, build_limit=20.0, limit=1.0, megabytes=50.0)
    assert outcome.failure == 'needs more than 50 MB of memory'
