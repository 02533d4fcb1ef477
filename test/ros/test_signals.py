# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Signals over messages of any type: what one end sends in its units the other hears in its."""

from dataclasses import dataclass, field
import math
from pathlib import Path
import time
from typing import Any

import numpy as np
import pytest
from rclpy.serialization import serialize_message
from sensor_msgs.msg import BatteryState, JointState, Temperature

from koopman_ros.core.message_fields import FieldDefaults, KNOWN_TYPES, MessageField, place
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.parameters.table import ConfigurationError
from koopman_ros.records import BagWriter, message_definition, read_series
from koopman_ros.ros import topics
from koopman_ros.ros.signals import SignalPublisher, SignalSample, SignalSubscriber
from koopman_ros.ros.time_conversion import stamp_message
from koopman_ros.testing import Harness

STAMP = stamp_message(7 * NANOSECONDS + 250)
TWIST = {'type': 'geometry_msgs/msg/TwistStamped', 'field': 'twist.linear.x'}


@dataclass
class Ends:
    """Places of signals, who publishes them, and what was heard of them."""

    ros: Harness
    places: dict[str, MessageField]
    units: dict[str, str]  #: of the signals
    heard: list[SignalSample] = field(default_factory=list)

    def __post_init__(self) -> None:
        node = self.ros.node

        def subscribe(topic: str, callback: Any, kind: Any) -> Any:
            return node.create_subscription(kind, topic, callback, topics.LOOP_QOS)

        self.inlet = SignalSubscriber(node, subscribe, self.places, self.units, self.heard.append)
        self.outlet = SignalPublisher(
            self.places, self.units,
            lambda topic, kind: node.create_publisher(kind, topic, topics.LOOP_QOS))
        self.ros.wait_until(lambda: all(
            publisher.get_subscription_count() for publisher in self.outlet.publishers))

    def wait_for(self, count: int) -> list[SignalSample]:
        self.ros.wait_until(lambda: len(self.heard) >= count)
        return self.heard


@pytest.mark.parametrize(('unit', 'given', 'value', 'sent'), [
    # of the unit alone
    ('K', {}, 300.0, 26.85),
    ('Pa', {}, 1.5e5, 1.5e5),
    ('rad', {}, 0.5, 0.5),
    # of the type, and in another unit
    ('K', {'type': 'std_msgs/msg/Float64', 'unit': 'K'}, 300.0, 300.0),
    ('m^3/s', {'type': 'std_msgs/msg/Float64', 'unit': 'L/min'}, 0.001, 60.0),
    ('m/s', TWIST, -0.25, -0.25),
    ('km/h', {**TWIST, 'unit': 'm/s'}, 36.0, 10.0),
    ('V', {'type': 'std_msgs/msg/Float64MultiArray', 'field': 'data[2]'}, 6.0, 6.0),
    ('mol/L', {'field': 'position[reactant [mol/L]]'}, 0.75, 0.75),
])
def test_a_number_survives_a_message(
        shared_ros: Harness, unit: str, given: dict[str, str], value: float, sent: float) -> None:
    # a topic for each
    where = place(f'signal_{len(list(shared_ros.node.publishers))}', 'signal', unit, given)
    kind = topics.message_class(where.type)
    raw = shared_ros.listen(kind, where.topic)
    ends = Ends(shared_ros, {'signal': where}, {'signal': unit})
    shared_ros.wait_until(lambda: ends.outlet.publishers[0].get_subscription_count() == 2)
    before = time.time_ns()
    ends.outlet.send(np.array([value]), STAMP, 'somewhere')
    (heard,) = ends.wait_for(1)
    assert dict(heard.values) == {'signal': pytest.approx(value, rel=1e-12)}
    shared_ros.wait_until(lambda: raw)
    assert where.get(raw[0]) == pytest.approx(sent, rel=1e-12)
    if hasattr(kind, 'header'):
        assert (heard.stamped, heard.stamp, heard.frame_id) == (True, STAMP, 'somewhere')
        assert not ends.inlet.unstamped
    else:
        # that of its arrival
        assert (heard.stamped, heard.frame_id) == (False, '')
        assert before <= heard.stamp_ns <= time.time_ns()
        assert ends.inlet.unstamped == [where.topic]
    assert ends.inlet.published()


def test_signals_of_one_topic_are_one_message(shared_ros: Harness) -> None:
    units = {'angle': 'rad', 'rate': 'rad/s', 'heat': 'K', 'torque': 'N m'}
    places = {name: place('joints', name, unit, {'field': part} if part else {'topic': 'oven'})
              for (name, unit), part in zip(units.items(), (
                  'position[shaft]', 'velocity[shaft]', '', 'effort[motor]'), strict=True)}
    joints = shared_ros.listen(JointState, 'joints')
    ends = Ends(shared_ros, places, units)
    assert [publisher.topic_name for publisher in ends.outlet.publishers] == ['/joints', '/oven']
    shared_ros.wait_until(lambda: ends.outlet.publishers[0].get_subscription_count() == 2)
    ends.outlet.send(np.array([1.0, 2.0, 300.0, 3.0]), STAMP, '')
    parts = sorted((dict(part.values) for part in ends.wait_for(2)), key=len)
    assert parts == [{'heat': pytest.approx(300.0)}, {'angle': 1.0, 'rate': 2.0, 'torque': 3.0}]
    shared_ros.wait_until(lambda: joints)
    assert list(joints[0].name) == ['shaft', 'motor']
    assert (joints[0].position[0], joints[0].velocity[0], joints[0].effort[1]) == (1.0, 2.0, 3.0)

    # another's message of the same topic carries a part, or nothing
    publisher = ends.outlet.publishers[0]
    for name, position in (('leg', [9.0]), ('shaft', [4.0])):
        publisher.publish(JointState(name=[name], position=position))
    assert dict(ends.wait_for(3)[2].values) == {'angle': 4.0}


