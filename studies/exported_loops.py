# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Compare the C code of loops with the Python controller: all bundled models, and random ones.

Each loop runs over a sequence with faults; the random models and tunings are of every kind that
can be exported.
"""

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
import itertools
import json
import math
from pathlib import Path
import re
import subprocess
import sys
import tempfile
from typing import Any

import numpy as np

from koopman_ros.control import Controller
from koopman_ros.core.paths import config_directory
from koopman_ros.core.signals import Outputs
from koopman_ros.core.status import StatusCode
from koopman_ros.execution import backend_of, Notify
from koopman_ros.export import c_code, compiled
from koopman_ros.export.c_code import CODES
from koopman_ros.export.command_line import loop
from koopman_ros.export.cortex_m4 import measured, OPTIMISATIONS
from koopman_ros.export.vectors import vectors, with_laws
from koopman_ros.model import (
    Coordinates,
    LiftedModel,
    NetworkObservables,
    PolynomialObservables,
    Provenance,
)
from koopman_ros.model.input_matrix import InputTerms
from koopman_ros.model.training_data import TrainingStates, VerifiedLoops
from koopman_ros.tuning import DisturbanceLimits, InputLimits, SensorLimits, Tuning

INTERVAL = 0.5  # s, of the random loops
_SIZES = ('code', 'state', 'stack', 'instructions')
_MEASURED, _CALLS = 10, 200  # commands of a law on an emulated Cortex-M4F, of so many calls
FLAGS = ('-std=c99', '-Wall', '-Wextra', '-Wpedantic', '-Wconversion', '-Wdouble-promotion',
         '-Wfloat-equal', '-Wshadow', '-Werror', '-O1')
SANITIZERS = ('-fsanitize=address,undefined', '-fno-sanitize-recover')
#: largest relative difference of a command that is not due to rounding
TOLERANCE = 1e-9
# Which test rejects a Riccati equation without a solution is a matter of rounding.
_ALIKE = dict.fromkeys((str(CODES.index(code) + 1) for code in (
    StatusCode.NOT_STABILISABLE, StatusCode.RICCATI_INACCURATE, StatusCode.GAIN_TOO_LARGE)), '-')
# The floor below which an error of a command counts as one of it, in half-ranges of the input.
_FLOOR = 1e-3
# Seconds between samples of the bundled models, where not 1 s, and the plants of those that are
# not named like one.
_INTERVALS = {'pendulum': 0.02, 'two_state_example': 0.1, 'two_tanks': 0.5}
_PLANTS = {**dict.fromkeys(('reactor_feed', 'reactor_linear', 'reactor_nz3', 'reactor_nz4'),
                           'reactor'), 'two_state_saddle': 'two_state'}


@dataclass(frozen=True)
class Agreement:
    """How far the answers of the C code agree with those of the Python controller."""

    error: float  #: largest difference of a command, relative
    #: that of the controller, and of its C code, from C code with numbers of 80 bits; 0 where the
    #: two differ by less than the tolerance
    rounding: tuple[float, float]
    different: tuple[int, ...]  #: samples with another level, status or cause
    seen: frozenset[tuple[str, ...]]  #: the levels, statuses and causes


def compared(controller: Controller, samples: int, interval: float, seed: int = 0,
             compiler: str = 'gcc', flags: Sequence[str] = ()) -> Agreement:
    """Compile the code of a loop, run both over a sequence, and compare the answers."""
    rows = list(vectors(controller, samples, interval, seed))
    calls = ''.join(f'{",".join(call.row(controller))}\n' for call, _ in rows)
    wanted, n = [answer for _, answer in rows], controller.model.n_u
    code = c_code(controller, interval)
    answers = _answers(code, calls, compiler, (*FLAGS, *flags))
    error, different = disagreement(controller, wanted, answers)
    rounding = (0.0, 0.0)
    if error > TOLERANCE:
        exact = [answer.split(',') for answer in _answers(
            {name: _extended(text) for name, text in code.items()}, calls, 'gcc', ('-O1',))]
        rounding = (disagreement(controller, exact, [','.join(row) for row in wanted])[0],
                    disagreement(controller, exact, answers)[0])
    return Agreement(error, rounding, different,
                     frozenset(tuple(answer[n:]) for answer in wanted))


def _answers(code: Mapping[str, str], calls: str, compiler: str, flags: Sequence[str]
             ) -> list[str]:
    with tempfile.TemporaryDirectory() as place:
        program = compiled(code, Path(place), compiler, flags)
        return subprocess.run([program], input=calls, capture_output=True, text=True,
                              check=True).stdout.splitlines()


def _extended(code: str) -> str:
    """Return code for numbers of 80 bits."""
    code = re.sub(r'\bdouble\b', 'long double', code)
    return code.replace('<math.h>', '<tgmath.h>').replace('%.17g', '%.20Lg')


def disagreement(controller: Controller, wanted: Sequence[Sequence[str]], answers: Sequence[str]
                 ) -> tuple[float, tuple[int, ...]]:
    """Return the largest relative error of a command, and the samples with other codes."""
    n = controller.model.n_u
    found = [answer.split(',') for answer in answers]
    expected, got = (np.array([row[:n] for row in rows], dtype=float)
                     for rows in (wanted, found))
    error = np.abs(got - expected) / np.maximum(
        np.abs(expected), _FLOOR * controller.model.inputs.scale)
    codes = ([[_ALIKE.get(code, code) for code in row[n:]] for row in rows]
             for rows in (wanted, found))
    pairs = enumerate(zip(*codes, strict=True))
    return float(np.max(error)), tuple(k for k, (one, other) in pairs if one != other)


def bundled_loops() -> Iterator[tuple[str, Controller, float]]:
    """Yield name, loop and seconds between samples of each bundled model."""
    for path in sorted((config_directory() / 'models').glob('*.safetensors')):
        name = path.stem
        parameters = config_directory() / 'plants' / f'{_PLANTS.get(name, name)}.yaml'
        found = loop(name, 'sdre', parameters)
        # no analyser reports to a loop in C
        tuning = replace(found.tuning, analysis_delay=0.0 * found.tuning.analysis_delay)
        yield name, Controller(found.model, tuning, found.measured), _INTERVALS.get(name, 1.0)


def random_loops() -> Iterator[tuple[str, Controller, float]]:
    """Yield the same of random models, without those whose outputs do not suffice."""
    for seed in itertools.count():
        try:
            yield f'random {seed}', random_loop(seed), INTERVAL
        except ValueError as error:
            if 'do not determine' not in str(error):
                raise


def _row(samples: int, named: tuple[str, int], _: Notify) -> dict[str, Any]:
    """Compare a loop, and measure the code of a bundled one; for the summary."""
    name, seed = named
    loops = itertools.chain(bundled_loops(), random_loops())
    found, interval = next((found, interval) for one, found, interval in loops if one == name)
    seen = compared(found, samples, interval, seed)
    row = {'error': seen.error, 'rounding': seen.rounding, 'other_codes': len(seen.different),
           # where rounding errors grow, the C code may have as large ones as the controller
           'differs': bool(seen.different) or (
               seen.error > TOLERANCE and not seen.rounding[1] <= 10.0 * seen.rounding[0])}
    if not name.startswith('random'):
        calls = with_laws(found, list(vectors(found, _CALLS, interval, seed)), _MEASURED)
        with tempfile.TemporaryDirectory() as place:
            compiled(c_code(found, interval), Path(place), 'gcc', FLAGS)
            cortex = {flag: measured(Path(place), 'controller', calls, flag)
                      for flag in OPTIMISATIONS}
        row |= {flag: {size: getattr(one, size) for size in _SIZES}
                for flag, one in cortex.items() if one is not None}
    return row


def agreement_text(summary: Mapping[str, Any]) -> str:
    """Return the result of a comparison in a sentence."""
    rows = summary['loops'].values()
    rounded = [row for row in rows if row['error'] > TOLERANCE]
    text = (f'{sum(row["differs"] for row in rows)} of {len(rows)} loops differ in '
            f'{summary["samples"]:,} samples each; commands agree to '
            f'{max(row["error"] for row in rows if row not in rounded):.0e}')
    if not rounded:
        return text
    # the controller itself is as far from a calculation in 80 bits
    return (f'{text}, but in {len(rounded)}, where rounding errors move the commands of the '
            f'controller itself (by up to {max(row["rounding"][0] for row in rounded):.1g})')


def size_rows(summary: Mapping[str, Any]) -> list[str]:
    """Return a table of memory and instructions of the bundled models on a Cortex-M4F."""
    found = []
    for flag in OPTIMISATIONS:
        rows = [row[flag] for row in summary['loops'].values() if flag in row]
        sizes = (f'{min(values):.2g} to {max(values):.2g}' for values in (
            [row[name] / unit for row in rows]
            for name, unit in zip(_SIZES, (1e3, 1e3, 1e3, 1e6), strict=True)))
        if rows:
            found.append(f'| `{flag}` | {" | ".join(sizes)} |')
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare all; the exit code is 1 where one differs."""
    parser = argparse.ArgumentParser('exported_loops', description=__doc__)
    parser.add_argument('--samples', type=int, default=10_000)
    parser.add_argument('--random', type=int, default=50, help='number of random models')
    parser.add_argument('--executor', default='joblib', help='as the parameter of the trainer')
    parser.add_argument('--output', type=Path, help='folder of the summary')
    options = parser.parse_args(arguments)
    loops = itertools.chain(bundled_loops(), itertools.islice(random_loops(), options.random))
    items = {name: (name, seed) for seed, (name, _, _) in enumerate(loops)}
    summary: dict[str, Any] = {'samples': options.samples, 'loops': {}}
    with backend_of(options.executor) as backend:
        for name, found in backend.run(_row, items, shared=options.samples):
            summary['loops'][name] = found
            print(f'{name}: {found}', flush=True)
    print(agreement_text(summary), *size_rows(summary), sep='\n')
    if options.output is not None:
        options.output.mkdir(parents=True, exist_ok=True)
        (options.output / 'exported_loops.json').write_text(json.dumps(summary, indent=1) + '\n')
    return int(any(one['differs'] for one in summary['loops'].values()))


