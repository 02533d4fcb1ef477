# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Plants by name: those of the library, those of installed packages, and your own."""

from collections.abc import Mapping
from typing import Any

from numpy.typing import ArrayLike

from koopman_ros.core.plugins import contained, load_plugin
from koopman_ros.plants.constants import in_plant_units
from koopman_ros.plants.system import ControlAffineSystem

_LIBRARY = 'koopman_ros.plants.library'
#: the classes of the library by name, each imported on first use
PLANTS = {
    'reactor': f'{_LIBRARY}.reactor:OneStateReactor',
    'two_state': f'{_LIBRARY}.reactor:TwoStateReactor',
    'fed_reactor': f'{_LIBRARY}.reactor:FedReactor',
    'two_state_example': f'{_LIBRARY}.two_state:TwoStateExample',
    'two_tanks': f'{_LIBRARY}.two_tanks:TwoTanks',
    'quadruple_tank': f'{_LIBRARY}.quadruple_tank:QuadrupleTank',
    'pendulum': f'{_LIBRARY}.pendulum:Pendulum',
    'heated_line': f'{_LIBRARY}.heated_line:HeatedLine',
}
#: of packages that offer plants
ENTRY_POINTS = 'koopman_ros.plants'


def plant_class(name: str) -> Any:
    """
    Return the class of a plant, a frozen dataclass of constants with a method `system`.

    :param name: of the library, of an entry point of the group `koopman_ros.plants`, or
        ``package.module:factory``; the latter two may be of any callable that returns a
        ControlAffineSystem, too, which has no constants then.
    :raises ValueError: for a name that stands for no plant; it lists those that there are.
    """
    if name in PLANTS or ':' in name:
        return load_plugin(name, 'plant', PLANTS)
    # in here: no other name needs it
    from importlib.metadata import entry_points

    known = PLANTS | {entry.name: entry.value for entry in entry_points(group=ENTRY_POINTS)
                      if entry.name not in PLANTS}
    if name not in known:
        raise ValueError(f'unknown plant {name!r}: choose one of {", ".join(known)}, or use '
                         'module:Class; a package that provides a plant must be installed and its '
                         'workspace sourced')
    return load_plugin(name, 'plant', known)


def build(plant: Any, values: Mapping[str, float] | None = None,
          nominal_state: ArrayLike | None = None) -> ControlAffineSystem:
    """
    Build a plant.

    >>> build('two_tanks').input_names
    ('pump_1', 'pump_2')

    :param plant: its name, or its class, see :func:`plant_class`.
    :param values: constants in SI, by name, as :func:`constants_of` has them; the default of each
        that is missing.
    :param nominal_state: (n_x,) for a plant that raised EquilibriumError without, only then.
    :raises TypeError: for a plant that is neither.
    :raises ValueError: for an unknown constant or one outside its range, or for a factory that
        returns no ControlAffineSystem.
    :raises EquilibriumError: if the plant raises it.
    """
    plant = plant_class(plant) if isinstance(plant, str) else plant
    if not callable(plant):
        raise TypeError(f"plant must be a name, e.g. 'two_tanks', or a class, got {plant!r}")
    constants = in_plant_units(plant, values or {})
    # a callable need not have a name
    name = getattr(plant, '__name__', type(plant).__name__)
    try:
        made = plant(**constants)
        if not isinstance(made, ControlAffineSystem) and hasattr(made, 'system'):
            made = made.system() if nominal_state is None else made.system(nominal_state)
    except ValueError:
        raise
    except BaseException as error:  # code of one's own may raise anything, SystemExit included
        raise ValueError(f'the plant {name} cannot be constructed ({contained(error)}): correct '
                         'the class') from error
    if not isinstance(made, ControlAffineSystem):
        raise ValueError(f'the plant {name} returned a {type(made).__name__}, must be a '
                         'ControlAffineSystem: return one from the method system')
    return made
