# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Share of the range of states and inputs that episodes visit."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from koopman_ros.lifting import Box
from koopman_ros.plant_data import Episode

CELLS = 10  # along each state and input


def visited_cells(episodes: Sequence[Episode], box: Box) -> NDArray[np.int64]:
    """Return the cells (K, n_x + n_u) of the box that measurements and their inputs lie in."""
    found = []
    for episode in episodes:
        u = box.inputs.to_deviation(episode.inputs_at(episode.time))
        scaled = np.hstack([box.states.to_deviation(episode.x), u])
        found.append(np.clip((0.5 * (scaled + 1.0) * CELLS).astype(np.int64), 0, CELLS - 1))
    return np.unique(np.concatenate(found), axis=0)


def coverage(episodes: Sequence[Episode], box: Box) -> float:
    """Return the share of the cells of the box that are visited."""
    cells = visited_cells(episodes, box)
    return len(cells) / float(CELLS) ** cells.shape[1]
