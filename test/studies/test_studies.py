# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The studies: short runs of each, and their references against independent ones."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
import json
import math
from pathlib import Path
import re
from typing import Any

import matplotlib.image
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from koopman_ros.core.paths import model_path
from koopman_ros.learning import IncrementalTraining, Linearisation, NeuralDrift, rollout_rmse
from koopman_ros.model import load
from koopman_ros.parameters.plant import PlantTable
from koopman_ros.plants import describe
from koopman_ros.ros.simulated_plant import SimulatedPlant
from studies import saddle, saddle_act, unstable
from studies.campaign import Campaign, Experiment, Metrics, Models, run_campaign
from studies.equations import EQUATIONS
from studies.general import learners, study
from studies.general.__main__ import main as general
from studies.general.systems import CASES, oscillator
from studies.paper import figures, reactor, report, scalar, two_state
from studies.paper.optimal_control import (
    exact_two_state_cost,
    exact_two_state_gain,
    exact_two_state_model,
)
from studies.partly_measured import __main__ as partly_measured
from studies.partly_measured.cases import CASES as PARTLY_MEASURED
from studies.partly_measured.report import DRAWN as DRAWN_CONTENDERS
from studies.robustness import disturbances, loop, stability
from studies.robustness.loop import REACTOR, START
from studies.true_model import TrueModel

PERIOD = 1.0 / 60.0  # min


# The runner.

def quick(seed: int) -> tuple[Metrics, Models]:
    return {'rw': 0.5 ** seed, 'part/cond': None if seed == 1 else 2.0,
            'ratio': {'R=1': np.inf}}, {}


def failing(seed: int) -> tuple[Metrics, Models]:
    if seed == 1:
        raise ValueError('no such lift')
    if seed == 2:
        raise KeyboardInterrupt
    return {'rw': 1.0}, {}


def test_a_campaign_keeps_finished_runs_and_reasons() -> None:
    experiments: dict[str, Experiment] = {'a': quick, 'b/c': failing}
    campaign = run_campaign(3, experiments, scheduler='')
    assert not campaign.complete
    assert campaign.errors == ['b/c, seed 1: ValueError: no such lift']
    assert campaign.summary() == {
        'a': {'rw': [1.0, 0.5, 0.25], 'part': {'cond': [2.0, None, 2.0]},
              'ratio': {'R=1': [None, None, None]}}, 'b': {'c': {'rw': [1.0]}}}


@pytest.mark.parametrize('args', [['--seeds', '0'], ['teapot']])
def test_impossible_options_are_rejected(args: list[str], capsys: pytest.CaptureFixture[str]
                                        ) -> None:
    with pytest.raises(SystemExit):
        general(args)
    assert args[-1] in capsys.readouterr().err


# References.

# K on (x1, x2, x1^2) and cost from (5, 5), from an independent Riccati solver
@pytest.mark.parametrize(('R', 'gain', 'cost'), [
    (1.0, [0.0, 2.41421356, -1.49559737], 990.1798),
    (0.001, [0.0, 32.6385840, -1.02512675], 127.1212)])
def test_two_state_optimum(R: float, gain: list[float], cost: float) -> None:
    np.testing.assert_allclose(exact_two_state_gain(R)[0], gain, rtol=1e-8, atol=1e-8)
    assert exact_two_state_cost(np.array([5.0, 5.0]), R) == pytest.approx(cost, abs=5e-5)


