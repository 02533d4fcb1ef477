# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Checked, read-only arrays."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def frozen(value: ArrayLike, name: str, shape: tuple[int | None, ...], *, finite: bool = True
           ) -> Array:
    """
    Return a read-only float64 copy of `value`, or say what is wrong with it.

    :param shape: expected; None where any length will do, -1 for a size that never fits.
    :param finite: whether infinity is refused as well as what is not a number.
    :raises ValueError: naming both shapes, or the first entry that is refused.
    """
    array = np.array(value, dtype=np.float64)
    fits = array.ndim == len(shape) and all(
        wanted in (None, length) for wanted, length in zip(shape, array.shape, strict=True))
    if not fits:
        raise ValueError(f'incompatible {name}: expected {str(shape).replace("None", "any")}, '
                         f'got {array.shape}')
    refused = ~np.isfinite(array) if finite else np.isnan(array)
    if refused.any():
        position = tuple(map(int, np.argwhere(refused)[0]))
        raise ValueError(f'{name} must be finite: entry {list(position)} is {array[position]}; '
                         'check where that number was computed or measured')
    array.setflags(write=False)
    return array
