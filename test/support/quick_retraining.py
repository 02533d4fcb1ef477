# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Retrainings that try few estimates, and judge by few loops; their pages without a picture."""

from collections.abc import Iterator
import contextlib
from functools import partial

import pytest

from koopman_ros.learning import compare_classes, evaluate_model
from koopman_ros.learning import pipeline as task_module
from koopman_ros.learning.identification import identify_with_characteristics, structure_search
from koopman_ros.learning.report import _sections
from support.known_plants import methods


@contextlib.contextmanager
def quick_retraining(loops: int, degrees: tuple[int, ...] = (1, 3),
                     windows: tuple[int, ...] = (20,)) -> Iterator[None]:
    """Estimate by a few methods alone, and try laws in so many loops."""
    fewer = {'degrees': degrees, 'methods': methods(*windows)}
    with pytest.MonkeyPatch.context() as patch:
        for original, *modules in (
                (identify_with_characteristics, task_module, structure_search),
                (task_module.identify_non_affine, task_module)):
            def quick(*given, _original=original, **others):
                return _original(*given, **{**others, **fewer})

            for module in modules:
                patch.setattr(module, original.__name__, quick)
        patch.setattr(task_module, 'compare_classes', partial(compare_classes, loops=loops))
        patch.setattr(task_module, 'evaluate_model', partial(evaluate_model, loops=loops))
        yield


def page_of(retrained: task_module.Retrained) -> str:
    """Return what the page of a retraining says; its picture takes half a second to draw."""
    return '\n\n'.join(map(str, _sections(retrained)))
