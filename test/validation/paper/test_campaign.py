# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The campaign over seeds, its summary, figures and report."""

import json
import os
import re
import signal

import matplotlib.image
import numpy as np
import pytest

from koopman_ros.execution import pools
from koopman_ros.learning import Edmd, fit, Linearisation
from koopman_ros.lifting import load
from koopman_ros.plants import box_episodes, describe
from koopman_ros.resources import model_path
from validation.paper import campaign as campaigns
from validation.paper import figures, reactor, report, scalar, two_state
from validation.paper.campaign import Campaign, run_campaign
from validation.paper.datasets import random_step_episodes
from validation.paper.optimal_control import exact_two_state_model


def quick(seed):
    return {'rw': 0.5 ** seed, 'part/cond': None if seed == 1 else 2.0,
            'ratio': {'R=1': np.inf}}, {}


def failing(seed):
    if seed == 1:
        raise ValueError('no such lift')
    return {'rw': 1.0}, {}


def test_summary_has_one_entry_for_each_seed(monkeypatch, capsys):
    monkeypatch.setattr(campaigns, 'EXPERIMENTS', {'a': quick, 'b/c': failing})
    campaign = run_campaign(3, scheduler='')
    assert campaign.complete
    assert campaign.errors == ['b/c, seed 1: ValueError: no such lift']
    assert campaign.summary() == {
        'a': {'rw': [1.0, 0.5, 0.25], 'part': {'cond': [2.0, None, 2.0]},
              'ratio': {'R=1': [None, None, None]}},
        'b': {'c': {'rw': [1.0, 1.0]}}}
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == '1/6: a, seed 0, rw 1.0e+00'
    assert '4/6: b/c, seed 1 failed' in lines


def test_a_lost_worker_keeps_what_is_done(monkeypatch):
    # what is begun anew, and how often, is the place's own affair
    monkeypatch.setattr(pools, '_ATTEMPTS', 1)

    def deadly(seed):
        if seed == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return {'rw': 1.0}, {}

    campaign = run_campaign(3, {'a': deadly}, 'joblib:1')
    assert not campaign.complete
    assert campaign.summary() == {'a': {'rw': [1.0]}}
    assert campaign.errors[0].startswith('a, seed 1: 1 workers that ran it were killed')


def test_an_interrupt_keeps_what_is_done(monkeypatch):
    def interrupted(seed):
        if seed == 2:
            raise KeyboardInterrupt
        return {'rw': 1.0}, {}

    monkeypatch.setattr(campaigns, 'EXPERIMENTS', {'a': interrupted})
    campaign = run_campaign(4, scheduler='')
    assert not campaign.complete
    assert campaign.summary() == {'a': {'rw': [1.0, 1.0]}}


@pytest.fixture(scope='module')
def campaign():
    """Return a campaign of one seed on few data, exact and shipped lifts in place of learned."""
    with pytest.MonkeyPatch.context() as patch:
        # of the seed below the first start finds it
        patch.setattr(scalar, 'STARTS', 1)
        # the least of them takes longest
        patch.setattr(two_state, 'INPUT_WEIGHTS', (1.0, 0.1))
        yield quick_campaign()


def quick_campaign():
    found = Campaign(complete=True)

    def add(name, outcome):
        found.metrics[name], found.models[name] = {0: outcome[0]}, {0: outcome[1]}

    add('scalar', scalar.run(2))
    plant, exact, narrow = (
        describe(two_state.SYSTEM), exact_two_state_model(), figures.FIGURE_NARROW_BOX)
    lifts = {'wide': exact, narrow: exact, 'linear': Linearisation(
        two_state.SYSTEM.drift_jacobian(np.zeros(2))).learn(
            plant, two_state.samples(two_state.WIDE, 0, episodes=5))}
    add('two_state', ({**two_state.judged(exact, 0), 'edmd_cost_ratio': {'R=1': None},
                       'linear_cost_ratio': {'R=1': 4.5, 'R=0.1': 1.9}}, lifts))
    add('narrow', ({f'{narrow}/{name}': value for name, value in (
        ('rw_in', 1e-7), ('cost_ratio_to_exact', None), ('left_box', True),
        ('final_distance', None))}, lifts))
    models = {f'nz={n}': load(model_path(f'reactor_nz{n}')) for n in (3, 4)}
    models['linear'] = load(model_path('reactor_linear'))
    few = box_episodes(reactor.SYSTEM, reactor.TRAINING, 30, 1.0, 0)
    models['edmd'] = Edmd(reactor.EDMD_DEGREE).learn(describe(reactor.SYSTEM), few)
    fresh = [random_step_episodes(reactor.SYSTEM, design, 1, 15.0, 5_000)
             for design in (reactor.IN_RANGE, reactor.OUT_OF_RANGE)]
    add('reactor', ({f'{name}/{figure}': value for name, model in models.items()
                     for figure, value in reactor.judged(model, few, *fresh).items()}, models))
    return found


