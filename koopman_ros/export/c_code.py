# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
C code of a control loop: tables of its numbers before the two templates of this package.

Lift, drift and derivatives are loops of the templates over these tables, not generated
expressions: a network and its derivatives take thirty lines of C for any model, and need no
CasADi.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, fields, is_dataclass
from importlib.resources import files
import math
from pathlib import Path
import re
import subprocess
import textwrap
from typing import Any

import numpy as np

from koopman_ros import __version__
from koopman_ros.control import Controller
from koopman_ros.control.laws.riccati import closed
from koopman_ros.core.integration import STEPS
from koopman_ros.core.status import StatusCode
from koopman_ros.core.steady_state import SteadyStateSettings
from koopman_ros.estimation import DisturbanceObserver, ExtendedKalmanFilter, MeasuredState
from koopman_ros.estimation.base import LOST
from koopman_ros.model import NetworkObservables, PolynomialObservables
from koopman_ros.model.lifted_model import NODES, WEIGHTS

_LAWS = ('sdre', 'linear')
_FILES = ('controller.h', 'controller.c', 'test_vectors.c', 'timer_loop.c')
_SIZES = ('NX', 'NU', 'NY', 'NC', 'ND', 'NP', 'LAWS', 'QUEUE', 'PERIOD_NS')  # in the header
_COLUMNS = 99
# Parts that a model may lack, and their tables that are counted.
_OPTIONAL = r'\b(?:OBSERVABLES|INPUT_TERMS|TRAINING_STATES|VERIFIED_LOOPS)_[A-Z_]+'
_COUNTED = {'N_TERMS': 'INPUT_TERMS_COEFFICIENTS', 'N_TRAINING': 'TRAINING_STATES_STATES',
            'N_LOOPS': 'VERIFIED_LOOPS_LOST'}
# The quadrature of the templates is exact up to this degree of a polynomial.
_MAX_DEGREE = 10
#: reasons that the C code gives, numbered from 1
CODES = tuple(StatusCode[name] for name in (
    'NOT_FINITE', 'OUTSIDE_SENSOR', 'JUMPED', 'FROZEN', 'NO_MEASUREMENT', 'OUTSIDE_TRAINING',
    'LAW_FAILED', 'HELD_TOO_LONG', 'RECOVERING', 'LOST_HERE', 'NOT_STABILISABLE',
    'RICCATI_INACCURATE', 'GAIN_TOO_LARGE', 'PREDICTED_UNSTABLE', 'COMMAND_NOT_FINITE',
    'CALCULATION_FAILED', 'NOT_PREDICTED', 'NO_STEADY_STATE'))
# Fields of model and tuning that the templates do not name: their effect is in other tables, or
# they have none in C. Any other one that is set is rejected.
_WITHOUT_TABLE = re.compile(
    r'MODEL_(PROVENANCE|TIME_UNIT|PRE_FEEDBACK|DEAD_TIME|STATES_MEASURED)'
    r'|OBSERVABLES_(V|IDENTITY|EXPONENTS)'
    r'|(STATES|INPUTS|DISTURBANCES)_(NAMES|UNITS|LOWER|UPPER)|INPUTS_CHARACTERISTICS'
    r'|DISTURBANCES_TIMEOUT|SENSOR_DEADBAND'
    r'|TUNING_((STATE|INPUT)_WEIGHT|DEAD_TIME|CONTROLLED|OBSERVER_BANDWIDTH|MAX_DISTURBANCE'
    r'|(MEASUREMENT|DISTURBANCE|ANALYSIS)_NOISE|INITIAL_ERROR|UNCERTAIN_NOISE_FACTOR|ESTIMATOR'
    r'|FALLBACK_ORDER|(LEARNED|LINEAR)_MODEL_MARGIN|SAFE_VALUE|PLUGINS)')


class ExportError(ValueError):
    """A loop cannot be exported; the message is one line for the user."""


