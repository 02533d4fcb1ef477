# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Linear plants between samples, by the matrix exponential."""

import numpy as np
from scipy.linalg import expm


def sampled(A: np.ndarray, B: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the transition and the gain of dx/dt = A x + B u over a period with u held."""
    n, m = B.shape
    whole = expm(period * np.block([[A, B], [np.zeros((m, n + m))]]))
    return whole[:n, :n], whole[:n, n:]
