# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The PI law: its equation, limits without windup, hand-over, and a plant without a model."""


import numpy as np
import pytest
from scipy.linalg import expm

from koopman_ros.control import (
    Controller,
    Initialisation,
    InputLimits,
    SetpointRequest,
    State,
    Tuning,
)
from koopman_ros.control.laws.pi import PIParameters
from koopman_ros.core.status import StatusCode
from koopman_ros.core.units import NANOSECONDS as SECOND
from koopman_ros.evaluation import at, run_loop
from koopman_ros.model import Coordinates, linearised_model, load, Provenance, save
from koopman_ros.plants import ControlAffineSystem, Process, steady_state, two_state_reactor
from studies.general.systems import SADDLE

GAIN, TIME = 2.0, 20.0
PLANT = ControlAffineSystem(
    'lag', ('x',), ('K',), ('u',), ('K',), 's', lambda x: -0.05 * x,
    np.array([[0.05]]), np.zeros(1), np.zeros(1))


def signals_alone(names=('x',), low=-50.0, high=50.0, inputs=('u',)):
    """Return a model of which nothing is known but names, units and ranges."""
    states, forced = (Coordinates.spanning(of, ('K',) * len(of), np.full(len(of), low),
                                           np.full(len(of), high)) for of in (names, inputs))
    n, m = len(names), len(inputs)
    return linearised_model(np.zeros((n, n)), np.zeros((n, m)), states, forced, 's',
                            Provenance('signals alone'))


def controller(model=None, *, lower=-1e3, upper=1e3, rate=np.inf, laws=('pi',), gain=GAIN,
               time=TIME, **others):
    model = model or signals_alone()
    return Controller(model, Tuning.for_model(model, **{
        'state_weight': np.ones(model.n_x), 'input_weight': np.ones(model.n_u),
        'limits': InputLimits(np.full(model.n_u, lower), np.full(model.n_u, upper),
                              np.full(model.n_u, rate)),
        'bumpless_transfer_time': 0.0, 'plugins': {'pi': PIParameters(gain, time)},
        'fallback_order': laws,
        'learned_model_margin': 1.0, 'linear_model_margin': 1.0, **others}))


def run(one, setpoint=10.0, seconds=200.0, u=0.0, events=()):
    return run_loop(one, Process(PLANT, 0, np.zeros(1), np.full(1, u)), [
        at(0.0, Initialisation(np.full(1, u))), at(0.0, SetpointRequest(0, np.array([setpoint]))),
        *events], duration=seconds)


def test_a_lagged_plant_follows_the_equation_of_the_pi_law():
    loop = run(controller(), seconds=300.0)
    assert set(loop.levels) == {'pi'}
    # x, u and the last error, sampled once a second
    decay = float(expm(np.array([[-0.05]]))[0, 0])
    x, u, error = 0.0, 0.0, 10.0
    # two samples have no interval yet
    for k, (found, command) in enumerate(zip(loop.states[:, 0], loop.commands[:, 0],
                                             strict=True)):
        assert found == pytest.approx(x, abs=1e-8)
        now = 10.0 - x
        u += GAIN * (now - error + now * (k > 1) / TIME)
        error = now
        assert command == pytest.approx(u, abs=1e-8)
        x = decay * x + (1.0 - decay) * u
    assert loop.states[-1, 0] == pytest.approx(10.0, abs=1e-3)


@pytest.mark.parametrize('limits', [{'lower': -4.0, 'upper': 4.0}, {'rate': 0.05}])
def test_nothing_winds_up_at_a_range_or_a_rate(limits):
    loop = run(controller(**limits), setpoint=10.0, seconds=900.0, events=[
        at(400.0, SetpointRequest(0, np.array([1.0])))])
    u, x = loop.commands[:, 0], loop.states[:, 0]
    if 'upper' in limits:
        assert np.all(u[100:400] == 4.0)
        # the first sample after it is asked for less is answered with less
        assert u[401] < 4.0 - 0.5 * GAIN
    assert np.max(np.abs(np.diff(u))) <= limits.get('rate', np.inf) + 1e-12
    assert np.min(x[400:]) > 0.0
    assert x[-1] == pytest.approx(1.0, abs=0.02)