def c_code(controller: Controller, interval: float, name: str = 'controller') -> dict[str, str]:
    """
    Return header, code and two examples of a loop, by file name.

    The code has only the parts of the templates that the loop uses: their ``#if`` are resolved.

    :param interval: shortest time between two calls in s, for which inputs under way are kept.
    :param name: prefix of functions, types, macros and include guard, and of the code's files.
    :raises ExportError: for a law, an estimator or a model that the C code does not support, or a
        name other than a C identifier in lower case.
    """
    if not re.fullmatch('[a-z][a-z0-9_]{0,30}', name):
        raise ExportError(f'name = {name!r} must be a C identifier of at most 31 lower-case '
                          'letters, digits and underscores that begins with a letter, e.g. tank_1')
    texts = {file: template(file) for file in _FILES}
    tables = _fields(controller, texts['controller.c']) | _tables(controller, interval)
    used = _uses(controller, tables)
    texts = {file: resolved(text, used) for file, text in texts.items()}
    about = [f'A control loop of {controller.model.provenance.plant}, exported by koopman_ros '
             f'{__version__}.', *(f'{role}: {", ".join(f"{name} [{unit}]" for name, unit in of)}'
                                  for role, of in signals(controller).items())]
    named = set(re.findall(r'\b[A-Z_]+\b', re.sub(r'(?s)/\*.*?\*/', '', texts['controller.c'])))
    parts = {
        'ABOUT': '\n'.join(line for text in about for line in textwrap.wrap(
            text, _COLUMNS, initial_indent=' * ', subsequent_indent=' *     ')),
        'SIZES': '\n'.join(f'#define CONTROLLER_{size} {tables[size]}' for size in _SIZES),
        'NOMINAL': ', '.join(map(_number, controller.measured.of(controller.model.states.center))),
        'CODES': ',\n'.join(['    CONTROLLER_OK', *(
            f'    CONTROLLER_{code.name}' for code in CODES)]),
        'TABLES': '\n'.join(_table(table, value) for table, value in tables.items()
                            if table in named and np.size(value))}
    return {re.sub('^controller', name, file): prefixed(filled(text, parts), name)
            for file, text in texts.items()}


def resolved(text: str, used: Mapping[str, bool]) -> str:
    """Return a template without the parts that are not used, and without the ``#if`` of others."""
    lines, kept = [], [(True, False)]
    for line in text.splitlines(keepends=True):
        directive = re.match(r'#(if|else|endif)\b *(!?)(\w*)$', line)
        if line.startswith('#if'):
            if directive is not None and directive[3] in used:
                kept.append((used[directive[3]] != bool(directive[2]), True))
                continue
            kept.append((True, False))
        elif directive is not None and kept[-1][1]:
            one, _ = kept.pop()
            if directive[1] == 'else':
                kept.append((not one, True))
            continue
        elif line.startswith('#endif'):
            kept.pop()
        if all(one for one, _ in kept):
            lines.append(line)
    return ''.join(lines)


def prefixed(text: str, name: str) -> str:
    """Return code with the name of a loop in place of that of the templates."""
    return re.sub(r'\bCONTROLLER_', f'{name.upper()}_', re.sub(
        r'(?<![a-zA-Z])controller(?=_|\.[ch]\b)', name, text))


def _uses(controller: Controller, tables: Mapping[str, Any]) -> dict[str, bool]:
    """Return which parts of the templates a loop uses."""
    learned = not all(tables['LINEAR'])
    read_out, terms = bool(tables['READ_OUT']), bool(tables['N_TERMS'])
    monomials = bool(tables['N_PHI'] and not tables['NETWORK'])
    closed_lift = learned and tables['CLOSED']
    secants = closed_lift or (learned and read_out)
    return {
        'HAS_LEARNED_LAW': learned, 'CLOSED': closed_lift, 'HAS_SECANTS': secants,
        'HAS_MONOMIALS': terms or monomials,
        'HAS_QUADRATURE': learned and (not read_out or terms or (secants and monomials)),
        'HAS_STORED_STATES': bool(tables['N_TRAINING'] or tables['N_LOOPS']),
        'HAS_CURVES': len(tables['CURVE_VALUES']) > 0,
        'HAS_PRE_FEEDBACK': bool(np.any(tables['PRE_FEEDBACK'])),
        'BUMPLESS': controller.tuning.bumpless_transfer_time > 0.0,
        **{name: bool(tables[name]) for name in (
            'NETWORK', 'READ_OUT', 'N_PHI', 'N_TRAINING', 'N_LOOPS', 'N_TERMS', 'ND', 'KALMAN',
            'DETERMINED', 'CONTROLS_ALL', 'RESTS', 'LIMITED_TARGET')}}


def template(name: str) -> str:
    """Return the text of a template."""
    return (files(__package__) / 'templates' / name).read_text()


def filled(text: str, parts: Mapping[str, str]) -> str:
    """Return a template with its parts in place of their names."""
    return re.sub('@([A-Z]+)@', lambda found: parts[found[1]], text)


