# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Plant and controller in a loop: any order of start, any names, no offset, and no bump."""

import signal

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
import numpy as np
import pytest
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Temperature

from koopman_ros.demo import reactor
from koopman_ros.ros import topics
from koopman_ros.ros.controller_status import TASKS
from koopman_ros.testing import Harness
from support.nodes import seconds, temperature, value

FOULED = 0.8 * reactor.constant('heat_transfer_coefficient')  # W/K
SETPOINT = 45.0  # degC
LOCKSTEP = {'lockstep': True, 'lockstep_subscribers': 2}


class Loop:
    """A controller and a plant without noise, and an operator who hears them."""

    def __init__(self, ros: Harness, prefix: str = '', measured: str = reactor.TEMPERATURE
                 ) -> None:
        self.ros, self._prefix = ros, prefix
        self.measured = ros.listen(Temperature, f'{prefix}{measured}')
        self.commands = ros.listen(Temperature, f'{prefix}{reactor.COOLANT_SETPOINT}')
        self.clock = ros.listen(Clock, topics.CLOCK, topics.CLOCK_QOS)
        self._setpoint = ros.node.create_publisher(
            Temperature, f'{prefix}{reactor.SETPOINT}', topics.LOOP_QOS)
        self._remaps = (*(('-r', f'__ns:={prefix[:-1]}') if prefix else ()),
                        '-r', f'{reactor.TEMPERATURE}:={measured}')

    def start_controller(self, celsius: float) -> None:
        """Start a controller, and turn the set-point when it hears the operator."""
        self.controller = self.ros.start('controller', arguments=self._remaps)
        self.ros.wait_until(self._setpoint.get_subscription_count)
        self.ros.meet(f'{self._prefix}controller')
        self._setpoint.publish(temperature(celsius))

    def start_plant(self, **parameters: object) -> None:
        self.ros.start('plant', parameters, self._remaps)

    def rest(self) -> None:
        """Wait until the plant has come to rest at the set-point for another half a minute."""
        seen = len(self.commands)

        def rests() -> bool:
            nonlocal seen
            if len(self.commands) < seen + 30:
                return False
            seen = len(self.commands)
            measured, commands = (
                np.array([message.temperature for message in messages[-30:]])
                for messages in (self.measured, self.commands))
            return bool(np.all(np.abs(measured - SETPOINT) <= 1e-3)
                        and np.ptp(commands) <= 1e-3)

        self.ros.wait_until(rests)


def test_follows_the_setpoint_beside_a_plant_that_was_there_before(ros: Harness) -> None:
    """Without lock-step commands come late by whatever the machine takes, and /clock ticks."""
    loop = Loop(ros)
    # no quicker: commands that are late by more than half a minute would let it run away
    loop.start_plant(speed=20.0)
    ros.wait_until(lambda: loop.measured)
    loop.start_controller(SETPOINT)
    ros.wait_until(lambda: loop.measured[-1].temperature < 48.0)
    # a busy bench may be behind with the temperatures, but not with the clock
    ros.wait_until(lambda: len(loop.clock) > 20 and abs(
        loop.clock[-1].clock.sec - seconds(loop.measured[-1])) < 60.0)
    ticks = [tick.clock.sec for tick in loop.clock]
    assert ticks == sorted(ticks)


def test_two_loops_side_by_side_in_their_namespaces_and_with_another_topic(ros: Harness) -> None:
    loops = {47.0: Loop(ros, '/unit_1/'), 42.0: Loop(ros, '/unit_2/', 'reactor_temperature')}
    for celsius, loop in loops.items():
        loop.start_controller(celsius)
        # no quicker: one works on while the other starts and settles
        loop.start_plant(**LOCKSTEP, speed=100.0)
    for celsius, loop in loops.items():
        ros.wait_until(lambda celsius=celsius, loop=loop: len(loop.measured) > 20 and all(
            abs(message.temperature - celsius) <= 0.01 for message in loop.measured[-20:]))
    ros.wait_until(lambda: {status.name for status in ros.statuses} >= {
        'unit_1/plant: simulation', 'unit_2/controller: control'})
    assert ros.node.count_publishers('/unit_2/temperature') == 0


def test_no_offset_is_left_and_the_next_controller_takes_over_the_coolant_in_force(
        ros: Harness) -> None:
    loop = Loop(ros)
    loop.start_controller(SETPOINT)
    # not as fast as it can: a publisher keeps the last hundred commands, and a bench that a busy
    # machine lets wait for longer than they last misses some
    loop.start_plant(**LOCKSTEP, speed=200.0, lockstep_timeout=0.3,
                     **{'constants.heat_transfer_coefficient': FOULED})
    loop.rest()
    rested = seconds(loop.commands[-1])
    truth = ros.wait_for_status(
        'plant: simulation', lambda s: float(value(s, 'time [s]')) >= rested)
    assert abs(float(value(truth, 'temperature [degC]')) - SETPOINT) <= 1e-3
    # it is no small thing that it makes up for
    status = ros.wait_for_status(
        'controller: control', lambda s: int(value(s, 'measurements')) >= rested)
    assert status.level == DiagnosticStatus.OK
    assert abs(float(value(status, 'disturbance [K of coolant]'))) > 1.0

    loop.controller.stop(signal.SIGKILL)
    ros.wait_for_status('plant: simulation', lambda s: 'no command arrives' in s.message)
    coolants = ros.listen(Temperature, reactor.COOLANT_TEMPERATURE)
    # what the old one said is still on its way to the other subscription
    commands = ros.listen(Temperature, reactor.COOLANT_SETPOINT)
    ros.start('controller')
    ros.wait_until(lambda: len(commands) > 50)
    in_force = {seconds(message): message.temperature for message in coolants}
    # the very first may be given before the bench is known
    assert commands[0].temperature == pytest.approx(in_force[seconds(commands[0])], abs=1e-3)
    assert commands[0].temperature == pytest.approx(min(in_force.values()), abs=1e-3)
    assert np.max(np.abs(np.diff([message.temperature for message in commands]))) < 0.05
    # of the set-point it knows nothing: it holds what it finds
    loop.rest()


def test_each_node_tells_of_all_its_tasks_in_one_message_and_names_the_plant(ros: Harness) -> None:
    heard: list[DiagnosticArray] = ros.listen(DiagnosticArray, topics.DIAGNOSTICS)
    tasks = {'plant': ('simulation',), 'controller': TASKS,
             'trainer': ('recording', 'experiment', 'training')}
    for node in tasks:
        ros.start(node, {'record_at_start': False} if node == 'trainer' else None)
    wanted = {tuple(f'{node}: {task}' for task in names) for node, names in tasks.items()}
    ros.wait_until(lambda: wanted <= {
        tuple(status.name for status in message.status) for message in heard})
    assert {status.hardware_id for message in heard for status in message.status} == {
        'one-state reactor'}
