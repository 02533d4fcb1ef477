# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
C code of a control loop: tables of its numbers before the two templates of this package.

Lift, drift and derivatives are loops of the templates over these tables, not generated
expressions: a network and its derivatives take thirty lines of C for any model, and need no
CasADi.
"""

from collections.abc import Mapping, Sequence
from importlib.resources import files
import math
from pathlib import Path
import subprocess
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from koopman_ros import __version__
from koopman_ros.control import Controller
from koopman_ros.control.laws.riccati import closed
from koopman_ros.core.status import StatusCode
from koopman_ros.estimation import DisturbanceObserver, ExtendedKalmanFilter, MeasuredState
from koopman_ros.model import NetworkObservables, PolynomialObservables
from koopman_ros.model.lifted_model import NODES, WEIGHTS

_LAWS = ('sdre', 'linear')
# The quadrature of the templates is exact up to this degree of a polynomial.
_MAX_DEGREE = 10
#: reasons that the C code gives, numbered from 1
CODES = tuple(StatusCode[name] for name in (
    'NOT_FINITE', 'OUTSIDE_SENSOR', 'JUMPED', 'FROZEN', 'NO_MEASUREMENT', 'OUTSIDE_TRAINING',
    'LAW_FAILED', 'HELD_TOO_LONG', 'RECOVERING', 'LOST_HERE', 'NOT_STABILISABLE',
    'RICCATI_INACCURATE', 'GAIN_TOO_LARGE', 'PREDICTED_UNSTABLE', 'COMMAND_NOT_FINITE',
    'CALCULATION_FAILED', 'NOT_PREDICTED', 'NO_STEADY_STATE'))


class ExportError(ValueError):
    """A loop cannot be exported; the message is one line for the user."""


def c_code(controller: Controller, interval: float) -> dict[str, str]:
    """
    Return ``controller.h`` and ``controller.c`` of a loop.

    :param interval: shortest time between two calls in s, for which inputs under way are kept.
    :raises ExportError: for a law, an estimator or a model that the C code does not support.
    """
    _check(controller)
    sizes, tables = _sizes(controller, interval), _tables(controller)
    model = controller.model
    about = [f'A control loop of {model.provenance.plant}, exported by koopman_ros {__version__}.',
             *(f'{role}: {", ".join(f"{name} [{unit}]" for name, unit in signals)}'
               for role, signals in signals(controller).items())]
    parts = {
        'ABOUT': '\n'.join(f' * {line}' for line in about),
        'SIZES': '\n'.join(f'#define KOOPMAN_{name} {value}' for name, value in sizes.items()),
        'CODES': ',\n'.join(['    KOOPMAN_OK', *(f'    KOOPMAN_{code.name}' for code in CODES)]),
        'TABLES': '\n'.join(_table(name, value) for name, value in tables.items())}
    found = {}
    for name in ('controller.h', 'controller.c'):
        text = (files(__package__) / 'templates' / name).read_text()
        for part, value in parts.items():
            text = text.replace(f'@{part}@', value)
        found[name] = text
    return found


def example() -> str:
    """Return the program ``example.c``, which reads calls and prints answers."""
    return (files(__package__) / 'templates' / 'example.c').read_text()


def compiled_example(controller: Controller, interval: float, folder: Path, compiler: str,
                     flags: Sequence[str]) -> Path:
    """
    Write the code of a loop and the example to a folder, and compile them; return the program.

    :raises subprocess.CalledProcessError: where the code does not compile.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in {**c_code(controller, interval), 'example.c': example()}.items():
        (folder / name).write_text(text)
    program = folder / 'example'
    subprocess.run([compiler, *flags, folder / 'controller.c', folder / 'example.c', '-lm', '-o',
                    program], check=True)
    return program


def _check(controller: Controller) -> None:
    """Raise an error for a part that the C code does not support."""
    for name in controller.levels:
        if name not in _LAWS:
            raise ExportError(
                f'the law {name} cannot be exported, only {" and ".join(_LAWS)}: '
                + ('for C code of a receding-horizon law use acados' if name == 'mpc' else
                   'take it out of fallback_order'))
    estimator = controller.best.estimator
    if type(estimator) not in (DisturbanceObserver, MeasuredState, ExtendedKalmanFilter):
        raise ExportError(
            f'the estimator {type(estimator).__name__} cannot be exported: set estimator to '
            'disturbance_observer, measured_state or extended_kalman_filter')
    tuning = controller.tuning
    for what, given, remedy in (
            ('a characteristic of an input', len(controller.model.inputs.characteristics),
             'invert it in the actuator, and learn a model of the linear input'),
            ('measured disturbances', len(controller.model.disturbances),
             'train a model without them'),
            ('safe_latch', tuning.safe_latch, 'set it to false'),
            ('report_on_change', tuning.sensor.report_on_change.any(), 'set it to 0')):
        if given:
            raise ExportError(f'{what} cannot be exported: {remedy}')
    lift = controller.model.observables
    for what, degree in (
            ('lift', lift.degree if isinstance(lift, PolynomialObservables) else 0),
            ('input matrix', controller.model.input_matrix_degree)):
        if degree > _MAX_DEGREE:
            raise ExportError(f'the {what} has degree {degree}, at most {_MAX_DEGREE} can be '
                              'exported: train a model of a lower degree')


