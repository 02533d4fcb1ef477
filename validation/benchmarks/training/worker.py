# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
One measurement in a process of its own.

What is noted goes line by line to a file, so that a process that has to be killed leaves what it
had reached.
"""

from collections.abc import Callable
import json
from pathlib import Path
from typing import Any

import torch

from validation.benchmarks.training import cost, problems, torch_solvers
from validation.benchmarks.training.trace import Tell, Trace


def prepare(tell: Tell, system: str, samples: int, hidden: int, path: str) -> None:
    """Build a case and write it."""
    case = problems.SYSTEMS[system](samples, hidden)
    case.save(Path(path))
    tell({'parameters': case.layout.size})


def solve(tell: Tell, solver: str, path: str, targets: list[float], limit: float) -> None:
    """Run one solver on one case."""
    case = problems.load(Path(path))
    trace = Trace(case, targets, limit, tell)
    if solver.startswith('ipopt'):
        try:
            from validation.benchmarks.training import ipopt
        except ImportError:
            tell({'error': 'casadi is not installed: pip install -e ".[bench]"'})
            return
        run = ipopt.compiled if solver == 'ipopt_compiled' else ipopt.expanded
    else:
        run = {'ours': torch_solvers.ours, 'lbfgs': torch_solvers.lbfgs,
               'adam': torch_solvers.adam}[solver]
    trace.close(run(case, trace))


def measure(tell: Tell, sizes: list[dict[str, int]]) -> None:
    """Measure what an iteration of our learner takes."""
    for size in sizes:
        tell({**size, **cost.measure(**size)})


JOBS: dict[str, Callable[..., None]] = {'prepare': prepare, 'solve': solve, 'measure': measure}


def main(job: dict[str, Any], events: Path) -> None:
    """
    Do one job.

    :param job: the name of the job under ``'do'``, and its arguments.
    :param events: the file for what is noted, one JSON object a line.
    """
    torch.set_num_threads(1)
    with events.open('a') as stream:
        def tell(event: dict[str, Any]) -> None:
            stream.write(json.dumps(event) + '\n')
            stream.flush()

        try:
            JOBS[job['do']](tell, **{name: value for name, value in job.items() if name != 'do'})
        except (RuntimeError, MemoryError) as error:
            tell({'error': str(error) or type(error).__name__})
