# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Description of each program, with the help, parameter files and SROS2 policy made from it.

Run it as ``python -m koopman_ros.ros.node_descriptions`` after a change to a table or in here.
"""

import argparse
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
import sys
import textwrap
from types import MappingProxyType
from typing import Any
from xml.etree import ElementTree

from koopman_ros.core.paths import config_directory, model_path
from koopman_ros.model import load
from koopman_ros.parameters import controller, panel, plant, player, trainer_table
from koopman_ros.parameters.signal_topics import (
    bundled_plants,
    DEFAULT_SYSTEM,
    described,
    plant_defaults,
    SIGNALS,
    SignalTopics,
    system_of,
)
from koopman_ros.parameters.table import as_yaml, ConfigurationError, ParameterTable, Specification
from koopman_ros.ros import topics

POLICY_FILE = 'sros2_policy.xml'

# topics and services that rclpy gives every node
STANDARD_TOPICS = ('/rosout', '/parameter_events')
STANDARD_SERVICES = (
    '~/describe_parameters', '~/get_parameter_types', '~/get_parameters', '~/list_parameters',
    '~/set_parameters', '~/set_parameters_atomically', '~/get_type_description')
# by which a node is tuned from afar
TUNING_SERVICES = ('list_parameters', 'describe_parameters', 'get_parameters',
                   'set_parameters_atomically')
# `ros2 service call` and its like start a node with these services, named after the service or
# their process
_COMMAND_LINE_SERVICES = tuple(
    service.replace('~', '/_ros2cli_*') for service in STANDARD_SERVICES)
# the node of `ros2 bag record`, whose name is fixed
_BAG_RECORDER_TOPIC = '/events/write_split'
_BAG_RECORDER_SERVICES = tuple(service.replace('~', '/rosbag2_recorder') for service in (
    *STANDARD_SERVICES, '~/is_paused', '~/pause', '~/resume', '~/snapshot', '~/split_bagfile'))

_TRANSITIONS = '~/transition_event'


def table_of(name: str, given: Mapping[str, Any]) -> ParameterTable[Any]:
    """
    Return the parameter table of a program.

    :param given: `system`, and `model` where it is not that of a bundled plant.
    :raises ConfigurationError: if nothing names the signals.
    """
    system = system_of(given)
    if name == 'plant':
        return plant.PlantTable(given)
    if name == 'player':
        return player.player_table(given)
    if name == 'replay':
        return controller.REPLAY_TABLE
    model = given.get('model', '')
    if name == 'panel':
        return panel.panel_table(load(model_path(model)) if model else None, given)
    model = model or plant_defaults(system, 'controller').get('model', '')
    present = load(model_path(model)) if model else None
    if name == 'trainer':
        return trainer_table.trainer_table(present, given)
    if present is None:
        raise ConfigurationError(
            f'the system {system!r} has no model: name one in the parameter model, or in '
            f'config/plants/{system}.yaml, or choose one of {", ".join(bundled_plants())}')
    return controller.table_of(present, given)


def tables(system: str = DEFAULT_SYSTEM) -> dict[str, ParameterTable[Any]]:
    """Return the tables of all programs for a bundled plant."""
    return {name: table_of(name, {'system': system}) for name in _NAMES}


_NAMES = ('plant', 'controller', 'trainer', 'player', 'replay', 'panel')


@dataclass(frozen=True)
class Program:
    """Purpose of a program, and its topics and services by their names in the node."""

    does: str = ''  #: a sentence
    codes: str = '0 after a signal, 1 if it cannot start, 2 for an unknown argument'
    publishes: tuple[str, ...] = ()  #: topics
    subscribes: tuple[str, ...] = ()  #: topics; /clock where it follows simulated time
    serves: tuple[str, ...] = ()  #: services
    calls: tuple[str, ...] = ()  #: services of others
    hosts: bool = False  #: whether it runs many loops with ``--loops``


def _wiring(given: Mapping[str, Any]) -> tuple[SignalTopics, tuple[str, ...]]:
    """Return the places of the signals, and the recorded topics."""
    settings = table_of('trainer', given).snapshot({})
    signals = trainer_table.trainer_signals(
        load(model_path(given['model'])) if 'model' in given else None,
        {**{name: getattr(settings, name) for name in SIGNALS}, **given})
    return SignalTopics.of(signals, settings), settings.topics


def programs(given: Mapping[str, Any] = MappingProxyType({})) -> dict[str, Program]:
    """Return all programs, with the topics of a system; `given` as for :func:`table_of`."""
    wiring, recorded = _wiring(given)

    def topics_of(*kinds: str) -> tuple[str, ...]:
        return tuple(place.topic for kind in kinds for place in getattr(wiring, kind).values())

    # states that are recorded where the plant has them, and not measured
    unmeasured = tuple(topic for topic in recorded
                       if topic not in wiring.topics and topic not in topics.TYPES)
    lifecycle = ('~/change_state', '~/get_state', '~/get_available_states',
                 '~/get_available_transitions', '~/get_transition_graph')
    return {
        'plant': Program(
            'Simulates a plant: publishes its measurements and takes commands.',
            publishes=(*topics_of('measured', 'applied', 'measured_disturbances'), *unmeasured,
                       topics.CLOCK,
                       topics.DIAGNOSTICS, _TRANSITIONS, *STANDARD_TOPICS),
            subscribes=topics_of('commands'),
            serves=('~/reset', *lifecycle, *STANDARD_SERVICES), hosts=True),
        'controller': Program(
            'Commands the inputs at each measurement, with a learned model.',
            publishes=(*topics_of('commands', 'active_setpoints', 'predicted'),
                       topics.CONTROLLER_INTERNALS, topics.PREDICTED_TRAJECTORY,
                       topics.ACTIVE_CONSTRAINTS, topics.EVENT_LOG, topics.DIAGNOSTICS,
                       _TRANSITIONS, *STANDARD_TOPICS),
            subscribes=(*topics_of('measured', 'quality', 'applied', 'measured_disturbances',
                                   'setpoints', 'joint_setpoints', 'manual'), topics.CLOCK),
            serves=('~/set_automatic', '~/clear_safe_state', '~/reload_model', *lifecycle,
                    *STANDARD_SERVICES),
            hosts=True),
        'trainer': Program(
            'Records the loop to MCAP bags, excites the plant, and learns models from bags.',
            f'{Program.codes}; with task:=train 0 for an accepted model, 2 for a rejected one, 1 '
            'for a failure',
            publishes=(*topics_of('commands', 'manual', 'setpoints'), topics.DIAGNOSTICS,
                       _TRANSITIONS, *STANDARD_TOPICS),
            subscribes=(*dict.fromkeys((*wiring.topics, *recorded)), topics.CLOCK),
            serves=('~/record', '~/experiment', '~/train', '~/cancel_training', *lifecycle,
                    *STANDARD_SERVICES)),
        'player': Program(
            'Plays the measurements and set-points of a bag, in recorded time or in lock-step '
            'with a controller.',
            '0 if all messages were played or after a signal, 1 if it cannot start or continue, 2 '
            'for an unknown argument',
            publishes=(*topics_of('applied', 'measured_disturbances', 'measured', 'setpoints',
                                  'joint_setpoints', 'manual'), topics.CLOCK,
                       *STANDARD_TOPICS),
            subscribes=topics_of('commands'),
            serves=STANDARD_SERVICES),
        'replay': Program(
            'Re-runs the control step on recorded bags, optionally with a new model.',
            '0 if the recorded commands are reproduced, 1 if not or if it cannot run, 2 for an '
            'unknown argument, 3 if a bag holds nothing to compare, 130 after an interrupt',
            publishes=('/parameter_events',), serves=('~/get_type_description',)),
        'panel': Program(
            'Browser HMI: shows the loop and forwards the commands of operators.',
            publishes=(*topics_of('setpoints', 'manual'), topics.AUDIT_LOG,
                       topics.DIAGNOSTICS, *STANDARD_TOPICS),
            subscribes=(*topics_of('measured', 'measured_disturbances', 'applied', 'commands',
                                   'active_setpoints', 'predicted'), topics.CONTROLLER_INTERNALS,
                        topics.PREDICTED_TRAJECTORY, topics.ACTIVE_CONSTRAINTS,
                        topics.EVENT_LOG, topics.DIAGNOSTICS, '/parameter_events',
                        topics.CLOCK),
            serves=STANDARD_SERVICES,
            calls=(*(f'controller/{service}' for service in (
                'set_automatic', 'clear_safe_state', 'reload_model')),
                   'plant/reset',
                   *(f'trainer/{service}' for service in (
                       'record', 'experiment', 'train', 'cancel_training')),
                   *(f'{node}/{service}' for node in ('controller', 'trainer', 'panel')
                     for service in TUNING_SERVICES))),
    }


def operator(given: Mapping[str, Any] = MappingProxyType({})) -> Program:
    """Return the access of a person or a panel: set-points, services, recording, all topics."""
    nodes = programs(given)
    wiring, _ = _wiring(given)
    asks = (*wiring.setpoints.values(), *wiring.joint_setpoints.values(), *wiring.manual.values())
    return Program(
        publishes=(*(place.topic for place in asks), _BAG_RECORDER_TOPIC, *STANDARD_TOPICS),
        subscribes=(*nodes['trainer'].subscribes, _BAG_RECORDER_TOPIC, *STANDARD_TOPICS, *(
            f'{node}/{name.removeprefix("~/")}' for node, program in nodes.items()
            for name in program.publishes if name.startswith('~/'))),
        serves=(*STANDARD_SERVICES, *_COMMAND_LINE_SERVICES, *_BAG_RECORDER_SERVICES),
        calls=tuple(f'{node}/{service.removeprefix("~/")}' for node, program in nodes.items()
                    if node != 'replay' for service in program.serves))


PROGRAMS = programs()
OPERATOR = operator()


def policy(system: str = DEFAULT_SYSTEM) -> str:
    """Return the text of the SROS2 policy: one enclave for each node, and one for operators."""
    if not plant_defaults(system, 'trainer'):
        raise ConfigurationError(f'the signals of the system {system!r} are not known: write '
                                 f'config/plants/{system}.yaml')
    root = ElementTree.Element('policy', version='0.2.0')
    root.append(ElementTree.Comment(
        ' Least privilege for each node, written by `make config`: see docs/how-to/secure.md. For '
        'nodes in\n       a namespace replace every ns="/" by it. '))
    enclaves = ElementTree.SubElement(root, 'enclaves')
    given = {'system': system}
    for name, own in {**programs(given), 'operator': operator(given)}.items():
        enclave = ElementTree.SubElement(enclaves, 'enclave', path=f'/koopman_ros/{name}')
        profiles = ElementTree.SubElement(enclave, 'profiles')
        profile = ElementTree.SubElement(profiles, 'profile', ns='/', node=name)
        for kind, verb, names in (
                ('topic', 'publish', own.publishes), ('topic', 'subscribe', own.subscribes),
                ('service', 'reply', own.serves), ('service', 'request', own.calls)):
            if names:
                rules = ElementTree.SubElement(profile, f'{kind}s', {verb: 'ALLOW'})
                for granted in sorted(set(names)):
                    ElementTree.SubElement(rules, kind).text = granted
    ElementTree.indent(root)
    return ('<?xml version="1.0" encoding="UTF-8"?>\n'
            + ElementTree.tostring(root, encoding='unicode') + '\n')


def help_text(name: str, given: Mapping[str, Any] = MappingProxyType({})) -> str:
    """
    Return the text that `--help` prints.

    :param given: as for :func:`table_of`.
    :raises ConfigurationError: if nothing names the signals.
    """
    table, system = table_of(name, given), system_of(given)
    if isinstance(table, plant.PlantTable) and not plant_defaults(system, 'trainer'):
        signals = table.described
        given = {**given, 'states_measured': described(signals.states),
                 'inputs_commanded': described(signals.inputs)}
    # these know no signals but those of a bundled plant
    fixed = name == 'replay' or (name == 'player' and not plant_defaults(system, 'trainer'))
    program = PROGRAMS[name] if fixed else programs(given)[name]
    lists = '' if fixed else ''.join(
        _filled(f'{title}: {", ".join(own)}') + '\n' for title, names in (
            ('subscribes to', program.subscribes), ('publishes', program.publishes),
            ('serves', program.serves))
        if (own := [item for item in names if item not in STANDARD_TOPICS + STANDARD_SERVICES]))
    called = f'{name} [--loops file]' if program.hosts else name
    many = '\n' + _filled(
        '--loops reads a file with one namespace per line, and runs one node in each. Parameters '
        f'are given by the full name of a node, e.g. /line_1/reactor_3/{name}.', '') + '\n'
    other = '' if name == 'replay' else (
        f'For another system: {name} --help --ros-args -p system:=NAME\n')
    parameters = '\n'.join(_help_row(row) for row in table.rows.values())
    return f"""\
