# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Plant and controller in a loop: any order of start, any names, no offset, and no bump."""

from collections.abc import Callable
import signal

from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np
import pytest
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Temperature

from koopman_ros.parameters.plant import PlantParameters
from koopman_ros.ros import topics
from koopman_ros.testing import Harness
from support.messages import seconds, temperature, value

FOULED = 0.8 * PlantParameters().heat_transfer_coefficient
SETPOINT = 45.0  # degC
# Not as fast as they can: a publisher keeps the last hundred commands, and a bench that a busy
# machine lets wait for longer than they last misses some.
LOCKSTEP = {'lockstep': True, 'lockstep_subscribers': 2, 'speed': 200.0}


class Loop:
    """
    A controller and a plant without noise, and an operator who hears them.

    :param ros: where they run.
    :param prefix: of the topics, e.g. ``/unit_1/``.
    :param measured: topic of the temperature.
    """

    def __init__(self, ros: Harness, prefix: str = '', measured: str = topics.TEMPERATURE
                 ) -> None:
        self.ros, self._prefix = ros, prefix
        self.measured = ros.listen(Temperature, f'{prefix}{measured}')
        self.commands = ros.listen(Temperature, f'{prefix}{topics.COOLANT_SETPOINT}')
        self.clock = ros.listen(Clock, topics.CLOCK, topics.CLOCK_QOS)
        self._setpoint = ros.node.create_publisher(
            Temperature, f'{prefix}{topics.SETPOINT}', topics.LOOP_QOS)
        self._remaps = (*(('-r', f'__ns:={prefix[:-1]}') if prefix else ()),
                        '-r', f'{topics.TEMPERATURE}:={measured}')

    def start_controller(self) -> None:
        """Start a controller, and wait until it hears the operator."""
        self.controller = self.ros.start('controller', arguments=self._remaps)
        self.ros.wait_until(self._setpoint.get_subscription_count)
        self.ros.meet(f'{self._prefix}controller')

    def start_plant(self, **parameters: object) -> None:
        self.ros.start('plant', parameters, self._remaps)

    def ask(self, celsius: float) -> None:
        """Turn the set-point."""
        self._setpoint.publish(temperature(celsius))

    def settled(self, celsius: float) -> bool:
        """Tell whether the last twenty temperatures are near a value."""
        last = self.measured[-20:]
        return len(last) == 20 and all(
            abs(message.temperature - celsius) <= 0.01 for message in last)

    def wait_for(self, duration: int) -> None:
        """Wait until the bench has heard what happens in so many seconds of the plant."""
        # the bench may be some hundred commands behind, but not of the clock
        ticks = len(self.clock) + 2
        self.ros.wait_until(lambda: len(self.clock) >= ticks)
        last = self.clock[-1].clock.sec + duration
        self.ros.wait_until(lambda: self.commands and seconds(self.commands[-1]) >= last)

    def rest(self) -> None:
        """Wait until the plant has come to rest at the set-point."""
        self.wait_for(60)
        seen = 0

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

    def steps(self, change: Callable[[], object], count: int) -> np.ndarray:
        """Return the steps of the coolant during a change and some seconds of the plant after."""
        first = len(self.commands) - 1
        change()
        self.wait_for(count)
        commands = self.commands[first:]
        assert np.all(np.diff([seconds(message) for message in commands]) == 1.0)
        return np.abs(np.diff([message.temperature for message in commands]))


def test_follows_the_setpoint_beside_a_plant_that_was_there_before(ros: Harness) -> None:
    """Without lock-step commands come late by whatever the machine takes, and /clock ticks."""
    loop = Loop(ros)
    # no quicker: commands that are late by more than half a minute would let it run away
    loop.start_plant(speed=20.0)
    ros.wait_until(lambda: loop.measured)
    loop.start_controller()
    loop.ask(45.0)
    ros.wait_until(lambda: loop.measured[-1].temperature < 48.0)
    # a busy bench may be behind with the temperatures, but not with the clock
    ros.wait_until(lambda: len(loop.clock) > 20 and abs(
        loop.clock[-1].clock.sec - seconds(loop.measured[-1])) < 60.0)
    ticks = [tick.clock.sec for tick in loop.clock]
    assert ticks == sorted(ticks)


def test_two_loops_side_by_side_in_their_namespaces_and_with_another_topic(ros: Harness) -> None:
    loops = {47.0: Loop(ros, '/unit_1/'), 42.0: Loop(ros, '/unit_2/', 'reactor_temperature')}
    for celsius, loop in loops.items():
        loop.start_controller()
        loop.ask(celsius)
        loop.start_plant(**LOCKSTEP | {'speed': 0.0})
    for celsius, loop in loops.items():
        ros.wait_until(lambda celsius=celsius, loop=loop: loop.settled(celsius))
    ros.wait_until(lambda: {status.name for status in ros.statuses} >= {
        'unit_1/plant: simulation', 'unit_2/controller: control'})
    assert ros.node.count_publishers('/unit_2/temperature') == 0


