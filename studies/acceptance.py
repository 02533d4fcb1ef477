# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Coverage of the acceptance: the bound of failing loops compared with the true plant.

Run by ``python -m studies.acceptance`` (needs the `train` and `bench` requirements). Each record
has white or coloured noise; each training is written when it ends, and is not repeated.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
import json
import math
from pathlib import Path
import sys
import time
from typing import Any

import numpy as np

from koopman_ros import __version__
from koopman_ros.core.arrays import Array
from koopman_ros.core.datasets import Episode, PlantDescription
from koopman_ros.core.integration import integrate
from koopman_ros.core.plots import table, write_figures
from koopman_ros.evaluation.closed_loop_test import evaluate_closed_loops
from koopman_ros.learning import compare_classes, evaluate_model, Thresholds
from koopman_ros.learning.identification import (
    DriftModel,
    identify,
    WeakForm,
    WeakFormParameters,
)
from koopman_ros.model_classes import LINEAR, POLYNOMIAL
from koopman_ros.plants import one_state_reactor, ReactorParameters
from studies import report
from studies.campaign import read_options

SAMPLES, NOISE, COLOUR = 1000, 0.005, 0.9  # noise as a share of each state's spread
TRUE_LOOPS, TRUE_SEED = 96, 12345
SUBSTEPS = 10  # of the integration between two samples
COLOURS = ('white', 'coloured')


@dataclass(frozen=True)
class Case:
    """A plant, its record and the structure of the drift that is estimated."""

    #: dx/dt (..., n_x) of states (..., n_x) and inputs (..., n_u)
    rate: Callable[[Array, Array], Array]
    start: Sequence[float]  #: (n_x,)
    inputs: Sequence[tuple[float, float]]  #: range of each
    period: float  #: between samples
    hold: int  #: samples of each random step of the inputs
    degrees: Sequence[int] = (1, 2, 3)  #: of the drift that are tried
    input_degree: int = 0  #: of B(x)
    right: bool = True  #: whether the structure contains the plant, nearly
    delay: int = 0  #: samples by which the inputs act late, which the model knows


def _stacked(*rates: Array) -> Array:
    return np.stack(rates, axis=-1)


def _two_tanks(x: Array, u: Array) -> Array:
    """Two tanks in a row, filled by a pump."""
    a, b = np.sqrt(np.maximum(x[..., 0], 1e-9)), np.sqrt(np.maximum(x[..., 1], 1e-9))
    return _stacked(u[..., 0] - a, a - b)


def _square_tanks(x: Array, u: Array) -> Array:
    """Return the same where the flow is the square of the command."""
    return _two_tanks(x, u ** 2)


def _pendulum(x: Array, u: Array) -> Array:
    """Swing a damped pendulum by a torque."""
    return _stacked(x[..., 1], u[..., 0] - np.sin(x[..., 0]) - 0.5 * x[..., 1])


def _dead_zone_pendulum(x: Array, u: Array) -> Array:
    """Return the same behind an actuator without effect for small commands."""
    return _pendulum(x, np.sign(u) * np.maximum(np.abs(u) - 0.5, 0.0))


def _saturating_pendulum(x: Array, u: Array) -> Array:
    """Return the same behind an actuator that saturates."""
    return _pendulum(x, np.tanh(2.0 * u))


def _friction_motor(x: Array, u: Array) -> Array:
    """Turn a shaft on a spring with dry friction."""
    return _stacked(x[..., 1], 2.0 * u[..., 0] - x[..., 0] - x[..., 1]
                    - 0.15 * np.tanh(x[..., 1] / 0.02))


def _duffing(x: Array, u: Array) -> Array:
    """Push a mass on a stiffening spring."""
    return _stacked(x[..., 1], u[..., 0] - x[..., 0] - x[..., 0] ** 3 - 0.6 * x[..., 1])


def _van_der_pol(x: Array, u: Array) -> Array:
    """Return the oscillator with a small limit cycle."""
    return _stacked(x[..., 1], u[..., 0] - x[..., 0] + 0.3 * (1.0 - x[..., 0] ** 2) * x[..., 1])


def _van_de_vusse(x: Array, u: Array) -> Array:
    """Feed a reactor of consecutive and parallel reactions (C. J. van de Vusse, 1964), 1/min."""
    a, b, feed = x[..., 0], x[..., 1], u[..., 0]
    return _stacked(-0.83 * a - 0.17 * a ** 2 + feed * (10.0 - a), 0.83 * a - 1.67 * b - feed * b)


def _chemostat(x: Array, u: Array) -> Array:
    """Dilute a culture with growth after Monod."""
    biomass, substrate = x[..., 0], x[..., 1]
    growth = 0.5 * substrate / (0.5 + substrate) * biomass
    return _stacked(growth - u[..., 0] * biomass, u[..., 0] * (4.0 - substrate) - 2.0 * growth)


