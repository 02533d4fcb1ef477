# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The study of the law on plants that it was not made for, with few data and starts."""

from dataclasses import replace
from functools import partial
import json
import re

import matplotlib.image
import numpy as np
import pytest

from koopman_ros.learning import fit, Growth, NoUsefulLift, rollout_rmse
from koopman_ros.lifting import Box
from koopman_ros.plants import describe
from koopman_ros.solvers import solve_riccati
from studies.general import coordinates, learners, loops, study
from studies.general.__main__ import main
from studies.general.loops import End, judged, Known
from studies.general.systems import CASES, oscillator


@pytest.mark.parametrize('name', CASES)
def test_cases_rest_at_their_nominal_state_and_are_factorised(name):
    case = CASES[name]
    system, x0 = case.system, case.system.nominal_state
    size = case.units[0] / case.horizon
    assert np.all(np.abs(system.derivative(x0, system.nominal_input)) < 1e-9 * size)
    # off the axes, and where one state is at its nominal value
    for x in (*case.starts(4), np.where(np.arange(system.n_x) == 0, x0, case.upper)):
        assert np.all((x >= case.lower) & (x <= case.upper))
        change = system.drift(x) - system.drift(x0)
        np.testing.assert_allclose(case.factorised(x) @ (x - x0), change,
                                   atol=1e-9 * np.max(np.abs(change)))


def test_the_factorisations_are_the_natural_ones():
    x = np.array([1.5, -0.7])
    x1 = x[0]
    np.testing.assert_allclose(CASES['van_der_pol'].factorised(x),
                               [[0.0, 1.0], [-1.0, 1.0 - x1 ** 2]])
    np.testing.assert_allclose(CASES['duffing'].factorised(x),
                               [[0.0, 1.0], [1.0 - x1 ** 2, -0.5]])
    # dx2/dt = x2 - x1^2
    np.testing.assert_allclose(CASES['two_state_example'].factorised(x),
                               [[-0.1, 0.0], [-x1, 1.0]])
    # friction over inertia 0.1/0.25, g/l 9.81/0.5
    np.testing.assert_allclose(CASES['pendulum'].factorised(x),
                               [[0.0, 1.0], [19.62 * np.sin(x1) / x1, -0.4]])


@pytest.mark.parametrize('name', ['van_der_pol', 'duffing'])
def test_slopes_of_the_oscillators(name):
    system, x, h = CASES[name].system, np.array([0.8, -1.3]), 1e-6
    slopes = [(system.drift(x + step) - system.drift(x - step)) / (2.0 * h)
              for step in h * np.eye(2)]
    np.testing.assert_allclose(system.drift_jacobian(x), np.transpose(slopes), atol=1e-8)


def test_of_a_linear_plant_all_costs_are_those_of_the_riccati_equation(monkeypatch):
    spring = oscillator('spring', lambda x1, x2: x1 - x2, lambda x1, x2: (1.0, -1.0))
    case = replace(CASES['duffing'], system=spring)
    monkeypatch.setitem(CASES, 'spring', case)
    found = loops.known('spring', 2)
    unit, u = case.units
    A, Q, R = np.array([[0.0, 1.0], [1.0, -1.0]]), np.diag(unit ** -2.0), np.diag(u ** -2.0)
    K = solve_riccati(A, spring.B, Q, R).K
    closed = A - spring.B @ K
    eigenvalues, V = np.linalg.eig(closed)
    # P of the Lyapunov equation closed' P + P closed = -(Q + K' R K), in modal coordinates
    W = V.conj().T @ (Q + K.T @ R @ K) @ V
    P = -W / np.add.outer(eigenvalues.conj(), eigenvalues)
    exact = [np.real(m.conj() @ P @ m) for m in (np.linalg.solve(V, x) for x in case.starts(2))]
    # six time constants leave exp(-12) of the cost, holding the input 1/800 of them more
    np.testing.assert_allclose([end.cost for end in found.lqr], exact, rtol=1e-4)
    np.testing.assert_allclose([end.cost for end in found.sdre], exact, rtol=1e-4)
    np.testing.assert_allclose(found.least, exact, rtol=1e-3)


def test_ends_are_counted_and_compared_start_by_start():
    known = Known(lqr=(End(2.0), End(1.0), End(np.inf), End(np.inf)),
                  sdre=(End(1.0), End(4.0), End(3.0), End(np.inf)),
                  least=(1.0, 0.5, np.inf, 1.0))
    ends = [End(1.04), End(1.2), End(np.inf, no_gain=True), End(np.inf)]
    assert judged(ends, known) == {
        'no_gain': 1, 'not_arrived': 2, 'missed': 3, 'ratio': pytest.approx(1.12),
        'ratio_worst': pytest.approx(1.2), 'least_ratio': pytest.approx(2.4)}
    assert judged([ends[2]] * 4, known)['ratio'] is None


def test_a_plant_that_does_not_get_there_in_time_has_not_arrived():
    # the linear law needs its horizon, and nothing is left of a hundredth of that
    case = replace(CASES['duffing'])
    assert all(np.isfinite(end.cost) for end in loops.loops(case, case.truth, 2))
    case.__dict__['horizon'] = 0.01 * case.horizon
    assert all(end == End(np.inf) for end in loops.loops(case, case.truth, 2))


def test_a_refused_model_is_judged_all_the_same(monkeypatch):
    calls = []

    def train(*args, refuse=True, **kwargs):
        calls.append(refuse)
        if refuse:
            raise NoUsefulLift('no better than a linear one')
        return real(*args, refuse=False, **kwargs)

    real = learners.train
    monkeypatch.setattr(learners, 'train', train)
    case = CASES['duffing']
    learned = learners._trained(lambda n_x: Growth(n_x + 1, max_iterations=3))(
        describe(case.system), case.samples(0, 12), 0)
    assert calls == [True, False]
    assert learned.refused == 'no better than a linear one'
    assert learned.model.n_z == 3