def compiled(code: Mapping[str, str], folder: Path, compiler: str, flags: Sequence[str],
             example: str = 'test_vectors.c') -> Path:
    """
    Write the code of a loop to a folder, and compile an example; return the program.

    :raises subprocess.CalledProcessError: where the code does not compile.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in code.items():
        (folder / name).write_text(text)
    program = folder / Path(example).stem
    header = next(name for name in code if name.endswith('.h'))
    subprocess.run([compiler, *flags, folder / f'{header[:-2]}.c', folder / example, '-lm', '-o',
                    program], check=True)
    return program


def signals(controller: Controller) -> dict[str, list[tuple[str, str]]]:
    """Return names and units of the entries of each array, in their order."""
    model = controller.model
    return {role: list(zip(of.names, of.units, strict=True)) for role, of in (
        ('measured', controller.measured), ('set-points', controller.controlled),
        ('inputs', model.inputs), ('measured disturbances', model.disturbances),
        ('states', model.states))}


def _fields(controller: Controller, code: str) -> dict[str, Any]:
    """Return the fields of model and tuning that the code names; ExportError for others."""
    model, estimator = controller.model, controller.best.estimator
    for name in controller.levels:
        if name not in _LAWS:
            raise ExportError(
                f'the law {name} cannot be exported, only {" and ".join(_LAWS)}: '
                + ('for C code of a receding-horizon law use acados' if name == 'mpc' else
                   'take it out of fallback_order'))
    if type(estimator) not in (DisturbanceObserver, MeasuredState, ExtendedKalmanFilter):
        raise ExportError(
            f'the estimator {type(estimator).__name__} cannot be exported: set estimator to '
            'disturbance_observer, measured_state or extended_kalman_filter')
    if not (controller.measured.determine_state or isinstance(estimator, ExtendedKalmanFilter)):
        raise ExportError('applied inputs that are not measured cannot be exported: measure them, '
                          'or set estimator to extended_kalman_filter')
    if model.commanded:
        raise ExportError('a command that is a state of the model cannot be exported: train a '
                          'model without as_state')
    degree = max(getattr(model.observables, 'degree', 0), model.input_matrix_degree)
    if degree > _MAX_DEGREE:
        raise ExportError(f'a polynomial of degree {degree} cannot be exported: train a model of '
                          f'at most {_MAX_DEGREE}')
    found: dict[str, Any] = dict.fromkeys(re.findall(_OPTIONAL, code), np.zeros(0))
    found['TRAINING_STATES_FILL_DISTANCE'] = 0.0
    for remedy, values in (('train a model without it', _walk(model, 'MODEL_')),
                           ('set it to 0 or false', _walk(controller.tuning, 'TUNING_'))):
        for name, value in values:
            if re.search(rf'\b{name}\b', code):
                found[name] = np.zeros(0) if value is None else value
            elif not _WITHOUT_TABLE.fullmatch(name) and value is not None and np.any(value):
                raise ExportError(f'{name.lower().removeprefix("tuning_")} cannot be exported: '
                                  f'{remedy}')
    return found | {count: len(found[name]) for count, name in _COUNTED.items()}


def _walk(value: Any, prefix: str) -> Iterator[tuple[str, Any]]:
    """Yield the fields of a dataclass and of those in it, named by both."""
    for field in fields(value):
        inner = getattr(value, field.name)
        if is_dataclass(inner) and field.name != 'provenance':
            yield from _walk(inner, f'{field.name}_')
        else:
            yield f'{prefix}{field.name}'.upper(), inner


def _tables(controller: Controller, interval: float) -> dict[str, Any]:
    """Return the constants of the C code, by name, that are not fields of model or tuning."""
    model, tuning, best, outputs = (
        controller.model, controller.tuning, controller.best, controller.measured)
    n, m, n_y = model.n_x, model.n_u, len(outputs.C)
    estimator: Any = best.estimator
    lift: Any = model.observables
    kalman = isinstance(estimator, ExtendedKalmanFilter)
    network = isinstance(lift, NetworkObservables)
    if network:
        psi = np.vstack((np.zeros((model.n_z - len(lift.V), len(lift.W))), lift.V))
        psi = np.hstack((np.eye(model.n_z, n) * model.identity, psi))
    else:
        psi = np.eye(model.n_z)
    # of each input, without points where it has no characteristic
    curves = [model.inputs.characteristics.get(name) for name in model.inputs.names]
    linear, unit, none = model.linearised, model.seconds_per_time_unit, np.zeros(0)
    order = model.n_z if closed(model) else n
    dead = [round(seconds * 1e9) for seconds in tuning.dead_times(model).tolist()]
    return {
        'NX': n, 'NU': m, 'NY': n_y, 'NC': len(controller.controlled), 'NZ': model.n_z,
        'ND': len(model.disturbances), 'NP': 2 * n, 'NXU': n + m,
        'WIDTH': 1 + 2 * n if kalman else 1, 'N_PSI': psi.shape[1], 'N_PHI': psi.shape[1] - n,
        'LAWS': len(controller.levels), 'PERIOD_NS': round(interval * 1e9),
        'QUEUE': math.ceil(max(dead) / 1e9 / interval) + 2,
        'ORDER': max(order, n, m), 'MAX_INVERTED': max((n + m) ** 2, n * model.n_z),
        'NETWORK': network, 'READ_OUT': model.readout is not None, 'CLOSED': closed(model),
        'KALMAN': kalman, 'DETERMINED': outputs.determine_state, 'CONTROLS_ALL': best.controls_all,
        'LIMITED_TARGET': model.n_u > 1, 'LOST': LOST,
        'RESTS': np.count_nonzero(np.any(outputs.C != 0.0, axis=0)) == n_y, 'TIME_UNIT': unit,
        'FASTEST_RATE': linear.fastest_rate / unit,
        'STEP_LENGTH': STEPS.time_constants, 'STEP_MOST': float(STEPS.most),
        # one that measures the state takes all of a measurement, and knows no disturbance
        'OBSERVER_BANDWIDTH': tuning.observer_bandwidth if estimator.remembers else math.inf,
        'MAX_DISTURBANCE': np.where(
            estimator.remembers, tuning.max_disturbance / model.inputs.scale, 0.0),
        **({'H_OUTPUT': np.hstack((estimator._H, 0.0 * estimator._H)), 'NOISE': estimator._R,
            'INTENSITY': np.pad(estimator._intensity, ((n, 0), (n, 0))),
            'ONTO_DISTURBANCES': estimator._onto_directions,
            'FIRST_COVARIANCE': estimator.initial_covariance,
            'FARTHEST': np.sqrt(estimator._lost)} if kalman else
           {**dict.fromkeys(('H_OUTPUT', 'NOISE', 'INTENSITY', 'FIRST_COVARIANCE'), none),
            'ONTO_DISTURBANCES': np.eye(n), 'FARTHEST': LOST * model.states.half_widths}),
        **{f'STEADY_{name}'.upper(): value
           for name, value in asdict(SteadyStateSettings()).items()},
        'HALF_WIDTH': model.states.half_widths, 'CORNERS': model.states.corners,
        'LOWER_V': model.inputs.to_deviation(tuning.limits.lower),
        'UPPER_V': model.inputs.to_deviation(tuning.limits.upper),
        'INPUTS_EFFECT': [float(u if curve is None else curve.effect(u)) for u, curve in zip(
            model.inputs.center, curves, strict=True)],
        'CURVES': np.cumsum([0, *(0 if one is None else len(one.values) for one in curves)]),
        **{f'CURVE_{name.upper()}': [value for one in curves if one is not None
                                     for value in getattr(one, name).tolist()]
           for name in ('values', 'effects')},
        'SAFE': controller.safe_input, 'NOMINAL': controller.nominal_input,
        'DEAD_TIME': dead, 'LONGEST_DEAD_TIME': max(dead),
        'SHORTEST_DEAD_TIME': min(dead), 'MARGIN': controller.order.margins,
        'CONTROLLED': [model.states.names.index(name) for name in best.controlled],
        'LINEAR': np.array([level.law.extrapolates for level in controller.levels.values()]),
        'OUTPUTS': outputs.C, 'FROM_OUTPUTS': np.linalg.pinv(outputs.C),
        'MEASURED': np.any(outputs.C != 0.0, axis=0), 'STATE_WEIGHT': np.diag(best.law.weights.Q),
        'INPUT_WEIGHT': np.diag(best.law.weights.R),
        'AT_ZERO': lift.value_at_zero if network else none,
        'POWERS': none if network else lift.exponents[n:], 'LIFT': psi, 'RATE': model.A @ psi,
        'INPUT_INVERSE': estimator.as_input(np.eye(n)), 'SLOPE': linear.A,
        'PRE_FEEDBACK': model.pre_feedback_slope, 'NODES': NODES, 'SHARES': WEIGHTS,
        'TERM_POWERS': PolynomialObservables.total_degree(
            n, max(1, model.input_matrix_degree)).exponents}


def _table(name: str, value: Any) -> str:
    """Write a number as a macro, an array as a table."""
    if np.ndim(value) == 0:
        return f'#define {name} {_number(value)}'
    flat = np.ravel(value)
    kind = 'int64_t' if name == 'DEAD_TIME' else 'int' if flat.dtype.kind != 'f' or re.search(
        'POWERS|LOST', name) else 'double'
    entries = ', '.join(_number(int(one) if kind == 'int' else one) for one in flat)
    shape = f' /* {np.shape(value)} */' if np.ndim(value) > 1 else ''
    line = f'static const {kind} {name}[] = {{{entries}}};'
    return line if not shape and len(line) <= _COLUMNS else (
        f'static const {kind} {name}[] = {{{shape}\n' + textwrap.fill(
            entries, _COLUMNS, initial_indent=4 * ' ', subsequent_indent=4 * ' ') + '\n};')


def _number(value: Any) -> str:
    if isinstance(value, (bool, int, np.bool_, np.integer)):
        return str(int(value))
    number = 'HUGE_VAL' if math.isinf(value) else repr(abs(float(value)))
    return f'-{number}' if value < 0.0 else number