def _boost(x: Array, u: Array) -> Array:
    """Switch a boost converter, averaged; current and voltage, by the duty."""
    off = 1.0 - u[..., 0]
    return _stacked(1.0 - off * x[..., 1] - 0.1 * x[..., 0], off * x[..., 0] - 0.5 * x[..., 1])


def _mixing_tank(x: Array, u: Array) -> Array:
    """Fill and heat a tank; level and temperature."""
    level = np.maximum(x[..., 0], 0.1)
    heated = u[..., 0] * (1.0 - x[..., 1]) + u[..., 1]
    return _stacked(u[..., 0] - np.sqrt(level), heated / level)


def _outflow(x: Array, u: Array) -> Array:
    """Fill one tank."""
    return u - np.sqrt(np.maximum(x, 1e-9))


_REACTOR = one_state_reactor(ReactorParameters())
CASES: dict[str, Case] = {
    'reactor': Case(_REACTOR.derivative, (316.0,), ((284.0, 299.0),), 1.0 / 30.0, 30,
                    (1, 2, 3, 4)),
    'outflow': Case(_outflow, (1.0,), ((0.5, 1.5),), 0.2, 10),
    'outflow behind dead time': Case(_outflow, (1.0,), ((0.5, 1.5),), 0.2, 10, delay=5),
    'two tanks': Case(_two_tanks, (1.0, 1.0), ((0.5, 1.5),), 0.3, 8),
    'square tanks': Case(_square_tanks, (1.0, 1.0), ((0.3, 1.8),), 0.3, 8, right=False),
    'pendulum': Case(_pendulum, (0.0, 0.0), ((-0.8, 0.8),), 0.1, 15),
    'dead zone': Case(_dead_zone_pendulum, (0.0, 0.0), ((-1.4, 1.4),), 0.1, 15, right=False),
    'saturation': Case(_saturating_pendulum, (0.0, 0.0), ((-1.0, 1.0),), 0.1, 15, right=False),
    'dry friction': Case(_friction_motor, (0.0, 0.0), ((-1.0, 1.0),), 0.1, 15, right=False),
    'duffing': Case(_duffing, (0.0, 0.0), ((-1.5, 1.5),), 0.1, 12),
    'van der pol': Case(_van_der_pol, (0.5, 0.0), ((-1.0, 1.0),), 0.1, 12),
    'van de vusse': Case(_van_de_vusse, (3.0, 1.1), ((0.3, 1.0),), 0.05, 10, input_degree=1),
    'chemostat': Case(_chemostat, (1.5, 1.0), ((0.1, 0.35),), 0.4, 10, input_degree=1),
    'boost': Case(_boost, (1.5, 1.5), ((0.2, 0.5),), 0.3, 10, input_degree=1),
    'boost, constant B': Case(_boost, (1.5, 1.5), ((0.2, 0.5),), 0.3, 10, right=False),
    'mixing tank': Case(_mixing_tank, (1.0, 2.0), ((0.7, 1.3), (0.5, 1.5)), 0.2, 10,
                        input_degree=1),
}


def _under(rate: Callable[[Array, Array], Array], u: Array, x: Array) -> Array:
    return rate(x, u)