usage: ros2 run koopman_ros {called} [--ros-args [-p name:=value ...] [--params-file file] ...]

{program.does}
{many * program.hosts}
{lists}{_filled(f'exit codes: {program.codes}')}

Parameters, with the defaults of the system {system!r}. A file of those of the {DEFAULT_SYSTEM}:
{config_directory() / f'{name}.yaml'}
{other}{parameters}"""


def _filled(text: str, indent: str = '  ') -> str:
    return textwrap.fill(text, 99, subsequent_indent=indent, break_on_hyphens=False)


def _help_row(row: Specification) -> str:
    notes = f' ({"; ".join(row.notes)})' if row.notes else ''
    return (f'  {row.name}: {as_yaml(row.default)} {row.unit}'.rstrip() + notes + '\n'
            + _filled(f'      {row.description}', '      '))


def parameter_file(node: str, system: str = DEFAULT_SYSTEM) -> str:
    """Return the text of a node's parameter file, every parameter at its default."""
    return (f'# Parameters of the {node} node, all at their defaults. Use a copy with\n'
            f'#   ros2 run koopman_ros {node} --ros-args --params-file {node}.yaml\n'
            f'{tables(system)[node].yaml()}')


def main(args: list[str] | None = None) -> int:
    """Write the parameter files and the policy, for a plant with a file in config/plants."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument('--output', type=Path, default=Path('config'))
    parser.add_argument('--system', default=DEFAULT_SYSTEM)
    given = parser.parse_args(args)
    try:
        written = {f'{node}.yaml': parameter_file(node, given.system) for node in PROGRAMS}
        written[POLICY_FILE] = policy(given.system)
    except ConfigurationError as error:
        parser.error(str(error))
    given.output.mkdir(parents=True, exist_ok=True)
    for name, text in written.items():
        (given.output / name).write_text(text)
    return 0


if __name__ == '__main__':
    sys.exit(main())
