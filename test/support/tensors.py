# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Tensors beside each other."""

import numpy as np
import torch


def assert_close(found: torch.Tensor, expected: torch.Tensor, *, rtol: float, atol: float) -> None:
    """Compare as `torch.testing.assert_close`, types and shapes, too; to import that takes 1 s."""
    assert (found.dtype, found.shape) == (expected.dtype, expected.shape)
    np.testing.assert_allclose(found, expected, rtol=rtol, atol=atol, equal_nan=False)
