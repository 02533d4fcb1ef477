# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The outflow of a tank through an orifice by gravity, after Torricelli."""

import numpy as np

from koopman_ros.core.arrays import Array

GRAVITY = 9.81  # m/s^2
# An empty tank stays empty; integrating into the kink of the root undershoots by far less, in m.
LOWEST_LEVEL = -1e-3


def outflow(orifice: Array | float, level: Array) -> Array:
    """Evaluate a sqrt(2 g h), in m^3/s, of an orifice in m^2 and a level in m; 0 below zero."""
    flow: Array = orifice * np.sqrt(2.0 * GRAVITY * np.maximum(level, 0.0))
    return flow


def outflow_slope(orifice: Array | float, level: Array) -> Array:
    """Evaluate its derivative by the level, in m^2/s, which rises without bound towards zero."""
    filled = level > 0.0
    slope: Array = np.where(
        filled, orifice * np.sqrt(0.5 * GRAVITY / np.where(filled, level, 1.0)), 0.0)
    return slope


def level_with_outflow(orifice: Array | float, flow: Array | float) -> Array:
    """Return the level, in m, from which a flow in m^3/s runs out."""
    level: Array = np.square(np.asarray(flow) / orifice) / (2.0 * GRAVITY)
    return level
