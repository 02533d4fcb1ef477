# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The replay: the records in bags through the control step again, and beside a new model."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
import enum
from pathlib import Path
import sys
from types import MappingProxyType
from typing import Any

import numpy as np

from koopman_ros.bags import BagReadError, summary
from koopman_ros.control import Controller
from koopman_ros.lifting import LiftedModel
from koopman_ros.parameters.controller import (
    built,
    REPLAY_TABLE,
    ReplayParameters,
    table_of,
)
from koopman_ros.parameters.table import ConfigurationError
from koopman_ros.parameters.trainer import preset_wiring
from koopman_ros.parameters.wire import renamed, signals_of, Wiring
from koopman_ros.replay.loop import Alternative, Replay, replay
from koopman_ros.replay.records import Record, RecordError
from koopman_ros.replay.report import ReplayedBag, reproduced, verdict, write_report
from koopman_ros.replay.sources import command_counts, lately, Models, read_records
from koopman_ros.resources import config_directory, model_path
from koopman_ros.ros import topics
from koopman_ros.ros.model_reload import load_suitable
from koopman_ros.ros.node import LoopNode
from koopman_ros.ros.process import run_task
from koopman_ros.wire import Place


class Result(enum.IntEnum):
    """What a replay found, as exit code; 1 is that of every error, too."""

    REPRODUCED = 0
    DIFFERENT = 1
    NOTHING_COMPARED = 3


@dataclass(frozen=True)
class Names:
    """The topics of a controller in a bag, as absolute names."""

    #: where it wrote down what happened
    records: str = f'/{topics.CONTROLLER_EVENTS}'
    namespace: str = '/'  #: of the controller
    #: topics of commands that are remapped
    commands: Mapping[str, str] = field(default_factory=dict)

    def of(self, topic: str) -> str:
        """Return the absolute name of a topic of commands."""
        relative = f'{self.namespace.rstrip("/")}/{topic}'
        return self.commands.get(topic, topic if topic.startswith('/') else relative)


def replay_bags(parameters: ReplayParameters, names: Names,
                given: Mapping[str, Any] = MappingProxyType({})) -> Result:
    """
    Replay bags and write the report; `given` are the parameters that replace recorded ones.

    :raises BagReadError, ModelFileError, ConfigurationError: also without the package that draws.
    """
    try:
        # a controller's machine may lack it
        from koopman_ros.replay.figure import draw
    except ImportError as error:
        raise ConfigurationError(
            'the picture needs matplotlib, which is missing: pip install matplotlib, or '
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
                  f'differ by more than {parameters.tolerance:g}')
    write_report(folder, bags, pictures, new_model)
    print(f'see {folder / "report.md"}')
    if any(np.any(bag.check.beyond) for bag in bags):
        return Result.DIFFERENT
    return Result.REPRODUCED if all(map(reproduced, bags)) else Result.NOTHING_COMPARED


def replayed_bag(path: str, names: Names, parameters: ReplayParameters,
                 given: Mapping[str, Any] = MappingProxyType({})) -> ReplayedBag:
    """Replay one bag; arguments and errors are those of :func:`replay_bags`."""
    alternative = None
    if parameters.new_model:
        new = load_suitable(parameters.new_model, force=True)
        alternative = Alternative(new.model, new.digest, _tuning(new.model, given))
    records = read_records(path, names.records, recover=parameters.recover)
    if parameters.last:
        records = lately(records, parameters.last)
    try:
        found = replay_records(
            records, [Path(parameters.model).expanduser(), model_path(parameters.model)]
            if parameters.model else [], alternative)
    except RecordError as error:
        raise BagReadError(f'bag {path!r}: {error}') from error
    places = _commands(found, names)
    return ReplayedBag(
        path, summary(path).complete, found,
        command_counts(path, places, recover=parameters.recover, since_ns=(
            found.samples[0].stamp_ns if parameters.last and found.samples else 0)),
        places, parameters.tolerance,
        None if alternative is None else alternative.model.states)