def signals(controller: Controller) -> dict[str, list[tuple[str, str]]]:
    """Return names and units of the entries of each array, in their order."""
    return {role: list(zip(of.names, of.units, strict=True)) for role, of in (
        ('measured', controller.measured), ('set-points', controller.controlled),
        ('inputs', controller.model.inputs), ('states', controller.model.states))}


def _sizes(controller: Controller, interval: float) -> dict[str, int]:
    model = controller.model
    kalman = isinstance(controller.best.estimator, ExtendedKalmanFilter)
    longest = float(np.max(controller.tuning.dead_times(model), initial=0.0))
    return {'NX': model.n_x, 'NU': model.n_u, 'NY': len(controller.measured.names),
            'NC': len(controller.controlled), 'NP': 2 * model.n_x if kalman else 1,
            'LAWS': len(controller.levels), 'QUEUE': math.ceil(longest / interval) + 2}


def _tables(controller: Controller) -> dict[str, Any]:
    """Return the constants of the C code by name."""
    model, tuning, outputs = controller.model, controller.tuning, controller.measured
    best, n = controller.best, controller.model.n_x
    states, inputs, estimator = model.states, model.inputs, best.estimator
    lift, terms, loops = model.observables, model.input_terms, model.verified_loops
    states_first = np.eye(model.n_z, n) if model.identity else np.zeros((model.n_z, n))
    if isinstance(lift, PolynomialObservables):
        powers, count = lift.exponents[n:], model.n_z - n
        output = np.eye(model.n_z)[:, n:]
        hidden = np.zeros((0, n)), np.zeros(0), np.zeros(0)
    else:
        assert isinstance(lift, NetworkObservables)
        powers, count = np.zeros((0, n), dtype=int), len(lift.W)
        output = np.concatenate((np.zeros((model.n_z - len(lift.V), count)), lift.V))
        hidden = lift.W, lift.b, lift.value_at_zero
    trained = model.training_states
    linear = [level.law.extrapolates for level in controller.levels.values()]
    kalman = isinstance(estimator, ExtendedKalmanFilter)
    weights = best.law.weights
    dead = [round(seconds * 1e9) for seconds in tuning.dead_times(model).tolist()]
    return {
        'NZ': model.n_z, 'N_PHI': count, 'N_PSI': n + count, 'N_PHI_': max(count, 1),
        'N_TERMS': 0 if terms is None else len(terms.coefficients),
        'N_TRAINING': 0 if trained is None else len(trained.states),
        'N_LOOPS': 0 if loops is None else len(loops.lost),
        'NETWORK': isinstance(lift, NetworkObservables), 'READ_OUT': model.readout is not None,
        'CLOSED': closed(model), 'KALMAN': kalman, 'REMEMBERS': estimator.remembers,
        'DETERMINED': outputs.determine_state, 'CONTROLS_ALL': best.controls_all,
        'RESTS': np.count_nonzero(np.any(outputs.C != 0.0, axis=0)) == len(outputs.C),
        'TIME_UNIT': model.seconds_per_time_unit,
        'FASTEST_RATE': model.linearised.fastest_rate / model.seconds_per_time_unit,
        'FASTEST_MODE': np.max(np.abs(np.linalg.eigvals(model.linearised.A)))
        / model.seconds_per_time_unit,
        'BANDWIDTH': tuning.observer_bandwidth,
        'STUCK_TIMEOUT': tuning.sensor.stuck_sensor_timeout,
        'HOLD_TIMEOUT': tuning.hold_timeout, 'RECOVERY_TIME': tuning.recovery_time,
        'TRANSFER_TIME': tuning.bumpless_transfer_time, 'FILTER_TIME': tuning.setpoint_filter_time,
        'MAX_GAIN': tuning.max_gain, 'MAX_RESIDUAL': tuning.max_riccati_residual,
        'FILL_DISTANCE': 0.0 if trained is None else trained.fill_distance,
        'LONGEST_DEAD_TIME': max(dead), 'SHORTEST_DEAD_TIME': min(dead),
        'X_CENTER': states.center, 'X_SCALE': states.scale, 'X_LOWER': states.lower,
        'X_UPPER': states.upper, 'HALF_WIDTH': states.half_widths, 'CORNERS': states.corners,
        'U_CENTER': inputs.center, 'U_SCALE': inputs.scale,
        'U_LOWER': tuning.limits.lower, 'U_UPPER': tuning.limits.upper,
        'LOWER_V': inputs.to_deviation(tuning.limits.lower),
        'UPPER_V': inputs.to_deviation(tuning.limits.upper),
        'RATE_LIMIT': tuning.limits.rate, 'TOLERANCE': tuning.tracking_tolerance,
        'SAFE': controller.safe_input, 'NOMINAL': controller.nominal_input,
        'DEAD_TIME': dead, 'CONTROLLED': [states.names.index(name) for name in best.controlled],
        'SETPOINT_RAMP': tuning.setpoint_ramp, 'LINEAR': np.array(linear, dtype=int),
        'MARGIN': controller.order.margins,
        'SENSOR_LOWER': tuning.sensor.lower, 'SENSOR_UPPER': tuning.sensor.upper,
        'MAX_STEP': tuning.sensor.jump, 'MAX_RATE': tuning.sensor.rate,
        'OUTPUTS': outputs.C, 'FROM_OUTPUTS': np.linalg.pinv(outputs.C),
        'MEASURED': np.any(outputs.C != 0.0, axis=0).astype(int),
        'STATE_WEIGHT': np.diag(weights.Q), 'INPUT_WEIGHT': np.diag(weights.R),
        'WEIGHT': hidden[0], 'BIAS': hidden[1], 'AT_ZERO': hidden[2], 'POWERS': powers,
        'LIFT': np.concatenate((states_first, output), axis=1),
        'DRIFT': np.zeros((n, 0)) if model.readout is None else model.readout,
        'DYNAMICS': model.A, 'INPUT_MATRIX': model.B, 'INPUT_INVERSE': model.input_inverse(),
        'SLOPE': model.linearised.A, 'PRE_FEEDBACK': model.pre_feedback_slope,
        'TERMS': np.zeros(0) if terms is None else terms.coefficients,
        'TERM_POWERS': np.zeros(0, dtype=int) if terms is None else (
            PolynomialObservables.total_degree(n, terms.degree).exponents),
        'NODES': NODES, 'SHARES': WEIGHTS,
        'TRAINING': np.zeros(0) if trained is None else trained.states,
        'LOOP_STARTS': np.zeros(0) if loops is None else loops.starts,
        'LOOP_SETPOINTS': np.zeros(0) if loops is None else loops.setpoints,
        'LOOP_LOST': np.zeros(0, dtype=int) if loops is None else loops.lost.astype(int),
        'MAX_DISTURBANCE': tuning.max_disturbance / inputs.scale,
        **_kalman_tables(estimator)}


