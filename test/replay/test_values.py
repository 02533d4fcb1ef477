# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Values go through JSON bit-identical, and nothing but data comes back."""

from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
import json
import math
import struct

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from koopman_ros.control import Mode, State
from koopman_ros.replay.records import decoded, encoded, float_array, numbers


@dataclass(frozen=True)
class Leaf:
    mode: Mode
    weights: np.ndarray
    note: object = None


FLOATS = st.floats() | st.sampled_from([-0.0, 5e-324, 1.7976931348623157e308, 0.1])
ARRAYS = st.lists(FLOATS, max_size=4).map(np.array) | st.lists(
    FLOATS, min_size=6, max_size=6).map(lambda values: np.array(values).reshape(2, 3)) | (
    st.lists(st.integers(-9, 9), max_size=3).map(lambda values: np.array(values, dtype=int))) | (
    st.just(np.zeros((0, 3))))
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | FLOATS | st.text(max_size=5) | ARRAYS
    | st.sampled_from(Mode) | FLOATS.map(np.float64),
    lambda inner: st.lists(inner, max_size=3).map(tuple) | st.dictionaries(
        st.text(max_size=3).filter(lambda key: key != '@'), inner, max_size=3) | st.builds(
        Leaf, st.sampled_from(Mode), ARRAYS, inner), max_leaves=12)


def same(a: object, b: object) -> bool:
    """Compare bits; all NaN are one."""
    if isinstance(a, np.ndarray):
        return (isinstance(b, np.ndarray) and (a.shape, a.dtype) == (b.shape, b.dtype)
                and same(tuple(a.ravel().tolist()), tuple(b.ravel().tolist())))
    if isinstance(a, float):
        return isinstance(b, float) and (
            (math.isnan(a) and math.isnan(b)) or struct.pack('d', a) == struct.pack('d', b))
    if isinstance(a, tuple):
        return isinstance(b, tuple) and len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, dict):
        return isinstance(b, dict) and list(a) == list(b) and all(
            same(a[key], b[key]) for key in a)
    if is_dataclass(a):
        return type(a) is type(b) and all(
            same(getattr(a, item.name), getattr(b, item.name)) for item in fields(a))
    return type(a) is type(b) and a == b


@given(VALUES)
def test_values_survive_to_the_bit(value: object) -> None:
    assert same(decoded(json.loads(json.dumps(encoded(value), allow_nan=False))), value)


@given(st.lists(FLOATS, max_size=5))
def test_numbers_survive_to_the_bit(values: list[float]) -> None:
    array = np.array(values, dtype=np.float64)
    back = float_array(json.loads(json.dumps(numbers(array), allow_nan=False)))
    assert same(back, array)
    assert not back.flags.writeable


class Plain:
    pass


@pytest.mark.parametrize(('text', 'error'), [
    ({'@': 'os:system'}, ValueError), ({'@': 'subprocess:Popen', 'args': ['true']}, ValueError),
    ({'@': f'{__name__}:Plain'}, ValueError), ({'@': 'no_such_module:State'}, ValueError),
    ({'@': 'koopman_ros.control.state:State', 'other': 1}, TypeError),
    ({'@': f'{Mode.__module__}:Mode', 'name': 'ASLEEP'}, KeyError),
])
def test_only_known_data_is_made(text: dict, error: type[Exception]) -> None:
    with pytest.raises(error):
        decoded(text)


@pytest.mark.parametrize('value', [Plain(), {1, 2}, b'bytes', lambda: None])
def test_what_is_no_data_is_refused(value: object) -> None:
    with pytest.raises(TypeError, match='cannot be written to a record'):
        encoded(value)


def test_first_state_of_a_controller() -> None:
    assert same(decoded(encoded(State())), State())
    assert issubclass(type(State().mode), Enum)
