# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What holds for all tests of solvers."""

import os

import pytest
import torch


@pytest.fixture(autouse=True, scope='session')
def _one_thread():
    """Small problems are slower on several threads, and far slower where others use the cores."""
    if 'OMP_NUM_THREADS' not in os.environ:
        torch.set_num_threads(1)
