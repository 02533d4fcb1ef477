# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The gate: what is let through, what is refused, and why."""

from dataclasses import replace
import sys

import numpy as np
import pytest

from koopman_ros.identification import identify
from koopman_ros.lifting import linearised_model, load, Provenance
from koopman_ros.plants import two_state_reactor
from koopman_ros.resources import model_path
from koopman_ros.retraining import decide, learn_lift, Thresholds
from koopman_ros.retraining.gate import lifted_rate
from support.known_plants import methods
from support.random_lifts import random_lift
from support.recorded_runs import driven, linear_run, NOISE, reactor


@pytest.fixture(scope='module')
def shipped():
    return load(model_path('reactor_nz4'))


@pytest.fixture(scope='module')
def found(shipped):
    """Return the estimate of a reactor whose jacket has fouled."""
    return identify(shipped.plant, [driven(reactor(0.8), 15.0).episode()], degrees=(1, 2, 3),
                    methods=methods(20))


@pytest.fixture(scope='module')
def trained(found, shipped):
    return learn_lift(found, shipped.plant, 2, seed=0, starts=1)


def linear_lift(model, slope, input_matrix):
    """Return the lift N(x) = x with the names and boxes of a model."""
    return linearised_model(np.array([[slope]]), np.array([[input_matrix]]), model.states,
                            model.inputs, model.time_unit, Provenance(model.provenance.plant))


# Rates.


@pytest.mark.parametrize('unit', ['s', 'min'])
def test_rate_of_a_lift_in_units(unit):
    lift = replace(random_lift(n_u=2), time_unit=unit)
    rng = np.random.default_rng(0)
    x = lift.states.center + rng.uniform(-0.5, 0.5, (5, 2))
    u = lift.inputs.center + rng.uniform(-0.5, 0.5, (5, 2))
    seconds = {'s': 1.0, 'min': 60.0}[unit]
    rates = lifted_rate(lift, 60.0)(x, u)
    for k in range(5):
        xi, v = lift.states.to_deviation(x[k]), lift.inputs.to_deviation(u[k])
        z, J = lift.lift_and_jacobian(xi)
        # the definition, with least squares in place of the pseudo-inverse
        rate = np.linalg.lstsq(J, lift.A @ z, rcond=None)[0] + lift.B @ v
        assert rates[k] == pytest.approx(rate * lift.states.scale * 60.0 / seconds, rel=1e-9)


def test_rate_of_a_state_that_has_diverged(shipped):
    x = np.array([[310.0], [np.nan], [np.inf], [1e300], [311.0]])
    u = np.full((5, 1), 290.0)
    rates = lifted_rate(shipped, 60.0)(x, u)
    assert np.isfinite(rates[:, 0]).tolist() == [True, False, False, False, True]
    np.testing.assert_allclose(
        rates[[0, 4]], lifted_rate(shipped, 60.0)(x[[0, 4]], u[[0, 4]]), rtol=1e-13)


# Verdicts.


def test_a_better_lift_is_accepted(found, trained, shipped):
    decision = decide(found, trained, shipped, Thresholds())
    assert decision.accepted
    assert (decision.reasons, decision.warnings) == ((), ())
    assert (decision.loops, decision.arrived) == (9, 9)
    # nothing but noise is left of its error, and kelvins of the present one's
    assert decision.rmse == pytest.approx([NOISE], rel=0.15)
    assert decision.noise == pytest.approx([NOISE], rel=0.15)
    assert decision.rmse == pytest.approx(decision.drift_rmse, rel=0.05)
    assert decision.current_rmse > 10.0 * decision.rmse
    assert decision.linear_rmse > 1.2 * decision.rmse


def test_the_present_lift_does_not_beat_itself(found, trained):
    decision = decide(found, trained, trained.model, Thresholds())
    own = f'{decision.rmse[0]:.4g} K'
    assert decision.reasons == (
        f'its error on held-out records, {own}, is not 10 % below that of the present lift, '
        f'{own}',)
    assert decide(found, trained, trained.model, Thresholds(margin=0.0)).accepted


def test_an_undrifted_plant_needs_no_new_lift(shipped):
    run = driven(reactor(), 8.0, coolant=(281.33, 300.55))
    found = identify(shipped.plant, [run.episode()], degrees=(1, 3), methods=methods(20))
    trained = learn_lift(found, shipped.plant, 2, seed=0, starts=1)
    decision = decide(found, trained, shipped, Thresholds())
    (reason,) = decision.reasons
    assert 'is not 10 % below that of the present lift' in reason


