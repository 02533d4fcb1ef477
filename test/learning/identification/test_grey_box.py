# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Constants of plants whose equations are known, from records of plants with other constants."""

from dataclasses import dataclass, fields
import warnings

import numpy as np
import pytest
from scipy.special import chdtri

from koopman_ros.core.datasets import Episode, PlantDescription
from koopman_ros.core.integration import runge_kutta_step
from koopman_ros.learning.identification import estimate_parameters, EstimateStatus, Stopped
from koopman_ros.learning.identification.equations import Equations
from koopman_ros.plants import (
    constant,
    Constants,
    constants_of,
    ControlAffineSystem,
    estimated_parameters_of,
    random_steps,
    RandomStepDesign,
)
from koopman_ros.plants.library.reactor import FedReactor, TwoStateReactor
from koopman_ros.plants.library.two_tanks import TwoTanks


@dataclass(frozen=True)
class Vessel(Constants):
    """A level with inflow and leak, dx/dt = gain strength u - leak x."""

    gain: float = constant(1.0, 'm/(V s)', 0.0, 10.0, 'of the pump', estimated=(0.5, 2.0))
    strength: float = constant(1.0, '1', 0.1, 10.0, 'of the mains')
    leak: float = constant(0.3, '1/s', 0.0, 10.0, 'through the bottom', estimated=(0.05, 5.0))

    def system(self):
        return ControlAffineSystem(
            'vessel', ('level',), ('m',), ('pump',), ('V',), 's', lambda x: -self.leak * x,
            np.array([[self.gain * self.strength]]), np.zeros(1), np.zeros(1),
            drift_jacobian=lambda x: np.full((*x.shape, 1), -self.leak))


TRUE = Vessel(gain=1.2, leak=0.4)


def description(states, inputs, *, state_units=('m',), input_units=('V',)):
    """Return a plant whose steady state and B are not known."""
    return PlantDescription('recorded', states, state_units, inputs, input_units, 's',
                            np.full(len(states), np.nan), np.full(len(inputs), np.nan), None)


VESSEL = description(('level',), ('pump',))


def vessel(seed, samples=170, noise=0.02, disturbed=0.0):
    """Record it each half second under steps of random height and length."""
    rng = np.random.default_rng(seed)
    period, x, u, push = 0.5, 0.0, 0.0, 0.0
    decay = np.exp(-TRUE.leak * period)
    levels, inputs = np.empty((samples, 1)), np.empty((samples, 1))
    for k in range(samples):
        if rng.uniform() < 0.1:
            u = rng.uniform(-1.0, 1.0)
        levels[k], inputs[k] = x + noise * rng.standard_normal(), u
        push = 0.8 * push + disturbed * rng.standard_normal()
        # exactly
        x = decay * x + (1.0 - decay) / TRUE.leak * TRUE.gain * u + push
    time = period * np.arange(samples)
    return Episode(time, levels, time, inputs)


def errors(found, truth):
    """Return how many standard errors the estimates are off, by name."""
    shown = {one.name: one.default for one in constants_of(type(truth))}
    for field in fields(truth):
        # in SI, as the estimates are
        own = getattr(truth, field.name)
        shown[field.name] *= own / field.default
    assert all(one.standing is EstimateStatus.ESTIMATED for one in found.constants)
    return {one.name: (one.value - shown[one.name]) / one.standard_error
            for one in found.constants}


def test_standard_errors_are_those_of_many_records():
    z = np.array([list(errors(estimate_parameters(VESSEL, [vessel(seed)], Vessel), TRUE).values())
                  for seed in range(4)])
    assert np.max(np.abs(z)) < 3.5
    # the estimates of a record are correlated, so that there are as many squares as records
    low, high = chdtri(len(z), [1.0 - 1e-3, 1e-3])
    assert np.all((low < np.sum(z ** 2, axis=0)) & (np.sum(z ** 2, axis=0) < high))


def test_of_a_disturbed_plant_a_filter_is_found_too():
    found = estimate_parameters(VESSEL, [vessel(3, 300, disturbed=0.03)], Vessel)
    assert found.method == 'innovations form'
    assert np.max(np.abs([one.value / getattr(TRUE, one.name) - 1.0
                          for one in found.constants])) < 0.1
    assert estimate_parameters(VESSEL, [vessel(3)], Vessel).method == 'output error'


