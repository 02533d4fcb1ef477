# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Retraining with two states and two inputs from a bag; the input as measured or as commanded."""

from dataclasses import asdict, replace
from functools import partial
import importlib
import json
import warnings

import numpy as np
import pytest

from koopman_ros.core.datasets import Episode, PlantDescription
from koopman_ros.core.message_fields import MessageField
from koopman_ros.core.units import NANOSECONDS as SECOND
from koopman_ros.execution.training import constant_lines, scalars
from koopman_ros.learning import drift_estimation, retrain, TrainingTask, write_report
from koopman_ros.learning.identification import identify, identify_unmeasured
from koopman_ros.learning.task import resolve_signals
from koopman_ros.model import Coordinates, linearised_model, load, Provenance, save
from koopman_ros.plants import Actuator, Process, random_steps, RandomStepDesign
from koopman_ros.plants.library.two_tanks import TwoTanks
from koopman_ros.records import BagWriter, message_definition, RecordedInput, RecordedState
from support.known_plants import methods
from support.quick_retraining import page_of, quick_retraining
from support.recorded_runs import NOISE, reactor

JOINTS, ARRAY = 'sensor_msgs/msg/JointState', 'std_msgs/msg/Float64MultiArray'
LEVEL_NOISE = 2e-4  # m
TANKS = TwoTanks().system()
RANGE = 0.5 * TANKS.nominal_state, 1.6 * TANKS.nominal_state
# not in the order of the model
STATES = tuple(RecordedState(name, 'm', MessageField('/tanks', JOINTS, f'position[{name}]', 'cm'))
               for name in ('level_2', 'level_1'))
INPUTS = tuple(RecordedInput(name, 'V', MessageField('/pumps', ARRAY, f'data[{k}]', 'mV'))
               for k, name in ((1, 'pump_2'), (0, 'pump_1')))
PROMPT = dict.fromkeys(TANKS.input_names, 0.0)  # dead times, in s


def write_tanks(path, seconds=500.0):
    """Write eight minutes of the tanks under random steps of both pumps, at 1 Hz."""
    serialize = importlib.import_module('rclpy.serialization').serialize_message
    joints = importlib.import_module('sensor_msgs.msg').JointState(name=list(TANKS.state_names))
    pumps = importlib.import_module('std_msgs.msg').Float64MultiArray()
    design = RandomStepDesign([3.0, 0.0], [9.0, 4.0], *RANGE, (15.0, 45.0), 1.0, rtol=1e-9)
    run = random_steps(TANKS, design, seconds, 0)
    x = run.x + LEVEL_NOISE * np.random.default_rng(0).standard_normal(run.x.shape)
    with BagWriter(path) as writer, warnings.catch_warnings():
        # The type support imports its generator, whose parser imports a deprecated module.
        warnings.simplefilter('ignore', DeprecationWarning)
        writer.add_topic('/tanks', message_definition(JOINTS))
        writer.add_topic('/pumps', message_definition(ARRAY))
        for k, u in enumerate(run.u, 1):
            joints.header.stamp.sec = k
            joints.position, pumps.data = (100.0 * x[k - 1]).tolist(), (1000.0 * u).tolist()
            writer.write('/tanks', serialize(joints), k * SECOND)
            writer.write('/pumps', serialize(pumps), k * SECOND)
    return path


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return write_tanks(tmp_path_factory.mktemp('bags') / 'run.mcap')


def present_model():
    """Return the linearisation of the tanks."""
    boxes = (Coordinates.spanning(TANKS.state_names, ('m', 'm'), *RANGE, TANKS.nominal_state),
             Coordinates.spanning(TANKS.input_names, ('V', 'V'), np.array([3.0, 0.0]),
                                  np.array([9.0, 4.0]), TANKS.nominal_input))
    return linearised_model(TANKS.drift_jacobian(TANKS.nominal_state), TANKS.B, *boxes, 's',
                            Provenance('two tanks'))


@pytest.fixture(scope='module')
def retrained(bag, tmp_path_factory):
    """Return what became of a linear model whose pumps are half as strong again."""
    folder = tmp_path_factory.mktemp('tanks')
    present = replace(present_model(), B=1.5 * present_model().B)
    save(present, folder / 'present.safetensors')
    with quick_retraining(8):
        return retrain(TrainingTask((str(bag),), str(folder / 'new.safetensors'),
                                    str(folder / 'present.safetensors'), STATES, INPUTS,
                                    coordinates=3, starts=1, model_class='identity lift',
                                    dead_time=PROMPT))


