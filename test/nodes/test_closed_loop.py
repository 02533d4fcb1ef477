# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Plant and controller in a loop: any order of start, no offset, and no bump."""

from pathlib import Path
import signal

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
import numpy as np
import pytest
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Temperature

from koopman_ros.demo import reactor
from koopman_ros.model import save
from koopman_ros.ros import topics
from koopman_ros.ros.controller_status import TASKS
from koopman_ros.testing import Harness
from support.lagged_reactor import lagged_model
from support.nodes import seconds, temperature, value

FOULED = 0.8 * reactor.constant('heat_transfer_coefficient')  # W/K
SETPOINT = 45.0  # degC


class Loop:
    """A controller and a plant without noise, and an operator who hears them."""

    def __init__(self, ros: Harness) -> None:
        self.ros = ros
        self.measured = ros.listen(Temperature, reactor.TEMPERATURE)
        self.commands = ros.listen(Temperature, reactor.COOLANT_SETPOINT)
        self.clock = ros.listen(Clock, topics.CLOCK, topics.CLOCK_QOS)

    def start_controller(self, celsius: float) -> None:
        """Start a controller, and turn the set-point when it hears the operator."""
        self.controller = self.ros.start('controller')
        self.ros.speak(Temperature, reactor.SETPOINT, to='controller').publish(
            temperature(celsius))

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
    ros.start('plant', {'speed': 20.0})
    ros.wait_until(lambda: loop.measured)
    loop.start_controller(SETPOINT)
    ros.wait_until(lambda: loop.measured[-1].temperature < 48.0)
    # a busy bench may be behind with the temperatures, but not with the clock
    ros.wait_until(lambda: len(loop.clock) > 20 and abs(
        loop.clock[-1].clock.sec - seconds(loop.measured[-1])) < 60.0)
    ticks = [tick.clock.sec for tick in loop.clock]
    assert ticks == sorted(ticks)


def test_no_offset_is_left_and_the_next_controller_takes_over_the_coolant_in_force(
        ros: Harness) -> None:
    loop = Loop(ros)
    loop.start_controller(SETPOINT)
    # not as fast as it can: a publisher keeps the last hundred commands, and a bench that a busy
    # machine lets wait for longer than they last misses some
    ros.start('plant', {'lockstep': True, 'lockstep_subscribers': 2, 'speed': 200.0,
                        'lockstep_timeout': 0.3, 'constants.heat_transfer_coefficient': FOULED})
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
    ros.wait_for_status('plant: simulation', lambda s: 'no command is received' in s.message)
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


def test_a_lag_that_the_model_has_brings_no_overshoot(ros: Harness, tmp_path: Path) -> None:
    """The applied coolant is a state of the model, which no topic tells."""
    save(lagged_model(30.0), tmp_path / 'lagged.safetensors')
    loop = Loop(ros)
    loop.controller = ros.start('controller', {'model': str(tmp_path / 'lagged.safetensors')})
    ros.speak(Temperature, reactor.SETPOINT, to='controller').publish(temperature(SETPOINT))
    ros.start('plant', {'lockstep': True, 'lockstep_subscribers': 2, 'speed': 200.0,
                        'lockstep_timeout': 0.3, 'coolant_temperature.lag': 30.0})
    loop.rest()
    assert min(message.temperature for message in loop.measured) > SETPOINT - 0.3


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
