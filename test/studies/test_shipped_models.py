# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The shipped models: what they promise, recomputed on data that no training has seen."""

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest

from koopman_ros.control import Controller, Initialisation, InputLimits, SetpointRequest, Tuning
from koopman_ros.core.paths import model_path
from koopman_ros.evaluation import at, run_loop
from koopman_ros.evaluation.optimal_cost import cost_along, linear_law, optimum, Task
from koopman_ros.learning import fit
from koopman_ros.model import load
from koopman_ros.plants import (
    box_episodes,
    Process,
    random_steps,
    RandomStepDesign,
    steady_state,
)
from studies import saddle, shipped_models
from studies.paper import reactor
from studies.paper.reactor import SETPOINT, SYSTEM, training_samples
from studies.robustness.loop import on_plant
from studies.shipped_models import (
    FEED,
    library_system,
    LIFTS,
    LINE,
    LINE_VALVE,
    line_with_feed,
    reactor_with_feed,
    SADDLE,
    SEED,
    train_lifts,
)
from studies.unstable import SADDLE_TEMPERATURE, steady

SAMPLE_PERIOD = 0.25
# What is known to be reachable on this plant, by n_z: of rw, and of the error of a prediction in
# K, be it over an episode or at rest, where a wrong feed-forward leaves an offset.
PROMISED_FIT = {3: 1e-6, 4: 1e-7}
PROMISED_KELVIN = {3: 0.005, 4: 0.002}


# by seed
drawn = cache(training_samples)


def shipped(name):
    return load(model_path(f'reactor_{name}'))


@pytest.fixture(scope='module')
def episodes():
    """Drive the reactor through 15 minutes of random coolant steps within the models' box."""
    model = shipped('nz3')
    design = RandomStepDesign(
        input_lower=model.inputs.lower, input_upper=model.inputs.upper,
        state_lower=model.states.lower, state_upper=model.states.upper,
        hold_time=(0.5, 5.0), sample_period=SAMPLE_PERIOD)
    return [random_steps(SYSTEM, design, 15.0, seed) for seed in (7001, 7002, 7003, 7004)]


def roll_out_error(model, episodes):
    """Return the root mean square of the prediction error over all episodes, in K."""
    squares = [np.square(model.predict(episode.x[0], episode.u, SAMPLE_PERIOD)
                         - episode.x) for episode in episodes]
    return float(np.sqrt(np.mean(squares)))


@pytest.mark.parametrize('name', ['nz3', 'nz4', 'linear'])
def test_the_box_covers_the_range_of_operation(name):
    model = shipped(name)
    assert model.states.lower[0] < 306.0
    assert model.states.upper[0] > 326.0
    assert model.states.violation(np.array([314.475443])) == 0.0
    # set-points of the whole range have a coolant in the training box, up to its warm end
    assert model.inputs.lower[0] < 283.0
    assert model.inputs.upper[0] > 300.5


def assert_promise(model, episodes):
    """
    Hold a lift to all that is promised of it without a controller.

    On fresh samples; to the drift of the true plant at every temperature of its range, where rw
    and rx, squares of errors relative to the motion, promise on average, which lets the drift err
    by their root times the largest rate; and over whole episodes.
    """
    promised, fresh = PROMISED_FIT[model.n_z], drawn(7001)
    figures = fit(model, fresh.x, fresh.dxdt, fresh.u)
    assert max(figures.rw, figures.rx) <= promised
    assert figures.cond < 10.0
    # the file promises what fresh data confirm
    assert model.provenance.metrics['rw'] <= promised
    assert figures.rw < 10.0 * model.provenance.metrics['rw']
    x = np.linspace(model.states.lower, model.states.upper, 400)
    # a lift's drift is what the plant does under the input that its deviations are counted from
    true = SYSTEM.derivative(x, np.broadcast_to(model.inputs.center, x.shape))
    learned = model.drift(model.states.to_deviation(x)) * model.states.scale
    assert np.max(np.abs(learned - true)) <= np.sqrt(promised) * np.max(np.abs(true))
    assert roll_out_error(model, episodes) <= PROMISED_KELVIN[model.n_z]


@pytest.mark.parametrize('n_z', [3, 4])
def test_shipped_lifts_keep_their_promise_on_fresh_data(n_z, episodes):
    assert_promise(shipped(f'nz{n_z}'), episodes)


def test_the_lift_with_feed_temperature_has_the_true_effect():
    """q/V is 1/min, whatever the temperatures; along episodes in which both of them step."""
    model, system = load(model_path(FEED)), reactor_with_feed()
    assert (model.inputs.names, model.disturbances.names) == (
        SYSTEM.input_names, ('feed_temperature',))
    assert model.E * model.states.scale / model.disturbances.scale == pytest.approx(1.0, abs=1e-5)
    assert model.provenance.metrics['rw'] <= PROMISED_FIT[4]
    design = RandomStepDesign(
        input_lower=[282.0, 341.0], input_upper=[301.0, 359.0], state_lower=305.0,
        state_upper=327.0, hold_time=(0.5, 5.0), sample_period=SAMPLE_PERIOD)
    assert roll_out_error(model.joined, [
        random_steps(system, design, 15.0, 7001)]) <= PROMISED_KELVIN[4]


