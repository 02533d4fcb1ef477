# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""From a drift to a lift: steady point, samples; the gate: what is let through, and why."""

from dataclasses import replace
import re

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from koopman_ros.core.datasets import Episode, PlantDescription
from koopman_ros.core.paths import model_path
from koopman_ros.evaluation.closed_loop_test import ClosedLoopTest
from koopman_ros.learning import compare_classes, Edmd, evaluate_model, learn_lift, Thresholds
from koopman_ros.learning.acceptance import decision, held_out, HeldOut, uncovered_setpoints
from koopman_ros.learning.acceptance.plant_test import PlantTest
from koopman_ros.learning.drift_sampling import _spread, drift_samples
from koopman_ros.learning.ensemble import disagreement
from koopman_ros.learning.identification import (
    DriftModel,
    identify,
    longest_step,
    Segments,
)
from koopman_ros.learning.identification.drift import steady_point
from koopman_ros.learning.lift.metrics import lifted_rate
from koopman_ros.model import linearised_model, load, ModelFileError, Provenance, save
from koopman_ros.parameters.model_checks import load_suitable
from koopman_ros.plants import two_state_reactor
from support.known_plants import box, methods
from support.random_lifts import random_lift
from support.recorded_runs import driven, NOISE, reactor


@pytest.fixture(scope='module')
def shipped():
    return load(model_path('reactor_nz4'))


@pytest.fixture(scope='module')
def found(shipped):
    """Return the estimate of a reactor whose jacket has fouled."""
    return identify(shipped.plant, [driven(reactor(0.8), 15.0).episode()], degrees=(1, 3),
                    methods=methods(20))


@pytest.fixture(scope='module')
def trained(found, shipped):
    plant = replace(shipped.plant, nominal_input=np.array([np.nan]))
    return learn_lift(found, plant, 2, seed=0, starts=1)


@pytest.fixture
def no_loops(monkeypatch, shipped):
    """Leave the closed loops out where another figure decides; return their arguments."""
    given = []
    passed = ClosedLoopTest(shipped.states, *np.zeros((2, 9, 1)), np.ones(9), np.zeros(9, bool),
                            np.ones(9), 0)
    monkeypatch.setattr(held_out, 'evaluate_closed_loops',
                        lambda *_, **others: given.append((*_, others)) or passed)
    steady = np.linspace(308.0, 322.0, 9)[:, None]
    monkeypatch.setattr(held_out, 'run_plants', lambda *given_, **_: given.append(
        given_) or PlantTest(np.zeros(30, int), np.full(30, 16), steady, Thresholds()))
    return given


def test_loops_have_dead_time_noise_and_period_of_the_record(found, trained, no_loops):
    """A minute is the time unit of the drift; the period is 1 s."""
    evaluate_model(replace(found, dead_time=np.array([0.2])), trained, None, Thresholds())
    (model, _, others), (same, _, conditions, _) = no_loops
    assert model.dead_time == same.dead_time == pytest.approx([12.0])
    assert others['noise'] == conditions.noise == pytest.approx([NOISE], rel=0.15)
    assert others['interval'] == conditions.interval == pytest.approx(1.0)


def test_every_second_plant_has_the_disturbances_of_the_record_at_their_ends(
        found, trained, no_loops):
    drift, inputs, x = found.drift, found.drift.box.inputs, found.drift.box.states.center[None]
    evaluate_model(replace(
        found, offsets=np.array([[0.3], [0.1], [-0.4]]), disturbances=inputs.names,
        alternatives=(drift,) * 4), trained, None, Thresholds())
    nominal = trained.model.inputs.center
    expected = [drift.rate(x, u[None])[0, 0] + offset for u, offset in (
        (nominal, 0.0), (inputs.lower, -0.4), (nominal, 0.0), (inputs.upper, 0.3))]
    rates = no_loops[1][1]
    assert len(rates) == Thresholds().plants
    assert [rate(x, nominal[None])[0, 0] for rate in rates[:4]] == pytest.approx(expected)