@pytest.mark.parametrize('case', PARTLY_MEASURED.values(), ids=PARTLY_MEASURED)
def test_expressions_and_the_true_model_are_the_plants_equations(case: Any) -> None:
    rng, model = np.random.default_rng(0), case.truth
    assert isinstance(model, TrueModel)
    for _ in range(5):
        x, u = rng.uniform(case.lift.states.lower, case.lift.states.upper), rng.uniform(
            case.lower, case.upper)
        rate = case.system.derivative(x, u)
        np.testing.assert_allclose(np.asarray(EQUATIONS[case.plant](x, u)).ravel(), rate,
                                   rtol=1e-9, atol=1e-12)
        at_x, at_u = model.states.to_deviation(x), model.inputs.to_deviation(u)
        np.testing.assert_allclose(
            (model.drift(at_x) + model.forcing(at_x, at_u)) * model.states.scale, rate,
            rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize('name', CASES)
def test_cases_rest_at_their_nominal_state_and_are_factorised(name: str) -> None:
    case = CASES[name]
    system, x0 = case.system, case.system.nominal_state
    assert np.all(np.abs(system.derivative(x0, system.nominal_input))
                  < 1e-9 * case.units[0] / case.horizon)
    # off the axes, and where one state is at its nominal value
    for x in (*case.starts(4), np.where(np.arange(system.n_x) == 0, x0, case.upper)):
        change = system.drift(x) - system.drift(x0)
        np.testing.assert_allclose(case.factorised(x) @ (x - x0), change,
                                   atol=1e-9 * np.max(np.abs(change)))


# The paper.

@pytest.fixture(scope='module')
def campaign() -> Iterator[Campaign]:
    """Return a campaign of one seed on few data, exact and shipped lifts in place of learned."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scalar, 'STARTS', 1)
        patch.setattr(scalar, 'IncrementalTraining', partial(
            IncrementalTraining, max_iterations=400))
        patch.setattr(two_state, 'INPUT_WEIGHTS', (1.0,))
        found = Campaign(complete=True)
        plant, exact, narrow = (
            describe(two_state.SYSTEM), exact_two_state_model(), figures.FIGURE_NARROW_BOX)
        lifts = {'wide': exact, narrow: exact, 'linear': Linearisation(
            two_state.SYSTEM.drift_jacobian(np.zeros(2))).learn(
                plant, two_state.samples(two_state.WIDE, 0, episodes=5))}
        models = {name: load(model_path(f'reactor_{name.replace("=", "")}'))
                  for name in ('nz=3', 'linear')}
        fresh = [reactor.random_steps_of(design, 1, 15.0, 5_000)
                 for design in (reactor.IN_RANGE, reactor.IN_RANGE, reactor.OUT_OF_RANGE)]
        for name, (metrics, of) in {
            'scalar': scalar.run(2),
            'two_state': ({**two_state.judged(exact, 0), 'edmd_cost_ratio': {'R=1': None},
                           'linear_cost_ratio': {'R=1': 4.5}}, lifts),
            'narrow': ({f'{narrow}/{name}': value for name, value in (
                ('rw_in', 1e-7), ('cost_ratio_to_exact', None), ('left_box', True),
                ('final_distance', None))}, lifts),
            'reactor': ({f'{name}/{figure}': value for name, model in models.items()
                         for figure, value in reactor.judged(model, *fresh).items()}, models),
        }.items():
            found.metrics[name], found.models[name] = {0: metrics}, {0: of}  # type: ignore[dict-item]
        yield found


def test_figures_of_the_paper(campaign: Campaign) -> None:
    found = {name: of[0] for name, of in campaign.metrics.items()}
    inside, near, far = (found['scalar'][name] for name in ('rw_in', 'rw_5_6', 'rw_6_8'))
    assert inside < 1e-6  # type: ignore[operator]
    assert inside < near < far  # type: ignore[operator]
    assert found['two_state']['eigenvalue_error'] <= 1e-12  # type: ignore[operator]
    assert found['two_state']['cost_ratio_to_exact'] == {'R=1': pytest.approx(1.0, abs=1e-6)}
    of_reactor = found['reactor']
    assert of_reactor['linear/feed_forward_offset_kelvin'] == pytest.approx(3.3009, abs=1e-4)
    assert of_reactor['linear/tracking_offset_kelvin'] == pytest.approx(1.9334, abs=1e-4)
    assert of_reactor['nz=3/tracking_offset_kelvin'] < 1e-3  # type: ignore[operator]
    assert of_reactor['nz=3/cost_ratio_to_optimum'] == pytest.approx(1.0, abs=1e-5)


def test_report_of_the_paper_has_its_tables_and_figures(
        campaign: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for paper in (two_state, reactor):
        monkeypatch.setattr(paper, 'HORIZON', 4.0)
    drawn = figures.draw_figures(campaign, tmp_path)
    assert [one.file[:2] for one in drawn] == [f'{number:02d}' for number in range(1, 7)]
    for one in drawn:
        # neither blank nor one colour
        assert np.std(matplotlib.image.imread(tmp_path / one.file)[..., :3]) > 0.02
    missing = re.compile(r'nz=[245]|R=0\.')
    monkeypatch.setattr(report, 'TARGETS', [
        target for target in report.TARGETS if not missing.search(target.path)])
    monkeypatch.setattr(report, '_EXACT', {
        label: path for label, path in report._EXACT.items() if not missing.search(path)})
    report.write_report({'seeds': 1, 'complete': True, 'wall_seconds': 1.0, **campaign.summary()},
                        drawn, tmp_path)
    text = (tmp_path / 'report.md').read_text()
    assert len(re.findall(r'^!\[.*\]\((.*)\)$', text, re.MULTILINE)) == 6
    assert '| `reactor/nz=3/tracking_offset_kelvin` | 0.001 |' in text
    assert 'nan' not in text
    assert report.Criterion('a/b', 1e-6, 1.0).met({'a': {'b': [1.0, 1.1, None, 0.99]}}) == (2, 4)


# Other plants.

@pytest.fixture(scope='module')
def van_der_pol(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run one plant and one seed, few starts, cubic models and a hasty lift."""
    output = tmp_path_factory.mktemp('general')
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, 'LEARNERS', {
            'EDMD-3': learners.LEARNERS['EDMD-3'],
            'identity lift': partial(learners.trained, lambda n_x: IncrementalTraining(
                n_x + 1, max_iterations=5))})
        patch.setitem(study.EXPERIMENTS, 'van_der_pol', partial(
            study.run, 'van_der_pol', starts=3))
        assert general(['van_der_pol', '--seeds', '1', '--scheduler', '',
                        '--output', str(output)]) == 0
    return output