def test_scalar_example(campaign):
    metrics, model = campaign.metrics['scalar'][0], campaign.models['scalar'][0]['scalar']
    assert metrics['rw_in'] < 1e-6
    assert metrics['rw_in'] < metrics['rw_5_6'] < metrics['rw_6_8']
    x = np.linspace(0.5, 5.0, 50)
    # any power of the eigenfunction exp(-1/x) is one, too
    exact = np.exp(-model.A[0, 0] / x)
    z = model.lift(model.states.to_deviation(x[:, None]))[:, 0]
    scale = z @ exact / (exact @ exact)
    np.testing.assert_allclose(z, scale * exact, atol=2e-3 * np.max(np.abs(z)))
    points = scalar.points(*scalar.RANGE, 300)
    assert fit(model, points.x, points.dxdt, points.u).rw == pytest.approx(
        metrics['rw_in'], rel=1.0)


def test_exact_control_of_the_two_state_example(campaign):
    """Its third coordinate is x1^2, and with it the eigenvalues are 2 mu, mu and lambda."""
    metrics = campaign.metrics['two_state'][0]
    assert metrics['rw'] <= 1e-20
    assert metrics['eigenvalue_error'] <= 1e-12
    assert metrics['left_box'] is False
    assert len(metrics['cost_ratio_to_exact']) == 2
    for ratio in metrics['cost_ratio_to_exact'].values():
        assert abs(ratio - 1.0) <= 1e-6


def reactor_figures(campaign, name):
    """Return what the campaign says of a shipped model."""
    return {key.removeprefix(f'{name}/'): value
            for key, value in campaign.metrics['reactor'][0].items() if key.startswith(name)}


def test_the_linear_model_of_the_reactor_is_as_far_off_as_it_is(campaign):
    found = reactor_figures(campaign, 'linear')
    assert found['feed_forward_offset_kelvin'] == pytest.approx(3.3009, abs=1e-4)
    assert found['tracking_offset_kelvin'] == pytest.approx(1.9334, abs=1e-4)
    assert found['rollout_rmse_in_kelvin'] > 8.0
    assert found['cost_ratio_to_optimum'] > 5.0


@pytest.mark.parametrize('n_z', [3, 4])
def test_the_shipped_lifts_track(campaign, n_z):
    found = reactor_figures(campaign, f'nz={n_z}')
    assert found['tracking_offset_kelvin'] < 1e-3
    assert found['feed_forward_offset_kelvin'] < 1e-3
    assert found['rollout_rmse_in_kelvin'] < 0.005
    assert 1.0 - 1e-7 < found['cost_ratio_to_optimum'] < 1.0 + 1e-5
    assert found['rollout_rmse_out_kelvin'] > found['rollout_rmse_in_kelvin']


def test_report_names_every_experiment_and_its_eleven_figures(campaign, tmp_path, monkeypatch):
    drawn = figures.draw_figures(campaign, tmp_path)
    assert [one.file[:2] for one in drawn] == [f'{number:02d}' for number in range(1, 12)]
    for one in drawn:
        image = matplotlib.image.imread(tmp_path / one.file)
        assert min(image.shape[:2]) > 500
        # neither blank nor one colour
        assert np.std(image[..., :3]) > 0.02
        assert one.caption.endswith('.')
    summary = {'package_version': '1', 'seeds': 1, 'complete': True, 'errors': [],
               'wall_seconds': 1.0, **campaign.summary()}
    json.dumps(summary, allow_nan=False)
    # the quick campaign has no lifts of 2 and 5 coordinates, and two weights
    monkeypatch.setattr(report, 'TARGETS', [
        target for target in report.TARGETS if not re.search('nz=[25]|R=0.001$', target.path)])
    report.write_report(summary, drawn, tmp_path / 'report.md')
    text = (tmp_path / 'report.md').read_text()
    for heading in ('Motivating example', 'Two-state example', 'One-state reactor',
                    'Narrow data', 'Figures'):
        assert f'\n## {heading}' in text
    assert len(re.findall(r'^!\[.*\]\((.*)\)$', text, re.MULTILINE)) == 11
    assert '| `reactor/nz=3/tracking_offset_kelvin` | 0.001 |' in text
    assert 'failed in all 1' in text
    assert 'nan' not in text


def test_a_missed_target_is_counted():
    target = report.Target('a/b', 1e-6, 1.0)
    assert target.met({'a': {'b': [1.0, 1.0 + 2e-6, None, 0.99]}}) == (2, 4)


def test_seeds_below_one_are_refused(capsys):
    from validation.paper.__main__ import main
    with pytest.raises(SystemExit):
        main(['--seeds', '0'])
    assert '--seeds is 0, must be at least 1' in capsys.readouterr().err
