# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Retrainings that try few estimates, and judge by few loops; their pages without a picture."""

from collections.abc import Iterator
import contextlib
from functools import partial
from pathlib import Path

import pytest

from koopman_ros.learning import (
    compare_classes,
    drift_estimation,
    evaluate_model,
    pipeline,
    Thresholds,
)
from koopman_ros.learning.identification import identify_measured, structure_search
from koopman_ros.learning.report import _sections
from support.known_plants import methods


@contextlib.contextmanager
def quick_retraining(loops: int, degrees: tuple[int, ...] = (1, 3),
                     windows: tuple[int, ...] = (20,)) -> Iterator[None]:
    """Estimate by a few methods alone, and try laws in so many loops."""
    fewer = {'degrees': degrees, 'methods': methods(*windows)}
    with pytest.MonkeyPatch.context() as patch:
        for original, *modules in (
                (identify_measured, drift_estimation, structure_search),
                (drift_estimation.identify_non_affine, drift_estimation)):
            def quick(*given, _original=original, **others):
                return _original(*given, **{**others, **fewer})

            for module in modules:
                patch.setattr(module, original.__name__, quick)
        patch.setattr(pipeline, 'compare_classes', partial(compare_classes, loops=loops))
        patch.setattr(pipeline, 'evaluate_model', partial(evaluate_model, loops=loops))
        patch.setattr(pipeline, 'Thresholds', partial(
            Thresholds, plants=2, plant_loops=4, most_failing=0.5))
        yield


def page_of(retrained: pipeline.TrainingResult) -> str:
    """Return what the page of a retraining says; its picture takes half a second to draw."""
    return '\n\n'.join(map(str, _sections(retrained)))


# program of a training in a process of its own that is quick and draws no pictures
QUICK_CHILD = f"""
import os, signal, sys
sys.path.insert(0, {str(Path(__file__).parents[1])!r})
from koopman_ros.learning import report
from koopman_ros.process_entry import run_child
from support.quick_retraining import quick_retraining
report._draw = lambda *_: False
with quick_retraining(8):
    sys.exit(run_child(os.getppid(), signal.SIGKILL, 1, 'koopman_ros.learning.training_process',
                       ()))
"""
# program of a trainer whose trainings, each in its process, are quick and draw no pictures
QUICK_TRAINER = f"""
import sys
from koopman_ros.execution.training import TrainingJob
from koopman_ros.nodes import trainer
TrainingJob.command = lambda *_: (sys.executable, '-c', {QUICK_CHILD!r})
sys.exit(trainer.main())
"""
