# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A training whose input follows its command with a lag."""

from dataclasses import replace

import numpy as np
import pytest

from koopman_ros.core.datasets import Episode, PlantDescription
from koopman_ros.learning import retrain, TrainingTask
from koopman_ros.model import load
from koopman_ros.records import ImportReport, Record
from support.quick_retraining import page_of, quick_retraining
from support.recorded_runs import INPUTS, STATES

LAG, TIME_CONSTANT, GAIN = 10.0, 30.0, 1.5


def record(count=600):
    """Return a run of a linear plant behind a lag, exact for each second."""
    rng = np.random.default_rng(0)
    u = 288.0 + np.repeat(rng.uniform(-5.0, 5.0, count // 20), 20)
    kept, stays = np.exp(-1.0 / TIME_CONSTANT), np.exp(-1.0 / LAG)
    mixed = LAG / (TIME_CONSTANT - LAG) * (kept - stays)
    x, v, path = 315.0, u[0], []
    for value in u:
        path.append(x)
        rest = 315.0 + GAIN * (value - 288.0)
        x = rest + kept * (x - rest) + GAIN * mixed * (v - value)
        v = value + stays * (v - value)
    time = np.arange(float(count))
    plant = PlantDescription('jacket', ('temperature',), ('K',), ('coolant_temperature',), ('K',),
                             's', np.full(1, np.nan), np.full(1, np.nan), None)
    noisy = np.array(path)[:, None] + 0.02 * rng.standard_normal((count, 1))
    return Record(plant, (Episode(time, noisy, time, u[:, None]),), ImportReport(), ('run',))


def task(output, **others):
    return TrainingTask((), str(output), '', STATES, INPUTS, plant='jacket',
                        **{'model_class': 'linear', 'lag': {'coolant_temperature': LAG},
                           'dead_time': {'coolant_temperature': 0.0}, **others})


def test_the_applied_input_is_a_state_of_the_model(tmp_path):
    with quick_retraining(4, degrees=(1,)):
        retrained = retrain(task(tmp_path / 'new.safetensors'), record=record())
        assert retrained.accepted, retrained.reasons
        model = load(retrained.model_file)
        assert model.states.names == ('temperature', 'applied_coolant_temperature')
        assert model.lag == pytest.approx([LAG], rel=1e-6)
        assert f'lag of coolant_temperature: {LAG:g} s' in str(model)
        slope = model.drift_jacobian(np.zeros(2))
        assert slope[0, 0] == pytest.approx(-1.0 / TIME_CONSTANT, rel=0.1)
        assert slope[0, 1] * model.states.scale[0] / model.states.scale[1] == pytest.approx(
            GAIN / TIME_CONSTANT, rel=0.1)
        assert retrained.summary()['lag'] == {'coolant_temperature': pytest.approx(LAG)}
        assert f'lag of coolant_temperature: {LAG:.4g} s' in page_of(retrained)
        assert retrained.free_runs['record'].fit[0] > 95.0
        # the next one is compared with it
        again = retrain(replace(task(tmp_path / 'next.safetensors'),
                                model=retrained.model_file), record=record())
        assert again.present is not None
        assert again.decision.current_rmse is not None


@pytest.mark.parametrize(('lag', 'words'), [
    ({'pump': 3.0}, 'lag names pump'), ({'coolant_temperature': 0.2}, 'half of a sample interval'),
    ({'coolant_temperature': 200.0}, 'record longer')])
def test_a_lag_that_does_not_fit_is_rejected(tmp_path, lag, words):
    with pytest.raises(ValueError, match=words):
        retrain(task(tmp_path / 'new.safetensors', lag=lag), record=record())
