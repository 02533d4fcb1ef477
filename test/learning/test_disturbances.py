# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A reactor whose coolant is late and whose feed temperature is measured, from record to loop."""

from dataclasses import replace

import numpy as np
import pytest

from koopman_ros.control import Controller, State
from koopman_ros.evaluation import at, run_loop
from koopman_ros.learning import retrain
from koopman_ros.model import load
from koopman_ros.plants import equilibrium_input, one_state_reactor, Process, ReactorParameters
from koopman_ros.tuning import Tuning
from studies import late_reactor
from support.quick_retraining import quick_retraining


@pytest.fixture(scope='module')
def model(tmp_path_factory):
    """Learn from 100 minutes in which both temperatures step, and only the coolant is late."""
    task = late_reactor.task(tmp_path_factory.mktemp('learned'))
    with quick_retraining(4, degrees=(1, 3, 4)):
        retrained = retrain(task, record=late_reactor.record())
    assert retrained.reasons == ()
    assert retrained.free_runs['record'].fit[0] > 99.0
    return load(retrained.model_file)


def test_dead_time_and_effect_are_found(model):
    assert model.dead_time.tolist() == pytest.approx([late_reactor.RECORD_LATE], abs=2.0)
    assert (model.inputs.names, model.disturbances.names) == (
        late_reactor.INPUTS[:1], late_reactor.INPUTS[1:])
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
        run = run_loop(
            loop, Process(replace(system, nominal_state=x, nominal_input=u), 0, x, u),
            [at(20.0, lambda now: replace(now, plant=replace(now.plant, system=warm)))],
            duration=200.0, state=loop.initialise(State(), u),
            disturbances=lambda seconds, feed=feed: np.array([feed if seconds >= 20 else 350.0]))
        assert set(run.levels) == {'sdre'}
        peaks[feed] = np.max(np.abs(run.states - x))
        assert abs(run.states[-1] - x) < 0.02
    assert peaks[355.0] < peaks[350.0] / 3.0
