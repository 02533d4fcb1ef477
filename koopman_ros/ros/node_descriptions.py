# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
What each program does, and the help, parameter files and SROS2 policy that follow from it.

Run it as ``python -m koopman_ros.ros.node_descriptions`` after a change to a table or in here.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path
import sys
from typing import Any
from xml.etree import ElementTree

from koopman_ros.core.paths import config_directory, model_path
from koopman_ros.model import load
from koopman_ros.parameters import controller, panel, plant, trainer
from koopman_ros.parameters.signal_topics import DEFAULT_SYSTEM, plant_defaults
from koopman_ros.parameters.table import ConfigurationError, ParameterTable
from koopman_ros.ros import topics

POLICY_FILE = 'sros2_policy.xml'

# what rclpy gives every node
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


def tables(system: str = DEFAULT_SYSTEM) -> dict[str, ParameterTable[Any]]:
    """Return the tables of all programs for a plant that is shipped."""
    given = {'system': system}
    name = plant_defaults(system, 'controller').get('model', '')
    if not name:
        raise ConfigurationError(
            f'the system {system!r} has no model: name one in config/plants/{system}.yaml')
    model = load(model_path(name))
    return {'plant': plant.PlantTable(given), 'controller': controller.table_of(model, given),
            'trainer': trainer.trainer_table(model, given),
            'player': trainer.player_table(given), 'replay': controller.REPLAY_TABLE,
            'panel': panel.panel_table(None, given)}


_HOSTS = 'it runs such a node in each'


@dataclass(frozen=True)
class Program:
    """What a program does, and on the network by names as in the node."""

    does: str = ''  #: a sentence
    codes: str = '0 after a signal, 1 when it cannot start, 2 for an unknown argument'
    publishes: tuple[str, ...] = ()  #: topics
    subscribes: tuple[str, ...] = ()  #: topics; /clock where it follows simulated time
    serves: tuple[str, ...] = ()  #: services
    calls: tuple[str, ...] = ()  #: services of others
    many: str = ''  #: what it does with ``--loops``, a file of namespaces


def programs(system: str = DEFAULT_SYSTEM) -> dict[str, Program]:
    """Return all programs, with the topics of a plant that is shipped."""
    wiring = trainer.preset_wiring(system)
    if wiring is None:
        raise ConfigurationError(f'no file says what the signals of the system {system!r} are: '
                                 f'write config/plants/{system}.yaml')
    recorded = tables(system)['trainer'].rows['topics'].default

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
            publishes=(*topics_of('measured', 'applied'), *unmeasured, topics.CLOCK,
                       topics.DIAGNOSTICS, _TRANSITIONS, *STANDARD_TOPICS),
            subscribes=topics_of('commands'),
            serves=('~/reset', *lifecycle, *STANDARD_SERVICES), many=_HOSTS),
        'controller': Program(
            'Answers each measurement with a command, by a learned model.',
            publishes=(*topics_of('commands', 'active_setpoints', 'predicted'),
                       topics.CONTROLLER_INTERNALS, topics.PREDICTED_TRAJECTORY,
                       topics.ACTIVE_CONSTRAINTS, topics.EVENT_LOG, topics.DIAGNOSTICS,
                       _TRANSITIONS, *STANDARD_TOPICS),
            subscribes=(*topics_of('measured', 'applied', 'setpoints', 'manual'), topics.CLOCK),
            serves=('~/set_automatic', '~/reload_model', *lifecycle, *STANDARD_SERVICES),
            many=_HOSTS),
        'trainer': Program(
            'Records the loop to MCAP bags, excites the plant, and learns models from bags.',
            f'{Program.codes}; with task:=train or --loops 0 for an accepted model, 2 for a '
            'refused one, 1 for a failure, of many the worst',
            publishes=(*topics_of('commands', 'manual', 'setpoints'), topics.DIAGNOSTICS,
                       _TRANSITIONS, *STANDARD_TOPICS),
            subscribes=(*dict.fromkeys((*wiring.topics, *recorded)), topics.CLOCK),
            serves=('~/record', '~/experiment', '~/train', '~/cancel_training', *lifecycle,
                    *STANDARD_SERVICES),
            many='it trains the plant of each from its bags, and ends'),
        'player': Program(
            'Publishes the measurements and set-points of a bag again, by the clock or in '
            'lock-step.',
            '0 when all was played or after a signal, 1 when it cannot start or go on, 2 for an '
            'unknown argument',
            publishes=(*topics_of('applied', 'measured', 'setpoints', 'manual'), topics.CLOCK,
                       *STANDARD_TOPICS),
            subscribes=topics_of('commands'),
            serves=STANDARD_SERVICES),
        'replay': Program(
            'Takes the records in bags through the control step again, also with a new model.',
            '0 when the recorded commands are reproduced, 1 when not or when it cannot run, 2 for '
            'an unknown argument, 3 when there is nothing to compare in a bag, 130 when '
            'interrupted',
            publishes=('/parameter_events',), serves=('~/get_type_description',)),
        'panel': Program(
            'Shows the loop in a browser, and passes on what an operator asks for there.',
            publishes=(*topics_of('setpoints', 'manual'), topics.AUDIT_LOG,
                       topics.DIAGNOSTICS, *STANDARD_TOPICS),
            subscribes=(*topics_of('measured', 'applied', 'commands', 'active_setpoints',
                                   'predicted'), topics.CONTROLLER_INTERNALS,
                        topics.PREDICTED_TRAJECTORY, topics.ACTIVE_CONSTRAINTS,
                        topics.EVENT_LOG, topics.DIAGNOSTICS, '/parameter_events',
                        topics.CLOCK),
            serves=STANDARD_SERVICES,
            calls=(*(f'controller/{service}' for service in ('set_automatic', 'reload_model')),
                   *(f'trainer/{service}' for service in (
                       'record', 'experiment', 'train', 'cancel_training')),
                   *(f'{node}/{service}' for node in ('controller', 'trainer')
                     for service in TUNING_SERVICES))),
    }


