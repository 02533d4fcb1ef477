# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Compiled functions give what numpy gives, and leave to it what is near to a border.

One file, so that they are compiled once where nothing is kept yet.
"""

from dataclasses import replace
from functools import cache
import itertools
import sys

from koopman_ros.estimation.kalman import propagated
from koopman_ros.estimation.observer import moved
from koopman_ros.kernels import COMPILED, IN_NUMPY, Kernels, named, NUMPY
import numpy as np
import pytest
from std_msgs.msg import String

from koopman_ros.control import State
from koopman_ros.control.laws.base import steady_state_target, Weights
from koopman_ros.control.laws.riccati import recentred, regulator
from koopman_ros.control.laws.shooting import Horizon, program, slope_at
from koopman_ros.lifting import LiftedModel, load
from koopman_ros.parameters.controller import built, table_of
from koopman_ros.replay.records import decoded, encoded, NUMERICS
from koopman_ros.resources import model_path
from koopman_ros.ros import topics
from koopman_ros.solvers import RiccatiStatus, solve_riccati
from koopman_ros.testing import Harness
from koopman_ros.units import NANOSECONDS
from support.controller_bench import Bench, reproduced, STEADY
from support.odd_events import leaves, odd_event
from support.random_lifts import random_lift

STEPS = 40
# model, parameters, seconds between samples, and how far apart commands may be, scaled. A plan is
# a quadratic program, solved until it stands still: what rounding makes of it is larger.
LOOPS = {
    'reactor_nz3': ({}, 1.0, 1e-12),
    'reactor_nz4': ({}, 1.0, 1e-12),
    'reactor_linear': ({}, 1.0, 1e-12),
    'two_state': ({'system': 'two_state'}, 1.0, 1e-12),
    'two_state_example': ({'system': 'two_state_example', 'levels': ('sdre',)}, 0.05, 1e-12),
    'two_tanks': ({'system': 'two_tanks'}, 0.5, 1e-12),
    'quadruple_tank': ({'system': 'quadruple_tank'}, 1.0, 3e-12),
    'pendulum': ({'system': 'pendulum', 'levels': ('sdre',)}, 0.02, 1e-12),
    'fed_reactor': ({'system': 'fed_reactor'}, 1.0, 1e-12),
    'two_state_saddle': ({'levels': ('sdre', 'linear')}, 1.0, 1e-12),
    'two_state_saddle planned': ({'levels': ('mpc', 'sdre')}, 1.0, 1e-11),
}


@cache
def kernels() -> Kernels:
    """Return what is compiled, which takes half a minute where nothing is kept yet."""
    found = named(COMPILED)
    assert found
    return found


def compiled(model: LiftedModel) -> LiftedModel:
    return replace(model, kernels=kernels())


@pytest.mark.parametrize('name', LOOPS)
def test_a_loop_with_a_shipped_model_is_commanded_the_same(name: str) -> None:
    given, seconds, apart = LOOPS[name]
    model = load(model_path(name.split()[0]))
    if 'saddle' in name:
        given = {'states_measured': ('temperature [K]',), **given}
    parameters = table_of(model, given).snapshot(given)
    ours, theirs = built(parameters, compiled(model)), built(parameters, model)
    rng, state = np.random.default_rng(0), State()
    x = np.zeros(model.n_x)
    for k in range(STEPS):
        if k == 3:
            state, _ = theirs.request_setpoint(
                state, theirs.controlled.center + 0.1 * theirs.controlled.scale)
        y = theirs.measured.of(model.states.to_physical(x + 1e-3 * rng.normal(size=len(x))))
        one, two = (controller.step(state, y, round((k + 1) * seconds * NANOSECONDS))
                    for controller in (ours, theirs))
        assert one[2].level == two[2].level
        np.testing.assert_allclose((one[1] - two[1]) / model.inputs.scale, 0.0, atol=apart)
        for part in ('x', 'w'):
            np.testing.assert_allclose(getattr(one[0].estimate, part),
                                       getattr(two[0].estimate, part), rtol=1e-12, atol=1e-12)
        state, u = two[0], model.inputs.to_deviation(two[1])
        h = seconds / model.seconds_per_time_unit
        x = x + h * (model.drift(x) + model.forcing(x, u))


@pytest.mark.parametrize(('name', 'given', 'seconds', 'usual'), [
    ('reactor_nz4', {}, 1.0, 50),
    ('reactor_nz4', {'coolant_temperature.max_disturbance': 0.05,
                     'coolant_temperature.rate_limit': 0.02}, 1.0, 50),
    ('reactor_nz3', {'disturbance_bandwidth': 0.0, 'setpoint_filter': 5.0}, 1.0, 50),
    ('two_state_example', {'system': 'two_state_example', 'levels': ('sdre',)}, 0.05, 25),
])
def test_a_step_is_the_same_whether_it_is_regular_or_not(
        name: str, given: dict[str, object], seconds: float, usual: int) -> None:
    model, answered = load(model_path(name)), []

    def counted(*arguments: object) -> object:
        answered.append(kernels()['regular_step'](*arguments))
        return answered[-1]

    parameters = table_of(model, given).snapshot(given)
    ours = built(parameters, replace(model, kernels={**kernels(), 'regular_step': counted}))
    theirs, rng, state = built(parameters, model), np.random.default_rng(1), State()
    for k in range(120):
        if k % 30 == 20:
            asked = model.states.center + 0.1 * rng.uniform(-1.0, 1.0) * model.states.scale
            state, _ = theirs.request_setpoint(state, asked)
        event = odd_event(model, rng, state, seconds)
        one, two = ours.step(state, *event), theirs.step(state, *event)
        np.testing.assert_allclose((one[1] - two[1]) / model.inputs.scale, 0.0, atol=1e-12)
        for part in ('level', 'depth', 'reason', 'mode'):
            assert repr(getattr(one[2], part)) == repr(getattr(two[2], part))
        for part in ('arrival', 'outside', 'missed', 'clock_went_back', 'follows'):
            np.testing.assert_equal(*(getattr(found[2].measurement, part) for found in (one, two)))
        for part in ('at_range', 'at_rate', 'way_back'):
            assert getattr(one[2].command, part) == getattr(two[2].command, part)
        assert one[2].estimate.at_bound == two[2].estimate.at_bound
        here, there = (np.concatenate([np.ravel(value).astype(float) for value in (
            report.estimate.state, report.target.input, report.target.state,
            report.target.residual, report.measurement.predicted, report.command.outside,
            report.command.law.gain, report.command.law.growth)])
            for report in (one[2], two[2]))
        np.testing.assert_allclose(here, there, rtol=1e-11, atol=1e-11)
        if k % 8 == 0:
            # whatever is remembered, and in no other way
            parts = zip(*(leaves(encoded(found[0])) for found in (one, two)), strict=True)
            for (place, here), (other, there) in parts:
                assert place == other
                if isinstance(here, float):
                    np.testing.assert_allclose(here, there, rtol=1e-11, atol=1e-11)
                else:
                    assert here == there
            # a replay that begins at this state finds the same bits
            again = built(parameters, compiled(model)).step(decoded(encoded(state)), *event)
            assert again[1].tolist() == one[1].tolist()
        state = two[0]
    assert sum(found is not None for found in answered) > usual


def same_plans(model: LiftedModel, x: np.ndarray, w: np.ndarray) -> None:
    """Check programs and distances about a course, of as many intervals as suits no processor."""
    rng, fast, (n, m), N = np.random.default_rng(0), compiled(model), model.B.shape, 5
    horizon = Horizon(x, w, np.zeros(n), np.zeros(m), 0.01 * np.arange(1, N + 1), 2, np.eye(n),
                      np.eye(m), np.eye(n))
    inputs, nodes = 0.1 * rng.normal(size=(N, m)), x + 0.05 * rng.normal(size=(N + 1, n))
    ours = kernels()['program'](fast, horizon, inputs, nodes)
    theirs = program(model, horizon, inputs, nodes)
    for part in ('nodes', 'by_inputs', 'H', 'f'):
        exact = getattr(theirs, part)
        np.testing.assert_allclose(getattr(ours, part), exact, rtol=0.0,
                                   atol=1e-12 * max(1.0, np.max(np.abs(exact))))
    nodes[-1, 0] = np.inf
    np.testing.assert_array_equal(kernels()['distances'](fast, nodes), model.distances(nodes))


@pytest.mark.parametrize('widths', [(5,), (7, 3)])
@pytest.mark.parametrize(('n_x', 'n_u'), [(1, 1), (2, 1), (3, 2)])
def test_random_lifts_of_any_depth_move_and_are_fed_back_the_same(
        n_x: int, n_u: int, widths: tuple[int, ...]) -> None:
    for seed in range(10):
        model = random_lift(n_x, widths, n_u=n_u, seed=seed)
        fast, rng = compiled(model), np.random.default_rng(seed)
        x, x_ref, w = (0.3 * rng.normal(size=n_x) for _ in range(3))
        u = rng.normal(size=n_u)
        np.testing.assert_allclose(moved(fast, x, w, u, 0.01, 3), moved(model, x, w, u, 0.01, 3),
                                   rtol=1e-12, atol=1e-13)
        same_plans(model, x, w)
        weights = Weights(np.eye(n_x), np.eye(n_u))
        target = steady_state_target(model, x_ref, w)
        one, two = (recentred(lift, x, target, weights, interval=0.05) for lift in (fast, model))
        assert one.riccati.status is two.riccati.status
        if two.solved:
            for part in ('u', 'drift', 'action'):
                exact = getattr(two, part)
                np.testing.assert_allclose(getattr(one, part), exact, rtol=0.0,
                                           atol=1e-11 * max(1.0, np.max(np.abs(exact))))


@pytest.mark.parametrize('name', ['reactor_nz3', 'pendulum', 'quadruple_tank', 'two_tanks',
                                  'two_state_saddle'])
def test_plans_and_predictions_are_set_up_the_same_with_a_read_out_and_without(name: str) -> None:
    model, rng = load(model_path(name)), np.random.default_rng(0)
    fast, n, m = compiled(model), model.n_x, model.n_u
    x, w, u = rng.uniform(-0.4, 0.4, n), 0.1 * rng.normal(size=n), rng.normal(size=m)
    inputs, nodes = 0.1 * rng.normal(size=(6, m)), np.tile(x, (7, 1))
    horizon = Horizon(x, w, np.zeros(n), np.zeros(m), np.full(6, 0.02), 2, np.eye(n), np.eye(m),
                      np.eye(n))
    astray = np.concatenate((nodes, 3.0 * nodes))
    np.testing.assert_allclose(kernels()['distances'](fast, astray), model.distances(astray),
                               rtol=1e-12, atol=1e-13)
    for function, arguments in ((propagated, (x, w, np.eye(2 * n), u, 0.01, 3)),
                                (program, (horizon, inputs, nodes)), (slope_at, (x,))):
        assert kernels()[function.__name__](fast, *arguments) is not None
        ours, theirs = ((found if isinstance(found, tuple) else [found] if isinstance(
            found, np.ndarray) else [found.nodes, found.by_inputs, found.H, found.f])
            for found in (function(fast, *arguments), function(model, *arguments)))
        for one, two in zip(ours, theirs, strict=True):
            np.testing.assert_allclose(one, two, rtol=1e-12, atol=1e-13)


def test_what_is_no_number_stays_none() -> None:
    model = compiled(random_lift(1, (5,)))
    assert np.isnan(moved(model, np.array([np.nan]), np.zeros(1), np.zeros(1), 0.01, 1)).all()


@pytest.mark.parametrize(('A', 'B', 'Q', 'status'), [
    # a growing mode that no input moves
    (np.diag([1.0, -1.0]), np.array([[0.0], [1.0]]), np.eye(2), RiccatiStatus.NOT_STABILISABLE),
    # a mode on the imaginary axis that is not weighted
    (np.zeros((2, 2)), np.eye(2), np.diag([1.0, 0.0]), RiccatiStatus.NOT_STABILISABLE),
    (np.array([[np.nan]]), np.eye(1), np.eye(1), RiccatiStatus.NOT_STABILISABLE),
])
def test_what_has_no_gain_in_numpy_has_none(A, B, Q, status) -> None:
    model, R = compiled(random_lift()), np.eye(B.shape[1])
    for carrier in (model, replace(model, kernels=NUMPY)):
        found = regulator(carrier, A, B, Q, R, interval=0.1, max_residual=1e-8, max_gain=1e6)
        assert found.status is status


def test_gain_of_the_sampled_regulator_of_random_plants() -> None:
    rng, model, compared = np.random.default_rng(0), compiled(random_lift()), 0
    for _ in range(300):
        n, m = rng.integers(1, 6), rng.integers(1, 3)
        A, B = rng.normal(size=(n, n)), rng.normal(size=(n, m))
        Q, R, interval = np.eye(n), np.diag(10.0 ** rng.uniform(-1.0, 1.0, m)), rng.uniform(0, 0.5)
        found = kernels()['regulator'](model, A, B, Q, R, interval=interval)
        if found is not None:
            exact = solve_riccati(A, B, Q, R, interval=interval)
            np.testing.assert_allclose(found.K, exact.K, rtol=0.0,
                                       atol=1e-11 * np.max(np.abs(exact.K)))
            compared += 1
    assert compared > 280


def test_a_model_is_in_numpy_unless_it_is_asked_otherwise() -> None:
    model = random_lift()
    assert model.kernels is NUMPY is named(IN_NUMPY)
    assert compiled(model).linearised.kernels is kernels()


def test_without_the_compiler_there_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.startswith('koopman_ros.compiled')]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, 'numba', None)
    assert named(COMPILED) is None


def test_compiled_step_takes_over_after_the_first_command_and_is_replayed(ros: Harness) -> None:
    # what is kept now, the controller need not wait for
    assert named(COMPILED)
    records = ros.listen(String, topics.CONTROLLER_EVENTS)
    bench = Bench(ros, {'compiled': True, 'disturbance_bandwidth': 0.0})
    later = itertools.count(2)

    def measure() -> bool:
        """Measure once more; tell whether the last answers were compiled."""
        bench.measure(STEADY - 0.1 * (next(later) % 7), float(next(later)))
        switched = [k for k, record in enumerate(records)
                    if f'"event":"{NUMERICS}"' in record.data]
        return bool(switched) and len(records) > switched[0] + 20

    ros.wait_until(measure)
    ros.wait_until(lambda: sum('"event":"measurement"' in record.data for record in records)
                   == bench.sent)
    written, commands = reproduced(records)
    assert [record.event for record in written].count(NUMERICS) == 1
    # the one that a new listener gets, or that of the start
    assert written[0].fields[NUMERICS] == 'numpy'
    assert commands == [message.temperature for message in bench.commands]
