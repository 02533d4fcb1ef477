# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Replay of bags: their records, the models and parameters that these name, and the report."""

from collections.abc import Iterable, Mapping, Sequence
import enum
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from koopman_ros.control import Controller
from koopman_ros.core.paths import config_directory, model_path
from koopman_ros.event_log.loop import Alternative, Replay, replay
from koopman_ros.event_log.records import EventRecord, RecordError
from koopman_ros.event_log.report import (
    compared_bag,
    ReplayedBag,
    reproduced,
    verdict,
    write_report,
)
from koopman_ros.event_log.sources import find_model, lately, read_records
from koopman_ros.model import LiftedModel
from koopman_ros.parameters.controller import built, ReplayParameters, table_of
from koopman_ros.parameters.model_checks import load_suitable
from koopman_ros.parameters.signal_topics import EVENT_LOG, signals_of
from koopman_ros.parameters.table import ConfigurationError
from koopman_ros.records import BagReadError, summary

RECORDS = f'/{EVENT_LOG}'  # topic of the records in a bag


class Result(enum.IntEnum):
    """The result of a replay, as exit code; 1 is that of every error, too."""

    REPRODUCED = 0
    DIFFERENT = 1
    NOTHING_COMPARED = 3


def replay_bags(parameters: ReplayParameters, topic: str = RECORDS,
                given: Mapping[str, Any] = MappingProxyType({})) -> Result:
    """
    Replay bags and write the report.

    :param topic: absolute name of that of the records.
    :param given: parameters that replace recorded ones.
    :raises BagReadError, ModelFileError, ConfigurationError: also without the package that draws.
    """
    try:
        # a controller's machine may lack it
        from koopman_ros.event_log.figure import draw
    except ImportError as error:
        raise ConfigurationError(
            'the plot needs matplotlib, which is not installed: pip install matplotlib, or '
            'apt-get install python3-matplotlib') from error

    bags = [replayed_bag(path, parameters, topic, given) for path in parameters.bags]
    folder, new_model = Path(parameters.output), parameters.new_model
    folder.mkdir(parents=True, exist_ok=True)
    pictures = ['replay.png'] if len(bags) == 1 else [
        f'replay_{number}.png' for number in range(1, len(bags) + 1)]
    for bag, picture in zip(bags, pictures, strict=True):
        draw(folder / picture, bag, new_model)
        print(f'{bag.path}: {verdict(bag)}')
        if bag.new is not None:
            print(f'{bag.path}: {np.count_nonzero(bag.new.beyond)} commands of {new_model} '
                  f'differ by more than {parameters.tolerance:g}')
    write_report(folder, bags, pictures, new_model)
    print(f'see {folder / "report.md"}')
    if any(np.any(bag.check.beyond) for bag in bags):
        return Result.DIFFERENT
    return Result.REPRODUCED if all(map(reproduced, bags)) else Result.NOTHING_COMPARED


def replayed_bag(path: str, parameters: ReplayParameters, topic: str = RECORDS,
                 given: Mapping[str, Any] = MappingProxyType({})) -> ReplayedBag:
    """Replay one bag; arguments and errors are those of :func:`replay_bags`."""
    alternative = None
    if parameters.new_model:
        new = load_suitable(parameters.new_model, force=True)
        alternative = Alternative(new.model, new.digest, tuning(new.model, given))
    records = read_records(path, topic, recover=parameters.recover)
    if parameters.last:
        records = lately(records, parameters.last)
    try:
        found = replay_records(
            records, [Path(parameters.model).expanduser(), model_path(parameters.model)]
            if parameters.model else [], alternative)
    except RecordError as error:
        raise BagReadError(f'bag {path!r}: {error}') from error
    return compared_bag(path, summary(path).complete, found, parameters.tolerance,
                        None if alternative is None else alternative.model.states)


def replay_records(records: Iterable[EventRecord], models: Sequence[Path] = (),
                   alternative: Alternative | None = None) -> Replay:
    """
    Replay records of this package's controller node, in the order of receipt.

    :param models: files or folders to search for models, in addition to the bundled ones.
    :raises RecordError: for records that cannot be replayed.
    """
    places = [*models, config_directory() / 'models']
    return replay(records, partial(find_model, places), _controller, alternative)


def tuning(model: LiftedModel, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the given parameters of a controller; ConfigurationError where one is wrong."""
    table = table_of(model, given)
    own = {name: value for name, value in given.items()
           if name in table.rows and name not in ('model', 'system')}
    for name, value in own.items():
        if type(value) is not type(table.rows[name].default):
            raise ConfigurationError(table.rows[name].type_error(value))
    if reason := table.check(table.snapshot(own)):
        raise ConfigurationError(reason)
    return own


def _controller(values: Mapping[str, Any], model: LiftedModel) -> Controller:
    values = {name: tuple(value) if isinstance(value, list) else value
              for name, value in values.items()}
    signals = signals_of(model)
    # a measured state had a topic, whatever other states this model has
    values['states_measured'] = tuple(
        f'{name} [{unit}]' for name, unit in signals.states.items() if f'{name}.topic' in values)
    table = table_of(model, values)
    # those of a state that another model of the run estimates tell nothing here
    if unknown := ', '.join(sorted(
            name for name in set(values) - set(table.rows)
            if '.' not in name or name.partition('.')[0] in signals.units)):
        raise RecordError(f'its controller had the parameters {unknown}, which this version does '
                          'not have: use the package that recorded it')
    try:
        snapshot = table.snapshot(values)
        if reason := table.check(snapshot):
            raise ConfigurationError(reason)
    except ConfigurationError as error:
        raise RecordError(f'its controller had parameters that this version rejects ({error}): '
                          'use the package that recorded it') from None
    return built(snapshot, model)
