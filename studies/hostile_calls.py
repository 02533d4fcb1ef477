# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Compare the C code of loops with the Python controller under calls that no plant would make.

Times from 1 ns to hours and below 0, signals that are not finite or absurd, states that jump; the
code is compiled with the sanitizers of addresses and undefined behaviour.
"""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
import subprocess
import sys
import tempfile

import numpy as np

from koopman_ros.control import Controller
from koopman_ros.control.state import State
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.export import c_code, compiled
from koopman_ros.export.vectors import answer_row, answered, Call
from studies.exported_loops import bundled_loops, disagreement, FLAGS, SANITIZERS, TOLERANCE

_ABSURD = (np.nan, np.inf, -np.inf, 1e308, -1e308, 1e300, 5e-324, -0.0)


def hostile_calls(controller: Controller, count: int, interval: float, seed: int
                  ) -> Iterator[tuple[Call, list[str]]]:
    """
    Yield calls with the answers of the controller.

    :param interval: usual one between samples in s.
    """
    rng = np.random.default_rng(seed)
    model, outputs, box = controller.model, controller.measured, controller.controlled
    state, now_ns, x = State(), NANOSECONDS, np.zeros(model.n_x)
    setpoint, d = np.full(len(box), np.nan), model.disturbances.center
    factors = [1.0] * 12 + [1.3, 0.5, 0.0, 10.0, 100.0, -1.0]
    for _ in range(count):
        elapsed_ns = round(float(rng.choice(factors)) * interval * NANOSECONDS)
        if rng.random() < 0.06:
            elapsed_ns = int(rng.choice([1, 1000, 10_000 * NANOSECONDS, -NANOSECONDS]))
        kind = rng.random()
        if 0.15 <= kind < 0.2:
            x = rng.uniform(-2.0, 2.0, model.n_x) * model.states.half_widths
        elif 0.2 <= kind < 0.35:
            x = np.zeros(model.n_x)
        y = outputs.of(model.states.to_physical(x + 0.01 * rng.normal(size=model.n_x)))
        if rng.random() < 0.06:
            y = _with(rng, y)
        if rng.random() < 0.05:
            setpoint = rng.uniform(box.lower, box.upper)
        if rng.random() < 0.02:
            setpoint = _with(rng, setpoint)
        applied = np.full(model.n_u, np.nan)
        if rng.random() < 0.3:
            applied = model.inputs.center + rng.normal(size=model.n_u) * rng.choice(
                [0.0, 0.1, 1.0, 1e3])
        if rng.random() < 0.03:
            applied = _with(rng, applied)
        if rng.random() < 0.2:
            d = rng.uniform(model.disturbances.lower, model.disturbances.upper)
        seen = _with(rng, d) if len(d) and rng.random() < 0.1 else d
        call = Call(elapsed_ns, None if rng.random() < 0.1 else y, setpoint, applied, seen)
        now_ns += max(0, elapsed_ns)
        state, command, report = answered(controller, state, call, now_ns)
        yield call, answer_row(command, report)


def _with(rng: np.random.Generator, values: np.ndarray) -> np.ndarray:
    """Return values of which one is absurd."""
    values = values.copy()
    values[rng.integers(len(values))] = rng.choice(_ABSURD)
    return values


def compared_hostile(controller: Controller, program: Path, count: int, interval: float, seed: int
                     ) -> tuple[float, tuple[int, ...]]:
    """Return the largest relative error of a command, and the calls with other codes."""
    rows = list(hostile_calls(controller, count, interval, seed))
    calls = ''.join(f'{",".join(call.row(controller))}\n' for call, _ in rows)
    ran = subprocess.run([program], input=calls, capture_output=True, text=True, check=True)
    return disagreement(controller, [answer for _, answer in rows], ran.stdout.splitlines())


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare all bundled models; the exit code is 1 where one differs."""
    parser = argparse.ArgumentParser('hostile_calls', description=__doc__)
    parser.add_argument('--calls', type=int, default=100, help='calls of a run')
    parser.add_argument('--runs', type=int, default=50, help='runs of each model')
    parser.add_argument('--only', default='', help='name of a model')
    options = parser.parse_args(arguments)
    failed = total = 0
    for name, controller, interval in bundled_loops():
        if options.only not in ('', name):
            continue
        with tempfile.TemporaryDirectory() as place:
            program = compiled(c_code(controller, interval), Path(place), 'gcc',
                               (*FLAGS, *SANITIZERS))
            for seed in range(options.runs):
                error, different = compared_hostile(
                    controller, program, options.calls, interval, seed)
                total += options.calls
                if error > TOLERANCE or different:
                    failed += 1
                    print(f'{name}, run {seed}: error {error:.1e}, other codes {different[:5]}',
                          flush=True)
        print(f'{name}: {total:,} calls so far, {failed} runs differ', flush=True)
    return int(failed > 0)


if __name__ == '__main__':
    sys.exit(main())
