# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Units against their definitions, and how values and reasons are written."""

import math
import string

import numpy as np
import pytest

from koopman_ros.core.status import reason, StatusCode, StatusFormatter
from koopman_ros.core.units import check_unit, conversion, Display, Displays


@pytest.mark.parametrize(('unit', 'wanted', 'value', 'converted'), [
    ('K', 'degC', 300.0, 26.85), ('degC', 'K', 26.85, 300.0), ('degC', 'degF', 100.0, 212.0),
    ('degF', 'K', 32.0, 273.15), ('m', 'mm', 0.25, 250.0), ('bar', 'Pa', 1.5, 150_000.0),
    ('K/min', 'K/s', 60.0, 1.0), ('rad', 'deg', math.pi, 180.0), ('%', '1', 20.0, 0.2),
    ('%/min', '1/s', 30.0, 0.005), ('ppm', '%', 500.0, 0.05), ('mol/L', 'mol/m^3', 0.5, 500.0),
    ('anything', 'anything', 3.0, 3.0)])
def test_values_are_converted(unit: str, wanted: str, value: float, converted: float) -> None:
    assert conversion(unit, wanted)(value) == pytest.approx(converted, rel=1e-12)
    np.testing.assert_allclose(conversion(unit, wanted)(np.full(2, value)), converted, rtol=1e-12)


@pytest.mark.parametrize(('unit', 'wanted'), [('K', 'm'), ('K', 'nonsense'), ('', 'degC')])
def test_units_that_do_not_fit_are_named(unit: str, wanted: str) -> None:
    with pytest.raises(ValueError, match=f"'{unit}' cannot be converted to '{wanted}'"):
        conversion(unit, wanted)


def test_every_code_has_its_words() -> None:
    say = StatusFormatter(Displays({'T': 'K'}, {'K': Display('K', 'degC', '.2f')}))
    assert say(None) == ''
    for code in StatusCode:
        values = {'signal': 'T'}
        for _, name, form, _ in string.Formatter().parse(code.template):
            if name and name != 'signal':
                values[name] = {
                    'ranges': (('T', 300.0, 310.0),), 'values': (('T', 300.0),),
                    'level': 'sdre', 'cause': reason(StatusCode.NO_MEASUREMENT)}.get(form or name,
                                                                                     300.0)
        words = say(reason(code, **values))
        assert words
        assert '{' not in words
    assert say(reason(StatusCode.HELD_TOO_LONG, timeout=60.0, cause=reason(
        StatusCode.OUTSIDE_SENSOR, signal='T', value=473.15, lower=273.15, upper=373.15))) == (
            'the measured T 200.00 degC is outside the range of the sensor, 0.00 degC to '
            '100.00 degC: check the sensor; held for longer than 60 s')


@pytest.mark.parametrize('unit', ['Kelvin', 'l/mn', 'm/', 'metre metre2'])
def test_unit_that_there_is_not_is_named(unit):
    with pytest.raises(ValueError, match=f"there is no unit '{unit}': use e.g. K"):
        check_unit(unit)
    for one in ('K', 'L/min', 'N m', '%', '%/s', 'ppm', '1', 'm^3/s', '', '(m/s)**2', 'kg/(m*s)',
                'm^-0.5', '°C', 'ft_H2O', 'm²'):
        check_unit(one)


@pytest.mark.parametrize('unit', [
    'm" :style="(alert(1))" a="', 'm # :a=1', 'm<b>', ':m', 'm\\', 'm\n', 'm\x00', 'm : "x"',
    '{m}', '9**9**9', '((m**99)**99)**99 ' * 10, 'm' * 1000, '1e400', 'm  s'])
def test_text_that_the_library_would_skip_or_work_at_for_ever_is_no_unit(unit: str) -> None:
    with pytest.raises(ValueError, match='there is no unit'):
        check_unit(unit)
    with pytest.raises(ValueError, match='is not a valid unit'):
        conversion('m', unit)
    with pytest.raises(ValueError, match='is not a valid unit'):
        conversion(unit, 'm')