def operator(system: str = DEFAULT_SYSTEM) -> Program:
    """Return the access of a person or a panel: set-points, services, recording, all topics."""
    nodes = programs(system)
    wiring = trainer.preset_wiring(system)
    assert wiring is not None
    asks = (*wiring.setpoints.values(), *wiring.manual.values())
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
    root = ElementTree.Element('policy', version='0.2.0')
    root.append(ElementTree.Comment(
        ' Least privilege for each node, written by `make config`: see docs/how-to/secure.md. For '
        'nodes in\n       a namespace replace every ns="/" by it. '))
    enclaves = ElementTree.SubElement(root, 'enclaves')
    for name, own in {**programs(system), 'operator': operator(system)}.items():
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


def help_text(name: str) -> str:
    """Return what `--help` prints."""
    program = PROGRAMS[name]
    rows = tables()[name].rows.values()
    width = max(len(row.name) for row in rows)
    parameters = '\n'.join(
        f'  {row.name:{width}}  {row.description}' + (f' [{row.unit}]' if row.unit else '')
        for row in rows)
    lists = ''.join(
        f'{title}: {", ".join(own)}\n' for title, names in (
            ('subscribes to', program.subscribes), ('publishes', program.publishes),
            ('serves', program.serves))
        if (own := [item for item in names if item not in STANDARD_TOPICS + STANDARD_SERVICES]))
    file = config_directory() / f'{name}.yaml'
    called = f'{name} [--loops file]' if program.many else name
    many = (f'\nWith --loops, a file of namespaces, one a line, {program.many}. Parameters are\n'
            f'given by the full name of a node, e.g. /line_1/reactor_3/{name}.\n'
            ) if program.many else ''
    return f"""\
usage: ros2 run koopman_ros {called} [--ros-args [-p name:=value ...] [--params-file file] ...]

{program.does}
{many}
{lists}exit codes: {program.codes}

Parameters for the system {DEFAULT_SYSTEM}, with defaults and ranges in {file}:
{parameters}"""


def parameter_file(node: str, system: str = DEFAULT_SYSTEM) -> str:
    """Return the text of a node's parameter file, every parameter at its default."""
    return (f'# Parameters of the {node} node, all at their defaults. Use a copy with\n'
            f'#   ros2 run koopman_ros {node} --ros-args --params-file {node}.yaml\n'
            f'{tables(system)[node].yaml()}')


def main(args: list[str] | None = None) -> int:
    """Write all parameter files and the policy, for a plant that has a file in config/plants."""
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
