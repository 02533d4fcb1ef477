# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A reactor of two states whose concentration is estimated, over topics, and its replay."""

import pytest
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import String

from koopman_ros.nodes.replay import replay_records
from koopman_ros.plants import steady_state, two_state_reactor
from koopman_ros.plants.library.reactor import ReactorParameters
from koopman_ros.replay.records import parse
from koopman_ros.ros import topics
from koopman_ros.testing import Harness
from koopman_ros.units import to_kelvin
from support.nodes import temperature, value

FEED = 355.0  # K, 5 K more than the model knows
SETPOINT = 39.0  # degC
SAMPLES = 900


def test_no_offset_is_left_and_what_is_not_measured_is_known(ros: Harness) -> None:
    internals = ros.listen(JointState, topics.CONTROLLER_STATE)
    measured = ros.listen(Temperature, 'temperature')
    recorded = ros.listen(String, topics.CONTROLLER_EVENTS)
    setpoint = ros.node.create_publisher(Temperature, 'setpoint', topics.LOOP_QOS)
    ros.start('controller', {
        'system': 'two_state', 'states_measured': "['temperature [K]']",
        'temperature.noise': 0.05, 'coolant_temperature.wander': 1.0})
    ros.meet('controller')
    ros.wait_until(setpoint.get_subscription_count)
    setpoint.publish(temperature(SETPOINT))
    ros.start('plant', {
        'system': 'two_state', 'constants.feed_temperature': FEED - to_kelvin(0.0), 'speed': 0.0,
        'duration': float(SAMPLES), 'temperature.noise': 0.05, 'lockstep': True,
        'lockstep_subscribers': 2})
    status = ros.wait_for_status('controller: control', lambda status: (
        int(value(status, 'measurements')) >= SAMPLES))
    late = [message.temperature for message in measured[-200:]]
    assert sum(late) / len(late) == pytest.approx(SETPOINT, abs=0.02)
    said = dict(zip(internals[-1].name, internals[-1].position, strict=True))
    truth = steady_state(two_state_reactor(ReactorParameters(feed_temperature=FEED)),
                         {'temperature': to_kelvin(SETPOINT)})[0][0]
    assert said['estimated_concentration [mol/L]'] == pytest.approx(truth, abs=5e-3)
    assert 0.0 < said['deviation_concentration [mol/L]'] < 0.02
    # a warmer feed, q/V = 1/min, is like a warmer coolant, UA/(rho C_p V) = 2.09/min
    assert said['disturbance [K]'] == pytest.approx((FEED - 350.0) / 2.0921, abs=0.3)
    assert 'consistent' in value(status, 'innovations, mean square over expected')
    assert float(value(status, 'concentration, estimated [mol/L]').split()[0]) == pytest.approx(
        truth, abs=5e-3)
    # what was written down is enough to find the same commands
    found = replay_records([parse(message.data) for message in recorded])
    assert len(found.samples) >= SAMPLES
    assert not found.lost
    assert all(sample.replayed.tobytes() == sample.recorded.tobytes() for sample in found.samples)
