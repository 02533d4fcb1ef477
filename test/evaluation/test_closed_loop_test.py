# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Closed loops over a box: which laws pass, which fail, where, and beside what."""

from dataclasses import replace
from functools import cache
import math

import numpy as np
import pytest
from scipy.integrate import quad

from koopman_ros.control import Controller, InputLimits, State, Tuning
from koopman_ros.control.laws import Law, LawResult, Linear
from koopman_ros.control.steady_state import steady_state_target
from koopman_ros.core.status import StatusCode
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.estimation import Estimate
from koopman_ros.evaluation.closed_loop_test import (
    evaluate_closed_loops,
)
from koopman_ros.execution import Serial
from koopman_ros.model import (
    Coordinates,
    LiftedModel,
    linearised_model,
    PolynomialObservables,
    Provenance,
    TrainingStates,
    VerifiedLoops,
)

STATE = Coordinates(('level',), ('m',), np.zeros(1), np.ones(1), -np.ones(1), np.ones(1))
INPUT = Coordinates(('flow',), ('m/s',), np.zeros(1), np.ones(1), np.full(1, -3.0),
                    np.full(1, 3.0))
CASCADE, CASCADE_INPUT = np.array([[-1.0, 1.0], [0.0, -1.0]]), np.array([[0.0], [1.0]])
TWO = Coordinates(('a', 'b'), ('m', 'K'), np.array([2.0, 300.0]), np.array([0.5, 20.0]),
                  np.array([1.5, 280.0]), np.array([2.5, 320.0]))
A, B = np.array([[0.3, 1.0], [-2.0, -0.5]]), np.array([[0.0, 0.4], [1.5, 0.0]])
INPUTS = Coordinates(('u', 'v'), ('V', 'V'), np.array([1.0, 2.0]), np.ones(2),
                     np.array([-9.0, -9.0]), np.array([9.0, 9.0]))


def scalar(a=1.0, b=1.0):
    """Return the model of dx/dt = a x + b u."""
    return linearised_model(np.array([[a]]), np.array([[b]]), STATE, INPUT, 's', Provenance('s'))


def linear_rate(a, b=1.0):
    return lambda x, u: a * x + b * u


def two_states(B=B):
    """Return a model in units that differ from its scaled deviations, and minutes."""
    D = TWO.scale[:, None]
    return linearised_model(D * A / TWO.scale, D * B, TWO, INPUTS, 'min', Provenance('two'))


def two_state_rate(x, u):
    return TWO.scale * (TWO.to_deviation(x) @ A.T + INPUTS.to_deviation(u) @ B.T)


def test_as_many_samples_and_steps_however_the_rates_are_rounded():
    """With one state the slowest mode is the fastest, and both numbers are whole."""
    sizes = set()

    class Looking(Serial):
        def run(self, function, parts, *, shared, watch):
            sizes.add((shared.samples, shared.steps))
            yield from ()

    for a in np.random.default_rng(0).uniform(-2.0, 2.0, 40):
        assert evaluate_closed_loops(scalar(a), linear_rate(a), interval=1e-3, loops=4,
                                     backend=Looking()) is None
    assert len(sizes) == 1


def test_on_a_linear_plant_the_law_is_the_linear_one():
    found = evaluate_closed_loops(two_states(), two_state_rate, loops=32)
    assert (found.loops, found.arrived, found.hopeless) == (32, 32, 0)
    assert found.ratios == pytest.approx(np.ones(32), abs=1e-8)
    assert found.accepted
    assert found.region == ''
    assert str(found).startswith('the controller fails in 0 of 32 simulated closed loops;')
    # all over the box, in each of its quarters
    for x in (found.starts, found.setpoints):
        assert np.all((x >= TWO.lower) & (x <= TWO.upper))
        quarters = (x > TWO.center) @ [1, 2]
        assert min(np.bincount(quarters, minlength=4)) >= 2
    assert np.all(np.max(np.abs(found.starts - found.setpoints) / TWO.scale, axis=1) >= 0.25)


@pytest.mark.parametrize(('model', 'rate', 'dead', 'limits'), [
    # of a part of a sample, and of several; of plants that are unstable and in minutes
    (scalar(), linear_rate(1.0), [0.2], 2e-3), (scalar(), linear_rate(1.0), [1.0], 2e-3),
    (two_states(), two_state_rate, [70.0, 70.0], 2e-3),
    (two_states(), two_state_rate, [0.0, 70.0], 0.03)])
