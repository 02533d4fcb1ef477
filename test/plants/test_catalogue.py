# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Plants by name, and their constants as parameters in SI."""

import contextlib
from dataclasses import dataclass, fields

import numpy as np
import pytest

from koopman_ros.plants import (
    build,
    constant,
    Constants,
    constants_of,
    ControlAffineSystem,
    EquilibriumError,
    plant_class,
    PLANTS,
    two_state_example,
)


@dataclass(frozen=True)
class Heater(Constants):
    """dT/dt = u - rate (T - surroundings), nominal at the surroundings unless they freeze."""

    rate: float = constant(0.7, '1/min', 0.0, 10.0, 'of cooling', si='1/s', factor=60.0)
    surroundings: float = constant(350.0, 'K', 250.0, 500.0, 'around it', si='degC')

    def system(self, nominal_state=None):
        if nominal_state is None:
            if self.surroundings < 273.15:
                raise EquilibriumError('it freezes; give nominal_state')
            nominal_state = [self.surroundings]
        return ControlAffineSystem(
            name='heater', state_names=('temperature',), state_units=('K',),
            input_names=('heating',), input_units=('K/min',), time_unit='min',
            drift=lambda x: self.rate * (self.surroundings - x),
            drift_jacobian=lambda x: np.full((*x.shape, 1), -self.rate),
            B=np.eye(1), nominal_state=nominal_state, nominal_input=np.zeros(1))


class Plain:
    """A plant that takes no nominal state."""

    def system(self):
        return two_state_example()


def returns_nothing():
    return None


@pytest.mark.parametrize('name', PLANTS)
def test_each_plant_of_the_library_is_built_from_its_defaults_in_si_to_the_bit(name):
    plant = plant_class(name)
    rows = constants_of(plant)
    assert [row.name for row in rows] == [item.name for item in fields(plant)]
    assert all(row.lower <= row.default <= row.upper and row.description for row in rows)
    from_si = build(plant, {row.name: row.default for row in rows})
    usual = plant().system()
    for attribute in ('nominal_state', 'nominal_input'):
        np.testing.assert_array_equal(getattr(from_si, attribute), getattr(usual, attribute))
    x = 1.01 * usual.nominal_state + 0.01
    np.testing.assert_array_equal(from_si.drift(x), usual.drift(x))
    np.testing.assert_array_equal(from_si.input_matrix(x), usual.input_matrix(x))
    assert all(row.lower <= row.estimated[0] < row.default < row.estimated[1] <= row.upper
               for row in rows if row.estimated)
    # the ends of the ranges, converted there and back, lie within them
    for row in rows:
        for end in (row.lower, row.upper):
            with contextlib.suppress(EquilibriumError):
                build(plant, {row.name: end})


@pytest.mark.parametrize(('plant', 'values', 'message'), [
    (Heater, {'rate': 0.2}, r'rate is 12 1/min, must lie in \[0, 10\] 1/min'),
    (Heater, {'rate': np.nan}, 'rate is nan 1/min, must lie in'),
    (Heater, {'colour': 1.0}, 'constant of Heater'),
    (Plain, {'rate': 1.0}, 'constant of Plain'),
    (returns_nothing, {}, 'returns_nothing returned a NoneType, must be a ControlAffineSystem'),
])
def test_an_error_of_a_plant_names_the_constant(plant, values, message):
    with pytest.raises(ValueError, match=message):
        build(plant, values)


def test_plants_of_other_packages_are_found(monkeypatch, tmp_path):
    (tmp_path / 'greenhouse.py').write_text(
        'from koopman_ros.plants import two_state_example\n'
        'def plant():\n    return two_state_example(mu=-0.2)\n')
    (tmp_path / 'broken.py').write_text('import no_such_module\n')
    (tmp_path / 'greenhouse-1.dist-info').mkdir()
    (tmp_path / 'greenhouse-1.dist-info' / 'METADATA').write_text('Name: greenhouse\nVersion: 1\n')
    (tmp_path / 'greenhouse-1.dist-info' / 'entry_points.txt').write_text(
        '[koopman_ros.plants]\nhouse = greenhouse:plant\n')
    monkeypatch.syspath_prepend(tmp_path)
    for name in ('house', 'greenhouse:plant'):
        plant = plant_class(name)
        assert constants_of(plant) == ()
        assert build(plant, {}).drift(np.array([1.0, 0.0]))[0] == -0.2
    with pytest.raises(ValueError, match="plant 'hose': choose one of reactor"):
        plant_class('hose')
    with pytest.raises(ValueError, match=r"'broken:plant' cannot be loaded "
                                         r"\(ModuleNotFoundError: No module named 'no_such_"):
        plant_class('broken:plant')