def test_the_lift_of_the_heated_line_has_its_feed_valve_and_dead_time():
    model = load(model_path(LINE))
    assert model.dead_time.tolist() == [LINE_VALVE.dead_time]
    assert model.provenance.metrics['rw'] <= PROMISED_FIT[4]
    design = RandomStepDesign(
        input_lower=[10.0, 284.0], input_upper=[90.0, 302.0], state_lower=[0.15, 308.0],
        state_upper=[0.5, 338.0], hold_time=(60.0, 240.0), sample_period=30.0)
    run = random_steps(line_with_feed(), design, 3600.0, 7001)
    # of the lift, and of the straight pieces of its characteristic
    u = np.column_stack([LINE_VALVE.position(run.u[:, :1]), run.u[:, 1]])
    predicted = model.joined.predict(run.x[0], u, design.sample_period)
    np.testing.assert_allclose(predicted, run.x, rtol=0.0, atol=0.04)


def test_the_linear_model_is_the_linearisation_and_predicts_far_worse(episodes):
    model = shipped('linear')
    np.testing.assert_allclose(
        model.A, SYSTEM.drift_jacobian(SYSTEM.nominal_state), rtol=1e-12)
    assert model.provenance.seed is None
    assert roll_out_error(model, episodes) > 1.0


# seconds of computing, many times as long beside other programs
@pytest.mark.timeout(900)
def test_a_retrained_lift_is_as_accurate_as_the_shipped_one(episodes, monkeypatch):
    """
    Judge by the true plant alone: the bits of a training are those of its processor.

    Another one rounds differently, in the simulated data already, and a thousand steps of the
    minimisation carry that along directions that hardly change the model: with data that differ
    by 1e-13 rw comes out several times as large or as small.
    """
    # the best of three is shipped; one is to keep the promise, too, which is of the true plant
    monkeypatch.setattr(shipped_models, 'LIFTED_SIZES', (3,))
    (n_z, model), = train_lifts(starts=1, loops=0).items()
    shipped_one = shipped(f'nz{n_z}')
    assert model.is_hurwitz
    assert_promise(model, episodes)
    assert model.provenance.metrics['rollout_rmse'] <= PROMISED_KELVIN[n_z]
    # of a step of 10 K, without an observer
    assert reactor.feed_forward_offset(model) <= PROMISED_KELVIN[n_z]
    loop = reactor.close_loop(model)
    assert loop.failure == ''
    assert abs(float(loop.states[-1, 0]) - SETPOINT) <= PROMISED_KELVIN[n_z]
    # it is learned from what the shipped one was learned from
    for mine, theirs in ((model.states, shipped_one.states), (model.inputs, shipped_one.inputs)):
        for name in ('center', 'scale', 'lower', 'upper'):
            np.testing.assert_allclose(getattr(mine, name), getattr(theirs, name), rtol=1e-9)
    assert model.provenance.data_digest == drawn(SEED).digest()


# The lifts of the other plants: a task each, for the learned law on the true plant.


@dataclass(frozen=True)
class Promise:
    """What the lift of a plant promises, from its nominal state unless another is given."""

    fit: float  #: rw and rx on fresh data
    wanted: dict[str, float]  #: the set-point of the controlled states
    weights: tuple[float, ...]  #: of squared state errors
    #: lowest and highest value of each input
    limits: tuple[tuple[float, ...], tuple[float, ...]]
    period: float  #: in s
    samples: int  #: so many of them
    ratio: float  #: of the cost to the least there is
    linear_ratio: float  #: what the linear law's is above
    #: distance from the set-point at the end, of the controlled states
    offset: float
    x0: tuple[float, ...] | None = None  #: start


PROMISES = {
    'two_state': Promise(1e-6, {'temperature': 314.475443}, (0.0, 1.0), ((278.15,), (305.15,)),
                         2.0, 300, 1.002, 3.0, 0.005),
    # another conversion at another temperature takes another feed
    'fed_reactor': Promise(1e-7, {'concentration': 0.92, 'temperature': 318.0}, (100.0, 1.0),
                           ((60.0, 278.15), (150.0, 305.15)), 1.0, 300, 1.002, 20.0, 0.005),
    # x1 decays as it likes
    'two_state_example': Promise(1e-8, {'x1': 0.0, 'x2': 0.0}, (1.0, 1.0), ((-50.0,), (50.0,)),
                                 0.1, 800, 1.0009, 4.5, 0.0017, (5.0, 5.0)),
    'two_tanks': Promise(1e-6, {'level_1': 0.12, 'level_2': 0.20}, (1e3, 1e3),
                         ((0.0, 0.0), (12.0, 12.0)), 0.5, 240, 1.002, 1.2, 1e-4),
    'quadruple_tank': Promise(1e-5, {'level_1': 0.20, 'level_2': 0.16}, (1e3, 1e3, 0.0, 0.0),
                              ((0.0, 0.0), (10.0, 10.0)), 2.0, 300, 1.002, 1.2, 1e-4),
    'pendulum': Promise(1e-4, {'angle': 0.0, 'rate': 0.0}, (1.0, 0.1), ((-15.0,), (15.0,)),
                        0.02, 300, 1.01, 1.03, 1e-6, (np.pi / 3.0, 0.0))}


