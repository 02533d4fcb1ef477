# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Learn a model of a plant from files of measurements, without ROS.

The model is written with a report. Exit code: 0 for an accepted model, 2 for a rejected one, 1 for
an error, 130 after an interrupt, which keeps the best model so far.
"""

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
import shlex
import sys
from typing import Any

from koopman_ros import __version__
from koopman_ros.core.paths import model_path
from koopman_ros.core.units import printed
from koopman_ros.execution.training import (
    class_lines,
    constant_lines,
    JobState,
    outcome_text,
    TrainingProgress,
)
from koopman_ros.model import LiftedModel, load
from koopman_ros.model_classes import BEST
from koopman_ros.parameters.signal_topics import described, Signals
from koopman_ros.parameters.table import ParameterTable
from koopman_ros.parameters.trainer import TrainerParameters
from koopman_ros.parameters.trainer_table import trainer_table
from koopman_ros.records import read, Record

# Parameters of the trainer that are options here, by the same names.
_OPTIONS = (
    'model', 'model_output', 'model_class', 'lifted_dimension', 'unmeasured_states',
    'input_matrix', 'input_matrix_degree', 'physical_model', 'estimated_constants',
    'identification_methods', 'restarts', 'training_seed', 'training_samples', 'warm_start_model',
    'acceptance_margin', 'max_condition_number', 'synchronisation_tolerance', 'executor', 'device')
# Not those of a node: of a plant that is not known yet any class may be the best, and states may
# be missing. The controller of a trainer is set up for the states of its model.
_DEFAULTS = {'model_class': BEST, 'model_output': '', 'unmeasured_states': -1}


def main(arguments: list[str] | None = None) -> int:
    """Learn, print the result, and return the exit code."""
    options = vars(command_parser().parse_args(arguments))
    try:
        present = _loaded(options.get('model', ''))
        states, inputs, disturbances = _wanted(options, present)
        record, test = (read(files, states, [*inputs, *disturbances], time=options['time'],
                             period=options['period'], linear=options['linear'],
                             dayfirst=options['dayfirst'],
                             tolerance=options.get('synchronisation_tolerance', 0.0))
                        if files else None for files in (options['record'], options['test']))
        assert record is not None
        print(record, flush=True)
        return _learned(options, present, record, len(inputs), test)
    except (OSError, ValueError, ImportError) as error:
        print(f'learn: {" ".join(str(error).split())}', file=sys.stderr)
        return 1


def command_parser() -> argparse.ArgumentParser:
    """Return the options of the command."""
    parser = argparse.ArgumentParser(
        'learn', description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add: Callable[..., Any] = parser.add_argument
    add('--version', action='version', version=__version__)
    add('record', nargs='+', help='.csv, .parquet or .mat files, or bags')
    signal = "as name, 'name [unit]' or 'name = column [unit]'"
    add('--states', nargs='+', default=(), metavar='STATE', help=f'measured signals, {signal}; '
        'by default those of the model')
    add('--inputs', nargs='+', default=(), metavar='INPUT', help=f'inputs, {signal}')
    add('--disturbances', nargs='+', default=(), metavar='SIGNAL',
        help=f'measured disturbances: signals that act but are not manipulated, {signal}')
    add('--time', default='', metavar='COLUMN', help="column of the time, with its unit, as in "
        "'stamp [ms]'; by default the column time")
    add('--period', type=float, default=0.0, metavar='S',
        help='time between rows, in place of a column, in s')
    add('--dayfirst', action=argparse.BooleanOptionalAction, default=None,
        help='whether 1/2/2026 is 1 February, where the dates of the column leave it open')
    add('--linear', nargs='+', default=(), metavar='INPUT',
        help='inputs that are linear from row to row; others are held')
    add('--lag', nargs='+', default=(), metavar='INPUT=S', help='time constants with which inputs '
        'follow their commands, in s; -1: found from a record of all states')
    add('--dead_time', nargs='+', default=(), metavar='INPUT=S', help='dead times of inputs, in '
        's; of those not named it is found')
    add('--characteristic', nargs='+', default=(), metavar='INPUT=VALUE:EFFECT,...',
        help='static characteristics of inputs, as points; two points: it acts linearly; of those '
        'not named it is found')
    add('--as-state', nargs='+', default=(), metavar='INPUT', help='inputs that do not act '
        'linearly: their commands are states of the model, whose rates the laws set')
    add('--test', nargs='+', default=(), metavar='FILE', help='record of the same signals to test '
        'the model on; it takes no part in the training')
    options = parser.add_argument_group('training, by the parameters of the trainer node')
    for row in (_table(None, ('x [1]',), ('u [1]',)).rows[name] for name in _OPTIONS):
        default: Any = _DEFAULTS.get(row.name, row.default)
        many = isinstance(default, tuple)
        notes = '; '.join(filter(None, (
            row.range_text if not row.choices else '', '' if many or row.default == '' else
            f'default: {"the name of the record" if default == "" else default}')))
        options.add_argument(
            f'--{row.name}', type=type(default[0] if many else default),
            default=argparse.SUPPRESS, nargs='+' if many else None, choices=row.choices or None,
            metavar=None if row.choices else row.name.upper(), help=(
                f'{row.description}{f" [{row.unit}]" if row.unit else ""}'
                f'{f" ({notes})" if notes else ""}').replace('%', '%%'))
    return parser


def _next(summary: Mapping[str, Any]) -> str:
    """Return the next steps in words."""
    file = summary['model_file']
    if summary['accepted'] is None:
        return (f'--model_class {shlex.quote(summary["model_class"])} learns and judges this '
                'class alone')
    if not summary['accepted']:
        return ('change the record or the options as the reasons say; '
                'docs/how-to/tune_training.md explains each')
    return (f"control by load('{file}') in Python (docs/tutorials/without_ros.md) or by the node "
            f'(-p model:={file}), or write C code (python -m koopman_ros.export {file})')


def _loaded(model: str) -> LiftedModel | None:
    return load(model_path(model)) if model else None


def _wanted(options: Mapping[str, Any], present: LiftedModel | None) -> list[list[str]]:
    """Return states, inputs and disturbances as named, or as the current model has them."""
    named = [list(options[kind]) for kind in ('states', 'inputs', 'disturbances')]
    if present is None:
        if not (named[0] and named[1]):
            raise ValueError('the signals are not known: give --states and --inputs, as in '
                             "--states level --inputs 'pump [V]'")
        return named
    own = [[f'{name} [{unit}]' for name, unit in zip(of.names, of.units, strict=True)]
           for of in (present.states, present.inputs, present.disturbances)]
    return [*(named[:2] if named[0] and named[1] else own[:2]), named[2] or own[2]]


def _table(present: LiftedModel | None, states: tuple[str, ...], inputs: tuple[str, ...],
           disturbances: tuple[str, ...] = ()) -> ParameterTable[TrainerParameters]:
    return trainer_table(present, {
        'system': '', 'states_measured': states, 'inputs_commanded': inputs,
        'disturbances_measured': disturbances})


def _seconds(option: str, texts: Sequence[str]) -> dict[str, float]:
    try:
        return {name: float(seconds) for name, seconds in (one.split('=') for one in texts)}
    except ValueError:
        raise ValueError(f'--{option} {" ".join(texts)} must be inputs with a time in s each, as '
                         'in pump=5') from None


def _points(texts: Sequence[str]) -> dict[str, tuple[float, ...]]:
    try:
        pairs = {name: [point.split(':') for point in points.split(',')]
                 for name, points in (one.split('=') for one in texts)}
        return {name: tuple(float(number) for value, effect in points for number in (
            value, effect)) for name, points in pairs.items()}
    except ValueError:
        raise ValueError(f'--characteristic {" ".join(texts)} must be inputs with points, as in '
                         'valve=0:0,50:20,100:90') from None


def _learned(options: Mapping[str, Any], present: LiftedModel | None, record: Record, n_u: int,
             test: Record | None) -> int:
    # not before it is clear that there is something to learn: torch takes seconds
    from koopman_ros.learning import Interrupted, learn
    from koopman_ros.learning.report import reported

    about = record.plant
    acting = dict(zip(about.input_names, about.input_units, strict=True))
    inputs, disturbances = dict(list(acting.items())[:n_u]), dict(list(acting.items())[n_u:])
    signals = Signals(dict(zip(about.state_names, about.state_units, strict=True)), inputs,
                      disturbances=disturbances)
    table = _table(present, *(described(some) for some in (
        signals.states, signals.inputs, disturbances)))
    given = {name: tuple(value) if isinstance(value, list) else value
             for name, value in options.items() if name in _OPTIONS}
    settings = table.snapshot({
        **_DEFAULTS, 'model_output': f'{about.name}.safetensors', **given})
    if reason := table.check(settings):
        raise ValueError(reason)
    progress = TrainingProgress(lambda text: print(text, file=sys.stderr, flush=True))

    now = JobState()

    def on_progress(share: float, text: str) -> bool:
        nonlocal now
        now = JobState(share, text)
        progress.show(now)
        return False

    try:
        result = learn(record, test=test, on_progress=on_progress, **{
            **settings.training(signals), 'lag': _seconds('lag', options['lag']),
            'dead_time': _seconds('dead_time', options['dead_time']),
            'characteristics': _points(options['characteristic']),
            'as_state': tuple(options['as_state']), 'output': settings.model_output,
            **{name: str(model_path(file)) for name in ('model', 'warm_start_model')
               if (file := getattr(settings, name))}})
    except Interrupted as interrupt:
        progress.show(replace(now, ended=True))
        if interrupt.result is not None:
            summary: Mapping[str, Any] = interrupt.result.summary()
            print(printed(outcome_text(summary)))
            _print_classes(summary)
            print(f'next: {_next(summary)}', flush=True)
        raise
    progress.show(JobState(1.0, ended=True))
    summary, files = reported(result)
    print(printed(outcome_text(summary)))
    _print_classes(summary)
    for warning in summary['warnings']:
        print(f'warning: {printed(warning)}')
    for name, run in result.free_runs.items():
        print(printed(f'{name}: {run}'))
    print('report: ' + ', '.join(files))
    print(f'{summary["found"]}: {result.verdict}')
    print(f'next: {_next(summary)}')
    return 0 if result.accepted else 2


def _print_classes(summary: Mapping[str, Any]) -> None:
    for name, line in {**class_lines(summary), **constant_lines(summary)}.items():
        print(printed(f'{name}: {line}'))