@pytest.mark.parametrize(('unit', 'seconds'), [('s', 1.0), ('min', 60.0)])
def test_rate_of_a_lift_in_units(unit, seconds):
    lift = replace(random_lift(n_u=2), time_unit=unit)
    rng = np.random.default_rng(0)
    x = lift.states.center + rng.uniform(-0.5, 0.5, (5, 2))
    u = lift.inputs.center + rng.uniform(-0.5, 0.5, (5, 2))
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


def test_a_linear_model_has_a_rate_everywhere(shipped):
    linear = shipped.linearised
    x = linear.states.to_physical(np.array([[1e3], [1e9]]))
    rates = lifted_rate(linear, 60.0)(x, np.tile(linear.inputs.center, (2, 1)))
    assert rates[1] == pytest.approx(1e6 * rates[0])


def test_a_better_lift_is_accepted(found, trained, shipped):
    decision = evaluate_model(found, trained, shipped, Thresholds(plants=8), loops=8)
    assert decision.accepted
    assert (decision.reasons, decision.warnings) == ((), ())
    assert decision.law_check.arrived == decision.law_check.loops == 8
    assert decision.law_check.worst_ratio < 1.01
    # the nominal input, which was not given, holds the nominal state
    states, inputs = trained.model.states, trained.model.inputs
    assert states.center == shipped.states.center
    assert found.drift.rate(states.center, inputs.center) == pytest.approx([0.0], abs=1e-9)
    # nothing but noise is left of its error, and kelvins of the present one's
    assert decision.rmse == pytest.approx([NOISE], rel=0.15)
    assert decision.noise == pytest.approx([NOISE], rel=0.15)
    assert decision.rmse == pytest.approx(decision.drift_rmse, rel=0.05)
    assert decision.current_rmse > 10.0 * decision.rmse
    assert decision.linear_rmse > 1.2 * decision.rmse


@pytest.mark.usefixtures('no_loops')
def test_the_present_lift_does_not_beat_itself(found, trained):
    decision = evaluate_model(found, trained, trained.model, Thresholds())
    own = f'{decision.rmse[0]:.4g} K'
    assert decision.reasons == (
        f'its error on held-out data, {own}, is not 10 % below that of the current model, '
        f'{own}: keep that one, or reduce acceptance_margin',)
    assert evaluate_model(found, trained, trained.model, Thresholds(margin=0.0)).accepted


@pytest.mark.usefixtures('no_loops')
@pytest.mark.parametrize(('error', 'accepted'), [(NOISE, True), (np.inf, False)])
def test_a_linear_model_whose_predictions_diverge_is_rejected(found, trained, error, accepted):
    check = evaluate_model(found, trained, None, Thresholds()).law_check
    reasons = HeldOut(found, Thresholds(), compared=False).reasons(
        trained.model, np.array([error]), trained.figures, check, linear=True)
    assert (not reasons) == accepted
    assert ('diverge' in ' '.join(reasons)) != accepted


@pytest.mark.parametrize(('gain', 'explains'), [(5.0, True), (0.0, False)])
def test_inputs_explain_a_record_whose_segments_move_less_than_its_noise(gain, explains):
    """A slow oven in noise; over a held-out segment its inputs lower the error by 0.2 %."""
    rng = np.random.default_rng(0)
    u, x, decay = np.repeat(rng.uniform(-1.0, 1.0, 10), 60), np.zeros(600), np.exp(-1.0 / 300.0)
    for k in range(599):
        x[k + 1] = decay * x[k] + (1.0 - decay) * gain * u[k]
    time = np.arange(600.0)
    oven = PlantDescription('oven', ('T',), ('K',), ('P',), ('V',), 's', np.full(1, np.nan),
                            np.full(1, np.nan), None)
    estimate = identify(oven, [Episode(
        time, (x + 0.3 * rng.standard_normal(600))[:, None], time, u[:, None])], degrees=(1,),
        methods=methods(20))
    model = Edmd(1).learn(
        replace(oven, nominal_state=np.zeros(1), nominal_input=np.zeros(1),
                B=estimate.drift.input_matrix), drift_samples(estimate.drift, estimate.fitted))
    reason = HeldOut(estimate, Thresholds(), compared=False).without_effect(model)
    assert ('the inputs explain nothing of the record' in reason) is not explains