def test_a_cubic_drift_is_found_by_cubic_models(van_der_pol: Path) -> None:
    summary = json.loads((van_der_pol / 'summary.json').read_text())
    found = {label: {name: values[0] for name, values in of.items()}
             for label, of in summary['van_der_pol'].items()}
    assert found['EDMD-3']['accepted'] is None
    assert found['identity lift']['accepted'] in (True, False)
    for of in found.values():
        assert 0 <= of['no_gain'] <= of['not_arrived'] <= of['missed'] <= 3
    assert found['EDMD-3']['rx'] < 1e-20 < found['EDMD-3']['rx_noisy']
    assert found['identity lift']['rollout'] < found['identity lift']['rollout_z']
    text = (van_der_pol / 'report.md').read_text()
    assert re.search(r'^\| natural SDRE on the truth \| 1 of 1 \|$', text, re.MULTILINE)
    assert 'nan' not in text


def test_predictions_of_a_linear_plant_are_exact() -> None:
    """In z as by the drift."""
    spring = oscillator('spring', lambda x1, x2: x1 - x2, lambda x1, x2: (1.0, -1.0))
    case = replace(CASES['duffing'], system=spring)
    held_out = case.samples(1, 10)
    np.testing.assert_allclose(study.rolled_in_z(case.truth, held_out),
                               rollout_rmse(case.truth, held_out), rtol=1e-3, atol=1e-9)


def test_controllers_of_partly_measured_plants_stand_in_one_table(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PARTLY_MEASURED, 'pendulum', replace(
        PARTLY_MEASURED['pendulum'], stepped_at=0.3125, loaded_at=2.1875, duration=4.375))
    monkeypatch.setattr(partly_measured, 'CONTENDERS', {
        name: partly_measured.CONTENDERS[name] for name in DRAWN_CONTENDERS})
    assert partly_measured.main(['pendulum', '--seeds', '1', '--output', str(tmp_path)]) == 0
    found = json.loads((tmp_path / 'summary.json').read_text())['plants']['pendulum']
    assert tuple(found) == DRAWN_CONTENDERS
    for name, of in found.items():
        linear = name.startswith('LQG')
        assert 0.99 < of['cost_worst'] < (1.2 if linear else 1.03)
        # it knows no disturbance; a window has not yet found all of that one
        assert (of['offset_under_load'] > 0.2) == linear
    assert '# Plants measured in part' in (tmp_path / 'report.md').read_text()


# Robustness.

def first_order(temperature: float, coolant_weight: float) -> tuple[float, float, float]:
    """Return slope a, gain b (1/min) and K of the scalar sampled regulator by hand."""
    a = REACTOR.drift_jacobian(np.array([temperature]))[0, 0]
    b = float(np.asarray(REACTOR.B)[0, 0])
    pole, square = math.exp(a * PERIOD), math.exp(2.0 * a * PERIOD)
    # integrals of exp(a t) and exp(2 a t); weights over a period of state, product and input
    once, twice = (pole - 1.0) / a, (square - 1.0) / (2.0 * a)
    N = b / a * (twice - once)
    R = coolant_weight * PERIOD + (b / a) ** 2 * (twice - 2.0 * once + PERIOD)
    gain = b * once
    # (P (1 - pole^2) - twice) (R + gain^2 P) + (gain pole P + N)^2 = 0
    P = max(np.roots([gain ** 2, (1.0 - square) * R - twice * gain ** 2 + 2.0 * gain * pole * N,
                      N * N - twice * R]))
    return a, b, (gain * P * pole + N) / (R + gain ** 2 * P)


def test_margins_without_observer_are_those_of_a_first_order_loop() -> None:
    a, b, K = first_order(310.0, 1.0)
    pole = math.exp(a * PERIOD)
    gain = b * (pole - 1.0) / a
    controller = loop.reactor_controller(bandwidth=0.0)
    learned = -stability.linearised_controller(controller, 310.0).D[0, 0]
    # as far as the lift's slope is that of the reactor
    assert learned == pytest.approx(K, rel=2e-3)
    # the pole of the closed loop leaves the unit circle at -1
    assert stability.margins_at(controller, 310.0).gain == pytest.approx(
        (1.0 + pole) / (learned * gain), rel=1e-6)