def test_a_law_bridges_the_dead_time_by_the_inputs_under_way(model, rate, dead, limits):
    model, wide = replace(model, dead_time=np.array(dead)), np.full(model.n_u, 99.0)
    free = InputLimits(-wide, wide, np.full(model.n_u, np.inf))
    found = evaluate_closed_loops(model, rate, loops=8, limits=free)
    # beside the same law that acts on the state of that time
    assert found.excess == pytest.approx(np.ones(8), abs=limits)
    assert found.accepted
    unaware = Tuning.for_model(model, max_gain=1e6, dead_time=np.zeros(model.n_u), limits=free)
    lost = evaluate_closed_loops(model, rate, loops=8, tuning=unaware)
    assert max(dead) < 0.5 or lost.share_failed > 0.5


def test_an_input_of_the_wrong_sign_is_rejected():
    found = evaluate_closed_loops(two_states(-B), two_state_rate, loops=16)
    assert not found.accepted
    assert (found.loops, found.arrived, found.share_failed) == (16, 0, 1.0)
    assert not found.no_gain.any()
    assert math.isinf(found.worst_ratio)
    assert '16 of 16 simulated closed loops (in 16 it does not reach' in str(found)
    assert len(repr(found)) < 300


def test_a_law_that_fails_in_a_part_of_its_box_is_rejected_with_that_part():
    """
    The plant is dx/dt = 0.5 x + u, the model has -1.5 (x^3 + x^4) beside.

    Where its secant S is below -0.75 the gain S + sqrt(S^2 + 1) is below the 0.5 it takes.
    """
    A = np.zeros((4, 4))
    A[0] = 0.5, 0.0, -1.5, -1.5
    observables = PolynomialObservables.total_degree(1, 4)
    model = LiftedModel(observables, A, np.ones((1, 1)), STATE, INPUT, 's', Provenance('wrong'),
                        readout=A[:1])
    found = evaluate_closed_loops(model, linear_rate(0.5), loops=64)
    x0, r = found.starts[:, 0], found.setpoints[:, 0]
    secant = 0.5 - 1.5 * (x0 ** 3 - r ** 3 + x0 ** 4 - r ** 4) / (x0 - r)
    lost = (x0 > r) & (x0 > 0.0) & (secant < -0.8)
    assert np.sum(lost) > 5
    assert np.isinf(found.ratios[lost]).all()
    sound = (x0 < 0.1) & (r < 0.1)
    assert np.sum(sound) > 10
    assert np.isfinite(found.ratios[sound]).all()
    assert not found.accepted
    failed = found.failed
    # to a thousandth of the box
    low, high = (round(500.0 * x) / 500.0 for x in (x0[failed].min(), x0[failed].max()))
    assert f'from level {low:.4g} to {high:.4g} m to set-points level ' in found.region
    assert found.region in str(found)
    # elsewhere it costs more than it might
    assert np.maximum(x0, r)[np.isinf(found.ratios)].min() > 0.1
    # the right one passes
    A = np.diag([0.5, 0.0, 0.0, 0.0])
    right = replace(model, A=A, readout=A[:1])
    assert evaluate_closed_loops(right, linear_rate(0.5), loops=32).accepted


class Constant(Law):
    """A law with a gain of 4."""

    def compute(self, estimate, target, memory, interval, previous):
        return LawResult(self.model.inputs.to_physical(target.u - 4.0 * (estimate.x - target.x)))


def held_cost(a, gain, h):
    """Return the cost from x = 1 of dx/dt = a x + u, u = -gain x held over h."""
    def x(t):
        return math.exp(a * t) - gain * math.expm1(a * t) / a
    return (quad(lambda t: x(t) ** 2, 0.0, h)[0] + h * gain ** 2) / (1.0 - x(h) ** 2)


def test_a_costly_law_is_rejected_by_its_cost():
    endless = InputLimits(np.full(1, -np.inf), np.full(1, np.inf), np.full(1, np.inf))
    model, h = scalar(), 0.4  # longer than half of 1 / sqrt(2)
    found = evaluate_closed_loops(model, linear_rate(1.0), law=Constant, limits=endless,
                                  interval=h, loops=16)
    u = Linear(model, Tuning.for_model(model), None).compute(
        Estimate(np.ones(1), np.zeros(1)), steady_state_target(model, np.zeros(1)), None, h,
        None).u
    expected = held_cost(1.0, 4.0, h) / held_cost(1.0, -float(u[0]), h)
    assert expected > 1.1
    assert found.ratios == pytest.approx(np.full(16, expected), rel=1e-4)
    # of a linear plant it is the same law
    assert found.excess == pytest.approx(found.ratios, rel=1e-4)
    assert '(in 16 it costs over 1.05 times' in str(found)


