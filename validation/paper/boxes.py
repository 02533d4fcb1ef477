# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Training boxes and closed-loop paths in three dimensions."""

from collections.abc import Sequence
import itertools
from pathlib import Path
from typing import Any

from mpl_toolkits.mplot3d.art3d import Poly3DCollection
import numpy as np

from koopman_ros.control import ClosedLoop
from koopman_ros.reports import drawing, legend
from validation.paper.two_state import Box


def draw_box(path: Path, parts: Sequence[tuple[str, str, Box, ClosedLoop, str]]) -> None:
    """
    Draw boxes over (x1, x2, u) with the closed-loop paths that their lifts give.

    :param path: the PNG file.
    :param parts: label, face colour, box, path, colour of the path.
    """
    corners = []
    with drawing(path, size=(7.5, 6.0), grid=False,
                 subplot_kw={'projection': '3d'}) as (figure, panels):
        axes: Any = panels[0]
        for label, face, box, loop, color in parts:
            lower = np.array([*box.lower, box.inputs[0]])
            upper = np.array([*box.upper, box.inputs[1]])
            corners += [lower, upper]
            axes.add_collection3d(Poly3DCollection(
                _faces(lower, upper), facecolors=face, edgecolors='black', linewidths=0.8,
                alpha=0.0 if face == 'none' else 0.2,
                linestyles='--' if face == 'none' else '-', label=label))
            points = np.column_stack([loop.states, loop.inputs])
            # what escapes would shrink the boxes to a point
            points = points[np.all(np.abs(points) < 80.0, axis=1)]
            axes.plot(*points.T, color=color, linewidth=2.0, label=f'path with the {label}')
            axes.scatter(*points[0], color=color, s=30)
            corners += [points.min(axis=0), points.max(axis=0)]
        axes.scatter(0.0, 0.0, 0.0, color='black', marker='x', s=40, label='origin')
        low, high = np.min(corners, axis=0), np.max(corners, axis=0)
        axes.set(xlabel='x$_1$', ylabel='x$_2$', zlabel='u  [1/s]', xlim=(low[0], high[0]),
                 ylim=(low[1], high[1]), zlim=(low[2], high[2]))
        axes.view_init(elev=22.0, azim=-60.0)
        legend(figure, [axes], 3)


def _faces(lower: np.ndarray, upper: np.ndarray) -> list[np.ndarray]:
    """Return the six faces of a cuboid, four corners each."""
    faces = []
    for axis, side in itertools.product(range(3), (lower, upper)):
        i, j = (k for k in range(3) if k != axis)
        face = np.tile(side, (4, 1))
        face[:, i] = np.array([lower[i], upper[i], upper[i], lower[i]])
        face[:, j] = np.array([lower[j], lower[j], upper[j], upper[j]])
        faces.append(face)
    return faces
