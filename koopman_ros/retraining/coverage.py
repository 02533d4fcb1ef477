# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0


"""How much of the range of states and inputs some records visit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from koopman_ros.identification import Box, Record

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
