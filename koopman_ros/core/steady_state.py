# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Steady states: the target problem of a controller, with limits.

For a rate F of y = (states, inputs), least squares in order of importance within limits of y::

    F(y) = 0                    the plant rests
    min |y_goal - values|^2     as near to the goal as possible
    min |y - anchor|^2          and, of all solutions, nearest to an anchor

Newton's method linearises F; each linear problem is solved by an active-set method for bounded
least squares (C. L. Lawson, R. J. Hanson, Solving Least Squares Problems, ch. 23; for several
ranks of importance A. Escande, N. Mansard, P.-B. Wieber, Int. J. Robot. Res. 33 (2014)).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from koopman_ros.core.arrays import Array


@dataclass(frozen=True)
class SteadyStateSettings:
    """
    Settings of the search; its variables have a magnitude of about 1.

    The exported C code has the same search, with the same numbers.
    """

    #: a step this short is the last one, and the plant rests if such a step would bring it to rest
    tolerance: float = 1e-10
    #: steps at most; a search far from any fold takes three to ten
    steps: int = 80
    #: changes of the set of active limits at most, for each variable
    changes: int = 10
    #: a singular value below this share of the matrix's norm counts as 0
    rank: float = 1e-10
    #: a step is repeated at half the length if what curvature leaves of the rate takes a step of
    #: more than this share of it
    curvature: float = 0.5
    #: a fold, where the way to the goal ends, is reached if so short steps are the longest
    #: possible ones that they lead nearer by at most this share of the distance
    fold: float = 1e-9
    #: or if the goal comes nearer by less than this share of what the linearisation promises
    progress: float = 0.1


class Goal(NamedTuple):
    """Values that some of the variables should have."""

    places: NDArray[np.intp]  #: (k,) which
    values: Array  #: (k,)


#: no variable should have a particular value
NO_GOAL = Goal(np.zeros(0, dtype=np.intp), np.zeros(0))


def steady_state(rate: Callable[[Array], Array], slope: Callable[[Array], Array], start: Array,
                 lower: Array, upper: Array, goal: Goal = NO_GOAL, anchor: Array | None = None,
                 settings: SteadyStateSettings = SteadyStateSettings()) -> Array | None:
    """
    Find the steady state nearest to a goal, and of those that are as near to an anchor.

    :param rate: F, (n,) -> (m,).
    :param slope: its derivative, (n,) -> (m, n).
    :param start: (n,) where the search begins; of several solutions it follows this one.
    :param lower: (n,) limits, to `upper` (n,); a variable between two equal ones is given.
    :param anchor: (n,), 0 by default.
    :return: (n,), or None where none was found: within the limits nothing rests, or the search
        did not converge.
    """
    y, every = np.minimum(np.maximum(start, lower), upper), np.eye(len(start))
    wanted, anchor = every[goal.places], np.zeros(len(y)) if anchor is None else anchor
    radius, share, fresh = np.inf, 1.0, True
    last, damping = np.zeros(len(y)), 1.0

    def missed(place: Array) -> float:
        return float(np.linalg.norm(wanted.dot(place) - goal.values))

    def at_rest(place: Array, left: Array, *others: tuple[Array, Array]) -> Array:
        """Return the place where the linearised rate is 0 that is nearest, others apart."""
        return place if np.linalg.norm(left) <= small else bounded_least_squares(
            ((J, J.dot(place) - left), *others, (every, place)), lower, upper, place, settings)

    try:
        found = rate(y)
        for _ in range(settings.steps):
            if fresh:
                J = slope(y)
                if not (np.isfinite(J).all() and np.isfinite(found).all()):
                    return None
                small = settings.tolerance * float(np.linalg.norm(J))
                before = at_rest(y, found)
                now = missed(before)
            # no further from the nearest place of rest than the linearisation has proved to hold
            best = bounded_least_squares(
                ((J, J.dot(y) - found), (wanted, goal.values), (every, anchor)),
                np.maximum(lower, before - radius), np.minimum(upper, before + radius), before,
                settings)
            step, ends = best - y, False
            length = float(np.max(np.abs(step), initial=0.0))
            if length <= settings.tolerance:
                return best if np.linalg.norm(J.dot(step) + found) <= small else None
            if length >= 0.5 * radius:
                ends = now - missed(best) <= settings.fold * now
                if ends and np.linalg.norm(found) <= small:
                    return y
            resting = ends or float(np.max(np.abs(before - y))) > radius
            if resting:
                step, way = share * (before - y), np.zeros(len(y))
            else:
                way = best - before
                if fresh and np.max(np.abs(last), initial=0.0) > settings.tolerance:
                    # near a goal out of reach, curvature makes the whole way too far: the change
                    # from the way before shows what part of it is right
                    turned = 1.0 - float(way.dot(last) / last.dot(last))
                    damping = min(1.0, damping / max(0.5, turned))
                step = before - y + damping * way
            left = rate(y + step)
            bend = left - found - J.dot(step)
            fresh = bool(np.isfinite(left).all())
            if fresh:
                after = at_rest(y + step, bend, *() if resting else (
                    (wanted, wanted.dot(y + step)),))
                away = float(np.linalg.norm(after - y - step))
                fresh = away <= settings.curvature * float(np.linalg.norm(step)) and (
                    resting or missed(after) <= now + settings.tolerance + settings.progress * (
                        missed(y + step) - now + away))
            if fresh:
                y, found, last = y + step, left, way
            if resting:
                share = min(1.0, 2.0 * share) if fresh else 0.5 * share
            else:
                radius = 2.0 * radius if fresh else 0.5 * min(length, radius)
    except np.linalg.LinAlgError:
        # a model that gives no numbers
        pass
    return None