@cache
def known(name):
    """Return fresh data of a plant, its task, the least cost of it and that of the linear law."""
    promise, system = PROMISES[name], library_system(name)
    x_ref, u_ref = steady_state(system, promise.wanted)
    task = Task(system, system.nominal_state if promise.x0 is None else np.array(promise.x0),
                x_ref, u_ref, np.array(promise.weights), np.ones(system.n_u),
                promise.period / system.seconds_per_time_unit, promise.samples)
    lift = LIFTS[name]
    fresh = box_episodes(system, lift.design, lift.episodes // 6, lift.duration, 7001)
    return fresh, task, optimum(task).cost, linear_law(task).cost


def keeps(name, model):
    """Hold a lift to what is promised of it, on fresh data and in closed loop."""
    promise, (fresh, task, least, linear) = PROMISES[name], known(name)
    system, x_ref = task.system, task.x_ref
    figures = fit(model, fresh.x, fresh.dxdt, fresh.u)
    assert max(figures.rw, figures.rx) <= promise.fit
    assert figures.cond < 10.0

    lower, upper = map(np.array, promise.limits)
    # the learned law alone, within the margin of its data that is the default
    settings = Tuning.for_model(
        model, state_weight=task.Q, input_weight=task.R,
        limits=InputLimits(lower, upper, np.full(system.n_u, np.inf)),
        fallback_order=('sdre',), bumpless_transfer_time=30.0)
    loop = run_loop(
        Controller(model, settings), Process(system, 0, task.x0, system.nominal_input),
        [at(0.0, SetpointRequest(0, x_ref))], period=promise.period,
        duration=promise.period * promise.samples)
    assert set(loop.levels) == {'sdre'}
    controlled = [system.state_names.index(state) for state in promise.wanted]
    assert np.max(np.abs(loop.states[-1] - x_ref)[controlled]) <= promise.offset
    cost = cost_along(task, loop.states, loop.commands[:-1])
    # the limits do not matter, so that nothing is below the optimum
    assert 1.0 - 1e-6 < cost / least < promise.ratio
    assert linear > promise.linear_ratio * least
    return cost


@pytest.mark.parametrize('name', LIFTS)
def test_shipped_lifts_of_the_library_keep_their_promise(name):
    system, model, lift = library_system(name), load(model_path(name)), LIFTS[name]
    assert (model.n_z, model.identity) == (lift.recipe.n_z, lift.recipe.identity)
    assert model.provenance.plant == system.name
    assert model.provenance.metrics['rw'] <= PROMISES[name].fit
    for box, other in ((model.states, 'state'), (model.inputs, 'input')):
        assert box.names == getattr(system, f'{other}_names')
        assert box.units == getattr(system, f'{other}_units')
        np.testing.assert_allclose(box.center, getattr(system, f'nominal_{other}'), rtol=1e-12)
        width = np.subtract(getattr(lift.design, f'{other}_upper'),
                            getattr(lift.design, f'{other}_lower'))
        np.testing.assert_allclose((box.upper - box.lower) / width, 1.0, rtol=0.05)
    cost = keeps(name, model)
    if name == 'two_state_example':
        # of the exact lift's regulator in continuous time
        assert cost < 1.001 * 990.1798


def test_the_lift_at_the_saddle_holds_it_from_the_temperature_alone():
    model = load(model_path(SADDLE))
    assert (model.n_z, model.provenance.seed) == (2, 0)
    assert max(model.provenance.metrics[figure] for figure in ('rw', 'rx')) < 1e-6
    wanted, (x0, u0) = SADDLE_TEMPERATURE, steady(SADDLE_TEMPERATURE)
    loop = run_loop(
        saddle.controller(model, ('sdre',), saddle.WIDE), Process(saddle.SYSTEM, 0, x0, u0), [
            at(0.0, Initialisation(u0)), at(0.0, SetpointRequest(0, np.array([wanted]))),
            at(60.0, on_plant(system=saddle.reactor(saddle.FOULING)))],
        duration=400.0, noise=np.array([saddle.NOISE]), seed=0)
    away = loop.states[:, 1] - wanted
    # with the reactor's own equations and both states known it is 3.85 K
    assert np.max(np.abs(away)) < 4.2
    assert abs(np.mean(away[-200:])) < 0.05
