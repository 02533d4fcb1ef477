# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Learning from a record, for the command line, scripts and notebooks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import Field, fields
from numbers import Integral, Real
from typing import Any

from koopman_ros.core.arrays import expect
from koopman_ros.core.message_fields import place
from koopman_ros.learning.pipeline import retrain
from koopman_ros.learning.pipeline_progress import OnProgress
from koopman_ros.learning.task import TrainingTask
from koopman_ros.learning.training_result import TrainingResult
from koopman_ros.model_classes import BEST
from koopman_ros.records import Record, RecordedInput, RecordedState

_OF_RECORD = ('bags', 'states', 'inputs')  # fields of a task that the record has


def learn(record: Record, *, test: Record | None = None, disturbances: Sequence[str] = (),
          unmeasured_states: int = -1, dead_time: Mapping[str, float] | None = None,
          model_class: str = BEST, seed: int = 0, on_progress: OnProgress | None = None,
          **settings: Any) -> TrainingResult:
    """
    Learn a model of a record, and judge it.

    Dead times, unmeasured states and the equations are found from the record, a lift is learned
    of them, and closed loops and a free run of the record judge it, as in the program `learn`, the
    trainer node and the panel. Nothing is written.

    >>> record = read('log.csv', 'level', 'pump')
    >>> result = learn(record, unmeasured_states=0)
    >>> result.accepted, result.dead_time.tolist()
    (True, [3.0])
    >>> result.save('tank.safetensors')

    :param record: measurements, of :func:`read`.
    :param test: record of the same signals that takes no part in the training.
    :param disturbances: those of its inputs that are measured, not manipulated.
    :param unmeasured_states: most states that are not in the record; -1: as many as it needs.
    :param dead_time: of inputs by name, in s; of those not named it is found.
    :param model_class: to learn, e.g. ``'linear'``; by default the one that the rule selects.
    :param seed: of the split and of the training.
    :param on_progress: called with the share done and a text; True stops the training, which
        returns the best of the classes learned so far, or raises `Stopped` before the first.
    :param settings: further fields of :class:`TrainingTask`, e.g. ``lag`` or ``physical_model``.
    :raises TypeError: for an unknown setting, or a record that is none.
    :raises ValueError: for a record that does not determine a model, or settings that do not fit.
    :raises KeyboardInterrupt: at Ctrl-C; its `result` has the best of the classes learned so far.
    """
    expect(record=(record, Record))
    if test is not None:
        expect(test=(test, Record))
    known = sorted({one.name for one in fields(TrainingTask)} - set(_OF_RECORD))
    if unknown := ', '.join(name for name in settings if name not in known):
        raise TypeError(f'unknown setting {unknown}: choose from {", ".join(known)}')
    settings |= {'disturbances': disturbances, 'unmeasured_states': unmeasured_states,
                 'dead_time': dead_time or {}, 'model_class': model_class, 'seed': seed}
    for one in fields(TrainingTask):
        if one.name in settings:
            settings[one.name] = _checked(one, settings[one.name], record.plant.input_names)
    if on_progress is not None and not callable(on_progress):
        raise TypeError(f'on_progress must be a function of share and text, got {on_progress!r}')
    about = record.plant
    # tables have no topics: those that the names would usually have stand for them
    states = tuple(RecordedState(name, unit, place(name, name, unit)) for name, unit in zip(
        about.state_names, about.state_units, strict=True))
    inputs = tuple(RecordedInput(name, unit, place(name, name, unit)) for name, unit in zip(
        about.input_names, about.input_units, strict=True))
    task = TrainingTask(**{
        'output': '', 'model': '', 'plant': about.name, 'bags': record.sources, 'states': states,
        'inputs': inputs, **settings})
    return retrain(task, on_progress, record=record, test=test)


def _checked(about: Field[Any], value: Any, inputs: Sequence[str]) -> Any:
    """Return a setting of a task, one name as a tuple of it; TypeError for another type."""
    name, default = about.name, about.default
    if about.default_factory is dict:
        if not isinstance(value, Mapping):
            raise TypeError(f'{name} must be by name of the signal, as in {{{inputs[0]!r}: 3.0}}, '
                            f'got {value!r}')
        if name in ('dead_time', 'lag'):
            for signal, seconds in value.items():
                if not isinstance(seconds, Real):
                    raise TypeError(f'{name} of {signal} must be a number of s, got {seconds!r}')
    elif isinstance(default, tuple):
        value = (value,) if isinstance(value, str) else value
        if not (isinstance(value, Sequence) and all(isinstance(one, str) for one in value)):
            raise TypeError(f'{name} must be a list of names, got {value!r}')
        return tuple(value)
    elif isinstance(default, int | float):
        if not isinstance(value, Integral if isinstance(default, int) else Real):
            words = 'an integer' if isinstance(default, int) else 'a number'
            raise TypeError(f'{name} must be {words}, got {value!r}')
        least = {'unmeasured_states': -1, 'starts': 1, 'most_samples': 1000}.get(name, 0)
        if not float(value) >= least:
            raise ValueError(f'{name} = {value} must be at least {least}')
    return value
