# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
A disturbance of the data that trainings see, in place of a processor that rounds differently.

``DISTURB_TRAINING=1e-13`` in the environment switches it on. Rounding of one part in 2^53 is
carried that far by the simulations of samples; what a test asks of a training has to hold with it.
"""

import os

import numpy as np

# relative, 0 for none
SIZE = float(os.environ.get('DISTURB_TRAINING') or 0.0)


def disturbed(values: np.ndarray) -> np.ndarray:
    """Return values with relative white noise, the same for the same shape; as they are for 0."""
    if not SIZE:
        return values
    return values * (1.0 + SIZE * np.random.default_rng(2026).standard_normal(values.shape))


def disturbed_data(data):
    """Return samples as a minimisation sees them, disturbed likewise."""
    import torch
    arrays = (data.x, data.f, data.u)
    return type(data)(*(None if array is None else torch.from_numpy(disturbed(array.numpy()))
                        for array in arrays))


def disturb_training() -> None:
    """Disturb what `train` hands to its starts; figures and digests are of the data as given."""
    if not SIZE:
        return
    from koopman_ros.learning.lift import scaling
    original = scaling.ScaledSamples
    scaling.ScaledSamples = lambda *arrays: disturbed_data(original(*arrays))