def test_two_tanks_all_of_which_is_measured():
    truth = TwoTanks(orifice_1=0.2e-4, orifice_2=0.16e-4, pump_gain=3e-6)
    system = truth.system()
    plant = description(system.state_names[::-1], system.input_names[::-1],
                        state_units=('m', 'm'), input_units=('V', 'V'))
    design = RandomStepDesign([3.0, 0.0], [9.0, 4.0], 0.4 * system.nominal_state,
                              1.8 * system.nominal_state, (15.0, 45.0), 4.0, rtol=1e-9)
    run = random_steps(system, design, 800.0, 0)
    noisy = run.x + 1e-3 * np.random.default_rng(0).standard_normal(run.x.shape)
    time = 4.0 * np.arange(len(noisy))
    # in an order of the record's own
    found = estimate_parameters(plant, [Episode(time, noisy[:, ::-1], time[:-1], run.u[:, ::-1])],
                                TwoTanks)
    off = errors(found, truth)
    assert set(off) == {'orifice_1', 'orifice_2', 'pump_gain'}
    assert np.max(np.abs(list(off.values()))) < 3.0
    assert max(one.standard_error / one.value for one in found.constants) < 0.01
    assert found.hidden == 0
    assert found.drift.box.states.names == ('level_2', 'level_1')
    x, u = np.array([0.12, 0.15]), np.array([2.0, 6.0])
    true_rate = system.derivative(x[::-1], u[::-1])[::-1]
    assert found.drift.rate(x, u) == pytest.approx(true_rate, abs=3e-5)
    assert found.drift.input_matrix == pytest.approx(system.B[::-1, ::-1], rel=0.02)
    assert found.noise == pytest.approx([1e-3, 1e-3], rel=0.3)


def saddle(truth, seed, minutes=16.0, period=3.0):
    """Record temperatures, in K, of the reactor that a PI law holds at its saddle."""
    system = truth.system(np.array([0.5, 350.0]))
    rng = np.random.default_rng(seed)
    x, target, wanted, left = np.array([0.5, 350.0]), 350.0, 350.0, 0
    integral, samples = 300.0, int(60.0 * minutes / period)
    T, Tc = np.empty((samples, 1)), np.empty((samples, 1))
    for k in range(samples):
        if not left:
            wanted, left = rng.uniform(341.0, 359.0), int(rng.integers(10, 30))
        left -= 1
        target += np.clip(wanted - target, -0.1 * period, 0.1 * period)
        T[k] = x[1] + 0.1 * rng.standard_normal()
        integral += 8.0 * (target - T[k, 0]) * period / 120.0
        Tc[k] = u = integral + 8.0 * (target - T[k])
        for _ in range(4):
            x = runge_kutta_step(lambda x, u=u: system.derivative(x, u), x, period / 240.0)
    time = period * np.arange(samples)
    return Episode(time, T, time, Tc)


def test_reactor_at_its_saddle_from_its_temperature_alone():
    truth = TwoStateReactor(heat_transfer_coefficient=4.6e4, reaction_enthalpy=-4.8e4)
    plant = description(('temperature',), ('coolant_temperature',), state_units=('K',),
                        input_units=('K',))
    said = []
    found = estimate_parameters(
        plant, [saddle(truth, 0)], TwoStateReactor,
        {'heat_transfer_coefficient': None, 'reaction_enthalpy': (-7e4, -3e4)},
        watch=lambda done, total, text: bool(said.append((done, total, text))))
    assert np.max(np.abs(list(errors(found, truth).values()))) < 3.0
    assert max(one.standard_error / abs(one.value) for one in found.constants) < 0.01
    assert said[0] == (0, 3, '2 constants of TwoStateReactor')
    # what is not measured has its own name and unit, and its own values
    assert found.hidden == 1
    assert found.drift.box.states.names == ('temperature', 'concentration')
    assert found.drift.box.states.units == ('K', 'mol/L')
    assert 0.3 < found.drift.box.states.lower[1] < found.drift.box.states.upper[1] < 0.7
    assert found.drift.form == 'equations of TwoStateReactor'
    x, u = np.array([350.0, 0.5]), np.array([300.0])
    own = truth.system(np.array([0.5, 350.0]))
    # a minute has 60 s
    assert 60.0 * found.drift.rate(x, u) == pytest.approx(
        own.derivative(x[::-1], u)[::-1], abs=1.0)
    # foreseen but for the noise of the sensor and what a filter makes of it
    assert 0.08 < found.scores[0].rmse[0] < 0.16
    # roll-outs grow by no more than can be judged
    assert max(part.time[-1] - part.time[0] for part in found.held_out) < 60.0


def test_an_estimate_at_the_end_of_its_range_is_reported():
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        found = estimate_parameters(VESSEL, [vessel(0)], Vessel,
                                    {'gain': (0.5, 1.1), 'leak': None})
    gain, leak = found.constants
    assert gain.standing is EstimateStatus.AT_UPPER_END
    assert gain.value == pytest.approx(1.1, rel=1e-3)
    assert np.isnan(gain.standard_error)
    assert 'upper end of its range' in str(gain)
    assert leak.standing is EstimateStatus.ESTIMATED


