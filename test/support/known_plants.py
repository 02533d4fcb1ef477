# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Plants whose drift is a known polynomial, and records of them by an independent integrator."""

from dataclasses import dataclass
import math

import numpy as np
from scipy.integrate import solve_ivp

from koopman_ros.core.datasets import Episode, PlantDescription
from koopman_ros.learning.identification import (
    DriftModel,
    IdentificationMethod,
    TotalVariation,
    WeakForm,
    WeakFormParameters,
)
from koopman_ros.model import Box, Coordinates
from support.disturbance import disturbed


def names(letter: str, count: int) -> tuple[str, ...]:
    return tuple(f'{letter}{i + 1}' for i in range(count))


def box(state_lower, state_upper, input_lower, input_upper) -> Box:
    return Box(*(Coordinates.spanning(names(letter, len(lower)), ('1',) * len(lower),
                                      np.array(lower), np.array(upper))
                 for letter, lower, upper in (('x', state_lower, state_upper),
                                              ('u', input_lower, input_upper))), 's')


def methods(*windows: int) -> dict[str, IdentificationMethod]:
    """Return few methods to choose from: the weak form with some windows, total variation."""
    return {'weak_form': WeakForm(WeakFormParameters(windows)),
            'total_variation': TotalVariation()}


@dataclass(frozen=True)
class KnownPlant:
    """dx/dt = f(x) + B u, f a polynomial."""

    #: (m, n_x + 1) exponents of the states in each term, then the row that it is in
    terms: tuple[tuple[int, ...], ...]
    coefficients: tuple[float, ...]  #: (m,) of the terms
    B: np.ndarray  #: (n_x, n_u)

    @property
    def plant(self) -> PlantDescription:
        """What an identification is told: names and units, B not among it."""
        n_x, n_u = self.B.shape
        return PlantDescription('known', names('x', n_x), ('m',) * n_x, names('u', n_u),
                                ('A',) * n_u, 's',
                                np.zeros(n_x), np.zeros(n_u), None)

    def rate(self, x, u):
        """Evaluate dx/dt: (..., n_x) and (..., n_u) -> (..., n_x)."""
        dxdt = u @ self.B.T
        for (*powers, row), c in zip(self.terms, self.coefficients, strict=True):
            dxdt[..., row] += c * np.prod(x ** np.array(powers), axis=-1)
        return dxdt

    def states(self, x0, times, input_time, u):
        """Integrate from hold to hold with DOP853 and return the states at the times."""
        x, found = np.asarray(x0, dtype=np.float64), np.empty((len(times), len(x0)))
        edges = np.append(input_time, np.inf)
        for k, held in enumerate(u):
            begin, end = max(edges[k], times[0]), min(edges[k + 1], times[-1])
            if end < begin:
                continue
            rows = np.flatnonzero((times >= begin) & (times <= end))
            stops = np.union1d(times[rows], [begin, end])
            if len(stops) == 1:
                found[rows] = x
                continue
            path = solve_ivp(self._under(held), (begin, end), x, method='DOP853', rtol=1e-11,
                             atol=1e-13, t_eval=stops).y.T
            found[rows] = path[np.searchsorted(stops, times[rows])]
            x = path[-1]
        return found

    def _under(self, u):
        """Return the rate of one state under an input: of few numbers, without numpy."""
        constant = (self.B @ u).tolist()
        terms = [(c, powers, row) for (*powers, row), c in zip(
            self.terms, self.coefficients, strict=True)]

        def rate(_, x):
            found = constant.copy()
            for c, powers, row in terms:
                found[row] += c * math.prod(map(pow, x.tolist(), powers))
            return found

        return rate

    def record(self, times, input_time, u, *, x0=None, noise=0.0, seed=0):
        """Return a record with white noise of standard deviation `noise` on each state."""
        start = np.zeros(len(self.B)) if x0 is None else x0
        x = self.states(start, times, input_time, u)
        noisy = x + noise * np.random.default_rng(seed).standard_normal(x.shape)
        return Episode(times, disturbed(noisy), input_time, u)

    def excited(self, count, period, *, noise=0.0, seed=0, level=1.0, hold=20):
        rng = np.random.default_rng(seed)
        steps = np.arange(0, count, hold) + rng.integers(0, hold // 2, -(-count // hold))
        steps[0] = 0
        u = rng.uniform(-level, level, (len(steps), self.B.shape[1]))
        return self.record(period * np.arange(count), period * steps, u, noise=noise,
                           seed=seed + 1000)

    def irregular(self, count, changes, periods, *, seed):
        """Return a clean record at irregular times, of inputs that change between them."""
        rng = np.random.default_rng(seed)
        times = np.cumsum(rng.uniform(*periods, count))
        edges = np.concatenate(([0.0], np.sort(rng.uniform(0.0, times[-1], changes))))
        return self.record(times, edges, rng.uniform(-1.0, 1.0, (changes + 1, self.B.shape[1])))

    def misfit(self, model: DriftModel, box: Box | None = None) -> float:
        """Return the largest error of a model's rates over a box, relative to their size."""
        box = box or model.box
        axes = [np.linspace(low, high, 9) for low, high in (
            *zip(box.states.lower, box.states.upper, strict=True),
            *zip(box.inputs.lower, box.inputs.upper, strict=True))]
        grid = np.stack([axis.ravel() for axis in np.meshgrid(*axes)], axis=-1)
        x, u = grid[:, :len(self.B)], grid[:, len(self.B):]
        true = self.rate(x, u)
        return float(np.max(np.abs(model.rate(x, u) - true) / np.max(np.abs(true), axis=0)))


# dx/dt = 0.5 - x + 0.3 x^2 - 0.2 x^3 + 1.5 u
CUBIC = KnownPlant(((0, 0), (1, 0), (2, 0), (3, 0)), (0.5, -1.0, 0.3, -0.2), np.array([[1.5]]))
# dx1/dt = -x1 + 0.5 x2 + u1, dx2/dt = -2 x2 + 0.4 x1^2 + 0.3 u1 + 2 u2
PAIR = KnownPlant(((1, 0, 0), (0, 1, 0), (0, 1, 1), (2, 0, 1)), (-1.0, 0.5, -2.0, 0.4),
                  np.array([[1.0, 0.0], [0.3, 2.0]]))