@pytest.mark.usefixtures('no_loops')
@pytest.mark.parametrize('share', [-1.01, -0.99, 0.99, 1.01])
def test_a_model_is_accepted_where_its_file_can_be_loaded(found, trained, tmp_path, share):
    """The nominal input from below all that was recorded to above it, as steady_point gives it."""
    inputs, path = trained.model.inputs, tmp_path / 'lift.safetensors'
    center = 0.5 * (inputs.lower + inputs.upper) + share * 0.5 * (inputs.upper - inputs.lower)
    model = replace(trained.model, inputs=replace(inputs, center=center))
    decision = evaluate_model(found, replace(trained, model=model), None, Thresholds())
    save(model, path)
    if abs(share) < 1.0:
        assert not any('nominal' in reason for reason in decision.reasons)
        load_suitable(str(path))
        return
    assert f'to {center[0] - 273.15:.4g} degC' in ' '.join(decision.reasons)
    with pytest.raises(ModelFileError, match='the nominal coolant_temperature'):
        load_suitable(str(path))


@pytest.mark.usefixtures('no_loops')
def test_margin_and_condition_number_decide_and_warnings_are_passed_on(found, trained, shipped):
    def judged(**thresholds):
        return evaluate_model(replace(found, warnings=('the pumps moved together',)), trained,
                              shipped, Thresholds(**thresholds))

    decision, cond = judged(), trained.figures.fit.cond
    assert decision.warnings == ('the pumps moved together',)
    # the margin is a share
    ratio = float(decision.rmse[0] / decision.linear_rmse[0])
    assert judged(margin=1.0 - 1.01 * ratio).accepted
    (reason,) = judged(margin=1.0 - 0.99 * ratio).reasons
    assert 'the best linear model' in reason
    assert trained.figures.fit.cond_of_states == 1.0
    assert judged(condition=1.01 * cond).accepted
    (reason,) = judged(condition=0.99 * cond).reasons
    assert f'condition number of its coordinates, {cond:.3g}' in reason


@pytest.mark.usefixtures('no_loops')
def test_the_condition_number_of_monomials_does_not_matter(found, trained, shipped):
    model = Edmd(3).learn(shipped.plant, drift_samples(found.drift, found.fitted))
    strict, loose = (evaluate_model(found, replace(trained, model=model), shipped,
                                    Thresholds(condition=most)) for most in (1.001, 1e12))
    assert strict.reasons == loose.reasons


def test_a_controller_that_destabilises_is_rejected(found, trained, shipped):
    wrong = replace(trained, model=replace(trained.model, B=-trained.model.B))
    decision = evaluate_model(found, wrong, shipped, Thresholds(), loops=16)
    assert decision.law_check.share_failed > 0.9
    (reason,) = (reason for reason in decision.reasons if 'control' in reason)
    assert 'of 16 simulated closed loops' in reason
    assert f'{decision.law_check.region}' in reason


def test_the_law_is_tried_on_alternative_drifts_and_on_plausible_plants(found, trained):
    few = Thresholds(plants=4, plant_loops=4, most_failing=0.2, lost_plants=1)

    def judged(*alternatives):
        return evaluate_model(replace(found, alternatives=alternatives), trained, None, few,
                              loops=8)

    drift = found.drift
    decision = judged(replace(drift), replace(drift))
    assert (decision.reasons, decision.warnings) == ((), ())
    assert decision.plant.test.failed.tolist() == [0] * 4
    assert 'On 4 plants that the record cannot distinguish from yours, 0 of 16 loops' in (
        decision.statement)
    assert 'K/min' in decision.statement
    # with starts of their own
    assert len(np.unique(decision.plant.test.setpoints)) > 12
    decision = judged(replace(drift), replace(drift, B=-drift.B))
    (reason,) = decision.reasons
    assert reason.startswith('On 2 plants')
    (warning,) = decision.warnings
    assert '3 drifts that explain the record equally well differ by ' in warning


@pytest.mark.usefixtures('no_loops')
def test_a_drift_that_follows_no_part_of_the_record_is_rejected(found, trained, monkeypatch):
    def fails(*_, **__):
        raise ValueError('no part of the record')

    monkeypatch.setattr(decision, 'correction_posterior', fails)
    result = evaluate_model(found, trained, None, Thresholds())
    assert 'no part of the record' in ' '.join(result.reasons)
    assert result.statement == ''


