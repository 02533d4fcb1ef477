# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Plant and controller as two processes: the closed loop, its order of start, and its names."""

from __future__ import annotations

from collections.abc import Mapping

import pytest
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Temperature

from koopman_ros.ros import topics
from koopman_ros.testing import Harness
from support.messages import seconds, temperature

LOCKSTEP = {'lockstep': True, 'speed': 0.0}


class Loop:
    """
    What an operator hears of a loop, and the set-point that he turns.

    :param ros: where plant and controller run.
    :param prefix: of the topics, e.g. ``/unit_1/``.
    :param measured: topic of the temperature.
    """

    def __init__(self, ros: Harness, prefix: str = '', measured: str = 'temperature') -> None:
        self._ros = ros
        self.temperatures = ros.listen(Temperature, f'{prefix}{measured}')
        self.commands = ros.listen(Temperature, f'{prefix}{topics.COOLANT_SETPOINT}')
        self._setpoint = ros.node.create_publisher(
            Temperature, f'{prefix}{topics.SETPOINT}', topics.LOOP_QOS)

    def ask(self, celsius: float) -> None:
        """Turn the set-point, once the controller hears it."""
        self._ros.wait_until(self._setpoint.get_subscription_count)
        self._setpoint.publish(temperature(celsius))

    def settled(self, celsius: float, within: float) -> bool:
        """Tell whether the last twenty temperatures are near a value."""
        last = self.temperatures[-20:]
        return len(last) == 20 and all(
            abs(message.temperature - celsius) <= within for message in last)

    def reach(self, celsius: float, within: float) -> None:
        """Turn the set-point and wait until it is reached."""
        self.ask(celsius)
        self._ros.wait_until(lambda: self.settled(celsius, within))


def start_loop(ros: Harness, plant: Mapping[str, object], arguments: tuple[str, ...] = ()
               ) -> None:
    ros.start('controller', arguments=arguments)
    # the bench listens, too: nobody misses the first measurement
    ros.start('plant', {**plant, 'lockstep_subscribers': 2}, arguments)


def test_follows_the_setpoint_beside_a_plant_that_was_there_before(ros: Harness) -> None:
    loop = Loop(ros)
    ros.start('plant', {**LOCKSTEP, 'lockstep_subscribers': 2})
    ros.wait_until(lambda: 'plant' in ros.node.get_node_names())
    ros.start('controller')
    loop.ask(47.0)
    ros.wait_until(lambda: loop.temperatures and loop.temperatures[-1].temperature < 49.0)
    loop.ask(38.0)
    ros.wait_until(lambda: loop.temperatures[-1].temperature < 45.0)
    loop.reach(50.0, within=0.01)


def test_converges_at_two_hundred_times_real_time(ros: Harness) -> None:
    """Without lock-step commands come late by whatever the machine takes, and /clock ticks."""
    loop = Loop(ros)
    clock = ros.listen(Clock, topics.CLOCK, topics.CLOCK_QOS)
    start_loop(ros, {'speed': 200.0})
    loop.reach(42.0, within=0.1)
    # a busy bench may be behind with the temperatures, but not with the clock
    ros.wait_until(lambda: len(clock) > 20 and abs(
        clock[-1].clock.sec - seconds(loop.temperatures[-1])) < 60.0)
    ticks = [tick.clock.sec for tick in clock]
    assert ticks == sorted(ticks)


def test_every_measurement_has_exactly_one_command(ros: Harness) -> None:
    loop = Loop(ros)
    ros.start('controller')
    # or its first commands may go out before it knows that the bench listens
    ros.meet('controller')
    ros.start('plant', {**LOCKSTEP, 'lockstep_subscribers': 2, 'duration': 300.0,
                        'sample_period': 0.7})
    ros.wait_until(lambda: len(loop.commands) >= 429 and len(loop.temperatures) >= 429)
    measured = [message.header.stamp for message in loop.temperatures]
    assert [seconds(message) for message in loop.temperatures] == [
        pytest.approx(1.0 + 0.7 * k, abs=1e-9) for k in range(429)]
    assert [message.header.stamp for message in loop.commands] == measured


def test_two_loops_side_by_side_in_their_namespaces_and_with_another_topic(ros: Harness) -> None:
    loops = {'unit_1': Loop(ros, '/unit_1/'),
             'unit_2': Loop(ros, '/unit_2/', measured='reactor_temperature')}
    for unit, remap in (('unit_1', ()), ('unit_2', ('-r', 'temperature:=reactor_temperature'))):
        start_loop(ros, LOCKSTEP, ('-r', f'__ns:=/{unit}', *remap))
    loops['unit_1'].ask(47.0)
    loops['unit_2'].ask(42.0)
    ros.wait_until(lambda: loops['unit_1'].settled(47.0, 0.01))
    ros.wait_until(lambda: loops['unit_2'].settled(42.0, 0.01))
    assert {status.name for status in ros.statuses} >= {
        'unit_1/plant: simulation', 'unit_2/controller: control'}
    assert ros.node.count_publishers('/unit_2/temperature') == 0
