# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The studies: short runs of each, and their references against independent ones."""

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

from koopman_ros.learning import IncrementalTraining
from studies.campaign import Experiment, Metrics, Models, run_campaign
from studies.equations import EQUATIONS
from studies.general import coordinates, learners, study
from studies.general.__main__ import main as general
from studies.general.systems import CASES
from studies.paper.optimal_control import (
    exact_two_state_cost,
    exact_two_state_gain,
)
from studies.partly_measured.cases import CASES as PARTLY_MEASURED
from studies.robustness import loop, stability
from studies.robustness.loop import REACTOR
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


# Other plants.

@pytest.fixture(scope='module')
def van_der_pol(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run one plant and one seed, few starts, cubic models and a hasty lift."""
    output = tmp_path_factory.mktemp('general')
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, 'LEARNERS', {
            'EDMD-3': learners.LEARNERS['EDMD-3'], 'SINDy-5': learners.LEARNERS['SINDy-5'],
            'hasty lift': learners._trained(lambda n_x: IncrementalTraining(n_x + 1,
                                                                            max_iterations=5))})
        patch.setitem(study.EXPERIMENTS, 'van_der_pol', partial(
            study.run, 'van_der_pol', starts=3))
        patch.setattr(coordinates, 'RECIPES', {
            'identity lift': lambda n_x: IncrementalTraining(n_x + 1, max_iterations=5)})
        patch.setitem(coordinates.EXPERIMENTS, 'coordinates/van_der_pol', partial(
            coordinates.run, 'van_der_pol', starts=3))
        assert general(['van_der_pol', '--seeds', '1', '--scheduler', '',
                        '--output', str(output)]) == 0
    return output


def test_a_cubic_drift_is_found_by_cubic_models(van_der_pol: Path) -> None:
    summary = json.loads((van_der_pol / 'summary.json').read_text())
    found = {label: {name: values[0] for name, values in of.items()}
             for label, of in summary['van_der_pol'].items()}
    assert found['EDMD-3']['rx'] < 1e-20
    assert found['SINDy-5']['rx'] < 1e-10
    assert found['hasty lift']['accepted'] in (True, False)
    for of in found.values():
        assert 0 <= of['no_gain'] <= of['not_arrived'] <= of['missed'] <= 3
        assert of['least_ratio'] is None or of['least_ratio'] > 0.99
    used = summary['coordinates']['van_der_pol']
    # noise apart, exact in and beyond the box
    assert max(used['EDMD-3']['rx'] + used['EDMD-3']['rx_few'] + used['EDMD-3']['rx_beyond']
               ) < 1e-20
    assert used['identity lift']['rollout'][0] < used['identity lift']['rollout_z'][0]
    text = (van_der_pol / 'report.md').read_text()
    assert re.search(r'^\| natural SDRE on the truth \| 1 of 1 \|$', text, re.MULTILINE)
    assert 'nan' not in text
    assert np.std(matplotlib.image.imread(van_der_pol / 'general.png')[..., :3]) > 0.02


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