@pytest.mark.parametrize(('effect', 'accepted'), [
    (lambda u: 3.0 * u, True), (lambda u: 6.0 * np.sign(u) * np.maximum(np.abs(u) - 0.5, 0.0),
                                False)])
def test_an_input_that_acts_nonlinearly_is_named_as_the_cause(effect, accepted):
    """A tank whose valve has a dead zone, of which the best linear model is learned."""
    rng = np.random.default_rng(1)
    u = np.repeat(rng.uniform(-1.0, 1.0, 60), 8)
    x, time = np.zeros(len(u)), 0.1 * np.arange(len(u))
    for k in range(len(u) - 1):
        x[k + 1] = np.exp(-0.1) * x[k] - np.expm1(-0.1) * effect(u[k])
    plant = PlantDescription('tank', ('h',), ('m',), ('q',), ('V',), 's', np.full(1, np.nan),
                             np.full(1, np.nan), None)
    found = identify(plant, [Episode(time, (x + 0.01 * rng.standard_normal(len(x)))[:, None], time,
                                     u[:, None])], degrees=(1,), methods=methods(20))
    plant = replace(plant, nominal_state=np.zeros(1), nominal_input=np.zeros(1))
    learned = compare_classes(found, plant, Thresholds(), model_class='linear', n_z=1, seed=0,
                              starts=1, loops=8)
    decision = evaluate_model(found, learned, None, Thresholds(plants=6))
    assert decision.accepted is accepted
    assert decision.statement
    assert accepted or 'the effect of q is nonlinear' in ' '.join(decision.reasons)


@pytest.mark.parametrize(('factor', 'said'), [(1.05, False), (1.2, True)])
def test_drifts_that_differ_are_named(found, factor, said):
    """All rates are a fifth larger, so the difference is most where the rates are."""
    drift = found.drift
    other = replace(drift, coefficients=factor * drift.coefficients, B=factor * drift.B)
    text = disagreement(replace(found, alternatives=(other,)))
    assert ('differ by 20 % of the motion, most at temperature' in text) == said
    assert bool(text) == said


@pytest.mark.usefixtures('no_loops')
def test_a_lift_that_diverges_is_rejected_even_where_the_present_one_does(found, trained):
    model = trained.model
    diverging = linearised_model(np.array([[1e4]]), np.array([[1.0]]), model.states, model.inputs,
                                 model.time_unit, Provenance(model.provenance.plant))
    decision = evaluate_model(found, trained, diverging, Thresholds())
    assert decision.current_rmse == [np.inf]
    assert decision.accepted
    decision = evaluate_model(found, replace(trained, model=diverging), diverging, Thresholds())
    said = ' '.join(decision.reasons)
    assert 'inf K, is not 10 % below that of the current model' in said
    # the drift is stable
    assert re.search('it is unstable at temperature .* although a drift of degree 3, which', said)


@pytest.mark.parametrize('values', [
    {'margin': 1.0}, {'margin': -0.1}, {'margin': float('nan')}, {'condition': 1.0},
    {'condition': float('nan')}], ids=str)
def test_thresholds_out_of_range(values):
    with pytest.raises(ValueError, match='must be'):
        Thresholds(**values)


@pytest.mark.usefixtures('no_loops')
def test_warns_of_a_state_that_is_not_measured(trained, shipped):
    """The reactor's concentration moves, too; its temperature alone does not tell where it is."""
    run = driven(two_state_reactor(), 20.0, coolant=(294.0, 302.0), seed=2, noise=0.03)
    found = identify(shipped.plant, [run.episode()], degrees=(1, 2), methods=methods(20))
    decision = evaluate_model(found, trained, shipped, Thresholds())
    coloured, warning = decision.warnings
    assert coloured.startswith('the noise of temperature is coloured')
    assert f'temperature with an error of {decision.drift_rmse[0]:.3g} K' in warning
    assert 'unmeasured_states' in warning
    # the noise is told apart from it
    assert decision.noise == pytest.approx([0.03], rel=0.15)
    assert decision.drift_rmse > 1.5 * decision.noise
    assert not {coloured, warning} & set(decision.reasons)


