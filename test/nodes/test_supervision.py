# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What is said when a partner falls silent or asks for what cannot be."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
import shutil
import signal

from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np
from sensor_msgs.msg import Temperature

from koopman_ros.bags import summary
from koopman_ros.lifting import load, save
from koopman_ros.nodes import topics
from koopman_ros.nodes.shipped import model_path
from koopman_ros.testing import Harness
from support.messages import temperature


def test_controller_that_falls_silent_is_reported_by_the_plant(ros: Harness) -> None:
    ros.start('plant', {'speed': 20.0})
    command = ros.speak(Temperature, topics.COOLANT_SETPOINT, to='plant')
    command.publish(temperature(26.0))
    ros.wait_for_status('plant: simulation', lambda s: s.message == 'running')
    status = ros.wait_for_status(
        'plant: simulation', lambda s: s.level == DiagnosticStatus.WARN)
    assert 'no command arrives: the last one is held' in status.message
    command.publish(temperature(26.5))
    ros.wait_for_status('plant: simulation', lambda s: s.message == 'running')


def test_reset_of_a_finished_plant_is_refused(ros: Harness) -> None:
    ros.start('plant', {'speed': 0.0, 'duration': 5.0})
    ros.wait_for_status('plant: simulation', lambda s: s.message.startswith('finished'))
    response = ros.trigger('plant/reset')
    assert not response.success
    assert response.message == 'the duration is over: start the plant again'


def test_closed_terminal_completes_the_bag(ros: Harness, tmp_path: Path) -> None:
    trainer = ros.start('trainer', {'output': tmp_path / 'bag'})
    sender = ros.speak(Temperature, topics.TEMPERATURE, to='trainer')
    sender.publish(temperature(50.0))
    ros.wait_for_status('trainer: recording', lambda s: any(
        item.key == 'messages on /temperature' and item.value == '1' for item in s.values))
    assert trainer.stop(signal.SIGHUP) == 0
    content = summary(tmp_path / 'bag')
    assert content.complete
    assert content.counts['/temperature'] == 1


def test_impossible_topic_name_is_refused(ros: Harness, tmp_path: Path) -> None:
    ros.start('trainer', {'output': tmp_path / 'bag'})
    (result,) = ros.set_parameters('trainer', topics=['temperature', 'bad topic!'])
    assert not result.successful
    assert 'bad topic!' in result.reason


def test_model_that_cannot_track_the_setpoint_is_refused(ros: Harness, tmp_path: Path) -> None:
    path = tmp_path / 'model.safetensors'
    shutil.copy(model_path('reactor_nz3'), path)
    ros.start('controller', {'model': path})
    sensor = ros.speak(Temperature, topics.TEMPERATURE, to='controller')
    setpoint = ros.speak(Temperature, topics.SETPOINT, to='controller')
    setpoint.publish(temperature(36.0))
    commands = ros.listen(Temperature, topics.COOLANT_SETPOINT)
    ros.wait_until(lambda: sensor.publish(temperature(37.0, 1.0)) or commands)
    model = load(path)
    save(replace(model, states=replace(model.states, lower=np.array([315.0]))), path)
    response = ros.trigger('controller/reload_model')
    assert not response.success
    assert 'the old model is kept' in response.message
    assert 'is outside the trained range 41.85 degC' in response.message
