# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A reactor whose coolant is late and whose feed temperature is measured, from record to loop."""

from dataclasses import replace

import numpy as np
import pytest

from koopman_ros.control import Controller, State
from koopman_ros.core.message_fields import place
from koopman_ros.evaluation import at, simulate
from koopman_ros.learning import retrain, TrainingTask
from koopman_ros.model import load
from koopman_ros.plants import (
    equilibrium_input,
    one_state_reactor,
    Process,
    random_steps,
    RandomStepDesign,
    ReactorParameters,
)
from koopman_ros.records import read, RecordedInput, RecordedState
from koopman_ros.tuning import Tuning
from studies.shipped_models import reactor_with_feed
from support.quick_retraining import quick_retraining

PERIOD, LATE = 5.0, 25.0  # s
NOISE, FEED_NOISE = 0.02, 0.05  # K
INPUTS = ('coolant_temperature', 'feed_temperature')


@pytest.fixture(scope='module')
def model(tmp_path_factory):
    """Learn from two hours in which both temperatures step, and only the coolant is late."""
    episode = random_steps(reactor_with_feed(), RandomStepDesign(
        input_lower=[282.0, 343.0], input_upper=[300.0, 357.0], state_lower=305.0,
        state_upper=327.0, hold_time=(0.5, 3.0), sample_period=PERIOD / 60.0), 100.0, 3)
    count, late, rng = len(episode.u), round(LATE / PERIOD), np.random.default_rng(0)
    coolant, feed = episode.u.T
    record = read({
        'time [s]': PERIOD * np.arange(count - late),
        'temperature [K]': (episode.x[:count, 0] + NOISE * rng.standard_normal(count))[:-late],
        # given so much before it acted
        'coolant_temperature [K]': coolant[late:],
        'feed_temperature [K]': (feed + FEED_NOISE * rng.standard_normal(count))[:-late],
    }, 'temperature', INPUTS)
    task = TrainingTask(
        (), str(tmp_path_factory.mktemp('learned') / 'feed.safetensors'), '',
        (RecordedState('temperature', 'K', place('t', 'temperature', 'K')),),
        tuple(RecordedInput(name, 'K', place(name, name, 'K')) for name in INPUTS),
        disturbances=INPUTS[1:], model_class='polynomial')
    with quick_retraining(16, degrees=(1, 3, 4)):
        retrained = retrain(task, record=record)
    assert retrained.reasons == ()
    assert retrained.free_runs['record'].fit[0] > 99.0
    return load(retrained.model_file)


def test_dead_time_and_effect_are_found(model):
    assert model.dead_time.tolist() == pytest.approx([LATE], abs=2.0)
    assert (model.inputs.names, model.disturbances.names) == (INPUTS[:1], INPUTS[1:])
    # q/V, in 1/s
    assert model.E * model.states.scale / model.disturbances.scale == pytest.approx(
        1.0 / 60.0, rel=0.01)


def test_a_measured_step_of_the_feed_peaks_at_a_third_of_an_unmeasured_one(model):
    system, x = one_state_reactor(), model.states.center
    warm = one_state_reactor(replace(ReactorParameters(), feed_temperature=355.0), x)
    u, prompt = equilibrium_input(system, x), replace(model, dead_time=np.zeros(1))
    loop = Controller(prompt, Tuning.for_model(prompt, observer_bandwidth=0.1))
    peaks = {}
    for feed in (355.0, 350.0):
        run = simulate(
            loop, Process(replace(system, nominal_state=x, nominal_input=u), 0, x, u),
            [at(20.0, lambda now: replace(now, plant=replace(now.plant, system=warm)))],
            duration=200.0, state=loop.initialise(State(), u),
            disturbances=lambda seconds, feed=feed: np.array([feed if seconds >= 20 else 350.0]))
        assert set(run.levels) == {'sdre'}
        peaks[feed] = np.max(np.abs(run.states - x))
        assert abs(run.states[-1] - x) < 0.02
    assert peaks[355.0] < peaks[350.0] / 3.0