@pytest.mark.usefixtures('no_loops')
@pytest.mark.parametrize('colour', [0.0, 0.8])
def test_noise_that_is_coloured_is_named(found, trained, shipped, colour):
    """The autocorrelation of n_k = 0.8 n_(k-1) + e_k is 0.8."""
    rng, episodes = np.random.default_rng(0), []
    for clean in found.held_out:
        n = rng.standard_normal(len(clean))
        for k in range(1, len(n)):
            n[k] = colour * n[k - 1] + np.sqrt(1.0 - colour ** 2) * n[k]
        segments = Segments.of([clean], longest_step([clean]))
        path = segments.path(found.drift.rate, clean.x[:1])[segments.sampled[:, 0], 0]
        episodes.append(replace(clean, x=path + NOISE * n[:, None]))
    decision = evaluate_model(replace(found, held_out=tuple(episodes)), trained, shipped,
                              Thresholds())
    if not colour:
        assert decision.warnings == ()
        return
    match = re.search(r'temperature is coloured \(autocorrelation (0\.\d\d).* counts as (\d+) % '
                      'of its samples', decision.warnings[0])
    # of three segments of 60 samples, whose starts are fitted
    r = float(match[1])
    assert r == pytest.approx(0.8, abs=0.2)
    assert float(match[2]) == pytest.approx(100.0 * (1.0 - r) / (1.0 + r), abs=1.0)


@pytest.mark.parametrize(('wanted', 'said'), [
    # the second by less than a twentieth of 20 K
    ((306.0, 326.0), ''), ((306.0, 327.9), ''), ((306.0, 329.5), '32.85 degC to 56.35 degC'),
    ((290.0, 326.0), '16.85 degC to 52.85 degC')])
def test_set_points_that_a_trained_range_leaves_out(shipped, wanted, said):
    warnings = uncovered_setpoints(shipped.states, {'temperature': wanted})
    assert len(warnings) == bool(said)
    assert said in ''.join(warnings)


# The steady point and the samples of a drift.

BOX = box([-1.0], [3.0], [-2.0], [2.0])


def drift_model(within, degree, f, input_matrix):
    """Return the drift model of f(x) + B u, with f a polynomial of the states in units."""
    model = DriftModel(within, degree, np.empty(0), within.input_matrix(np.array(input_matrix)))
    xi = np.random.default_rng(0).uniform(-1.0, 1.0, (50, len(within.states)))
    rate = f(within.states.to_physical(xi)) + within.inputs.center @ np.array(input_matrix).T
    return replace(model, coefficients=np.linalg.lstsq(
        model.features(xi), rate / within.states.scale, rcond=None)[0])


def bent(x):
    return 0.5 - x + 0.3 * x ** 2 - 0.2 * x ** 3


def held(drift, x0, u, count=60, period=0.1):
    """Return a record of a drift's own path by another integrator."""
    times = period * np.arange(count)
    path = solve_ivp(lambda _, x: drift.rate(x, np.array([u])), (0.0, times[-1]), [x0],
                     t_eval=times, rtol=1e-10, atol=1e-12).y.T
    return Episode(times, path, np.zeros(1), np.array([[u]]))


def test_steady_point_keeps_a_state_that_an_input_can_hold():
    x, u = steady_point(drift_model(BOX, 3, bent, [[1.5]]), np.array([1.2]), np.array([0.0]))
    assert x == pytest.approx([1.2], abs=1e-12)
    assert u == pytest.approx([-bent(1.2) / 1.5], abs=1e-11)


def test_the_range_of_an_unmeasured_state_does_not_limit_a_steady_state():
    # at rest the second state is 3
    drift = DriftModel(box([-1.0, -1.0], [1.0, 1.0], [-1.0], [1.0]), 1,
                       np.array([[0.0, -3.0], [-1.0, 0.0], [0.0, 1.0]]), np.eye(2, 1))
    with pytest.raises(ValueError, match='no steady state'):
        steady_point(drift, np.zeros(2), np.zeros(1))
    x, u = steady_point(drift, np.zeros(2), np.zeros(1), 1)
    assert drift.rate(x, u) == pytest.approx(0.0, abs=1e-9)
    assert x[1] == pytest.approx(3.0)


