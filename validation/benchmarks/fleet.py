# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What it saves to learn the plants of a fleet from a sibling's lift, beside from nothing."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
import sys
import tempfile
import time
from typing import Any

import numpy as np

from koopman_ros.learning import retrain_fleet, TrainingTask
from koopman_ros.learning.lift.metrics import lifted_rate
from koopman_ros.learning.task import FIRST
from koopman_ros.lifting import load
from koopman_ros.plants import ControlAffineSystem, equilibrium_input
from koopman_ros.plants.library.reactor import OneStateReactor
from koopman_ros.plants.library.two_tanks import TwoTanks
from koopman_ros.reports import table
from koopman_ros.units import SECONDS_PER_TIME_UNIT
from validation.benchmarks.long_records import Design, simulated
from validation.benchmarks.retraining import Case, task_of, write_bags

PACKAGES = ('torch', 'numpy', 'scipy')
_OUTLETS = ('orifice_1', 'orifice_2')
_MIDDLE = 318.0  # K
_TESTED = 2000  # states at which a lift is held against the plant


@dataclass(frozen=True)
class Plan:
    """One extent of the measurements."""

    #: share by which the constant of each plant differs, by kind
    plants: Mapping[str, tuple[float, ...]]
    samples: int  #: of each plant


PLANS = {
    'quick': Plan({'reactors': (0.0, -0.1)}, 1800),
    'default': Plan(dict.fromkeys(('reactors', 'tanks'), (0.0, -0.1, 0.1, -0.2, 0.2, 0.15)),
                    3600),
}


def plant(kind: str, share: float) -> Case:
    """Return a plant of a kind whose constant, UA or the outlets, differs by a share."""
    if kind == 'reactors':
        clean = OneStateReactor()
        system = replace(clean, heat_transfer_coefficient=(
            1.0 + share) * clean.heat_transfer_coefficient).system([314.475])
        # about what holds the middle of the range, which the plants have in common
        held = equilibrium_input(system, [_MIDDLE])
        design = Design(system, held - 20.0, held + 4.0, (30.0, 120.0), 1.0, np.array([0.1]))
    else:
        tanks = TwoTanks()
        system = replace(tanks, **{name: (1.0 + share) * getattr(tanks, name)
                                   for name in _OUTLETS}).system()
        design = Design(system, 0.6 * system.nominal_input, 1.4 * system.nominal_input,
                        (10.0, 60.0), 1.0, np.full(2, 2e-4))
    return Case(f'{kind}, {100.0 * share:+.0f} %', design, 1_000_000)


def measure(plan: Plan, figures: dict[str, Any], _: Path) -> Iterator[str]:
    """Learn the plants of each kind from nothing, and from the first that is accepted."""
    figures['clock'] = 'processor time'
    for kind, shares in plan.plants.items():
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            cases = {f'{100.0 * share:+.0f} %': plant(kind, share) for share in shares}
            tasks = {}
            for own, case in cases.items():
                (folder / own).mkdir()
                tasks[own] = replace(
                    task_of(case, write_bags(case, plan.samples, folder / own),
                            folder / own / 'new.safetensors'),
                    coordinates=case.design.system.n_x + 2)
            rows = figures[kind] = {}
            for begin in ('', FIRST):
                _tell(f'{kind} from {begin or "nothing"}')
                rows[begin or 'nothing'] = _learned(cases, {
                    own: replace(task, sibling=begin) for own, task in tasks.items()})
        yield f'{kind}\n\n{_table(rows)}'


def _learned(cases: Mapping[str, Case], tasks: Mapping[str, TrainingTask]) -> dict[str, Any]:
    rows = {}
    since = time.process_time()
    for name, outcome in retrain_fleet(tasks):
        now = time.process_time()
        summary = outcome.summary
        if summary is None:
            raise RuntimeError(f'{name}: {outcome.error}')
        own = summary['classes'].get(summary.get('model_class', ''), {})
        rows[name] = {
            'seconds': now - since,
            'steps': own.get('steps'), 'accepted': outcome.accepted,
            'reasons': summary['reasons'], 'warnings': summary['warnings'],
            'heldout_error': summary.get('heldout_error'),
            'rx': _against(cases[name].design, summary['model_file'])
            if summary['model_file'] else None}
        since = time.process_time()
    return rows


def _against(design: Design, file: str) -> float:
    """Return the mean-square error of a lift's drift along fresh runs, relative to the drift's."""
    system: ControlAffineSystem = design.system
    states, inputs = simulated(replace(design, noise=np.zeros(system.n_x)), 7 * _TESTED, 1, 99)
    x, u = (values.reshape(-1, values.shape[2])[::7][:_TESTED] for values in (states, inputs))
    model = load(Path(file))
    seconds = SECONDS_PER_TIME_UNIT[system.time_unit]
    true = system.derivative(x, u) / seconds
    error = (lifted_rate(model, 1.0)(x, u) - true) / model.states.scale
    return float(np.mean(error ** 2) / np.mean((true / model.states.scale) ** 2))


def _table(rows: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> str:
    found = []
    for name in rows['nothing']:
        both = [rows[begin][name] for begin in ('nothing', FIRST)]
        found.append((name, *(f'{one["seconds"]:.1f}' for one in both),
                      *(one['steps'] for one in both),
                      *('' if one['rx'] is None else f'{one["rx"]:.1e}' for one in both),
                      *('accepted' if one['accepted'] else 'refused' for one in both)))
    total = [sum(one['seconds'] for one in rows[begin].values()) for begin in ('nothing', FIRST)]
    found.append(('all', *(f'{seconds:.1f}' for seconds in total),
                  *(sum(one['steps'] or 0 for one in rows[begin].values())
                    for begin in ('nothing', FIRST)), *[''] * 4))
    return table(('plant', *(f'{what}, from {begin}' for what in (
        'processor [s]', 'steps', 'error', 'lift') for begin in (
            'nothing', 'a sibling'))), found, range(1, 7))


def _tell(label: str) -> None:
    print(f'fleet: {label}', file=sys.stderr, flush=True)
