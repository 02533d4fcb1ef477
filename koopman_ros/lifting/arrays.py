# Copyright 2026 The koopman_ros Authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""What the modules of a lift share about arrays."""

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