def _tuning(model: LiftedModel, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return what is given of a controller with a model; ConfigurationError where it is wrong."""
    table = table_of(model, given)
    if former := renamed('controller', given, table):
        raise ConfigurationError(former)
    own = {name: value for name, value in given.items()
           if name in table.rows and name not in ('model', 'system')}
    for name, value in own.items():
        if type(value) is not type(table.rows[name].default):
            raise ConfigurationError(table.rows[name].type_error(value))
    if reason := table.check(table.snapshot(own)):
        raise ConfigurationError(reason)
    return own


def replay_records(records: Iterable[Record], models: Sequence[Path] = (),
                   alternative: Alternative | None = None) -> Replay:
    """
    Replay records of this package's controller node, in the order of receipt.

    :param models: files or folders in which models are looked for beside the shipped ones.
    :raises RecordError: for records that cannot be replayed.
    """
    return replay(records, Models([*models, config_directory() / 'models']).find, _controller,
                  alternative)


def _commands(found: Replay, names: Names) -> tuple[Place, ...]:
    """Return where the inputs of a replayed controller were commanded, in the bag."""
    if found.controller is None:
        return ()
    values = found.parameters
    table = table_of(found.controller.model, values)
    snapshot = table.snapshot(values)
    signals = signals_of(found.controller.model, snapshot.tuning.controlled, snapshot.states)
    wiring = Wiring(signals, snapshot.states, snapshot.inputs)
    return tuple(replace(place, topic=names.of(place.topic))
                 for place in wiring.commands.values())


def _controller(values: Mapping[str, Any], model: LiftedModel) -> Controller:
    values = {name: tuple(value) if isinstance(value, list) else value
              for name, value in values.items()}
    signals = signals_of(model)
    # what was measured had a topic, whatever other states this model has
    values['states_measured'] = tuple(
        f'{name} [{unit}]' for name, unit in signals.states.items() if f'{name}.topic' in values)
    table = table_of(model, values)
    # those of a state that another model of the run estimates tell nothing here
    if unknown := ', '.join(sorted(
            name for name in set(values) - set(table.rows)
            if '.' not in name or name.partition('.')[0] in signals.units)):
        raise RecordError(f'its controller had the parameters {unknown}, which this version has '
                          'not: take the package that recorded it')
    snapshot = table.snapshot(values)
    if reason := table.check(snapshot):
        raise RecordError(f'its controller had parameters that this version refuses ({reason}): '
                          'take the package that recorded it')
    return built(snapshot, model)


def _prepare() -> Callable[[], int]:
    """Read parameters and names, which remaps and the namespace change as for the controller."""
    node = LoopNode('replay', start_parameter_services=False, enable_rosout=False)
    try:
        given = node.given()
        new_model = str(given.get('new_model', ''))
        # what a controller with the new model is tuned by may be given, too
        beside = _tuning(load_suitable(new_model, force=True).model, given) if new_model else ()
        parameters = node.declare_table(REPLAY_TABLE, beside)
        wiring = preset_wiring(parameters.system)
        names = Names(
            node.resolve_topic_name(topics.CONTROLLER_EVENTS), node.get_namespace(),
            {} if wiring is None else {
                place.topic: node.resolve_topic_name(place.topic)
                for place in wiring.commands.values()})
    finally:
        node.destroy_node()
    return lambda: _run(parameters, names, given)


def _run(parameters: ReplayParameters, names: Names, given: Mapping[str, Any]) -> int:
    try:
        result = replay_bags(parameters, names, given)
    except MemoryError:
        print('replay: memory does not suffice for these bags: replay them one by one, or shorter '
              'ones', file=sys.stderr)
        return 1
    if result is Result.DIFFERENT:
        print('replay: not all recorded commands are reproduced within '
              f'{parameters.tolerance:g}: see the report for the first, and replay with the '
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
