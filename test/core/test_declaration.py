# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Settings are described by their declarations, and checked where they are written."""

from dataclasses import fields
import inspect

import numpy as np
import pytest

from koopman_ros.control.laws.pi import PIParameters
from koopman_ros.control.mpc.law import MPCParameters
from koopman_ros.core.declaration import Settings
from koopman_ros.core.paths import model_path
from koopman_ros.model import load
from koopman_ros.tuning import DisturbanceLimits, InputLimits, SensorLimits, Tuning

SETTINGS = (Tuning, InputLimits, SensorLimits, DisturbanceLimits, MPCParameters, PIParameters)


@pytest.mark.parametrize('kind', SETTINGS)
def test_the_docstring_of_settings_has_each_field_with_its_declaration(kind: type[Settings]):
    text = inspect.getdoc(kind)
    words = ' '.join(text.split())
    for item in fields(kind):
        assert f'\n``{item.name}``: ' in text
        if 'description' in item.metadata:
            assert item.metadata['description'] in words


@pytest.mark.parametrize(('kind', 'line'), [
    (InputLimits, '``rate``: one per input, in its unit/s, at least 0, default 0, in YAML '
                  '``<input>.rate_limit``'),
    (SensorLimits, '``lower``: one per measured signal, in its unit, default no limit, in YAML '
                   '``<measured signal>.sensor_min``'),
    (Tuning, '``observer_bandwidth``: in 1/s, 0 to 1000, default 0'),
    (Tuning, '``max_riccati_residual``: above 0 and at most 1, default 1.5e-08'),
    (Tuning, "``fallback_order``: default ('sdre', 'linear')"),
    (Tuning, '``limits``: see ``InputLimits``')])
def test_a_field_has_unit_range_default_and_parameter(kind: type[Settings], line: str):
    assert line in inspect.getdoc(kind).splitlines()


@pytest.mark.parametrize(('kind', 'given', 'words'), [
    (InputLimits, {'lower': 12.0, 'upper': 0.0}, ('lower = 12.0', 'upper = 0.0')),
    (InputLimits, {'lower': 0.0, 'upper': [3.0, -1.0]}, ('lower = 0.0', 'upper = [3.0, -1.0]')),
    (InputLimits, {'rate': -2.0}, ('rate = -2.0', '0')),
    (InputLimits, {'upper': np.nan}, ('upper = nan',)),
    (InputLimits, {'lower': 'low'}, ('lower', "'low'")),
    (SensorLimits, {'lower': 5.0, 'upper': 4.0}, ('lower = 5.0',)),
    (SensorLimits, {'stuck_sensor_timeout': -1.0}, ('stuck_sensor_timeout = -1.0', '86400')),
    (Tuning, {'input_weight': 0.0}, ('input_weight = 0.0', 'above 0')),
    (Tuning, {'hold_timeout': '60 s'}, ('hold_timeout', "'60 s'")),
    (MPCParameters, {'time_limit': 1e5}, ('time_limit = 1', '3600'))])
def test_a_wrong_value_fails_where_it_is_written(kind, given, words):
    with pytest.raises((TypeError, ValueError)) as raised:
        kind(**given)
    for one in words:
        assert one in str(raised.value)


def test_zero_is_no_limit_in_python_as_in_yaml():
    model = load(model_path('two_tanks'))
    limits = InputLimits(lower=0.0, upper=12.0, rate=[0.0, 2.0])
    made = Tuning.for_model(model, limits=limits, sensor=SensorLimits(jump=0.0)).for_signals(
        model, model.states.names)
    assert made.limits.rate.tolist() == [np.inf, 2.0]
    assert made.sensor.jump.tolist() == [np.inf, np.inf]