def random_loop(seed: int) -> Controller:
    """Return the loop of a number, with a time constant of about 20 s."""
    rng = np.random.default_rng(seed)
    model = _model(rng)
    n, m, d, names = model.n_x, model.n_u, len(model.disturbances), model.states.names

    def some(*values: Any) -> Any:
        return values[rng.integers(len(values))]

    partly = n > 1 and m < n and rng.random() < 0.5
    C = np.eye(n)[:max(1, n - 1)] if partly else np.eye(n)
    outputs = Outputs(names[:len(C)], model.states.units[:len(C)], C)
    half = 0.5 * (model.states.upper - model.states.lower)
    controlled = names[:m] if m < n else some(names, names[:1])
    inputs = model.inputs
    return Controller(model, Tuning.for_model(
        model, controlled=controlled,
        limits=InputLimits(inputs.lower, inputs.upper, some(np.full(m, np.inf), inputs.scale)),
        dead_time=some(np.full(m, -1.0), np.full(m, 1.7), rng.uniform(0.0, 3.0, m)),
        sensor=SensorLimits(
            np.full(len(C), -1e9), np.full(len(C), 1e9), some(np.full(len(C), np.inf), half[
                :len(C)]), some(np.full(len(C), np.inf), 0.1 * half[:len(C)]),
            stuck_sensor_timeout=3.0),
        disturbances=DisturbanceLimits(np.full(d, -1e9), np.full(d, 1e9), some(
            np.full(d, np.inf), np.full(d, 0.5)), np.full(d, 60.0)),
        setpoint_ramp=some(np.full(len(controlled), np.inf), 0.05 * np.ones(len(controlled))),
        setpoint_filter_time=some(0.0, 5.0),
        estimator='extended_kalman_filter' if partly else some(
            '', 'measured_state', 'extended_kalman_filter'),
        observer_bandwidth=some(0.0, 0.3),
        max_disturbance=some(np.full(m, np.inf), 0.3 * inputs.scale),
        tracking_tolerance=0.01 * inputs.scale, measurement_noise=np.zeros(len(C)),
        disturbance_noise=np.zeros(m), initial_error=np.zeros(n),
        fallback_order=some(('sdre', 'linear'), ('sdre',), ('linear',)),
        hold_timeout=some(2.0, 20.0), recovery_time=2.0, bumpless_transfer_time=some(0.0, 4.0),
        safe_value=some(inputs.center, inputs.lower)), outputs)


