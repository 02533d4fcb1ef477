# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Retrainings that try few estimates, and judge by few loops."""

from collections.abc import Iterator
import contextlib
from functools import partial

import pytest

from koopman_ros.retraining import compare_classes, decide
from koopman_ros.retraining import task as task_module
from support.known_plants import methods


@contextlib.contextmanager
def quick_retraining(loops: int) -> Iterator[None]:
    """Estimate by a few methods alone, and try laws in so many loops."""
    original = task_module.identify
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(task_module, 'identify',
                      partial(original, degrees=(1, 3), methods=methods(20)))
        patch.setattr(task_module, 'compare_classes', partial(compare_classes, loops=loops))
        patch.setattr(task_module, 'decide', partial(decide, loops=loops))
        yield
