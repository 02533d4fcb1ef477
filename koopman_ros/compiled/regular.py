# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The arithmetic of a regular control step at once; see :mod:`koopman_ros.control.regular`."""

import math

import numpy as np
from numpy.typing import NDArray

from koopman_ros.arrays import Array
from koopman_ros.compiled.estimation import moved
from koopman_ros.compiled.jit import compiled, INTEGERS, MATRIX, NUMBER, SIZE, VECTOR
from koopman_ros.compiled.laws import LAW, law
from koopman_ros.compiled.matrices import applied
from koopman_ros.compiled.network import N_U, N_X, weights_of

# Rows of the tables of a step.
CENTER, SCALE, LOWER, UPPER = range(4)
HALF, SENSOR_LOWER, SENSOR_UPPER, SENSOR_RATE, JUMP = range(4, 9)
RATE, BOX_LOWER, BOX_UPPER, BOUND = range(4, 8)
FIGURES = 7  # in what `step` returns, before the arrays
_MOST_MOVES = 20


@compiled(INTEGERS, VECTOR, VECTOR, MATRIX, MATRIX, MATRIX, MATRIX, MATRIX, MATRIX, VECTOR,
          VECTOR, VECTOR, VECTOR, VECTOR, VECTOR, VECTOR, VECTOR, VECTOR, NUMBER, NUMBER, NUMBER,
          NUMBER, SIZE)
def step(sizes: NDArray[np.int64], numbers: Array, tuning: Array, states: Array, inputs: Array,
         training: Array, Q: Array, R: Array, inverse: Array, y: Array, last: Array, x: Array,
         w: Array, acted: Array, command: Array, x_ref: Array, z_ref: Array, drift_ref: Array,
         elapsed: float, since: float, seconds: float, spacing: float, recentred: int) -> Array:
    """
    Check and take a measurement, aim, evaluate the law, and bring its command within limits.

    Arguments are those of :func:`koopman_ros.control.regular.regular_step`.

    :return: residual, gain, growth, rate that no input balances, distance of the command from the
        training box, whether range and rate were active; then x, w, what was expected, u_ref, what
        acts on the state beside the drift, what the law asks for, and the command. The first one
        is infinite where this is no regular step, or not sure.
    """
    n, m = sizes[N_X], sizes[N_U]
    found = np.empty(FIGURES + 4 * n + 3 * m)
    found[0] = math.inf
    bandwidth, unit, longest = tuning[0], tuning[1], tuning[2]
    if not (elapsed > 0.0 and spacing > 0.0):
        return found
    for i in range(n):
        within = states[LOWER, i] <= y[i] <= states[UPPER, i] and (
            states[SENSOR_LOWER, i] <= y[i] <= states[SENSOR_UPPER, i])
        change = abs(y[i] - last[i])
        reach = states[JUMP, i] + (states[SENSOR_RATE, i] * since if since > 0.0 else 0.0)
        if not (within and 0.0 < change <= reach):
            return found
    measured = np.empty(n)
    for i in range(n):
        measured[i] = (y[i] - states[CENTER, i]) / states[SCALE, i]
    if len(training):
        nearest = math.inf
        for k in range(len(training)):
            apart = 0.0
            for i in range(n):
                apart = max(apart, abs(training[k, i] - measured[i]) / states[HALF, i])
            nearest = min(nearest, apart)
        if not nearest <= tuning[5]:
            return found
    # what is expected of the measurement, and what it tells
    duration = elapsed / unit
    steps = max(1.0, math.ceil(duration / longest))
    if not steps <= _MOST_MOVES:
        return found
    expected = moved(sizes, numbers, x, w, acted, duration / steps, int(steps))
    start = FIGURES
    largest = 0.0
    x_now, w_now = measured, np.zeros(n)
    if bandwidth > 0.0:
        p = math.exp(-bandwidth * elapsed)
        for i in range(n):
            difference = measured[i] - expected[i]
            x_now[i] = expected[i] + (1.0 - p * p) * difference
            w_now[i] = w[i] + (1.0 - p) ** 2 / duration * difference
        # of one input
        for i in range(n):
            largest += inverse[0, i] * w_now[i]
        largest = abs(largest)
        bound = inputs[BOUND, 0]
        if not math.isfinite(largest):
            return found
        if largest > bound:
            for i in range(n):
                w_now[i] *= bound / largest
    for i in range(n):
        if not (math.isfinite(expected[i]) and math.isfinite(x_now[i])):
            return found
        found[start + i], found[start + n + i] = x_now[i], w_now[i]
        found[start + 2 * n + i] = states[CENTER, i] + expected[i] * states[SCALE, i]
    start += 3 * n
    # where to go
    load = np.empty(n)
    for i in range(n):
        load[i] = drift_ref[i] + w_now[i]
    u_ref = np.zeros(m)
    for i in range(m):
        for j in range(n):
            u_ref[i] -= inverse[i, j] * load[j]
        found[start + i] = u_ref[i]
    start += m
    _, _, B, _, _ = weights_of(sizes, numbers)
    forcing, rest = applied(B, u_ref), 0.0
    for i in range(n):
        rest += (load[i] + forcing[i]) ** 2
        forcing[i] += w_now[i]
        found[start + i] = forcing[i]
    start += n
    answer = law(
        sizes, numbers, x_now, x_ref, z_ref, u_ref, forcing, Q, R, spacing / unit, recentred)
    residual, gain, growth, u = answer[0], answer[1], answer[2], answer[LAW:]
    if not (residual < math.inf and residual <= tuning[3] and gain <= tuning[4] and growth < 1.0):
        return found
    outside, at_range, at_rate = 0.0, 0.0, 0.0
    for i in range(m):
        wanted = inputs[CENTER, i] + u[i] * inputs[SCALE, i]
        if not math.isfinite(wanted):
            return found
        within = min(max(wanted, inputs[LOWER, i]), inputs[UPPER, i])
        at_range = max(at_range, 1.0 if within != wanted else 0.0)
        reach = (inputs[RATE, i] * seconds if seconds > 0.0
                 else inputs[RATE, i] if math.isinf(inputs[RATE, i]) else 0.0)
        reached = min(max(within, command[i] - reach), command[i] + reach)
        at_rate = max(at_rate, 1.0 if reached != within else 0.0)
        beyond = max(inputs[BOX_LOWER, i] - reached, reached - inputs[BOX_UPPER, i])
        if beyond > 0.0:
            outside = max(outside, beyond / (
                0.5 * (inputs[BOX_UPPER, i] - inputs[BOX_LOWER, i])))
        found[start + i], found[start + m + i] = within, reached
    found[0], found[1], found[2], found[3] = residual, gain, growth, math.sqrt(rest)
    found[4], found[5], found[6] = outside, at_range, at_rate
    return found