def test_it_begins_where_another_law_ended():
    # the linear law has no model here and fails at once; 3 K were applied before
    loop = run(controller(laws=('linear', 'pi')), setpoint=0.0, u=3.0, seconds=100.0)
    assert set(loop.levels) == {'pi'}
    assert loop.commands[0, 0] == pytest.approx(3.0, abs=1e-9)
    assert abs(loop.states[-1, 0]) < 0.3


def test_it_takes_no_memory_of_another_law():
    loop = run(controller(), seconds=20.0).loop
    fresh, foreign = (
        loop.controller.step(loop.state._replace(law='mine', law_memory=memory), np.array([4.0]),
                             loop.state.time_ns + SECOND)[1]
        for memory in (None, np.array([100.0])))
    np.testing.assert_array_equal(foreign, fresh)


def test_without_a_gain_the_next_level_acts_with_a_reason():
    loop = run(controller(gain=0.0, laws=('pi',)), seconds=5.0)
    assert set(loop.levels) == {'hold'}
    assert loop.reports[-1].reason.cause.code is StatusCode.NO_PI_GAIN


def test_two_signals_move_two_inputs_each_its_own():
    model = signals_alone(('x', 'y', 'z'), inputs=('u', 'v'))
    one = controller(model, controlled=('x', 'z'), setpoint_ramp=np.full(2, np.inf),
                     gain=[2.0, 0.0, -3.0])
    state, _ = one.request_setpoint(one.initialise(State(), np.zeros(2)),
                                    np.array([10.0, 10.0]))
    for k in (1, 2):
        state, first, _ = one.step(state, np.zeros(3), k * SECOND)
    command = one.step(state, np.array([1.0, 5.0, 2.0]), 3 * SECOND)[1]
    assert command - first == pytest.approx([2.0 * (-1.0 + 9.0 / TIME),
                                             -3.0 * (-2.0 + 8.0 / TIME)])
    with pytest.raises(ValueError, match='2 inputs for the PI laws of x, y, z'):
        controller(model, gain=1.0)


def test_signals_alone_are_a_model_file(tmp_path):
    save(signals_alone(), tmp_path / 'signals.safetensors')
    loop = run(controller(load(tmp_path / 'signals.safetensors')), seconds=300.0)
    assert loop.states[-1, 0] == pytest.approx(10.0, abs=1e-3)


def test_the_reactor_is_held_at_its_saddle_at_several_setpoints():
    system = two_state_reactor(nominal_state=SADDLE)
    model = linearised_model(
        np.zeros((1, 1)), np.zeros((1, 1)),
        Coordinates.spanning(('temperature',), ('K',), np.array([320.0]), np.array([380.0])),
        Coordinates.spanning(('coolant_temperature',), ('K',), np.array([253.15]),
                             np.array([373.15])), 'min', Provenance('signals alone'))
    one = controller(model, lower=253.15, upper=373.15, rate=1.0, gain=8.0, time=120.0,
                     setpoint_ramp=np.array([0.05]))
    x0, u0 = steady_state(system, {'temperature': 350.0})
    rng = np.random.default_rng(0)
    loop = run_loop(one, Process(system, 0, x0, u0), [
        at(0.0, Initialisation(u0)), at(0.0, SetpointRequest(0, np.array([350.0]))),
        *(at(300.0 * k, SetpointRequest(0, np.array([rng.uniform(340.0, 360.0)])))
          for k in range(1, 5))], duration=1500.0, C=np.array([[0.0, 1.0]]), noise=np.array([0.1]))
    T = loop.states[:, 1]
    assert set(loop.levels) == {'pi'}
    assert np.max(np.abs(T - loop.setpoints[:, 0])[10:]) < 6.0
    assert np.ptp(T) > 10.0
