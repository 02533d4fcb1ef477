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


"""How much of the range of states and inputs some records visit."""

from __future__ import annotations

from collections.abc import Sequence

from koopman_ros.identification import Box, Record
import numpy as np
from numpy.typing import NDArray

CELLS = 10  # along each state and input


def visited_cells(records: Sequence[Record], box: Box) -> NDArray[np.int64]:
    """Return the cells (K, n_x + n_u) of the box that measurements and their inputs lie in."""
    found = []
    for record in records:
        u = box.input_deviation(record.inputs_at(record.time))
        scaled = np.hstack([box.state_deviation(record.x), u])
        found.append(np.clip((0.5 * (scaled + 1.0) * CELLS).astype(np.int64), 0, CELLS - 1))
    return np.unique(np.concatenate(found), axis=0)


def coverage(records: Sequence[Record], box: Box) -> float:
    """Return the share of the cells of the box that are visited."""
    cells = visited_cells(records, box)
    return len(cells) / float(CELLS) ** cells.shape[1]