def steady_states_near(rate: Callable[[Array], Array], slope: Callable[[Array], Array],
                       start: Array, steps: int = 30, longest: float = 0.5,
                       tolerance: float = 1e-9) -> Array:
    """
    Find steady states near many starts at once, without limits or a goal.

    By Newton's method with the least change in each step. :func:`steady_state` finds the nearest
    one, but takes 8 to 200 times as long for hundreds of starts.

    :param rate: F, (M, n) -> (M, m).
    :param slope: its derivative, (M, n) -> (M, m, n).
    :param start: (M, n), of a magnitude of about 1.
    :param steps: at most.
    :param longest: change of a variable in a step.
    :param tolerance: change below which a search has ended.
    :return: (M', n), without those of starts near which none was found.
    """
    y = start
    for _ in range(steps):
        found, J = rate(y), slope(y)
        good = np.isfinite(found).all(axis=1) & np.isfinite(J).all(axis=(1, 2))
        y, found, J = y[good], found[good], J[good]
        change = newton_steps(found, J)
        left = np.linalg.norm(found + (J @ change[..., None])[..., 0], axis=1)
        change *= longest / np.max(np.abs(change), axis=1, keepdims=True, initial=longest)
        y, moved = y + change, np.max(np.abs(change), axis=1, initial=0.0)
        if (moved < tolerance).all():
            break
    # a step also ends where the rate is not 0, but no variable changes it
    rests = left <= tolerance * np.linalg.norm(J, axis=(1, 2))
    return np.asarray(y[(moved < tolerance) & rests])


def newton_steps(rate: Array, slope: Array) -> Array:
    """Return the least steps (M, n) after which linearised rates (M, m) are nearest to 0."""
    return np.asarray(-(np.linalg.pinv(slope) @ rate[..., None])[..., 0])


def bounded_least_squares(ranks: Sequence[tuple[Array, Array]], lower: Array, upper: Array,
                          start: Array, settings: SteadyStateSettings = SteadyStateSettings()
                          ) -> Array:
    """
    Minimise |M y - m| for each (M, m) in turn, each among the minimisers of those before.

    :param ranks: M (k, n) and m (k,), the most important first.
    :param lower: (n,) limits of y, to `upper` (n,); equal ones make a variable given.
    :param start: (n,) of which the given variables are taken.
    """
    given = lower == upper
    y, slopes = _minimised(ranks, start, given, settings.rank)
    slack = settings.tolerance * (upper > lower)
    if ((y >= lower - slack) & (y <= upper + slack)).all():
        return np.minimum(np.maximum(y, lower), upper)
    at_limit = given | (y < lower) | (y > upper)
    y = np.minimum(np.maximum(y, lower), upper)
    for _ in range(settings.changes * len(y)):
        best, slopes = _minimised(ranks, y, at_limit, settings.rank)
        # as far as the first limit on the way
        step = best - y
        room = np.where(step > 0.0, upper - y, lower - y)
        beyond = ~at_limit & (np.abs(step) > np.abs(room) + slack)
        if beyond.any():
            shares = np.where(beyond, room / np.where(beyond, step, 1.0), 1.0)
            first = int(np.argmin(shares))
            y = y + shares[first] * step
            y[first] = upper[first] if step[first] > 0.0 else lower[first]
            at_limit[first] = True
            continue
        y = np.minimum(np.maximum(best, lower), upper)
        # a variable leaves its limit where that is an improvement
        gain = np.where(y == lower, -slopes, slopes) * (at_limit & ~given)
        first = int(np.argmax(gain))
        if not gain[first] > settings.rank:
            break
        at_limit[first] = False
    return y


def _minimised(ranks: Sequence[tuple[Array, Array]], y: Array, fixed: NDArray[np.bool_],
               rank: float) -> tuple[Array, Array]:
    """
    Minimise without limits; fixed variables stay.

    :return: y (n,), and for each fixed variable the derivative by it of the first |M y - m|^2 / 2
        that it changes when the other variables respond, (n,); 0 for free ones.
    """
    every = np.eye(len(y))
    free, moved, slopes = every[:, ~fixed], every[:, fixed], np.zeros(int(fixed.sum()))
    open_ = np.ones(len(slopes), dtype=np.bool_)
    for M, m in ranks:
        size = float(np.linalg.norm(M))
        U, values, V = np.linalg.svd(M.dot(free))
        count = int(np.count_nonzero(values > rank * size))
        onto = free.dot(V[:count].T).dot(U[:, :count].T / values[:count, None])
        y = y + onto.dot(m - M.dot(y))
        if len(slopes):
            moved = moved - onto.dot(M.dot(moved))
            change = M.dot(moved)
            decides = open_ & (np.linalg.norm(change, axis=0) > rank * size)
            slopes = np.where(decides, (M.dot(y) - m).dot(change), slopes)
            open_ &= ~decides
        free = free.dot(V[count:].T)
        if not (free.shape[1] or open_.any()):
            break
    result = np.zeros(len(y))
    result[fixed] = slopes
    return y, result