def test_lift_of_two_states_and_two_inputs_is_accepted(retrained):
    assert retrained.reasons == ()
    decision = retrained.decision
    assert decision.warnings == ()
    assert decision.law_check.loops == decision.law_check.arrived > 6
    # nothing but noise is left of the drift's error, in either state, and little of the lift's
    assert decision.drift_rmse == pytest.approx([LEVEL_NOISE] * 2, rel=0.1)
    assert np.all(decision.rmse < 2.0 * LEVEL_NOISE)
    assert np.all(decision.current_rmse > 10.0 * decision.rmse)
    assert retrained.account.used == 1000
    model = load(retrained.model_file)
    assert (model.states.names, model.inputs.names) == (TANKS.state_names, TANKS.input_names)
    rng = np.random.default_rng(1)
    x = TANKS.nominal_state * rng.uniform(0.8, 1.3, (50, 2))
    u = rng.uniform([4.0, 1.0], [8.0, 3.0], (50, 2))
    rate = model.states.scale * (model.drift(model.states.to_deviation(x))
                                 + model.inputs.to_deviation(u) @ model.B.T)
    true = TANKS.derivative(x, u)
    assert np.max(np.abs(rate - true)) < 0.05 * np.max(np.abs(true))


def test_summary_and_report_name_the_signals(retrained):
    figures = retrained.summary()
    gains = [[figures['input_gain'][x][u] for u in TANKS.input_names] for x in TANKS.state_names]
    assert np.array(gains) == pytest.approx(TANKS.B, abs=0.01 * TANKS.B[0, 0])
    assert figures['units'] == {'level_1': 'm', 'level_2': 'm', 'pump_1': 'V', 'pump_2': 'V'}
    assert figures['noise'] == dict.fromkeys(
        TANKS.state_names, pytest.approx(LEVEL_NOISE, rel=0.1))
    assert list(figures['heldout_error'].values()) == retrained.decision.rmse.tolist()
    assert len(figures['coverage']) == 6
    # some twenty steps of both at once
    assert 0.12 < figures['coverage']['pump_1, pump_2'] < 0.25
    metrics = load(retrained.model_file).provenance.metrics
    assert metrics['noise_level_2'] == figures['noise']['level_2']
    page, *pictures = write_report(retrained)[1:]
    text = page.read_text()
    assert '| prediction by | error of level_1 [m] | error of level_2 [m] |' in text
    assert [picture.name for picture in pictures] == ['new.png', 'new.free_run.png']
    for picture in pictures:
        assert picture.read_bytes().startswith(b'\x89PNG')
        assert f'({picture.name})' in text


# An actuator with a lag.


@pytest.fixture(scope='module')
def lagging():
    """Return twenty minutes of the reactor behind a lag of 10 s: x, input and command, at 1 s."""
    system, rng = reactor(), np.random.default_rng(0)
    process = Process(system, 0, system.nominal_state, system.nominal_input, Actuator(lag=10.0))
    rows, left, level = [], 0, 0.0
    for k in range(1200):
        process = process.until(k * SECOND)
        if left == 0:
            left, level = int(rng.integers(30, 120)), rng.uniform(281.33, 300.55)
        # held in the range in which the reactor is safe
        level = 281.33 if process.x[0] > 324.0 else 300.55 if process.x[0] < 307.0 else level
        rows.append((process.x[0], process.u[0], level))
        process, left = process.commanded(np.array([level]), k * SECOND), left - 1
    return system, np.array(rows)


@pytest.mark.parametrize('measured', [True, False])
def test_a_measured_input_replaces_the_command(lagging, measured):
    system, rows = lagging
    x = rows[:, :1] + NOISE * np.random.default_rng(1).standard_normal((len(rows), 1))
    minutes = np.arange(len(rows)) / 60.0
    episode = Episode(minutes, x, minutes, rows[:, 1:2] if measured else rows[:, 2:],
                      (True,) if measured else ())
    plant = PlantDescription('reactor', ('temperature',), ('K',), ('coolant',), ('K',), 'min',
                             system.nominal_state, system.nominal_input, None)
    found = identify(plant, [episode], degrees=(1, 3), methods=methods(40)).drift
    states, u = np.linspace(308.0, 320.0, 25)[:, None], np.full((25, 1), 288.0)
    drift = np.max(np.abs(found.rate(states, u) - system.derivative(states, u)))
    gain = found.input_matrix[0, 0] / system.B[0, 0] - 1.0
    if measured:
        # of rates up to 15 K/min
        assert abs(gain) < 0.01
        assert drift < 0.3
    else:
        # to the command the plant seems sluggish
        assert -0.4 < gain < -0.2
        assert drift > 3.0


