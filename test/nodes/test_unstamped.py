# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Sensors without stamps that publish best effort, with the default parameters."""

from pathlib import Path

from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64

from koopman_ros.core.message_fields import MessageField
from koopman_ros.records import RecordedInput, RecordedState
from koopman_ros.testing import Harness
from support.bag_samples import loop_episodes

LEVELS = {'level_1': 0.1, 'level_2': 0.15}  # m
TYPES = {f'{name}.type': 'std_msgs/msg/Float64' for name in LEVELS}
STATES = [RecordedState(name, 'm', MessageField(f'/{name}', 'std_msgs/msg/Float64', 'data', 'm'))
          for name in LEVELS]
INPUTS = [RecordedInput(name, 'V', MessageField(
    f'/{name}_setpoint', 'sensor_msgs/msg/JointState', f'position[{name}]', 'V'))
    for name in ('pump_1', 'pump_2')]
SENSOR = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


def test_loop_of_two_sensors(ros: Harness, tmp_path: Path) -> None:
    given = {'system': 'two_tanks', **TYPES}
    controller = ros.start('controller', {**given, 'stuck_sensor_timeout': 0.0})
    trainer = ros.start('trainer', {**given, 'output': tmp_path / 'bag'})
    commands = ros.listen(JointState, 'pump_1_setpoint')
    sensors = {name: ros.node.create_publisher(Float64, name, SENSOR) for name in LEVELS}

    def measure() -> None:
        for name, level in LEVELS.items():
            sensors[name].publish(Float64(data=level))

    ros.node.create_timer(0.1, measure)
    ros.wait_until(lambda: len(commands) > 20)
    assert 'have no stamp' in controller.output()
    assert 'synchronisation_tolerance' in controller.output()
    for node in (controller, trainer):
        # a publisher may be discovered before the node that it belongs to, and is not named then
        ros.wait_until(lambda node=node: all(
            f'/{name}: subscribed best effort, as published by ' in node.output()
            for name in LEVELS), node.output)
    assert ros.set_bool('trainer/record', False).success
    (path,) = tmp_path.glob('bag*')
    episodes, _ = loop_episodes([path], STATES, INPUTS)
    assert sum(map(len, episodes)) > 10
