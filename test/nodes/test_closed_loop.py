# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Plant and controller in a loop: no offset, and no bump when the controller is replaced."""

from itertools import pairwise
import signal

from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np
import pytest
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Temperature

from koopman_ros.demo import reactor
from koopman_ros.ros import topics
from koopman_ros.testing import Harness
from support.nodes import seconds, temperature, value

FOULED = 0.8 * reactor.constant('heat_transfer_coefficient')  # W/K
SETPOINT = 45.0  # degC


def test_no_offset_is_left_and_the_next_controller_takes_over_the_coolant_in_force(
        ros: Harness) -> None:
    measured = ros.listen(Temperature, reactor.TEMPERATURE)
    commands = ros.listen(Temperature, reactor.COOLANT_SETPOINT)
    ticks = ros.listen(Clock, topics.CLOCK, topics.CLOCK_QOS)

    def rest() -> None:
        """Wait until the plant has come to rest at the set-point for another half a minute."""
        seen = len(commands)

        def rests() -> bool:
            nonlocal seen
            if len(commands) < seen + 30:
                return False
            seen = len(commands)
            x, u = (np.array([message.temperature for message in messages[-30:]])
                    for messages in (measured, commands))
            return bool(np.all(np.abs(x - SETPOINT) <= 1e-3) and np.ptp(u) <= 1e-3)

        ros.wait_until(rests)

    controller = ros.start('controller')
    ros.speak(Temperature, reactor.SETPOINT, to='controller').publish(temperature(SETPOINT))
    # not as fast as it can: a publisher keeps the last hundred commands, and a bench that a busy
    # machine lets wait for longer than they last misses some
    ros.start('plant', {'lockstep': True, 'lockstep_subscribers': 2, 'speed': 200.0,
                        'lockstep_timeout': 0.3, 'constants.heat_transfer_coefficient': FOULED})
    rest()
    assert all(before.clock.sec <= after.clock.sec for before, after in pairwise(ticks))
    rested = seconds(commands[-1])
    truth = ros.wait_for_status(
        'plant: simulation', lambda s: float(value(s, 'time [s]')) >= rested)
    assert abs(float(value(truth, 'temperature [degC]')) - SETPOINT) <= 1e-3
    # it is no small thing that it makes up for
    status = ros.wait_for_status(
        'controller: control', lambda s: int(value(s, 'measurements')) >= rested)
    assert status.level == DiagnosticStatus.OK
    assert abs(float(value(status, 'disturbance [K of coolant]'))) > 1.0

    controller.stop(signal.SIGKILL)
    ros.wait_for_status('plant: simulation', lambda s: 'no command is received' in s.message)
    coolants = ros.listen(Temperature, reactor.COOLANT_TEMPERATURE)
    # what the old one said is still on its way to the other subscription
    own = ros.listen(Temperature, reactor.COOLANT_SETPOINT)
    ros.start('controller')
    ros.wait_until(lambda: len(own) > 50)
    in_force = {seconds(message): message.temperature for message in coolants}
    # the very first may be given before the bench is known
    assert own[0].temperature == pytest.approx(in_force[seconds(own[0])], abs=1e-3)
    assert own[0].temperature == pytest.approx(min(in_force.values()), abs=1e-3)
    assert np.max(np.abs(np.diff([message.temperature for message in own]))) < 0.05
    # of the set-point it knows nothing: it holds what it finds
    rest()
