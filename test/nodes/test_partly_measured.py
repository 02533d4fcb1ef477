# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A reactor of two states whose concentration is estimated, over topics, and its replay."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import String

from koopman_ros.core.units import to_kelvin
from koopman_ros.event_log.records import parse
from koopman_ros.event_log.run import replay_records
from koopman_ros.model import Coordinates, linearised_model, Provenance, save
from koopman_ros.plants import steady_state, two_state_reactor
from koopman_ros.plants.library.reactor import ReactorParameters
from koopman_ros.ros import topics
from koopman_ros.testing import Harness
from support.nodes import temperature, value

FEED = 355.0  # K, 5 K more than the model knows
SETPOINT = 39.0  # degC


def test_a_lift_with_a_hidden_state_takes_over_from_a_pi_law_without_offset(
        ros: Harness, tmp_path: Path) -> None:
    """Nothing was learned at first: the law knows names and ranges alone."""
    states, inputs = (Coordinates.spanning((name,), ('K',), np.array([low]), np.array([high]))
                      for name, low, high in (('temperature', 290.0, 330.0),
                                              ('coolant_temperature', 278.15, 305.15)))
    file = tmp_path / 'signals.safetensors'
    save(linearised_model(np.zeros((1, 1)), np.zeros((1, 1)), states, inputs, 'min',
                          Provenance('signals alone')), file)
    measured = ros.listen(Temperature, 'temperature')
    commands = ros.listen(Temperature, 'coolant_setpoint')
    recorded = ros.listen(String, topics.EVENT_LOG)
    internals = ros.listen(JointState, topics.CONTROLLER_INTERNALS)
    ros.start('controller', {
        'system': 'none', 'model': file, 'fallback_order': "['pi']", 'pi.temperature.gain': 3.0,
        'pi.temperature.integral_time': 60.0, 'coolant_temperature.safe_value': 5.0,
        'bumpless_transfer_time': 10.0, 'coolant_temperature.disturbance_noise': 1.0,
        'temperature.measurement_noise': 0.02, 'model_check_factor': 0.0})
    ros.speak(Temperature, 'setpoint', to='controller').publish(temperature(SETPOINT))
    ros.start('plant', {
        'system': 'two_state', 'speed': 200.0, 'temperature.measurement_noise': 0.02,
        'lockstep': True, 'lockstep_subscribers': 2})

    def rests() -> bool:
        # the mean alone is also there while the temperature swings through the set-point
        late = [message.temperature for message in measured[-120:]]
        return len(late) == 120 and abs(sum(late) / len(late) - SETPOINT) < 0.05 and (
            max(abs(one - SETPOINT) for one in late) < 0.15)

    ros.wait_until(rests)
    ros.set_parameters('controller', model='two_state', fallback_order=['sdre', 'linear'])
    begun = len(measured)
    status = ros.wait_for_status('controller: control', lambda status: (
        value(status, 'active law') == 'learned law'))
    assert value(status, 'model') == 'two_state'
    ros.wait_until(lambda: len(measured) > begun + 200)
    # without a bump, and without an offset
    late = np.array([message.temperature for message in measured[begun:]])
    assert np.max(np.abs(late - SETPOINT)) < 0.5
    assert np.mean(late[-60:]) == pytest.approx(SETPOINT, abs=0.05)
    assert max(abs(after.temperature - before.temperature)
               for before, after in itertools.pairwise(commands[begun:])) < 1.0
    # nor is one left by a feed that the model does not know, and the other state is still known
    (result,) = ros.set_parameters('plant', **{
        'constants.feed_temperature': FEED - to_kelvin(0.0)})
    assert result.successful, result.reason
    begun = len(measured)
    # a busy machine controls less often, and takes longer
    ros.wait_until(lambda: len(measured) > begun + 400 and np.mean([
        message.temperature for message in measured[-200:]]) == pytest.approx(SETPOINT, abs=0.02))
    # a sample that a busy machine missed has no estimate
    ros.wait_until(lambda: 'estimated_concentration [mol/L]' in internals[-1].name)
    said = dict(zip(internals[-1].name, internals[-1].position, strict=True))
    truth = steady_state(two_state_reactor(ReactorParameters(feed_temperature=FEED)),
                         {'temperature': to_kelvin(SETPOINT)})[0][0]
    assert said['estimated_concentration [mol/L]'] == pytest.approx(truth, abs=5e-3)
    deviation = said['deviation_concentration [mol/L]']
    assert 0.0 < deviation < 0.02
    assert 0.0 < abs(said['covariance_concentration_temperature [mol/L K]']) < (
        deviation * said['deviation_temperature [K]'])
    # the replay takes over as well
    found = replay_records([parse(message.data) for message in recorded], [file])
    assert not found.lost
    assert found.models == [str(file), 'two_state']
    assert len(found.samples) > 700
    assert all(sample.replayed.tobytes() == sample.recorded.tobytes() for sample in found.samples)
