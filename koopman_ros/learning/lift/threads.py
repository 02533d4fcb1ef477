# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""How many threads torch works with, of which the bits of its sums depend."""

from collections.abc import Generator
import contextlib

import torch


@contextlib.contextmanager
def torch_threads(count: int) -> Generator[None]:
    """Let torch work with so many threads for a while."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
