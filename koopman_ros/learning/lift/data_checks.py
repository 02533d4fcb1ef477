# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Checks of samples before training: their times, rates and nominal point."""

import contextlib
from dataclasses import replace
import math

import numpy as np

from koopman_ros.core.datasets import Array, DriftSamples, PlantDescription
from koopman_ros.learning.identification.drift import DriftModel, steady_point
from koopman_ros.learning.lift.input_model import InputModel
from koopman_ros.learning.lift.reference_drift import corrected, CorrectedRate
from koopman_ros.learning.lift.residuals import deviations
from koopman_ros.model import Box, Coordinates

# Times and derivatives contradict each other beyond this factor, by so many steps at least.
_FACTOR = 2.0
_ALIKE = 2.0
# The share of all steps whose derivatives are alike where samples resolve the motion.
_RESOLVED = 0.5
_FEWEST_STEPS = 20
# A steady state this near, in half-ranges, is taken for the nominal point; one farther away than
# the other number is not suggested.
_NEAR, _FAR = 0.02, 2.0
# The drift there is told from zero where it is so many standard errors, and so many times what
# another degree of the polynomial makes of it.
_ERRORS, _DIFFERENCES = 5.0, 3.0
# Likewise what the polynomial leaves, on average, of so many samples nearby.
_MISFITS, _FEWEST_NEAR = 4.0, 10
_DEGREES = (5, 4, 3, 2)
_ROWS, _MOST_COLUMNS = 2000, 130


def check_rates(plant: PlantDescription, samples: DriftSamples) -> None:
    """
    Compare differences of the states with derivatives and times, where the latter are known.

    Counted are steps whose derivatives at both ends are alike; between them the state cannot have
    moved otherwise. Where few are, samples do not resolve the motion and tell nothing. Noise of
    derivatives or of states draws the two estimates of the factor apart.

    :raises ValueError: when both are beyond half or twice, as by times in another unit.
    """
    if samples.time is None:
        return
    order = np.lexsort((samples.time, samples.episode))
    within = np.diff(samples.episode[order]) == 0
    steps = np.diff(samples.time[order])[within]
    moved = np.diff(samples.x[order], axis=0)[within]
    begin, end = (samples.dxdt[order][rows][within] for rows in (slice(-1), slice(1, None)))
    if plant.B is not None:
        # under the input of the step, not of the next one
        change = np.diff(samples.u[order], axis=0)[within]
        B = plant.input_matrix(samples.x[order][1:][within])
        end = end - (B @ change[..., None])[..., 0]
    for i, name in enumerate(plant.state_names):
        first, last = begin[:, i], end[:, i]
        alike = (first * last > 0.0) & (np.abs(first) < _ALIKE * np.abs(last)) & (
            np.abs(last) < _ALIKE * np.abs(first))
        expected, found = (0.5 * (first + last) * steps)[alike], moved[alike, i]
        if len(found) < max(_FEWEST_STEPS, _RESOLVED * len(alike)):
            continue
        # a median of 0 is that of a state which was not resolved
        low, high = _middle_ratio(found, expected), 1.0 / (_middle_ratio(expected, found) or 1.0)
        factor = low if low > _FACTOR else high
        if low > _FACTOR or high < 1.0 / _FACTOR:
            raise ValueError(
                f'{name} changes {factor:.3g} times as much from sample to sample as dxdt and '
                f'time predict (0.5 to 2 is allowed for noise): give time in {plant.time_unit} '
                f'and dxdt in {plant.state_units[i]} per {plant.time_unit}, or another time_unit, '
                'or no time if samples are a whole oscillation apart')


def _middle_ratio(a: Array, b: Array) -> float:
    """Return the median of a / b (N,) where b is larger than half of all; NaN where it is 0."""
    size = np.abs(b)
    large = (size >= np.median(size)) & (size > 0.0)
    return float(np.median(a[large] / b[large])) if large.any() else np.nan


def check_nominal_point(plant: PlantDescription, samples: DriftSamples, box: Box) -> None:
    """
    Look at the drift at the nominal point, where a lift has none.

    It is the constant of a polynomial fit; its reliability follows from the fit's standard error,
    a fit of one degree less, and the residuals of both at the samples nearest to the point, as
    where the drift has a kink.

    :raises ValueError: when the plant moves there, with a steady state nearby if there is one.
    """
    x, rate, u = deviations(box, samples)
    rows = np.linspace(0, len(x) - 1, min(len(x), _ROWS)).astype(int)
    x = x[rows]
    inputs = InputModel.of(plant, box, samples.x[rows])
    rate, regressors = inputs.apart(x, rate[rows], u[rows])
    fits = []
    for degree in _DEGREES:
        m = math.comb(x.shape[1] + degree, degree)
        shape = DriftModel(box, degree, np.empty(0), np.empty(0))
        left = np.hstack([shape.features(x), x[:, :0] if regressors is None else regressors])
        if left.shape[1] <= min(_MOST_COLUMNS, len(x) // 3):
            inverse = np.linalg.pinv(left)
            solution = inverse @ rate
            rest = rate - left @ solution
            error = np.sqrt(np.mean(rest ** 2, axis=0)) * np.linalg.norm(inverse[0])
            B = inputs.weights if inputs.weights is not None else solution[m:].T
            fits.append((replace(shape, coefficients=solution[:m], B=B), error, rest))
        if len(fits) == 2:
            break
    else:
        return
    (fitted, error, rest), (other, *_) = fits
    drift = fitted.coefficients[0]
    nearest = rest[np.argsort(np.max(np.abs(x), axis=1), kind='stable')[
        :max(_FEWEST_NEAR, len(x) // 30)]]
    spread = np.sqrt(np.mean(nearest ** 2, axis=0) / len(nearest))
    slight = np.max([_ERRORS * error + _DIFFERENCES * np.abs(drift - other.coefficients[0]),
                     _ERRORS * spread, _MISFITS * np.abs(np.mean(nearest, axis=0))], axis=0)
    moves = np.abs(drift) > slight
    if not moves.any():
        return
    odd = np.arange(len(samples)) % 2 == 1
    whole = corrected(fitted.rate, box, samples.where(~odd), samples.where(odd))
    if isinstance(whole, CorrectedRate) and whole.cause:
        # of a drift that is not affine in the inputs the constant of an affine fit says nothing
        there = whole(box.states.center, box.inputs.center) / box.states.scale
        moves &= np.abs(there) > slight
        if not moves.any():
            return
    nearby = 'excite the plant around a steady state'
    with contextlib.suppress(ValueError):
        x_held, u_held = steady_point(fitted, box.states.center, box.inputs.center)
        apart = max(np.max(np.abs(one.to_deviation(held)), initial=0.0) for one, held in (
            (box.states, x_held), (box.inputs, u_held)))
        if apart <= _NEAR:
            return
        if apart <= _FAR:
            nearby = ('according to the samples it is steady at nominal_state = '
                      f'{_text(box.states, x_held)} and nominal_input = '
                      f'{_text(box.inputs, u_held)}')
    states = box.states
    speeds = ', '.join(
        f'{drift[i] * states.scale[i]:.3g} {states.units[i]}/{box.time_unit} of {states.names[i]}'
        for i in np.flatnonzero(moves))
    raise ValueError(f'the nominal point is not a steady state, the plant moves with {speeds}: '
                     f'{nearby}')


def _text(signals: Coordinates, values: Array) -> str:
    """Write values to a ten thousandth of their range."""
    # without the sign of -0.0
    return str([round(float(value), 4 - math.floor(math.log10(scale))) + 0.0
                for value, scale in zip(values, signals.scale, strict=True)])