def _model(rng: np.random.Generator) -> LiftedModel:
    n, m = int(rng.integers(1, 4)), int(rng.integers(1, 3))
    identity, h = bool(rng.random() < 0.6), 6
    if rng.random() < 0.3:
        lift: Any = PolynomialObservables.total_degree(n, int(rng.integers(2, 4)))
    else:
        free = int(rng.integers(0, 4)) if identity else n + int(rng.integers(0, 2))
        V = 0.3 * rng.normal(size=(free, h)) / math.sqrt(h)
        W = rng.normal(size=(h, n))
        if not identity:
            V[:n] += np.linalg.pinv(W)
        lift = NetworkObservables(W, 0.3 * rng.normal(size=h), V, identity)
    features = lift.features.n_z
    A = -np.diag(rng.uniform(0.5, 3.0, lift.n_z)) + 0.2 * rng.normal(size=(lift.n_z, lift.n_z))
    readout = None
    if rng.random() < 0.4:
        readout = 0.1 * rng.normal(size=(n, features))
        readout[:, :n] -= np.diag(rng.uniform(0.5, 3.0, n))
    B = np.eye(n, m) + 0.3 * rng.normal(size=(n, m))
    states = Coordinates(tuple('xyz'[:n]), ('m',) * n, rng.normal(size=n), rng.uniform(
        0.5, 2.0, n), np.zeros(n), np.ones(n))
    states = replace(states, lower=states.center - states.scale, upper=states.center + (
        states.scale))
    inputs = Coordinates(tuple('uv'[:m]), ('V',) * m, rng.normal(size=m), rng.uniform(
        0.5, 2.0, m), np.full(m, -10.0), np.full(m, 10.0))
    inputs = replace(inputs, lower=inputs.center - 2.0 * inputs.scale,
                     upper=inputs.center + 2.0 * inputs.scale)
    some = rng.uniform(-1.0, 1.0, (30, n))
    found = LiftedModel(
        lift, 3.0 * A, 3.0 * B, states, inputs, 'min', Provenance('random'),
        training_states=TrainingStates(some, 0.3) if rng.random() < 0.5 else None,
        readout=None if readout is None else 3.0 * readout,
        input_terms=InputTerms(0.2 * rng.normal(size=(PolynomialObservables.total_degree(
            n, 2).n_z, n, m))) if rng.random() < 0.3 else None,
        pre_feedback=0.2 * rng.normal(size=(m, n)) if rng.random() < 0.3 else None,
        verified_loops=VerifiedLoops(some, rng.uniform(-1.0, 1.0, (30, n)), rng.random(30) < 0.3)
        if rng.random() < 0.3 else None,
        dead_time=rng.choice([0.0, 1.0], m))
    if rng.random() < 0.7:
        return found
    return replace(found, E=0.3 * rng.normal(size=(n, 1)), disturbances=Coordinates(
        ('d',), ('K',), np.ones(1), np.full(1, 2.0), -np.ones(1), np.full(1, 3.0)))


if __name__ == '__main__':
    sys.exit(main())