def test_a_level_that_is_in_no_bag_is_learned_with_the_other(bag, tmp_path, monkeypatch):
    """Tank 1 flows into tank 2, so that what it holds shows there."""
    monkeypatch.setattr(drift_estimation, 'identify_unmeasured', partial(
        identify_unmeasured, highest_degree=2))
    with quick_retraining(4):
        found = retrain(TrainingTask((str(bag),), str(tmp_path / 'new.safetensors'), '',
                                     STATES[:1], INPUTS, model_class='polynomial',
                                     unmeasured_states=1, dead_time=PROMPT))
    assert found.reasons == ()
    assert not any('hidden_1' in warning for warning in found.decision.warnings)
    model = load(found.model_file)
    assert model.states.names == ('level_2', 'hidden_1')
    assert model.states.units == ('m', '1')
    modes = np.linalg.eigvals(model.drift_jacobian(np.zeros(2))).real
    truth = np.linalg.eigvals(TANKS.drift_jacobian(TANKS.nominal_state)).real
    assert np.sort(modes) == pytest.approx(np.sort(truth), rel=0.25)
    assert found.decision.rmse[0] < 2.0 * LEVEL_NOISE
    page = page_of(found)
    assert 'Errors of simulations, at samples left out of the fit' in page
    assert ', 1 state not measured' in page


@pytest.fixture(scope='module')
def by_equations(bag, tmp_path_factory):
    """Return what the equations make of eight minutes of the lower level alone."""
    folder = tmp_path_factory.mktemp('physical_model')
    task = TrainingTask((str(bag),), str(folder / 'new.safetensors'), '', STATES[:1], INPUTS,
                        model_class='polynomial', physical_model='two_tanks',
                        constants={'orifice_1': (1e-6, 5e-5), 'pump_gain': None},
                        dead_time=PROMPT)
    # as the process that retrains is given it
    with quick_retraining(4):
        return retrain(TrainingTask.of(json.loads(json.dumps(asdict(task)))))


def test_a_level_that_is_in_no_bag_has_its_own_name_by_equations(by_equations):
    found = by_equations.found
    model = load(by_equations.model_file)
    assert (model.states.names, model.states.units) == (('level_2', 'level_1'), ('m', 'm'))
    assert model.provenance.method == 'output error, equations of TwoTanks'
    x, u = TANKS.nominal_state, TANKS.nominal_input
    assert found.drift.rate(x[::-1], u[::-1]) == pytest.approx([0.0, 0.0], abs=2e-5)
    figures, own = by_equations.summary(), TwoTanks()
    assert set(figures['constants']) == {'orifice_1', 'pump_gain'}
    for name, one in figures['constants'].items():
        assert one['standing'] == 'estimated'
        assert abs(one['value'] - getattr(own, name)) < 3.5 * one['standard_error']
        assert scalars(figures)[f'constant {name}'] == one['text'] == constant_lines(figures)[name]
    page = page_of(by_equations)
    for words in ('| constant | unit | estimate | standard error |', '| pump_gain | m^3/(s V) |',
                  'of the predicted next measurement'):
        assert words in page


@pytest.mark.parametrize(('given', 'words'), [
    ({'physical_model': 'two_tanks', 'unmeasured_states': 1}, 'set unmeasured_states to 0'),
    ({'physical_model': 'two_tanks', 'input_gain': {'level_2': {'pump_2': 1.0}}}, 'no input_gain'),
    ({'constants': {'orifice_1': None}},
     'constants name orifice_1, but no physical_model')])
def test_a_task_whose_equations_do_not_fit_is_rejected(given, words):
    with pytest.raises(ValueError, match=words):
        resolve_signals(replace(TrainingTask((), '', '', STATES, INPUTS), **given), None)


def test_of_a_present_lift_of_all_states_equations_need_some_in_the_bags():
    present = present_model()
    task = TrainingTask((), '', 'present', STATES[:1], INPUTS)
    plant, states, inputs = resolve_signals(replace(task, physical_model='two_tanks'), present)
    assert plant.state_names == tuple(state.name for state in states) == ('level_2',)
    assert plant.input_names == tuple(one.name for one in inputs) == TANKS.input_names
    with pytest.raises(ValueError, match=r'has the states level_1 \[m\], level_2 \[m\]'):
        resolve_signals(task, present)
