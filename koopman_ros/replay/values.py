# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Values as JSON and back, bit-identical: nested dataclasses, enums, arrays, tuples, mappings, None.

JSON has numbers, texts, lists and objects. What it lacks is an object with the key ``@``, which
says what it is: ``float`` for one that is not finite, ``array``, or the class of a dataclass or
an enum as ``module:name``. Lists become tuples.
"""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
import math
import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

_TAG = '@'


def encoded(value: Any) -> Any:
    """
    Return a value as what :func:`json.dumps` writes without loss.

    :raises TypeError: for what is none of those above.
    """
    if isinstance(value, Enum):
        return {_TAG: _name(type(value)), 'name': value.name}
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else {_TAG: 'float', 'value': repr(value)}
    if isinstance(value, np.ndarray):
        return {_TAG: 'array', 'dtype': value.dtype.str, 'shape': list(value.shape),
                'values': numbers(value.ravel())}
    if isinstance(value, (tuple, list)):
        return [encoded(item) for item in value]
    if isinstance(value, Mapping):
        return {str(key): encoded(item) for key, item in value.items()}
    if is_dataclass(value) and not isinstance(value, type):
        return {_TAG: _name(type(value)), **{
            item.name: encoded(getattr(value, item.name)) for item in fields(value)}}
    raise TypeError(f'a {type(value).__name__} cannot be written to a record')


def decoded(value: Any) -> Any:
    """
    Return the value that :func:`encoded` was given.

    A class is looked up among those that this program has loaded, and has to be a dataclass or an
    enum: no text of a bag imports anything.

    :raises ValueError: for a class that is not known here.
    :raises TypeError: for one that has other fields here.
    """
    if isinstance(value, list):
        return tuple(decoded(item) for item in value)
    if not isinstance(value, dict):
        return value
    rest = {key: item for key, item in value.items() if key != _TAG}
    match value.get(_TAG):
        case None:
            return {key: decoded(item) for key, item in rest.items()}
        case 'float':
            return float(rest['value'])
        case 'array':
            array = np.array([float(item) if isinstance(item, str) else item
                              for item in rest['values']],
                             dtype=np.dtype(rest['dtype'])).reshape(rest['shape'])
            array.setflags(write=False)
            return array
        case name:
            kind = _class(str(name))
            if issubclass(kind, Enum):
                return kind[rest['name']]
            return kind(**{key: decoded(item) for key, item in rest.items()})


def numbers(values: NDArray[Any]) -> list[Any]:
    """Return the numbers (n,) of an array, as texts those that JSON has no number for."""
    return [item if not isinstance(item, float) or math.isfinite(item) else repr(item)
            for item in values.tolist()]


def float_array(values: Any) -> NDArray[np.float64]:
    """
    Return what :func:`numbers` was given.

    :raises TypeError, ValueError: for anything but a list of numbers.
    """
    if not isinstance(values, list):
        raise TypeError(f'{values!r} is no list of numbers')
    array = np.array([float(item) for item in values], dtype=np.float64)
    array.setflags(write=False)
    return array


def _name(kind: type) -> str:
    return f'{kind.__module__}:{kind.__qualname__}'


def _class(name: str) -> type:
    module, _, path = name.partition(':')
    found: Any = sys.modules.get(module)
    for part in path.split('.'):
        found = getattr(found, part, None)
    if not isinstance(found, type) or not (is_dataclass(found) or issubclass(found, Enum)):
        raise ValueError(f'the class {name!r} is not known here')
    return found
