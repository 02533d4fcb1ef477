# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Choice of the terms of a polynomial that has too many of them to estimate all."""

from __future__ import annotations

from collections.abc import Sequence
import math

import numpy as np

from koopman_ros.core.datasets import Array

OVERLAP = 4  # of windows, by three quarters: equations that are worth one
_PATIENCE = 3  # terms that are added in vain
_DEPENDENT = 1e-6  # share of a column that the chosen ones leave


def chosen_terms(left: Array, right: Array, always: Sequence[int]) -> Array:
    """
    Solve left @ coefficients = right with few coefficients other than 0.

    Forward regression with orthogonal least squares (S. Chen, S. A. Billings, W. Luo,
    International Journal of Control 50, 1989) for each column of `right`, which ends where the
    Bayesian information criterion does not fall any more.

    :param left: (K, m) columns of equal length.
    :param right: (K, n).
    :param always: columns that are always used.
    :return: (m, n) coefficients.
    """
    solution = np.zeros((left.shape[1], right.shape[1]))
    for column, target in zip(solution.T, right.T, strict=True):
        terms = _terms(left, target, always)
        column[terms] = np.linalg.lstsq(left[:, terms], target, rcond=1e-12)[0]
    return solution


def _terms(left: Array, target: Array, always: Sequence[int]) -> list[int]:
    """Return the columns that one target needs."""
    count = len(left) / OVERLAP
    basis = np.linalg.qr(left[:, always])[0]
    rest, columns = target - basis @ (basis.T @ target), left - basis @ (basis.T @ left)
    terms, used = [*always], 0
    least = math.inf
    while len(terms) < count:
        # an error below rounding tells nothing
        square = max(float(rest @ rest), 1e-24 * float(target @ target), np.finfo(float).tiny)
        information = count * math.log(square) + len(terms) * math.log(count)
        if information < least:
            least, used = information, len(terms)
        elif len(terms) >= used + _PATIENCE:
            break
        norms = np.linalg.norm(columns, axis=0)
        norms[norms < _DEPENDENT] = math.inf
        norms[terms] = math.inf
        best = int(np.argmax(np.abs(rest @ columns) / norms))
        if not math.isfinite(norms[best]):
            break
        own = columns[:, best] / norms[best]
        rest = rest - own * (own @ rest)
        columns = columns - np.outer(own, own @ columns)
        terms.append(best)
    return terms[:used]
