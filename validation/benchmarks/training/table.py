# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The figures as text."""

from collections.abc import Iterator
from typing import Any

from validation.benchmarks.training.plan import SOLVERS, TARGETS


def of_case(case: dict[str, Any]) -> Iterator[str]:
    """Write one case: seconds to each rw, and in brackets how many times ours that is."""
    yield (f'{case["system"]}, N = {case["samples"]}, {case["hidden"]} hidden units, '
           f'{case["parameters"]} parameters: seconds to rw (times ours)')
    yield f'{"":24}' + ''.join(f'{name:>18}' for name in TARGETS) + f'{"build":>9}  '
    for solver, label in SOLVERS.items():
        cells = ''.join(f'{_cell(case, name, solver):>18}' for name in TARGETS)
        build = case.get(f'{solver}_build_seconds')
        note = '' if not case['notes'].get(solver) else f'  {case["notes"][solver]}'
        yield (f'{label:24}{cells}' + (f'{"-":>9}' if build is None else f'{build:7.1f} s')
               + note)


def _cell(case: dict[str, Any], name: str, solver: str) -> str:
    seconds = case['seconds'][name][solver]
    if seconds is None:
        return '-'
    ratio = case['ratio_to_ours'][name].get(solver)
    return f'{seconds:.3g}' + (f' ({ratio:.1f})' if ratio else '' if solver == 'ours' else ' (-)')


def of_cost(figures: dict[str, Any]) -> Iterator[str]:
    """Write how the cost of an iteration grows."""
    for title, name in (('N (n_x = 2, n_z = 3, 16 hidden units)', 'samples'),
                        ('n_z (n_x = 1, 17 hidden units, N = 2000)', 'n_z'),
                        ('n_x (n_z = n_x + 2, 16 hidden units, N = 2000)', 'n_x')):
        yield f'cost of an iteration by {title}'
        memory = figures.get('peak_memory_by_samples', {}) if name == 'samples' else {}
        for size, seconds in figures[f'seconds_per_iteration_by_{name}'].items():
            peak = memory.get(size)
            yield f'{int(size):10d}{1e3 * seconds:12.3f} ms' + (
                '' if peak is None else f'{peak:12.1f} MB')