def test_sindy_leaves_out_what_van_der_pol_does_not_have():
    pytest.importorskip('pysindy')
    case = CASES['van_der_pol']
    model = learners.LEARNERS['SINDy-5'](describe(case.system), case.samples(0, 20), 0).model
    # x2 in the first rate; x1, x2 and x1^2 x2 in the second, of the 20 monomials
    assert np.count_nonzero(model.A[:2], axis=1).tolist() == [1, 3]
    x = case.starts(5)
    deviations = model.states.to_deviation(x)
    np.testing.assert_allclose(model.drift(deviations) * model.states.scale,
                               case.system.drift(x), atol=1e-6)


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """Run one plant and one seed, few starts, linear and cubic models and a hasty lift."""
    output = tmp_path_factory.mktemp('general')
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, 'LEARNERS', {
            'linear': learners.LEARNERS['linear'], 'EDMD-3': learners.LEARNERS['EDMD-3'],
            'hasty lift': learners._trained(lambda n_x: Growth(n_x + 1, max_iterations=5))})
        patch.setitem(study.EXPERIMENTS, 'van_der_pol', partial(
            study.run, 'van_der_pol', starts=3))
        patch.setattr(coordinates, 'RECIPES', {
            'identity lift': lambda n_x: Growth(n_x + 1, max_iterations=5)})
        patch.setitem(coordinates.EXPERIMENTS, 'coordinates/van_der_pol', partial(
            coordinates.run, 'van_der_pol', starts=3))
        assert main(['van_der_pol', '--seeds', '1', '--scheduler', '',
                     '--output', str(output)]) == 0
    return output


def test_figures_of_van_der_pol(folder):
    summary = json.loads((folder / 'summary.json').read_text())
    assert summary['complete']
    found = {label: {name: values[0] for name, values in figures.items()}
             for label, figures in summary['van_der_pol'].items()}
    # its drift is a polynomial of degree 3
    assert found['EDMD-3']['rx'] < 1e-20
    assert found['EDMD-3']['rollout'] < 1e-6
    assert found['linear']['rx'] > 1e-3
    assert found['EDMD-3']['accepted'] is None
    assert found['hasty lift']['accepted'] in (True, False)
    for figures in found.values():
        assert 0 <= figures['no_gain'] <= figures['not_arrived'] <= figures['missed'] <= 3
        # nothing is cheaper than the least, but for an input that is held
        assert figures['least_ratio'] is None or figures['least_ratio'] > 0.99
    assert found[study.SDRE]['missed'] == 0


def test_uses_of_models_of_van_der_pol(folder):
    """Its drift is cubic: noise apart, the cubic model is exact in and beyond the box."""
    found = json.loads((folder / 'summary.json').read_text())['coordinates']['van_der_pol']
    cubic, lift = found['EDMD-3'], found['identity lift']
    assert max(cubic['rx'] + cubic['rx_few'] + cubic['rx_beyond']) < 1e-20
    # a variance of a part in 1100 for the noise, over some 70 samples to a coefficient
    assert 1e-6 < cubic['rx_noisy'][0] < 1e-4
    assert lift['rollout'][0] < lift['rollout_z'][0]
    assert {'averaged', 'recentred', 'averaged_missed', 'recentred_missed'} <= lift.keys()


def test_the_error_of_a_drift_is_rx():
    case = CASES['van_der_pol']
    samples = case.samples(0, 5)
    assert coordinates.drift_error(case.truth, samples) == pytest.approx(
        fit(case.truth, samples.x, samples.dxdt, samples.u).rx, rel=1e-12)
    # of one sample, too
    assert coordinates.drift_error(
        case.truth, samples.where(np.arange(len(samples)) == 3)) > 0.0


def test_in_z_a_linear_model_is_predicted_as_by_its_drift():
    case = CASES['van_der_pol']
    samples = case.samples(0, 5)
    model = case.truth
    by_drift = rollout_rmse(model, samples)
    np.testing.assert_allclose(coordinates.rolled_in_z(model, samples), by_drift, rtol=1e-3)
    assert by_drift.max() > 0.1


def test_in_discrete_time_a_linear_plant_is_predicted_exactly():
    """With delays, too, which it does not need."""
    spring = oscillator('spring', lambda x1, x2: x1 - x2, lambda x1, x2: (1.0, -1.0))
    case = replace(CASES['duffing'], system=spring)
    samples, held_out = case.samples(0), case.samples(1, 10)
    box = Box.of(describe(spring), samples.x, samples.u)
    for delays in (0, 1):
        assert coordinates.discrete(case, box, samples, held_out, delays) < 1e-6


def test_report_of_van_der_pol(folder):
    text = (folder / 'report.md').read_text()
    assert '| Van der Pol | EDMD-3 | ' in text
    assert re.search(r'^\| model \| Van der Pol \|$', text, re.MULTILINE)
    assert re.search(r'^\| natural SDRE on the truth \| 1 of 1 \|$', text, re.MULTILINE)
    assert '\n## Van der Pol\n' in text
    assert 'nan' not in text
    image = matplotlib.image.imread(folder / 'general.png')
    assert min(image.shape[:2]) > 400
    assert np.std(image[..., :3]) > 0.02


@pytest.mark.parametrize(('args', 'words'), [
    (['--seeds', '0'], '--seeds is 0, must be at least 1'),
    (['pendulums'], 'there is no plant pendulums: choose of van_der_pol, ')])
def test_what_cannot_be_run_is_refused(args, words, capsys):
    with pytest.raises(SystemExit):
        main(args)
    assert words in capsys.readouterr().err
