# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Two tanks behind slow pumps, from experiment to controller: the pumps are measured."""

import json
from pathlib import Path

import numpy as np
import pytest
from sensor_msgs.msg import JointState

from koopman_ros.bags import summary
from koopman_ros.lifting import load
from koopman_ros.testing import Harness
from support.nodes import value
from support.tanks import LEVELS, linear, PUMPS, TANKS

LAG = 10.0  # s
NOISE = 2e-4  # m
TRAINER = {
    'system': 'two_tanks', 'experiment_length': 500.0, 'experiment_shortest_hold': 15.0,
    'experiment_longest_hold': 45.0, 'model_coordinates': 3, 'training_starts': 1, **{
        f'{name}.{key}': numbers[i] for i, name in enumerate(PUMPS) for key, numbers in (
            ('experiment_min', (4.0, 0.5)), ('experiment_max', (8.5, 3.5)), ('safe', (6.0, 2.0)))},
    **{f'{name}.experiment_{end}': bound for name in LEVELS
       for end, bound in (('min', 0.02), ('max', 0.5))}}
PLANT = {'system': 'two_tanks', 'sample_period': 1.0, 'lockstep': True, 'speed': 0.0,
         **{f'{name}.lag': LAG for name in PUMPS}, **{f'{name}.noise': NOISE for name in LEVELS}}


def test_lift_is_learned_from_a_record_and_controls(ros: Harness, tmp_path: Path) -> None:
    bag, new = tmp_path / 'run.mcap', tmp_path / 'new.safetensors'
    # one whose pumps are half as strong again
    given = {**TRAINER, 'model': linear(tmp_path, 1.5), 'model_output': new}
    recorder = ros.start('trainer', {**given, 'output': bag})
    plant = ros.start('plant', {**PLANT, 'lockstep_subscribers': 2})
    ros.meet('plant')
    assert ros.set_bool('trainer/experiment', True).success
    ros.wait_for_status('trainer: experiment', lambda s: s.message.startswith('finished'))
    assert recorder.stop() == plant.stop() == 0
    assert summary(bag).counts['/pump_1'] > 500

    trainer = ros.start('trainer', {**given, 'task': 'train', 'bags': [bag]})
    assert trainer.wait(400.0) == 0, trainer.output()
    figures = json.loads(new.with_suffix('.json').read_text())
    assert figures['accepted']
    gains = [[figures['input_gain'][x][u] for u in PUMPS] for x in LEVELS]
    assert np.array(gains) == pytest.approx(TANKS.B, abs=0.02 * TANKS.B[0, 0])
    assert load(new).n_z == 3

    levels = [ros.listen(JointState, name) for name in LEVELS]
    ros.start('controller', {'system': 'two_tanks', 'model': new})
    goals = 1.1 * TANKS.nominal_state
    for name, goal in zip(LEVELS, goals.tolist(), strict=True):
        ros.speak(JointState, f'{name}/setpoint', to='controller').publish(
            JointState(name=[name], position=[goal]))
    ros.start('plant', {**PLANT, 'speed': 200.0, 'lockstep_subscribers': 2})
    ros.wait_until(lambda: len(levels[0]) > 400)
    for heard, goal in zip(levels, goals.tolist(), strict=True):
        # the noise alone moves them by 0.3 %
        found = [message.position[0] for message in heard[200:400]]
        assert found == pytest.approx([goal] * 200, rel=0.03)
        assert np.mean(found) == pytest.approx(goal, rel=0.003)
    status = ros.wait_for_status('controller: control', lambda s: s.message == 'automatic')
    assert value(status, 'active law') == 'learned law'