def test_indistinguishable_constants_are_reported():
    found = estimate_parameters(VESSEL, [vessel(0)], Vessel,
                                {'gain': None, 'strength': (0.5, 2.0), 'leak': None})
    gain, strength, leak = found.constants
    assert gain.standing is strength.standing is EstimateStatus.NOT_IDENTIFIABLE
    assert gain.value * strength.value == pytest.approx(1.2, rel=0.02)
    assert abs(leak.value - 0.4) < 3.0 * leak.standard_error
    assert 'its value, or that of' in str(gain)


def test_derivatives_by_constants_and_states_against_those_by_hand():
    episode = vessel(0)
    model = Equations.of(Vessel, estimated_parameters_of(Vessel, {}), VESSEL, episode.x, episode.u)
    theta = np.array([0.3, -0.4])
    at = model.at(theta)
    box = at.box
    xi, v = np.array([[0.4], [-0.2]]), np.array([[0.5], [0.1]])
    rate, slopes = at.rates(xi, v, np.zeros((2, 1, 3)))
    gain = 1.25 + 0.75 * np.sin(0.3)
    # from 0.05 to 5 it goes in powers
    leak = 0.5 * 10.0 ** np.sin(-0.4)
    x, u = box.states.to_physical(xi), box.inputs.to_physical(v)
    scale = box.states.scale[0]
    assert rate == pytest.approx((gain * u - leak * x) / scale, rel=1e-12)
    assert slopes[:, :, 0] == pytest.approx(0.75 * np.cos(0.3) * u / scale, rel=1e-8)
    assert slopes[:, :, 1] == pytest.approx(
        -leak * np.log(10.0) * np.cos(-0.4) * x / scale, rel=1e-8)
    assert not slopes[:, :, 2].any()
    assert at.scaled_slope(xi, v) == pytest.approx(np.full((2, 1, 1), -leak), rel=1e-12)
    assert not at.varying_input_matrix


@pytest.mark.parametrize('turned', [False, True])
def test_where_inputs_act_by_the_state_and_signals_have_another_order_and_time(turned):
    system = FedReactor().system()
    order = slice(None, None, -1 if turned else None)
    plant = description(system.state_names[order], system.input_names[order],
                        state_units=system.state_units[order],
                        input_units=system.input_units[order])
    rng = np.random.default_rng(0)
    x, u = ((nominal * rng.uniform(0.9, 1.1, (20, 2)))[:, order]
            for nominal in (system.nominal_state, system.nominal_input))
    model = Equations.of(FedReactor, estimated_parameters_of(FedReactor, {}), plant, x, u)
    # a minute has 60 s
    assert 60.0 * model.rate(x, u) == pytest.approx(
        system.derivative(x[:, order], u[:, order])[:, order], rel=1e-9)
    xi, v = model.box.states.to_deviation(x), model.box.inputs.to_deviation(u)
    assert model.varying_input_matrix
    forced = (model.scaled_input_matrix(xi) @ v[..., None])[..., 0]
    assert model.scaled_rate(xi, 0.0 * v) + forced == pytest.approx(model.scaled_rate(xi, v))
    slope = np.stack([(model.scaled_rate(xi + h, v) - model.scaled_rate(xi - h, v)) / 2e-5
                      for h in 1e-5 * np.eye(2)], axis=-1)
    assert model.scaled_slope(xi, v) == pytest.approx(slope, abs=1e-8)


@dataclass(frozen=True)
class Silent(Constants):
    """A plant whose class says of no constant that it is estimated."""

    leak: float = constant(0.3, '1/s', 0.0, 10.0, 'through the bottom')

    def system(self):
        return Vessel(leak=self.leak).system()


@pytest.mark.parametrize(('plant', 'equations', 'ranges', 'words'), [
    (VESSEL, Silent, {}, 'marks no constants as estimated: name some of '
     'leak'),
    (VESSEL, Vessel, {'height': None},
     'height is not a constant of Vessel: choose from gain, strength'),
    (VESSEL, Vessel, {'leak': (0.5, 0.1)},
     r'the range of leak is \[0.5, 0.1\] 1/s, must increase and lie in \[0, 10\] 1/s'),
    (VESSEL, Vessel, {'leak': (0.5, 11.0)}, r'lie in \[0, 10\] 1/s'),
    (description(('depth',), ('pump',)), Vessel, {},
     r'the record has the states depth \[m\]'),
    (description(('level',), ('tap',)), Vessel, {},
     r'the record has the inputs tap \[V\]')])
def test_what_does_not_fit_is_rejected(plant, equations, ranges, words):
    with pytest.raises(ValueError, match=words):
        estimate_parameters(plant, [vessel(0)], equations, ranges)


def test_training_can_be_cancelled_and_rejects_a_short_record():
    with pytest.raises(Stopped):
        estimate_parameters(VESSEL, [vessel(0)], Vessel, watch=lambda *_: True)
    with pytest.raises(ValueError, match='record at least 160'):
        estimate_parameters(VESSEL, [vessel(0, 100)], Vessel)
