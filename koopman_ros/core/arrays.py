# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Checked, read-only arrays."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
import math
import reprlib
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

# Arrays and lists of so few are written out where something is described.
_FEW = 4


def along_last(*parts: ArrayLike) -> Array:
    """Join numbers or arrays of one shape along a new last axis, in a fifth of stack's time."""
    joined = np.empty((*np.shape(parts[0]), len(parts)))
    for i, part in enumerate(parts):
        joined[..., i] = part
    return joined


def short_repr(holder: object) -> str:
    """Describe a dataclass or named tuple on one line: long arrays by shape, others by name."""
    names = getattr(holder, '_fields', ()) or [
        field.name for field in fields(cast(Any, holder)) if field.repr]
    shown = ', '.join(f'{name}={_brief(getattr(holder, name))}' for name in names)
    return f'{type(holder).__name__}({shown})'


def show_printed(holder: object, printer: Any, cycle: bool) -> None:
    """Show in a notebook the text that ``print`` shows, as ``_repr_pretty_`` of a class."""
    printer.text(repr(holder) if cycle else str(holder))


def _brief(value: object) -> str:
    if isinstance(value, np.ndarray):
        few = value.ndim == 1 and len(value) <= _FEW
        return f'[{", ".join(f"{number:.6g}" for number in value)}]' if few else (
            f'<array {value.shape}>')
    named = isinstance(value, tuple) and type(value) is not tuple
    if named or (is_dataclass(value) and not isinstance(value, type)):
        return f'{type(value).__name__}(...)'
    if isinstance(value, tuple | list | Mapping):
        plain = len(value) <= _FEW and all(isinstance(item, str | int | float) for item in value)
        return repr(value) if plain or not value else f'<{len(value)} items>'
    return repr(value)


def expect(**given: tuple[object, type]) -> None:
    """Raise TypeError for an argument that is not an instance of its class."""
    for name, (value, kind) in given.items():
        if not isinstance(value, kind):
            raise TypeError(f'{name} must be of the class {kind.__name__}, got '
                            f'{type(value).__name__}: check the order of the arguments')


def real(value: ArrayLike, name: str) -> Array:
    """Return numbers as a float64 array; ValueError for complex or non-numeric ones."""
    array = np.asarray(value)
    if array.dtype == np.float64:
        return array
    if np.iscomplexobj(array):
        raise ValueError(f'{name} must be real, got complex numbers: pass their real part')
    try:
        return np.asarray(array, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f'{name} must be numbers, got {reprlib.repr(value)}') from error


def frozen(value: ArrayLike, name: str, shape: tuple[int | None, ...], *, finite: bool = True
           ) -> Array:
    """
    Return a read-only float64 copy of `value`, or raise an error that describes its defect.

    :param shape: expected; None where any length will do, -1 for a size that never fits.
    :param finite: whether infinity is rejected as well as NaN.
    :raises ValueError: naming both shapes, or the first entry that is rejected.
    """
    array = real(value, name).copy()
    fits = array.ndim == len(shape) and all(
        wanted in (None, length) for wanted, length in zip(shape, array.shape, strict=True))
    if not fits:
        raise ValueError(f'incompatible {name}: expected {str(shape).replace("None", "any")}, '
                         f'got {array.shape}')
    rejected = ~np.isfinite(array) if finite else np.isnan(array)
    if rejected.any():
        position = tuple(map(int, np.argwhere(rejected)[0]))
        raise ValueError(f'{name} must be finite, but entry {list(position)} is '
                         f'{array[position]}: check its source')
    array.setflags(write=False)
    return array


def change_within(rate: Array, seconds: float) -> Array:
    """Return the largest changes (n,) at rates (n,); infinite for an infinite one, even in 0 s."""
    return rate * seconds if seconds > 0.0 else np.where(np.isinf(rate), np.inf, 0.0)


def pseudo_inverse(A: Array) -> Array:
    """
    Return the pseudo-inverse (..., n, m) of matrices (..., m, n).

    :raises numpy.linalg.LinAlgError: for numbers that are not finite, for which LAPACK's singular
        value decomposition may never end.
    """
    if not np.isfinite(A).all():
        raise np.linalg.LinAlgError('the pseudo-inverse of a matrix that is not finite')
    return np.asarray(np.linalg.pinv(A), dtype=np.float64)


def differ(values: Array, others: Array, scale: Array, tolerance: float = 1e-9) -> bool:
    """
    Return whether any of some numbers (n,) differs from another by more than rounding.

    :param scale: (n,) positive, in their units.
    :param tolerance: of the scale: far above the rounding error of a control step, which depends
        on the BLAS kernel, and below the resolution of any actuator.
    """
    return bool((np.abs(values - others) > tolerance * scale).any())


def all_finite(vector: Array) -> bool:
    """Return whether all numbers (n,) are finite, for a few of them in a fifth of NumPy's time."""
    return all(map(math.isfinite, vector.tolist()))


def read_only(value: ArrayLike) -> Array:
    """Return a read-only copy of numbers."""
    copy = np.array(value, dtype=np.float64)
    copy.setflags(write=False)
    return copy