def record(case: Case, seed: int, colour: str) -> tuple[PlantDescription, Episode]:
    """Return a record under random steps, with noise, the inputs as they act."""
    rng = np.random.default_rng([seed, COLOURS.index(colour)])
    low, high = np.transpose(case.inputs)
    steps = -(-SAMPLES // case.hold)
    u = np.repeat(rng.uniform(low, high, (steps, len(low))), case.hold, axis=0)[:SAMPLES]
    x = [np.array(case.start, dtype=np.float64)]
    for v in u[:-1]:
        x.append(integrate(partial(_under, case.rate, v), x[-1], case.period, SUBSTEPS))
    noise = rng.standard_normal((SAMPLES, len(case.start)))
    if colour == 'coloured':
        for k in range(1, SAMPLES):
            noise[k] = COLOUR * noise[k - 1] + math.sqrt(1.0 - COLOUR ** 2) * noise[k]
    states: Array = np.array(x)
    time_s: Array = case.period * np.arange(SAMPLES, dtype=np.float64)
    n, m = len(case.start), len(low)
    plant = PlantDescription(
        'plant', tuple(f'x{i + 1}' for i in range(n)), ('1',) * n,
        tuple(f'u{j + 1}' for j in range(m)), ('1',) * m, 's', np.full(n, np.nan),
        np.full(m, np.nan), None, input_matrix_degree=case.input_degree)
    measured: Array = states + NOISE * np.ptp(states, axis=0) * noise
    return plant, Episode(time_s, measured, time_s, u)


def train(case: Case, seed: int, colour: str) -> dict[str, Any]:
    """Learn from a record; return the statement, and the share of loops on the true plant."""
    plant, episode = record(case, seed, colour)
    begin = time.process_time()
    found = identify(plant, [episode], degrees=case.degrees, seed=seed,
                     methods={'weak_form': WeakForm(WeakFormParameters((20,)))})
    found = replace(found, dead_time=np.full(1, case.delay * case.period))
    box = found.drift.box
    learned = compare_classes(
        found, replace(plant, nominal_state=box.states.center, nominal_input=box.inputs.center),
        Thresholds(margin=0.0), n_z=1,
        model_class=LINEAR if isinstance(found.drift, DriftModel) and found.drift.linear else (
            POLYNOMIAL), seed=seed, starts=1, loops=16)
    middle = time.process_time()
    decision = evaluate_model(found, learned, None, Thresholds(margin=0.0))
    end = time.process_time()
    truth = evaluate_closed_loops(
        replace(learned.model, dead_time=np.full(len(box.inputs), case.delay * case.period)),
        case.rate, loops=TRUE_LOOPS, seed=TRUE_SEED, interval=case.period, noise=found.noise)
    assert truth is not None
    figures: dict[str, Any] = {
        'form': found.drift.form, 'accepted': decision.accepted,
        'reasons': list(decision.reasons), 'statement': decision.statement,
        'true_failed': int(truth.failed.sum()), 'true_loops': truth.loops,
        'true_hopeless': truth.hopeless, 'seconds_learning': middle - begin,
        'seconds_acceptance': end - middle, 'seconds_truth': time.process_time() - end}
    if (about := decision.plant) is not None:
        x = episode.x
        wrong = np.abs(case.rate(x, episode.u) - found.drift.rate(x, episode.u)).max(axis=0)
        figures |= {
            'plants': len(about.test.loops), 'failed': int(about.test.failed.sum()),
            'loops': int(about.test.loops.sum()), 'expected': about.test.share[0],
            'bound': about.test.share[1], 'cause': dict(about.causes),
            'rate_error': (learned.model.states.scale * about.band.error).tolist(),
            'true_rate_error': wrong.tolist(),
            'held': about.held.steady.tolist()}
    return figures


def coverage(trainings: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return the sentences about all trainings."""
    judged = [one for one in trainings.values() if 'bound' in one and one['true_loops']]
    covered = sum(one['true_failed'] <= one['bound'] * one['true_loops'] for one in judged)
    taken = [one for one in judged if one['accepted']]
    good = sum(one['true_failed'] <= one['bound'] * one['true_loops'] for one in taken)
    bands = [(stated, true) for one in judged for stated, true in zip(
        one['rate_error'], one['true_rate_error'], strict=True)]
    return [
        f'{len(trainings)} trainings, {len(judged)} with a bound: it holds on the true plant in '
        f'{covered}. {len(taken)} are accepted; it holds in {good} of them.',
        f'The largest error of a rate is within the band in {sum(t <= s for s, t in bands)} of '
        f'{len(bands)} cases.']


def table_of(trainings: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a row for each plant and kind of noise: ranges over the seeds."""
    def span(values: Sequence[float], factor: float = 1.0) -> str:
        low, high = (f'{factor * end:.2g}' for end in (min(values), max(values)))
        return low if low == high else f'{low} to {high}'

    rows = []
    for name in CASES:
        for colour in COLOURS:
            own = [one for key, one in trainings.items() if key.startswith(f'{name}/{colour}/')]
            judged = [one for one in own if 'bound' in one]
            counted = [one for one in own if one['true_loops']]
            if not own:
                continue
            rows.append((
                name, colour, len(own), f'{sum(one["accepted"] for one in own)}',
                span([one['bound'] for one in judged], 100.0) if judged else '-',
                span([one['true_failed'] / one['true_loops'] for one in counted], 100.0)
                if counted else '-',
                f'{np.mean([one["seconds_acceptance"] for one in own]):.1f}'))
    return table(('plant', 'noise', 'trainings', 'accepted', 'stated bound [%]',
                  'true share [%]', 'processor time [s]'), rows, range(2, 7))


def main(args: list[str] | None = None) -> int:
    """Run the study."""
    options = read_options(args, 'studies.acceptance', 'Compare the acceptance with true plants.',
                           'out/studies-acceptance', 2, plants=CASES)
    output: Path = options.output
    output.mkdir(parents=True, exist_ok=True)
    path = output / 'summary.json'
    trainings: dict[str, Any] = json.loads(path.read_text())['trainings'] if path.exists() else {}
    for seed in range(options.seeds):
        for name in options.plants or CASES:
            for colour in COLOURS:
                key = f'{name}/{colour}/{seed}'
                if key in trainings:
                    continue
                with np.errstate(all='ignore'):
                    try:
                        trainings[key] = train(CASES[name], seed, colour)
                    except ValueError as error:
                        print(f'{key}: {error}', file=sys.stderr)
                        continue
                one = trainings[key]
                print(f'{key}: {one["statement"] or one["reasons"]}; true '
                      f'{one["true_failed"]} of {one["true_loops"]}', file=sys.stderr, flush=True)
                write_figures(path, {'package_version': __version__, 'trainings': trainings})
    report.write(output, 'Acceptance and true plants',
                 [*coverage(trainings), table_of(trainings)], [])
    print(f'wrote {output}/report.md and summary.json')
    return 0


if __name__ == '__main__':
    sys.exit(main())
