# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Records of a reactor in many bags, each longer than an hour."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from koopman_ros.learning import TrainingTask
from koopman_ros.learning.record import Source
from validation.benchmarks.retraining import cases, task_of, write_bags

CASE = replace(cases()['reactor at 1 Hz'], bag=4000)


def bags_of(count: int, folder: Path) -> list[Path]:
    """Write so many bags."""
    return write_bags(CASE, count * CASE.bag, folder)


def task(bags: Sequence[Path], output: Path) -> TrainingTask:
    """Return the task of a first lift from some bags."""
    return task_of(CASE, bags, output)


def source(bags: Sequence[Path]) -> Source:
    """Return how some bags are read."""
    given = task(bags, Path('none.safetensors'))
    return Source(given.bags, given.states, given.inputs, 0, None)