def test_delay_margin_is_that_of_a_simulated_loop() -> None:
    """Of which deviations decay with a delay of 8.5 s, and grow with one of 9.4 s."""
    controller = loop.reactor_controller(bandwidth=10.0, coolant_weight=0.1)
    assert stability.margins_at(controller, 316.0).delay_seconds == pytest.approx(8.92, abs=0.05)


def test_no_coolant_saves_a_start_above_the_boundary() -> None:
    """With the coolant on its way to the coldest as fast as it may, from scipy's integration."""
    boundary = stability.hottest_saved(300.0)
    ends = [solve_ivp(lambda t, x: REACTOR.derivative(
        x, np.array([max(278.15, 300.0 - 60.0 * t)])), (0.0, 3.0), [boundary + d], rtol=1e-9,
        max_step=0.05).y[0, -1] for d in (-0.01, 0.01)]
    assert ends[0] < 340.0 < ends[1]


@pytest.mark.parametrize(('temperature', 'fallback', 'end'), [
    (340.0, True, 'SAFE'), (340.0, False, 'RAN_AWAY'), (343.0, True, 'RAN_AWAY')])
def test_fallback_widens_the_region_of_attraction(temperature: float, fallback: bool, end: str
                                                  ) -> None:
    assert stability.end_of(temperature, 316.0, fallback=fallback).name == end


def test_a_disturbance_leaves_no_offset() -> None:
    cases = {case.name: case for case in disturbances.cases()}
    found = disturbances.judge(replace(cases['UA −20 %, in the loop'], seconds=600.0))
    assert found['final_kelvin'] == pytest.approx(0.0, abs=1e-3)
    # the coolant that makes up for it: UA (T_c - T) as before, from the heat balance
    assert found['disturbance_kelvin'] == pytest.approx(0.25 * (START - 300.0), abs=0.01)


# The reactor at its saddle.

def test_a_free_lift_is_learned_at_the_saddle(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(unstable, 'EPISODES', 40)
    monkeypatch.setattr(unstable, 'STARTS', 1)
    monkeypatch.setattr(unstable, 'RECIPES', {
        'neural drift': NeuralDrift(4, max_iterations=50),
        'free lift': replace(unstable.LIFT, hidden_first=8, max_iterations=50)})
    model = unstable.learn(0)
    assert (model.n_z, model.identity, model.readout is None) == (2, False, False)
    assert model.pre_feedback is not None


def test_tables_of_the_shipped_lift_at_the_saddle(
        monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    for name, value in (('FRESH_EPISODES', 20), ('STEPS', unstable.STEPS[:1]),
                        ('LIMITED_STARTS', 1), ('LIMITED_SAMPLES', 120),
                        ('learn', lambda _: load(model_path('two_state_saddle')))):
        monkeypatch.setattr(unstable, name, value)
    assert unstable.main(['--seeds', '1']) == 0
    lines = capsys.readouterr().out.splitlines()
    _, rw, rx, _, by_rates, cost, _ = map(float, lines[2].strip('| ').split(' | '))
    assert rw < 1e-4
    assert rx < 1e-5 < by_rates < 0.1
    assert 1.0 - 1e-3 < cost < 1.01
    laws = {law: float(cost) for law, cost, _ in (
        line.strip('| ').split(' | ') for line in lines[-2:])}
    assert laws['mpc'] <= 1.005 * laws['sdre'] < 50.0


def test_without_the_concentration_the_same_law_costs_hardly_more(
        monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (('LAWS', {'sdre': ('sdre',)}), ('COURSE', {0.0: 350.0, 30.0: 345.0}),
                        ('FOULED', 330.0), ('END', 530.0)):
        monkeypatch.setattr(saddle, name, value)
    (row,) = saddle.course_rows([saddle.truth()], periods=(2.0,))
    _, _, over_true, _, over_full, _, offset, concentration, *lost = row
    assert over_true == '1.0000'
    assert 0.9 < float(over_full) < 1.1
    assert float(offset) < 0.05
    assert float(concentration) < 2e-3
    assert lost == ['0 of 1', '1.0000', '0 of 1', '0 of 1']


def test_the_noise_of_the_plant_is_known() -> None:
    table = PlantTable({'system': 'two_state'})
    plant = SimulatedPlant(table, table.snapshot({
        'temperature.measurement_noise': saddle.NOISE, 'seed': 3}), 0)
    measured = np.array([plant.measure(sample)[0][1] for sample in range(20)])
    assert np.std(measured) > 0.5 * saddle.NOISE
    found = saddle_act.without_noise(np.arange(20.0), measured, 3)
    assert found == pytest.approx(plant.process.x[1], abs=1e-9)
