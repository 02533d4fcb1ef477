# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The replay: the records in bags through the control step again, and beside a new model."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
import enum
from pathlib import Path
import sys
from typing import Any

import numpy as np

from koopman_ros.bags import BagReadError, summary
from koopman_ros.control import Settings
from koopman_ros.parameters import controller
from koopman_ros.parameters.controller import ControllerParameters, ReplayParameters
from koopman_ros.parameters.table import ConfigurationError
from koopman_ros.replay.loop import Alternative, Replay, replay
from koopman_ros.replay.records import Record, RecordError
from koopman_ros.replay.report import ReplayedBag, reproduced, verdict, write_report
from koopman_ros.replay.sources import command_counts, Models, read_records
from koopman_ros.resources import config_directory, model_path
from koopman_ros.ros import topics
from koopman_ros.ros.model_reload import load_suitable
from koopman_ros.ros.node import LoopNode
from koopman_ros.ros.process import run_task


class Result(enum.IntEnum):
    """What a replay found, as exit code; 1 is that of every error, too."""

    REPRODUCED = 0
    DIFFERENT = 1
    NOTHING_COMPARED = 3


@dataclass(frozen=True)
class Names:
    """The topics of a controller in a bag, as absolute names."""

    records: str = f'/{topics.CONTROLLER_EVENTS}'  #: where it wrote down what happened
    commands: str = f'/{topics.COOLANT_SETPOINT}'  #: where it commanded the coolant


def replay_bags(parameters: ReplayParameters, names: Names, given: Collection[str] = ()) -> Result:
    """
    Replay bags and write the report; `given` are the parameters that replace recorded ones.

    :raises BagReadError, ModelFileError, ConfigurationError: also without the package that draws.
    """
    try:
        # a controller's machine may lack it
        from koopman_ros.replay.figure import draw
    except ImportError as error:
        raise ConfigurationError(
            "the picture needs matplotlib, which is missing: pip install 'koopman_ros[demo]', or "
            'apt-get install python3-matplotlib') from error

    bags = [replayed_bag(path, names, parameters, given) for path in parameters.bags]
    folder, new_model = Path(parameters.output), parameters.new_model
    folder.mkdir(parents=True, exist_ok=True)
    pictures = ['replay.png'] if len(bags) == 1 else [
        f'replay_{number}.png' for number in range(1, len(bags) + 1)]
    for bag, picture in zip(bags, pictures, strict=True):
        draw(folder / picture, bag, new_model)
        print(f'{bag.path}: {verdict(bag)}')
        if bag.new is not None:
            print(f'{bag.path}: {np.count_nonzero(bag.new.beyond)} commands of {new_model} '
                  f'differ by more than {parameters.tolerance:g} K')
    write_report(folder, bags, pictures, new_model)
    print(f'see {folder / "report.md"}')
    if any(np.any(bag.check.beyond) for bag in bags):
        return Result.DIFFERENT
    return Result.REPRODUCED if all(map(reproduced, bags)) else Result.NOTHING_COMPARED


def replayed_bag(path: str, names: Names, parameters: ReplayParameters,
                 given: Collection[str] = ()) -> ReplayedBag:
    """Replay one bag; arguments and errors are those of :func:`replay_bags`."""
    alternative = None
    if parameters.new_model:
        new = load_suitable(parameters.new_model)
        tuning = {item.name for item in fields(ControllerParameters)} - {'model'}
        alternative = Alternative(new.model, new.digest, {
            name: getattr(parameters, name) for name in tuning.intersection(given)})
    records = read_records(path, names.records, recover=parameters.recover)
    try:
        found = replay_records(records, [Path(parameters.model).expanduser(),
                                         model_path(parameters.model)], alternative)
    except RecordError as error:
        raise BagReadError(f'bag {path!r}: {error}') from error
    return ReplayedBag(
        path, summary(path).complete, found,
        command_counts(path, names.commands, recover=parameters.recover), parameters.tolerance,
        None if alternative is None else alternative.model.states)


def replay_records(records: Iterable[Record], models: Sequence[Path] = (),
                   alternative: Alternative | None = None) -> Replay:
    """
    Replay records of this package's controller node, in the order of receipt.

    :param models: files or folders in which models are looked for beside the shipped ones.
    :raises RecordError: for records that cannot be replayed.
    """
    return replay(records, Models([*models, config_directory() / 'models']).find, _settings,
                  alternative)


def _settings(values: Mapping[str, Any]) -> Settings:
    unknown = ', '.join(sorted(set(values) - set(controller.TABLE.rows)))
    if unknown:
        raise RecordError(f'its controller had the parameters {unknown}, which this version has '
                          'not: take the package that recorded it')
    snapshot = ControllerParameters(**values)
    if reason := controller.TABLE.check(snapshot):
        raise RecordError(f'its controller had parameters that this version refuses ({reason}): '
                          'take the package that recorded it')
    return snapshot.settings()


def _prepare() -> Callable[[], int]:
    """Read parameters and names, which remaps and the namespace change as for the controller."""
    node = LoopNode('replay', start_parameter_services=False, enable_rosout=False)
    try:
        given = set(node.get_parameters_by_prefix(''))
        parameters = node.declare_table(controller.REPLAY_TABLE)
        names = Names(node.resolve_topic_name(topics.CONTROLLER_EVENTS),
                      node.resolve_topic_name(topics.COOLANT_SETPOINT))
    finally:
        node.destroy_node()
    return lambda: _run(parameters, names, given)


def _run(parameters: ReplayParameters, names: Names, given: Collection[str]) -> int:
    try:
        result = replay_bags(parameters, names, given)
    except MemoryError:
        print('replay: memory does not suffice for these bags: replay them one by one, or shorter '
              'ones', file=sys.stderr)
        return 1
    if result is Result.DIFFERENT:
        print('replay: not all recorded commands are reproduced within '
              f'{parameters.tolerance:g} K: see the report for the first, and replay with the '
              'package that recorded them', file=sys.stderr)
    elif result is Result.NOTHING_COMPARED:
        print('replay: nothing to compare in a bag: its records hold no snapshot before a '
              'command; give bags that begin with the run, or go on for longer', file=sys.stderr)
    return result


def main(args: list[str] | None = None) -> int:
    """Run the replay."""
    return run_task('replay', _prepare, args)


if __name__ == '__main__':
    sys.exit(main())