def test_physically_impossible_values_become_nan(shared_ros: Harness) -> None:
    places = {'heat': place('furnace', 'heat', 'K')}
    ends = Ends(shared_ros, places, {'heat': 'K'})
    for celsius in (-273.16, math.nan, math.inf, -273.15, 20.0):
        ends.outlet.publishers[0].publish(Temperature(temperature=celsius))
    found = [part.values['heat'] for part in ends.wait_for(5)]
    assert np.array(found) == pytest.approx(
        np.array([math.nan, math.nan, math.nan, 0.0, 293.15]), nan_ok=True)


def test_a_quantised_measurement_has_its_variance_in_the_unit_of_the_message(
        shared_ros: Harness) -> None:
    given = {'type': 'sensor_msgs/msg/FluidPressure'}
    ends = Ends(shared_ros, {'pressure': place('vessel', 'pressure', 'bar', given)},
                {'pressure': 'bar'})
    raw = shared_ros.listen(topics.message_class(given['type']), 'vessel')
    shared_ros.wait_until(lambda: ends.outlet.publishers[0].get_subscription_count() == 2)
    ends.outlet.send(np.array([1.2345]), STAMP, '', variances=np.array([0.01]),
                     resolutions=np.array([0.1]))
    shared_ros.wait_until(lambda: raw)
    # 1 bar is 1e5 Pa
    assert raw[0].fluid_pressure == pytest.approx(1.2e5)
    assert raw[0].variance == pytest.approx(1e8)
    assert ends.wait_for(1)[0].values['pressure'] == pytest.approx(1.2)


@pytest.mark.usefixtures('type_support')
def test_a_type_that_one_row_adds_is_learned_from(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kind = 'sensor_msgs/msg/BatteryState'
    monkeypatch.setitem(KNOWN_TYPES, kind, FieldDefaults('voltage', 'V', 0.0, 1e3))
    with BagWriter(tmp_path / 'run') as writer:
        writer.add_topic('/cell', message_definition(kind))
        for second, voltage in enumerate((3.5, -1.0, 3.75), 1):
            message = BatteryState(voltage=voltage)
            message.header.stamp.sec = second
            writer.write('/cell', serialize_message(message), second * NANOSECONDS)
    cell = place('/cell', 'cell', 'V', {'type': kind})
    series = read_series(tmp_path / 'run', cell)
    assert (series.values.tolist(), series.unit) == ([3.5, -1.0, 3.75], 'V')
    assert place('/cell', 'cell', 'mV', {'type': kind}) == MessageField(
        '/cell', kind, 'voltage', 'V')


def reject(*_: Any) -> Any:
    raise AssertionError('nothing is made for a place that cannot be')


@pytest.mark.parametrize(('unit', 'given', 'words'), [
    ('K', {'type': 'no_such_msgs/msg/Thing', 'field': 'x'}, 'is not installed'),
    ('K', {'field': 'heat'}, 'sensor_msgs/msg/Temperature has no heat'),
    ('K', {'field': 'header.stamp'}, 'header.stamp of sensor_msgs/msg/Temperature is not a'),
    ('m/s', {**TWIST, 'field': 'twist.linear.w'}, 'TwistStamped has no twist.linear.w'),
    ('K', {'unit': 'm'}, "'(K|m)' cannot be converted to '(K|m)'"),
])
def test_place_that_cannot_be_is_rejected(
        shared_ros: Harness, unit: str, given: dict[str, str], words: str) -> None:
    places, units = {'signal': place('nowhere', 'signal', unit, given)}, {'signal': unit}
    for make in (lambda: SignalSubscriber(shared_ros.node, reject, places, units, reject),
                 lambda: SignalPublisher(places, units, reject)):
        with pytest.raises(ConfigurationError, match=f'^signal: .*{words}'):
            make()


@pytest.mark.parametrize(('kind', 'field'), [
    ('std_msgs/msg/Bool', 'data'), ('std_msgs/msg/Int32', 'data'),
    ('std_msgs/msg/ByteMultiArray', 'data[0]')])
def test_integer_fields_are_read_and_not_published(
        shared_ros: Harness, kind: str, field: str) -> None:
    """A command of 23.7 would be sent as whatever the middleware makes of it."""
    places = {'pump': MessageField('pump', kind, field, '1')}
    with pytest.raises(ConfigurationError, match=r'^pump: data.* holds integers'):
        SignalPublisher(places, {'pump': '1'}, reject)
    heard: list[str] = []
    SignalSubscriber(shared_ros.node, lambda topic, *_: heard.append(topic), places, {'pump': '1'},
                     reject)
    assert heard == ['pump']


def test_signals_of_one_topic_have_one_type() -> None:
    places = {'heat': place('both', 'heat', 'K'), 'angle': place('both', 'angle', 'rad')}
    with pytest.raises(ConfigurationError, match='heat and angle share the topic both'):
        SignalPublisher(places, {'heat': 'K', 'angle': 'rad'}, reject)
