# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Other methods: ARX, N4SID, polynomial NARX and EDMDc.

Each takes records (u, y) of (N, n_u) and (N, n_y), of zero mean and unit spread, and returns a
free run from inputs (N, n_u) and first outputs (init, n_y) to outputs (N, n_y). Its options, with
a dead time of the inputs, are those with the best free run on held-out data: each record in turn,
or the last third of the only one. Then it learns from everything.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TypeAlias

import numpy as np
import pandas as pd
from scipy.linalg import lstsq

from koopman_ros.core.arrays import Array

Data: TypeAlias = tuple[Array, Array]
FreeRun: TypeAlias = Callable[[Array, Array], Array]
_ROWS = 20  # of the block Hankel matrices of N4SID


def arx(records: Sequence[Data], order: int) -> FreeRun:
    """Fit each output from past outputs and inputs, as many as `order`, by least squares."""
    def row(u: Array, y: Array, t: int) -> Array:
        return np.concatenate([[1.0], y[t - order:t].ravel(), u[t - order:t].ravel()])

    rows = np.array([row(u, y, t) for u, y in records for t in range(order, len(y))])
    found = lstsq(rows, np.concatenate([y[order:] for _, y in records]))[0]

    def run(u: Array, begin: Array) -> Array:
        y = np.vstack([begin, np.empty((len(u) - len(begin), begin.shape[1]))])
        for t in range(len(begin), len(u)):
            y[t] = row(u, y, t) @ found
        return y

    return run


def n4sid(records: Sequence[Data], order: int) -> FreeRun:
    """Identify from the record, as NFourSID takes one, that simulates all of them best."""
    def error(run: FreeRun) -> float:
        return float(sum(np.sum((run(u, y[:_ROWS]) - y) ** 2) for u, y in records))

    return min((_n4sid(*one, order) for one in records), key=error)


def _n4sid(u: Array, y: Array, order: int) -> FreeRun:
    """Identify a state space of an order."""
    from nfoursid.nfoursid import NFourSID
    n_u, n_y = u.shape[1], y.shape[1]
    program = NFourSID(pd.DataFrame(np.hstack([u, y]), columns=range(n_u + n_y)),
                       [*range(n_u, n_u + n_y)], [*range(n_u)], num_block_rows=_ROWS)
    program.subspace_identification()
    found = program.system_identification(order)[0]

    def outputs(u: Array, x: Array) -> Array:
        y = np.empty((len(u), n_y))
        for t, now in enumerate(u):
            y[t] = found.c @ x + found.d @ now
            x = found.a @ x + found.b @ now
        return y

    def run(u: Array, begin: Array) -> Array:
        size, rest = len(begin), np.zeros(order)
        # the state at the start by least squares
        responses = [outputs(0.0 * u[:size], unit).ravel() for unit in np.identity(order)]
        x = lstsq(np.transpose(responses), (begin - outputs(u[:size], rest)).ravel())[0]
        return outputs(u, x)

    return run


def narx(records: Sequence[Data], order: int, degree: int) -> FreeRun:
    """Choose terms of a polynomial of past samples for each output, by SysIdentPy's FROLS."""
    from sysidentpy.basis_function import Polynomial
    from sysidentpy.model_structure_selection import FROLS
    from sysidentpy.parameter_estimation import LeastSquares
    u, y = (np.concatenate(parts) for parts in zip(*records, strict=True))
    lags = [*range(1, order + 1)]
    programs = [FROLS(
        order_selection=True, n_info_values=15, info_criteria='bic', ylag=lags,
        xlag=[lags] * u.shape[1] if u.shape[1] > 1 else lags, estimator=LeastSquares(),
        basis_function=Polynomial(degree=degree)) for _ in range(y.shape[1])]
    for program, output in zip(programs, y.T, strict=True):
        program.fit(X=u, y=output[:, None])

    def run(u: Array, begin: Array) -> Array:
        early = len(begin) - order
        return np.vstack([begin, np.column_stack([
            program.predict(X=u[early:], y=output[early:, None])[order:, 0]
            for program, output in zip(programs, begin.T, strict=True)])])

    return run


def edmdc(records: Sequence[Data], delays: int, degree: int, ridge: int) -> FreeRun:
    """Fit pykoop's EDMD with inputs on monomials of delayed samples."""
    import pykoop
    n_u, n_y = records[0][0].shape[1], records[0][1].shape[1]
    program = pykoop.KoopmanPipeline([
        ('delays', pykoop.DelayLiftingFn(n_delays_state=delays, n_delays_input=delays)),
        ('monomials', pykoop.PolynomialLiftingFn(order=degree))], pykoop.Edmd(alpha=10.0 ** ridge))
    program.fit(np.vstack([np.hstack([np.full((len(y), 1), k), y, u])
                           for k, (u, y) in enumerate(records)]), n_inputs=n_u,
                episode_feature=True)

    def run(u: Array, begin: Array) -> Array:
        early = len(begin) - program.min_samples_
        return np.vstack([begin[:early], program.predict_trajectory(
            begin[early:], u[early:], episode_feature=False)[:, :n_y]])

    return run


@dataclass(frozen=True)
class Baseline:
    """A method, the package that it needs, and the values of its options that are tried."""

    fit: Callable[..., FreeRun]
    package: str
    options: Mapping[str, Sequence[int]]


_DELAYS = (-1, 0, 1, 2)  # samples; -1 lets the input of a sample act on its output
BASELINES = {
    'ARX': Baseline(arx, 'numpy', {'order': range(1, 11)}),
    'N4SID': Baseline(n4sid, 'nfoursid', {'order': range(1, 11)}),
    'NARX': Baseline(narx, 'sysidentpy', {'order': (1, 2, 3, 4), 'degree': (2, 3)}),
    'EDMDc': Baseline(edmdc, 'pykoop', {
        'delays': (0, 2, 5), 'degree': (1, 2), 'ridge': (-6, -2)})}


def chosen(baseline: Baseline, records: list[Data], init: int
           ) -> tuple[FreeRun, dict[str, int]]:
    """Return a free run by the best options, and these."""
    parts = [(records[:k] + records[k + 1:], records[k]) for k in range(len(records))]
    if len(records) == 1:
        (u, y), cut = records[0], 2 * len(records[0][1]) // 3
        parts = [([(u[:cut], y[:cut])], (u[cut:], y[cut:]))]
    errors: dict[tuple[int, ...], float] = {}
    for values in product(_DELAYS, *baseline.options.values()):
        try:
            errors[values] = sum(
                float(np.sum((_fitted(baseline, some, values)(u, y[:init]) - y)[init:] ** 2))
                for some, (u, y) in parts)
        except (ValueError, ArithmeticError, np.linalg.LinAlgError):
            errors[values] = np.inf  # too few samples for so many terms, or a divergence
    best = min(errors, key=lambda values: np.nan_to_num(errors[values], nan=np.inf))
    return _fitted(baseline, records, best), dict(
        zip(('delay', *baseline.options), best, strict=True))


def _fitted(baseline: Baseline, records: Sequence[Data], values: Sequence[int]) -> FreeRun:
    delay, *options = values

    def late(u: Array) -> Array:
        return u[np.clip(np.arange(len(u)) - delay, 0, len(u) - 1)]

    run = baseline.fit([(late(u), y) for u, y in records], *options)
    return lambda u, begin: run(late(u), begin)
