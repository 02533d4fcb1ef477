# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Parameters of running nodes, changed and read through their services as `ros2 param` does."""

import math
from typing import Any

import pytest
from rcl_interfaces.srv import DescribeParameters

from koopman_ros.parameters.controller import TABLE
from koopman_ros.ros.node import range_of
from koopman_ros.testing import Harness

CONTROLLER = '/controller'


@pytest.fixture(scope='module')
def running(shared_ros: Harness) -> Harness:
    """Start one controller, whose parameters every test leaves as they were."""
    shared_ros.start('controller')
    return shared_ros


@pytest.mark.parametrize(('change', 'words'), [
    ({'coolant_max': 500.0}, 'coolant_max = 500.0 degC must be in [-50, 150] degC'),
    ({'temperature_weight': 0.0}, 'temperature_weight = 0.0 1/K^2 must be in (0, 1000000] 1/K^2'),
    ({'temperature_weight': -1.0},
     'temperature_weight = -1.0 1/K^2 must be in (0, 1000000] 1/K^2'),
    ({'setpoint_ramp': math.nan}, 'setpoint_ramp = nan K/min must be in (0, 1000000] K/min'),
    ({'coolant_min': math.inf}, 'coolant_min = inf degC must be in [-50, 150] degC'),
    ({'coolant_weight': 1}, "expected 'Type.DOUBLE' got 'Type.INTEGER'"),
    ({'coolant_weight': 'much'}, "expected 'Type.DOUBLE' got 'Type.STRING'"),
    ({'coolant_min': 40.0}, 'coolant_min = 40.0 degC must be below coolant_max = 32.0 degC: '
     'change the other one first'),
    ({'model': 'reactor_nz5'}, 'the old model is kept: no model file at '),
    ({'no_such_thing': 1.0}, 'undeclared parameter'),
    ({'validity_margin': 2.0}, 'validity_margin = 2.0 must be at most linear_margin = '
     f'{TABLE.rows["linear_margin"].default}: change the other one first'),
    ({'sensor_min': 200.0}, 'sensor_min = 200.0 degC must be below sensor_max = 150.0 degC: '
     'change the other one first'),
    ({'min_riccati_digits': 16.0}, 'min_riccati_digits = 16.0 must be in [0, 15]'),
    # what fits, and cannot be used: 0 per second
    ({'coolant_rate_limit': 5e-324}, 'coolant_rate_limit = 5e-324 K/min cannot be used: input '
     'rate must be above 0, got [0.0]; choose another value in (0, 1000000] K/min'),
    ({'setpoint_ramp': 5e-324}, 'setpoint_ramp = 5e-324 K/min cannot be used: setpoint_ramp must '
     'be above 0, got [0.0]; choose another value in (0, 1000000] K/min'),
])
def test_change_that_does_not_fit_is_refused_with_the_reason(
        running: Harness, change: dict[str, Any], words: str) -> None:
    (result,) = running.set_parameters(CONTROLLER, **change)
    assert not result.successful
    assert words in result.reason
    (name,) = change
    if name in TABLE.rows:
        assert running.get_parameters(CONTROLLER, name) == [TABLE.rows[name].default]


def test_two_limits_that_cross_on_the_way_change_together(running: Harness) -> None:
    default = {name: TABLE.rows[name].default for name in ('coolant_min', 'coolant_max')}
    for limits in ({'coolant_min': 40.0, 'coolant_max': 60.0}, default):
        result = running.set_parameters_atomically(CONTROLLER, **limits)
        assert result.successful, result.reason
        assert running.get_parameters(CONTROLLER, *limits) == list(limits.values())


@pytest.mark.parametrize(('low', 'high', 'kind'), [
    ('coolant_min', 'coolant_max', 'input'), ('sensor_min', 'sensor_max', 'sensor')])
def test_limits_that_are_equal_in_kelvin_are_refused(
        running: Harness, low: str, high: str, kind: str) -> None:
    above = 20.00000000000001
    result = running.set_parameters_atomically(CONTROLLER, **{low: 20.0, high: above})
    assert not result.successful
    assert result.reason.startswith(f'{low} = 20.0 degC and {high} = {above} degC cannot be used: '
                                    f'{kind} limits must be lower < upper, got ')
    assert running.get_parameters(CONTROLLER, low) == [TABLE.rows[low].default]


def test_atomic_change_is_refused_as_a_whole(running: Harness) -> None:
    result = running.set_parameters_atomically(CONTROLLER, max_gain=7.0, coolant_max=500.0)
    assert not result.successful
    assert 'coolant_max = 500.0 degC' in result.reason
    assert running.get_parameters(CONTROLLER, 'max_gain') == [TABLE.rows['max_gain'].default]


def test_every_parameter_is_described_with_unit_and_range(running: Harness) -> None:
    names = list(TABLE.rows)
    response = running.call(DescribeParameters, f'{CONTROLLER}/describe_parameters',
                            DescribeParameters.Request(names=names))
    described = {item.name: item for item in response.descriptors}
    assert list(described) == names
    for name, row in TABLE.rows.items():
        assert described[name].description.startswith(row.description)
        assert described[name].description.endswith(f'[{row.unit}]' if row.unit else '')
        assert described[name].additional_constraints == row.range_text
        assert described[name].read_only == row.read_only
        found = [*described[name].floating_point_range, *described[name].integer_range]
        assert found == ([limits] if (limits := range_of(row)) else [])
    assert described['coolant_min'].description == 'lowest coolant temperature commanded [degC]'
    assert described['coolant_min'].additional_constraints == '[-50, 150] degC'


def test_refused_change_is_logged(running: Harness) -> None:
    running.set_parameters(CONTROLLER, max_gain=-3.0)
    running.wait_until(lambda: 'parameter change refused: max_gain = -3.0' in running.printed())