def test_steady_point_of_two_states_and_one_input():
    """Of dx1/dt = -x1 + x2 and dx2/dt = -x2 - x1^2 + u, on a box of half-widths 2 and 4."""
    drift = drift_model(
        box([-2.0, -4.0], [2.0, 4.0], [-5.0], [5.0]), 2,
        lambda x: np.stack([x[:, 1] - x[:, 0], -x[:, 1] - x[:, 0] ** 2], 1), [[0.0], [1.0]])
    x, u = steady_point(drift, np.array([1.0, 1.6]), np.array([2.0]))
    assert x[0] == pytest.approx(x[1], abs=1e-9)
    assert u == pytest.approx(x[1:] + x[0] ** 2, abs=1e-8)
    # near where it was asked for, in units of the range
    assert np.all(np.abs(x - [1.0, 1.6]) < 0.6)


def test_steady_point_finds_the_root_where_the_input_does_nothing():
    x, u = steady_point(drift_model(BOX, 3, bent, [[0.0]]), np.array([1.0]), np.array([0.3]))
    assert x == pytest.approx([brentq(bent, -1.0, 3.0, xtol=1e-14)], abs=1e-9)
    assert u == pytest.approx([0.3])


@pytest.mark.parametrize('coefficients', [[1.0, 0.0, 0.3, 0.0], [1e3, 1.0, 0.0, 0.0],
                                          [0.1, 0.0, 0.0, 1e-9]])
def test_no_steady_point(coefficients):
    still = DriftModel(BOX, 3, np.array(coefficients)[:, None], np.zeros((1, 1)))
    with pytest.raises(ValueError, match='no steady state was found within the range of the epi'):
        steady_point(still, np.array([1.0]), np.array([0.0]))


def test_samples_lie_on_the_paths_of_the_drift():
    drift = drift_model(BOX, 3, bent, [[1.5]])
    records = [held(drift, x0, u) for x0, u in ((2.5, -1.0), (-0.5, 1.5), (0.3, 0.2))]
    noisy = tuple(replace(r, x=r.x + 0.05 * np.random.default_rng(k).standard_normal(r.x.shape))
                  for k, r in enumerate(records))
    samples = drift_samples(drift, noisy)
    assert len(samples) == 3 * 59
    assert np.array_equal(samples.dxdt, drift.rate(samples.x, samples.u))
    # free of the noise: the start of each path is fitted to 60 measurements of it
    error = samples.x - np.concatenate([r.x[:-1] for r in records])
    assert np.sqrt(np.mean(error ** 2)) < 0.05 / 4.0
    # shares take part in turn, so that each covers the range
    assert np.array_equal(samples.episode[:12], [*range(10), 0, 1])
    # in the order of the segments and of their times
    assert samples.u[:, 0].tolist() == [-1.0] * 59 + [1.5] * 59 + [0.2] * 59


def test_segments_that_the_drift_does_not_follow_are_left_out():
    # above 1 it runs away
    drift = DriftModel(BOX, 3, np.array([[0.0], [-1.0], [0.0], [4.0]]), np.zeros((1, 1)))
    calm = held(drift, 1.4, 0.0)
    rising = Episode(calm.time, np.linspace(2.8, 3.0, 60)[:, None], calm.input_time, calm.u)
    samples = drift_samples(drift, (calm, rising))
    assert len(samples) == 59
    assert np.max(np.abs(samples.x)) < 3.0
    with pytest.raises(ValueError, match='the estimated drift reproduces'):
        drift_samples(drift, (rising,))


def test_samples_fill_the_range_and_few_are_all_kept():
    # a thousand around 0, a few on the way out
    xi = np.concatenate([np.random.default_rng(0).uniform(-0.1, 0.1, 5000),
                         np.linspace(-1.0, 1.0, 40)])[:, None]
    kept = _spread(xi)
    assert len(kept) <= 2000
    # all that is rare is kept
    assert set(kept) >= {i for i in range(5000, 5040) if abs(xi[i, 0]) > 0.15}
    xi = np.random.default_rng(0).uniform(-1.0, 1.0, (5000, 4))
    assert np.array_equal(_spread(xi[:300, :2]), np.arange(300))
    # of four states nearly every sample has a cell of its own
    assert 1000 < len(_spread(xi)) <= 2000
