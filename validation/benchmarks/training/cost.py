# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What one iteration of our learner takes, in seconds and in memory."""

import ctypes
import math
from pathlib import Path
from statistics import median
import time

from torch import Tensor

from koopman_ros.learning.levenberg_marquardt import minimise, NormalEquations
from validation.benchmarks.training.problems import artificial

_STATUS, _RESET = Path('/proc/self/status'), Path('/proc/self/clear_refs')


def measure(samples: int, n_x: int, n_z: int, hidden: int, iterations: int
            ) -> dict[str, float | None]:
    """
    Run a few iterations and time those whose step is taken.

    :param samples: N.
    :param iterations: how many steps that are taken; the median counts.
    :return: processor time of an accepted step in s, and the peak memory in MB beyond that of the
        process with the data (None where the system does not tell it).
    """
    # what torch sets up at its first calls belongs to neither figure
    warm = artificial(256, n_x, n_z, hidden)
    minimise(warm.problem.add_residuals, warm.theta, max_iterations=2)
    case = artificial(samples, n_x, n_z, hidden)
    problem = case.problem
    before = _restart_peak()
    taken: list[float] = []
    stamp, accepted = math.nan, False

    def residuals(theta: Tensor, equations: NormalEquations) -> None:
        nonlocal accepted
        accepted |= equations.derivatives
        problem.add_residuals(theta, equations)

    def monitor(iteration: int, cost: float) -> bool:
        nonlocal stamp, accepted
        # the first iteration holds the evaluation at the start as well; a refused step is cheaper
        if accepted and iteration > 1:
            taken.append(time.process_time() - stamp)
        stamp, accepted = time.process_time(), False
        return len(taken) == iterations

    minimise(residuals, case.theta, max_iterations=10 * iterations, tolerance=0.0, monitor=monitor)
    after = _memory('VmHWM')
    return {'seconds_per_iteration': median(taken),
            'peak_megabytes': None if before is None or after is None else after - before}


def _restart_peak() -> float | None:
    """Let the system forget the peak of the memory; return the present memory in MB."""
    # what the data took on the way is given back, or the iterations would be seen to use that
    if trim := getattr(ctypes.CDLL(None), 'malloc_trim', None):
        trim(0)
    try:
        # what the preparation freed would hide what the iterations take
        ctypes.CDLL(None).malloc_trim(0)
        _RESET.write_text('5')
    except (OSError, AttributeError):
        return None
    return _memory('VmRSS')


def _memory(name: str) -> float | None:
    try:
        lines = _STATUS.read_text().splitlines()
    except OSError:
        return None
    return next((float(line.split()[1]) / 1024.0 for line in lines if line.startswith(name)), None)