def _kalman_tables(estimator: Any) -> Mapping[str, ArrayLike]:
    if isinstance(estimator, ExtendedKalmanFilter):
        return {'H_OUTPUT': estimator._H, 'NOISE_VARIANCE': np.diag(estimator._R),
                'INTENSITY': estimator._intensity, 'ONTO_DISTURBANCES': estimator._onto_directions,
                'FIRST_COVARIANCE': estimator.initial_covariance, 'LOST_VARIANCE': estimator._lost}
    return dict.fromkeys(('H_OUTPUT', 'NOISE_VARIANCE', 'INTENSITY', 'ONTO_DISTURBANCES',
                          'FIRST_COVARIANCE', 'LOST_VARIANCE'), np.zeros(0))


def _table(name: str, value: Any) -> str:
    """Write a number as a macro, an array as a table; an empty one has one entry."""
    if np.ndim(value) == 0:
        return f'#define {name} {_number(value)}'
    flat = np.ravel(value)
    kind = 'int64_t' if name == 'DEAD_TIME' else 'int' if flat.dtype.kind == 'i' else 'double'
    entries = ', '.join(map(_number, flat)) or '0'
    return f'static const {kind} {name}[] = {{{entries}}};'


def _number(value: Any) -> str:
    if isinstance(value, (bool, int, np.bool_, np.integer)):
        return str(int(value))
    return 'INFINITY' if math.isinf(value) else repr(float(value))
