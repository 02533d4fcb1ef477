# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What is measured: systems, sizes, limits."""

from dataclasses import dataclass

from validation.benchmarks.options import Extent

TARGETS = {'1e-4': 1e-4, '1e-6': 1e-6, '1e-8': 1e-8}
# Three coordinates, the first of them the state, do not represent the reactor below 1e-8 or so.
SYSTEMS: dict[str, tuple[str, ...]] = {
    'two-state example': ('1e-4', '1e-6', '1e-8'),
    'one-state reactor': ('1e-4', '1e-6'),
}
SOLVERS = {
    'ours': 'ours',
    'ipopt': 'IPOPT, expanded graph',
    'ipopt_compiled': 'IPOPT, compiled graph',
    'lbfgs': 'L-BFGS',
    'adam': 'Adam',
}
REPEATED = 4.0  # s
# The case that is drawn.
DRAWN = (2000, 16)


@dataclass(frozen=True)
class Plan:
    """One extent of the comparison."""

    cases: tuple[tuple[int, int], ...]  #: (samples, hidden units), each for both systems
    limit: float  #: of a solver in a case, s
    build_limit: float  #: of building what a solver solves, s
    megabytes: float  #: limit of the memory
    #: of a solver that takes no longer than :data:`REPEATED`, of which the middle one counts: a
    #: busy moment is long beside a short run
    runs: int = 3
    #: N of the growth of the cost, with n_x = 2, n_z = 3 and 16 hidden units
    samples: tuple[int, ...] = (1000, 10_000, 100_000, 1_000_000)
    #: n_z of the growth of the cost, with n_x = 1, 17 hidden units and N = 2000
    n_z: tuple[int, ...] = (2, 3, 4, 5, 6, 7, 8)
    #: n_x of the growth of the cost, with n_z = n_x + 2, 16 hidden units and N = 2000
    n_x: tuple[int, ...] = (1, 2, 3, 4)


PLANS = {
    Extent.QUICK: Plan(((300, 8),), 1.0, 10.0, 4e3, 1, (1000, 10_000), (2, 3), (1, 2)),
    Extent.DEFAULT: Plan(((300, 8), (2000, 8), (2000, 16), (2000, 32)), 20.0, 60.0, 8e3),
    Extent.FULL: Plan(tuple((samples, hidden) for samples in (300, 2000, 5000)
                            for hidden in (8, 16, 32)), 120.0, 900.0, 16e3),
}


def sizes_of_cost(plan: Plan) -> dict[str, list[dict[str, int]]]:
    """Return what is measured of our learner's cost, by what is varied."""
    def size(samples: int, n_x: int, n_z: int, hidden: int) -> dict[str, int]:
        return {'samples': samples, 'n_x': n_x, 'n_z': n_z, 'hidden': hidden,
                'iterations': max(4, min(30, 100_000 // samples))}

    return {'samples': [size(N, 2, 3, 16) for N in plan.samples],
            'n_z': [size(2000, 1, n_z, 17) for n_z in plan.n_z],
            'n_x': [size(2000, n_x, n_x + 2, 16) for n_x in plan.n_x]}
