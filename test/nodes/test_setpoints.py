# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Set-points of two tanks: what flows out of the upper one enters the lower one."""

from collections.abc import Mapping
import math
from pathlib import Path
import re

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from sensor_msgs.msg import JointState

from koopman_ros.ros import topics
from koopman_ros.testing import Harness

LOW, HIGH = 0.05, 0.2  # m; with the upper level HIGH no pump keeps the lower one at LOW
LEVELS = ('level_1', 'level_2')
PAGE = (Path(__file__).parents[2] / 'docs' / 'how-to' / 'operate.md').read_text()


class Operator:
    """The controller of two tanks whose levels stay at LOW, and its operator."""

    def __init__(self, ros: Harness) -> None:
        self._ros, self._time = ros, 0
        ros.start('controller', {'system': 'two_tanks', 'stuck_sensor_timeout': 0.0,
                                 'measurement_timeout': 0.0})
        self.active = {name: ros.listen(JointState, f'{name}/active_setpoint',
                                        topics.LATCHED_QOS) for name in LEVELS}
        self._sensors = [ros.speak(JointState, name, to='controller') for name in LEVELS]
        self._single = {name: ros.speak(JointState, f'{name}/setpoint', to='controller')
                        for name in LEVELS}
        self._joint = ros.speak(JointState, 'setpoints', to='controller')
        self.measure()
        self.tracked(dict.fromkeys(LEVELS, LOW))

    def measure(self) -> None:
        self._time += 1
        for name, sensor in zip(LEVELS, self._sensors, strict=True):
            message = JointState(name=[name], position=[LOW])
            message.header.stamp.sec = self._time
            sensor.publish(message)

    def ask(self, **levels: float) -> None:
        publisher = self._single[next(iter(levels))] if len(levels) == 1 else self._joint
        publisher.publish(JointState(name=[*levels], position=[*levels.values()]))
        # in order: the request, then the measurement that is answered with it
        self._ros.meet('controller')
        self.measure()

    def tracked(self, levels: Mapping[str, float]) -> None:
        self._ros.wait_until(lambda: all(
            self.active[name] and math.isclose(self.active[name][-1].position[0], level)
            for name, level in levels.items()), lambda: f'{self.active}')

    def level(self, name: str) -> float:
        return float(self.active[name][-1].position[0])

    def rejected(self) -> None:
        self._ros.wait_for_status('controller: requests', lambda s: (
            s.level == DiagnosticStatus.WARN and 'cannot be held' in s.message))


def test_each_of_two_setpoints_is_judged_with_what_was_requested(ros: Harness) -> None:
    operator = Operator(ros)
    operator.ask(level_1=HIGH)
    operator.tracked({'level_1': HIGH})
    # the other one was not requested, so it has to make room
    ros.wait_until(lambda: operator.level('level_2') > LOW + 0.01)
    assert 'makes room' in ros.processes[0].output()
    room = operator.level('level_2')
    operator.ask(level_2=room + 0.02)
    operator.tracked({'level_1': HIGH, 'level_2': room + 0.02})
    # what was requested stays
    operator.ask(level_2=LOW)
    operator.rejected()
    operator.tracked({'level_1': HIGH, 'level_2': room + 0.02})


def test_both_are_set_in_one_message(ros: Harness) -> None:
    operator = Operator(ros)
    operator.ask(level_1=HIGH, level_2=0.22)
    operator.tracked({'level_1': HIGH, 'level_2': 0.22})
    # the lower one alone cannot go there
    operator.ask(level_2=0.07)
    operator.rejected()
    # as the page reads the answer
    (answers,) = re.findall(
        r'ros2 topic echo --once /diagnostics -f --filter "(.*)"', PAGE)
    heard = ros.listen(DiagnosticArray, '/diagnostics')
    ros.wait_until(lambda: any(eval(answers, {'m': message}) for message in heard))
    first = next(message for message in heard if eval(answers, {'m': message}))
    assert any('cannot be held' in status.message for status in first.status)
    operator.ask(level_1=0.06, level_2=0.07)
    operator.tracked({'level_1': 0.06, 'level_2': 0.07})
    ros.wait_for_status('controller: requests', lambda s: s.level == DiagnosticStatus.OK)