def test_setpoints_out_of_reach_within_limits_are_judged_without_limits():
    """With |u| <= 0.5 nothing brings dx/dt = x + u back from |x| > 0.5."""
    tight = InputLimits(np.full(1, -0.5), np.full(1, 0.5), np.full(1, np.inf))
    found = evaluate_closed_loops(scalar(), linear_rate(1.0), limits=tight, loops=32)
    assert found.accepted
    assert 10 < found.hopeless < 22
    assert found.loops == 32
    assert np.all(np.isfinite(found.excess))
    # they do not hide what another law costs out there
    costly = evaluate_closed_loops(scalar(), linear_rate(1.0), limits=tight, loops=32,
                                   law=Constant)
    far = np.abs(costly.starts[:, 0]) > 0.55
    assert np.sum(far) > 10
    assert np.all(costly.excess[far] > 1.05)
    assert np.max(np.abs(found.setpoints)) <= 0.5 + 1e-9
    # nor is it a recommendation where there is nothing else
    lost = evaluate_closed_loops(scalar(1.0, -1.0), lambda x, u: x, limits=tight, loops=16)
    assert lost.loops == 0
    assert not lost.accepted
    assert 'no law, not even a linear one, reaches the set-point in any of ' in str(lost)
    assert math.isnan(lost.worst_ratio)


def cubic(a, b, c, limit):
    """Return the model of dx/dt = a x + b x^2 + c x^3 + u, and this rate."""
    A = np.zeros((3, 3))
    A[0] = a, b, c
    bounds = np.full(1, limit)
    inputs = replace(INPUT, lower=-bounds, upper=bounds)
    return LiftedModel(PolynomialObservables.total_degree(1, 3), A, np.ones((1, 1)), STATE, inputs,
                       's', Provenance('cubic'), readout=A[:1]), (
        lambda x, u: a * x + b * x ** 2 + c * x ** 3 + u)


def too_steady():
    """Return a model of dx/dt = x + u that takes x for far steadier than it is, far out."""
    return cubic(1.0, 0.0, -0.5, 3.0)[0]


@cache
def too_steady_on_its_plant():
    return evaluate_closed_loops(too_steady(), linear_rate(1.0), loops=64)


def test_a_loss_that_a_perfect_model_shares_does_not_count():
    found = evaluate_closed_loops(*cubic(0.0, 6.0, 0.0, 8.0), loops=64)
    assert np.mean(found.poor) > 0.01
    assert np.all(found.excess[found.poor] <= 1.001)
    assert found.accepted
    assert found.region == ''
    assert str(found).endswith(f', except in {np.sum(found.poor)} loops that are costly with a '
                               'perfect model as well')
    # here it is to blame
    blamed = too_steady_on_its_plant()
    assert not blamed.accepted
    assert np.all(blamed.excess[blamed.failed] > 1.05)


def test_a_cost_that_a_better_model_would_save_counts_against_a_model():
    """A linear model passes beside linear laws, but another would save much."""
    model, rate = cubic(0.5, 0.5, 0.0, 8.0)
    assert evaluate_closed_loops(model, rate, loops=32).failed.sum() == 0
    found = evaluate_closed_loops(model.linearised, rate, loops=32)
    assert found.poor.sum() == 0
    assert found.ratios.max() == pytest.approx(1.0)
    assert not found.accepted
    # neither linear law arrives in some, which count all the same, as not arrived
    alone = np.isinf(found.excess)
    assert alone.any()
    assert (found.ratios[alone] == 0.0).all()
    assert found.arrived == found.loops - alone.sum()
    assert 'it costs over 1.05 times' in str(found)


def test_a_model_keeps_the_loops_in_which_its_law_is_lost():
    found = too_steady_on_its_plant()
    tried = found.tried
    assert tried is not None
    model = replace(too_steady(), verified_loops=tried)
    for start, setpoint, lost in zip(found.starts, found.setpoints, found.lost, strict=True):
        assert model.failed_near(start, setpoint) == lost
    assert model.linearised.verified_loops is None
    # and nothing of a law that is lost nowhere
    assert evaluate_closed_loops(two_states(), two_state_rate, loops=16).tried is None


@pytest.mark.parametrize(('starts', 'setpoints', 'lost'), [
    (np.zeros((3, 2)), np.zeros((3, 2)), np.zeros(2)),
    (np.zeros((3, 2)), np.zeros((3, 1)), np.zeros(3)),
    (np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0)),
    (np.zeros((1025, 2)), np.zeros((1025, 2)), np.zeros(1025))])
def test_tried_loops_that_do_not_fit_are_rejected(starts, setpoints, lost):
    with pytest.raises(ValueError, match='incompatible'):
        VerifiedLoops(starts, setpoints, lost)