# first, for a shared loop beside it would take what the machine has
def test_controller_that_was_killed_takes_over_the_coolant_in_force(ros: Harness) -> None:
    loop = Loop(ros)
    loop.start_controller()
    loop.ask(SETPOINT)
    loop.start_plant(**LOCKSTEP, heat_transfer_coefficient=FOULED, lockstep_timeout=0.3)
    loop.rest()
    loop.controller.stop(signal.SIGKILL)
    ros.wait_for_status('plant: simulation', lambda s: 'no command arrives' in s.message)
    coolants = ros.listen(Temperature, topics.COOLANT_TEMPERATURE)
    # what the old one said is still on its way to the other subscription
    commands = ros.listen(Temperature, topics.COOLANT_SETPOINT)

    ros.start('controller')
    ros.wait_until(lambda: len(commands) > 50)
    in_force = {seconds(message): message.temperature for message in coolants}
    # the very first may be given before the bench is known
    assert commands[0].temperature == pytest.approx(in_force[seconds(commands[0])], abs=1e-3)
    assert commands[0].temperature == pytest.approx(min(in_force.values()), abs=1e-3)
    assert np.max(np.abs(np.diff([message.temperature for message in commands]))) < 0.05
    # of the set-point it knows nothing: it holds what it finds
    loop.rest()


@pytest.fixture(scope='module')
def shared_loop(shared_ros: Harness) -> Loop:
    loop = Loop(shared_ros)
    loop.start_controller()
    loop.start_plant(**LOCKSTEP)
    return loop


@pytest.fixture
def loop(shared_loop: Loop) -> Loop:
    """Return a loop at rest, of a plant that is not as its model has it."""
    ros = shared_loop.ros
    ros.set_parameters('plant', heat_transfer_coefficient=FOULED)
    ros.set_parameters('controller', temperature_weight=1.0, coolant_weight=1.0,
                       setpoint_ramp=1000.0)
    ros.set_bool('controller/set_automatic', True)
    shared_loop.ask(SETPOINT)
    shared_loop.rest()
    return shared_loop


def test_no_offset_is_left_when_the_heat_transfer_changes(loop: Loop) -> None:
    count = len(loop.measured)
    loop.steps(lambda: loop.ros.set_parameters(
        'plant', heat_transfer_coefficient=1.5 * FOULED), 30)
    loop.rest()
    off = [seconds(message) for message in loop.measured[count:]
           if abs(message.temperature - SETPOINT) > 1e-3]
    assert off[-1] - off[0] < 600.0
    rested = seconds(loop.commands[-1])
    truth = loop.ros.wait_for_status(
        'plant: simulation', lambda s: float(value(s, 'time [s]')) >= rested)
    assert abs(float(value(truth, 'temperature [degC]')) - SETPOINT) <= 1e-3
    # it is no small thing that it makes up for
    status = loop.ros.wait_for_status(
        'controller: control', lambda s: int(value(s, 'measurements')) >= rested)
    assert status.level == DiagnosticStatus.OK
    assert abs(float(value(status, 'disturbance [K of coolant]'))) > 1.0


def test_manual_coolant_is_left_without_a_bump(loop: Loop) -> None:
    """The law would command another one."""
    manual = loop.ros.speak(Temperature, topics.MANUAL_COOLANT_SETPOINT, to='controller')
    law = loop.commands[-1].temperature
    loop.ros.set_bool('controller/set_automatic', False)
    manual.publish(temperature(law - 0.3))
    loop.ros.wait_until(lambda: loop.commands[-1].temperature == pytest.approx(law - 0.3))
    count = len(loop.commands) + 20
    loop.ros.wait_until(lambda: len(loop.commands) > count)
    steps = loop.steps(lambda: loop.ros.set_bool('controller/set_automatic', True), 200)
    # in manual mode nothing moves, so that the first steps are those of the switch
    assert np.max(steps[np.flatnonzero(steps)][:5]) < 0.01
    loop.rest()
    assert loop.commands[-1].temperature == pytest.approx(law, abs=0.01)
    steps = loop.steps(lambda: loop.ros.set_bool('controller/set_automatic', False), 30)
    assert np.max(steps) < 0.01


def test_weights_change_without_a_bump(loop: Loop) -> None:
    """At rest, and on the way to another set-point."""
    def retune() -> None:
        for weight in (0.01, 10.0, 0.3):
            (result,) = loop.ros.set_parameters('controller', coolant_weight=weight)
            assert result.successful, result.reason

    assert np.max(loop.steps(retune, 100)) < 0.01
    # slow, so that a busy machine comes in time, too
    loop.ros.set_parameters('controller', setpoint_ramp=0.05)
    loop.ask(SETPOINT + 4.0)
    loop.ros.wait_until(lambda: loop.measured[-1].temperature > SETPOINT + 0.2)
    steps = loop.steps(retune, 30)
    assert loop.measured[-1].temperature < SETPOINT + 3.9
    assert np.max(steps) < 0.05