def test_margin_is_a_share(found, trained, shipped):
    decision = decide(found, trained, shipped, Thresholds())
    ratio = float(decision.rmse[0] / decision.linear_rmse[0])
    assert decide(found, trained, shipped, Thresholds(margin=1.0 - 1.01 * ratio)).accepted
    (reason,) = decide(found, trained, shipped, Thresholds(margin=1.0 - 0.99 * ratio)).reasons
    assert 'the best linear model' in reason


def test_coordinates_that_have_collapsed(found, trained, shipped):
    limit = 0.99 * trained.figures.fit.cond
    (reason,) = decide(found, trained, shipped, Thresholds(condition=limit)).reasons
    assert reason == (
        f'the condition number of its coordinates, {trained.figures.fit.cond:.3g}, is above '
        f'{limit:.3g}: use fewer coordinates')


def test_a_linear_model_is_no_better_than_the_best_one(found, trained, shipped):
    scale = trained.model.states.center
    other = replace(trained, model=linear_lift(
        trained.model, float(found.linear.slope(scale)[0, 0]),
        float(found.linear.input_matrix[0, 0])))
    reasons = decide(found, other, shipped, Thresholds()).reasons
    assert [reason for reason in reasons if 'the best linear model' in reason]


def test_a_controller_that_destabilises_is_refused(found, trained, shipped):
    wrong = replace(trained, model=replace(trained.model, B=-trained.model.B))
    decision = decide(found, wrong, shipped, Thresholds())
    assert decision.arrived == 0
    assert ('its controller brings the estimated drift to the set-point in 0 of 9 closed loops '
            'over its box') in decision.reasons


def diverging(model):
    """Return a lift whose prediction overflows within a segment."""
    return linear_lift(model, 1e4, 1.0)


def test_present_lift_that_diverges(found, trained):
    decision = decide(found, trained, diverging(trained.model), Thresholds())
    assert decision.current_rmse == [np.inf]
    assert decision.accepted


def test_lift_that_diverges_is_refused_even_where_the_present_one_does(
        found, trained, monkeypatch):
    # stiff loops take long, and do not matter here
    monkeypatch.setattr(sys.modules[decide.__module__], '_closed_loops', lambda *_: (9, 9))
    bad = replace(trained, model=diverging(trained.model))
    decision = decide(found, bad, bad.model, Thresholds())
    assert 'its error on held-out records, inf K, is not 10 % below that of the present lift' in (
        ' '.join(decision.reasons))


@pytest.mark.parametrize(('values', 'words'), [
    ({'margin': 1.0}, r'margin = 1.0 must be in \[0, 1\)'),
    ({'margin': -0.1}, 'margin = -0.1'),
    ({'margin': float('nan')}, 'margin = nan'),
    ({'condition': 1.0}, 'condition = 1.0 must be above 1'),
    ({'condition': float('nan')}, 'condition = nan'),
])
def test_thresholds_out_of_range(values, words):
    with pytest.raises(ValueError, match=words):
        Thresholds(**values)


# What is not measured.


def test_warns_of_a_state_that_is_not_measured(shipped):
    """The reactor's concentration moves, too; its temperature alone does not tell where it is."""
    run = driven(two_state_reactor(), 20.0, coolant=(294.0, 302.0), seed=2, noise=0.03)
    found = identify(shipped.plant, [run.episode()], degrees=(1, 2), methods=methods(20))
    trained = learn_lift(found, shipped.plant, 2, seed=0, starts=1)
    decision = decide(found, trained, shipped, Thresholds())
    (warning,) = decision.warnings
    assert warning.startswith(
        f'the best drift errs by {decision.drift_rmse[0]:.3g} K in temperature, of which ')
    assert 'something that is not measured acts too' in warning
    # the noise is told apart from it
    assert decision.noise == pytest.approx([0.03], rel=0.15)
    assert decision.drift_rmse > 1.5 * decision.noise
    # it is judged by what it does, not by the warning
    assert decision.rmse < decision.current_rmse


def test_does_not_warn_where_all_is_measured(trained):
    model = load(model_path('reactor_nz3'))
    found = identify(model.plant, [linear_run(400).episode()], degrees=(1,), methods=methods(20))
    drift = replace(trained, model=linear_lift(
        model, float(found.drift.slope(model.states.center)[0, 0]),
        float(found.drift.input_matrix[0, 0])))
    assert decide(found, drift, model, Thresholds()).warnings == ()
