# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Checked, read-only arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def frozen(value: ArrayLike, name: str, shape: tuple[int, ...]) -> Array:
    """
    Return a read-only float64 copy of `value`, or say what is wrong with it.

    :param value: what should be finite and of this shape.
    :param name: what an error calls it.
    :param shape: expected; -1 stands for a size that `value` itself lacks, and never fits.
    :raises ValueError: naming both shapes, or values that are not finite.
    """
    array = np.array(value, dtype=np.float64, copy=True)
    if array.shape != shape:
        raise ValueError(f'incompatible {name}: expected {shape}, got {array.shape}')
    if not np.all(np.isfinite(array)):
        raise ValueError(f'{name} holds values that are not finite')
    array.setflags(write=False)
    return array
