# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Numbers in messages: found and written by path."""

from types import SimpleNamespace

import numpy as np
import pytest

from koopman_ros.core.message_fields import MessageField, place
from koopman_ros.parameters.signal_topics import named_units, Signals
from koopman_ros.parameters.table import ConfigurationError
from koopman_ros.parameters.trainer_table import trainer_signals, trainer_table


def joints() -> SimpleNamespace:
    return SimpleNamespace(name=['arm', 'level [m]'], position=[1.0, 2.0], velocity=[3.0, 4.0])


def test_number_is_found_by_path():
    for field, value in (('position[arm]', 1.0), ('velocity[1]', 4.0),
                         ('position[level [m]]', 2.0)):
        assert MessageField('joints', 'sensor_msgs/msg/JointState', field,
                            'rad').get(joints()) == value
    message = SimpleNamespace(twist=SimpleNamespace(linear=SimpleNamespace(x=0.5)))
    found = MessageField('speed', 'geometry_msgs/msg/TwistStamped', 'twist.linear.x', 'm/s')
    assert found.get(message) == 0.5
    found.put(message, 0.25)
    assert message.twist.linear.x == 0.25


@pytest.mark.parametrize('field', ['position[leg]', 'effort[arm]', 'position[7]', 'name[0]'])
def test_a_missing_field_is_named(field):
    with pytest.raises(LookupError, match=field.replace('[', r'\[')):
        MessageField('joints', 'sensor_msgs/msg/JointState', field, 'rad').get(joints())


@pytest.mark.parametrize('field', ['', '.x', 'x.', 'a b', 'data[', 'data[]', 'x..y', '3'])
def test_field_that_is_no_path_is_rejected(field):
    with pytest.raises(ValueError, match='not the path'):
        MessageField('t', 'std_msgs/msg/Float64', field, '1')


@pytest.mark.parametrize(('unit', 'given', 'expected'), [
    ('K', {}, ('sensor_msgs/msg/Temperature', 'temperature', 'degC')),
    ('Pa', {}, ('sensor_msgs/msg/FluidPressure', 'fluid_pressure', 'Pa')),
    ('rad/s', {}, ('sensor_msgs/msg/JointState', 'velocity[s]', 'rad/s')),
    ('m', {}, ('sensor_msgs/msg/JointState', 'position[s]', 'm')),
    ('m', {'type': 'sensor_msgs/msg/Range'}, ('sensor_msgs/msg/Range', 'range', 'm')),
    ('K', {'type': 'std_msgs/msg/Float64', 'unit': 'K'}, ('std_msgs/msg/Float64', 'data', 'K')),
])
def test_missing_parts_of_a_message_field_get_defaults(unit, given, expected):
    found = place('s', 's', unit, given)
    assert (found.topic, (found.type, found.field, found.unit)) == ('s', expected)


def test_signals_have_names_of_topics_and_units_that_there_are():
    with pytest.raises(ConfigurationError, match="'my level' is the name of a signal"):
        Signals({'my level': 'm'}, {})
    with pytest.raises(ConfigurationError, match=r"'level \[Metre\]': there is no unit 'Metre'"):
        named_units(['level [Metre]'])
    assert named_units(['level [m]', 'flow [L/min]']) == {'level': 'm', 'flow': 'L/min'}


def test_missing_bounds_of_an_experiment_are_named():
    given = {'system': '', 'states_measured': ('level [m]', 'oven [K]'),
             'inputs_commanded': ('flow [L/min]',), 'controlled': ('level',)}
    table, signals = trainer_table(None, given), trainer_signals(None, given)
    bounds = {'level.experiment_max': 2.0, 'oven.experiment_min': 20.0,
              'oven.experiment_max': 90.0}
    values = table.snapshot(bounds)
    # a trainer that only records needs none
    assert table.check(values) == ''
    with pytest.raises(ValueError, match=(
            r'flow.experiment_min \[L/min\], flow.experiment_max \[L/min\], '
            r'level.experiment_min \[m\]$')):
        values.experiment(signals)
    given = bounds | {'flow.experiment_max': 8.0, 'level.experiment_min': 0.1}
    assert table.snapshot(given).experiment(signals).measured_lower.tolist() == [0.1, 293.15]
    with pytest.raises(ValueError, match=r'level.setpoint_min \[m\], level.setpoint_max \[m\]$'):
        table.snapshot(given).experiment(signals, np.array([1.0]))
