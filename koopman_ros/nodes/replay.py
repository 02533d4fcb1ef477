# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The replay: recorded bags through the control step again, with the old and with a new model.

Its exit code is 0 when the recorded commands are reproduced, 1 when some are not and for every
error, and 3 when there was nothing to compare, as in a short bag from the middle of a run.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
import enum
from pathlib import Path
import sys

import numpy as np

from koopman_ros.nodes import topics
from koopman_ros.nodes.model_loading import load_suitable
from koopman_ros.nodes.parameter_node import ParameterNode
from koopman_ros.nodes.process import run_task
from koopman_ros.nodes.replay_parameters import ReplayParameters, TABLE
from koopman_ros.nodes.replaying.comparison import compare, ReplayedBag
from koopman_ros.nodes.replaying.record import Names, read_record
from koopman_ros.nodes.replaying.report import reproduced, verdict, write_report
from koopman_ros.nodes.replaying.steps import commands_of, replay
from koopman_ros.nodes.translation import controller_of


class Result(enum.IntEnum):
    """What a replay found, as exit code."""

    REPRODUCED = 0
    DIFFERENT = 1
    NOTHING_COMPARED = 3


def replay_bags(parameters: ReplayParameters, names: Names) -> Result:
    """
    Replay bags and write the report.

    :param parameters: of the replay.
    :param names: of the controller's topics in the bags.
    :return: whether the recorded commands are reproduced; when none differs, yet a bag has
        nothing to compare, that.
    :raises BagReadError: for a bag that cannot be replayed.
    :raises ModelFileError: for a model that cannot be used.
    """
    # drawing needs a package that a controller's machine may lack
    from koopman_ros.nodes.replaying.figure import draw

    bags = [replayed_bag(path, names, parameters) for path in parameters.bags]
    folder = Path(parameters.output)
    folder.mkdir(parents=True, exist_ok=True)
    pictures = ['replay.png'] if len(bags) == 1 else [
        f'replay_{number}.png' for number in range(1, len(bags) + 1)]
    for bag, picture in zip(bags, pictures, strict=True):
        draw(folder / picture, bag, parameters)
        print(f'{bag.path}: {verdict(bag)}')
        if bag.new is not None:
            print(f'{bag.path}: {np.count_nonzero(bag.new.beyond)} commands of '
                  f'{parameters.new_model} differ by more than {parameters.tolerance:g} K')
    write_report(folder, bags, pictures, parameters)
    print(f'see {folder / "report.md"}')
    if any(np.any(bag.check.beyond) for bag in bags):
        return Result.DIFFERENT
    return Result.REPRODUCED if all(map(reproduced, bags)) else Result.NOTHING_COMPARED


def replayed_bag(path: str, names: Names, parameters: ReplayParameters) -> ReplayedBag:
    """
    Replay one bag.

    :param path: of the bag.
    :param names: of the controller's topics in it.
    :param parameters: of the replay.
    :raises BagReadError: for a bag that cannot be replayed.
    :raises ModelFileError: for a model that cannot be used.
    """
    settings, tolerance = parameters.settings(), parameters.tolerance
    old = load_suitable(parameters.model).model
    new = load_suitable(parameters.new_model).model if parameters.new_model else None
    record = read_record(path, names, recover=parameters.recover)
    replayed = replay(record, controller_of(old, settings))
    commands = np.array([sample.replayed for sample in replayed.samples])
    bag = ReplayedBag(path, record, old.states, replayed, compare(replayed, commands, tolerance))
    if new is None:
        return bag
    commands = commands_of(controller_of(new, settings), replayed)
    return replace(bag, new_commands=commands, new=compare(replayed, commands, tolerance),
                   new_range=new.states)


def _prepare() -> Callable[[], int]:
    """Read parameters and names, which remaps and the namespace change as for the controller."""
    node = ParameterNode('replay', start_parameter_services=False, enable_rosout=False)
    try:
        parameters = TABLE.declare(node)
        resolve = node.resolve_topic_name
        names = Names(
            temperature=resolve(topics.TEMPERATURE), setpoint=resolve(topics.SETPOINT),
            manual=resolve(topics.MANUAL_COOLANT_SETPOINT),
            command=resolve(topics.COOLANT_SETPOINT), active=resolve(topics.ACTIVE_SETPOINT),
            coolant=resolve(topics.COOLANT_TEMPERATURE),
            internals=resolve(topics.CONTROLLER_STATE),
            diagnostics=resolve(topics.DIAGNOSTICS), namespace=node.get_namespace().strip('/'))
    finally:
        node.destroy_node()
    return lambda: _run(parameters, names)


def _run(parameters: ReplayParameters, names: Names) -> int:
    try:
        result = replay_bags(parameters, names)
    except MemoryError:
        print('replay: memory does not suffice for these bags: replay them one by one, or shorter '
              'ones', file=sys.stderr)
        return 1
    if result is Result.DIFFERENT:
        print('replay: not all recorded commands are reproduced within '
              f'{parameters.tolerance:g} K: give the model and the settings of the recording',
              file=sys.stderr)
    elif result is Result.NOTHING_COMPARED:
        print('replay: too short, or without commands: not every bag has commands to compare; '
              'give bags that begin with the run, or go on for longer', file=sys.stderr)
    return result


def main(args: list[str] | None = None) -> int:
    """Run the replay."""
    return run_task('replay', _prepare, args)


if __name__ == '__main__':
    sys.exit(main())