def levels_on_the_way(model, levels, start, setpoint):
    """Let a controller bring the plant dx/dt = x + u to a set-point; return (level, reason)s."""
    loop = Controller(model, Tuning.for_model(
        model, state_weight=np.ones(1), input_weight=np.ones(1), observer_bandwidth=5.0,
        limits=InputLimits(*(np.full(1, bound) for bound in (-3.0, 3.0, np.inf))),
        bumpless_transfer_time=0.0, fallback_order=levels, learned_model_margin=1.0,
        linear_model_margin=1.0,
        recovery_time=0.5))
    x, h, found = np.array([start]), 0.05, []
    state, rejected = loop.request_setpoint(State(), np.array([setpoint]))
    assert rejected is None
    for k in range(200):
        state, u, report = loop.step(state, x, round(k * h * NANOSECONDS))
        x = math.exp(h) * x + (math.exp(h) - 1.0) * u
        found.append((report.level, report.reason and report.reason.code))
    assert x == pytest.approx(setpoint, abs=1e-3)
    return found


def test_where_its_law_was_lost_the_controller_takes_the_next_one():
    found = too_steady_on_its_plant()
    assert 0 < found.lost.sum() < found.poor.sum() < found.loops
    model = replace(too_steady(), verified_loops=found.tried)
    for lost, expected in ((True, ('linear', StatusCode.LOST_HERE)), (False, ('sdre', None))):
        for k in np.flatnonzero(found.lost == lost)[:3]:
            first, *_ = levels_on_the_way(
                model, ('sdre', 'linear'), found.starts[k, 0], found.setpoints[k, 0])
            assert first == expected
    start, setpoint = found.starts[found.lost][0, 0], found.setpoints[found.lost][0, 0]
    # another set-point is another way
    *_, (last, _) = levels_on_the_way(model, ('sdre', 'linear'), start, 0.5 * start)
    assert last == 'sdre'
    # without another law there is nothing to leave the plant to
    assert set(levels_on_the_way(model, ('sdre',), start, setpoint)) == {('sdre', None)}


def cascade():
    """Return dx1/dt = -x1 + x2, dx2/dt = -x2 + u, which rests where x1 = x2 = u."""
    states = Coordinates.spanning(('x1', 'x2'), ('', ''), np.array([-1.0, -4.0]),
                                  np.array([1.0, 4.0]))
    return linearised_model(CASCADE, CASCADE_INPUT, states, INPUT, 's', Provenance('cascade'))


def cascade_rate(x, u):
    return x @ CASCADE.T + u @ CASCADE_INPUT.T


def test_setpoints_are_where_an_input_holds_the_plant():
    found = evaluate_closed_loops(cascade(), cascade_rate, loops=32)
    assert found.setpoints[:, 0] == pytest.approx(found.setpoints[:, 1], abs=1e-6)
    assert np.ptp(found.setpoints[:, 0]) > 1.0
    assert found.accepted


def test_loops_begin_and_end_where_the_data_are():
    line = np.linspace(-1.0, 1.0, 41)
    data = TrainingStates.of(np.stack([line, line], 1), np.ones(2))
    model = replace(two_states(), training_states=data)
    found = evaluate_closed_loops(model, two_state_rate, loops=32)
    assert found.loops > 8
    assert all(model.distance(x) <= 1e-9 for x in (*found.starts, *found.setpoints))
    for shares in ((found.starts - TWO.lower) / (TWO.upper - TWO.lower)).T:
        assert np.ptp(shares) > 0.9


def test_loops_that_cannot_be_tried_have_a_reason():
    found = evaluate_closed_loops(cascade(), cascade_rate, loops=16,
                                  limits=InputLimits(*(np.full(1, bound) for bound in (
                                      5.0, 6.0, np.inf))))
    assert found.loops == 0
    assert not found.accepted
    assert str(found).startswith('no closed loop could be tried: no steady state within')


def test_the_watch_sees_it_and_can_end_it():
    seen = []
    assert evaluate_closed_loops(scalar(), linear_rate(1.0), loops=2,
                                 watch=seen.append) is not None
    assert seen[0] == 0.0
    assert 0.9 < seen[-1] < 1.0
    assert seen == sorted(seen)
    assert evaluate_closed_loops(scalar(), linear_rate(1.0),
                                 watch=lambda share: share > 0.3) is None


def test_a_plant_without_inputs_has_no_closed_loop():
    none = Coordinates((), (), *np.zeros((4, 0)))
    model = LiftedModel(PolynomialObservables.total_degree(1, 1), -np.eye(1), np.zeros((1, 0)),
                        STATE, none, 's', Provenance('free'))
    with pytest.raises(ValueError, match='a plant without inputs cannot be controlled'):
        evaluate_closed_loops(model, lambda x, u: -x)
