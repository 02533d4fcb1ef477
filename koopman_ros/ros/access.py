# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Who publishes, subscribes and serves what, and the SROS2 policy that grants no more."""

from __future__ import annotations

from dataclasses import dataclass
from xml.etree import ElementTree

from koopman_ros.parameters.player import PlayerParameters
from koopman_ros.parameters.trainer import EXPERIMENT_TOPICS, LOOP_TOPICS
from koopman_ros.ros import topics

POLICY_FILE = 'sros2_policy.xml'

# what rclpy gives every node
_ROSOUT, _PARAMETER_EVENTS = '/rosout', '/parameter_events'
_PARAMETER_SERVICES = (
    '~/describe_parameters', '~/get_parameter_types', '~/get_parameters', '~/list_parameters',
    '~/set_parameters', '~/set_parameters_atomically')
_TYPE_SERVICE = '~/get_type_description'
STANDARD_TOPICS = (_ROSOUT, _PARAMETER_EVENTS)
STANDARD_SERVICES = (*_PARAMETER_SERVICES, _TYPE_SERVICE)
# `ros2 topic pub` and its like start a node with this service, named after their process
_COMMAND_LINE_SERVICE = '/_ros2cli_*/get_type_description'

_LOOP = tuple(name for name in topics.TYPES if name != topics.CLOCK)


@dataclass(frozen=True)
class Access:
    """
    What a node does on the network, by names as in the node; all tuples of names.

    :param publishes: topics.
    :param subscribes: topics; /clock where it follows simulated time (`use_sim_time`).
    :param serves: services.
    :param calls: services of others.
    """

    publishes: tuple[str, ...] = ()
    subscribes: tuple[str, ...] = ()
    serves: tuple[str, ...] = ()
    calls: tuple[str, ...] = ()


NODES = {
    'plant': Access(
        publishes=(topics.TEMPERATURE, topics.CONCENTRATION, topics.COOLANT_TEMPERATURE,
                   topics.CLOCK, topics.DIAGNOSTICS, *STANDARD_TOPICS),
        subscribes=(topics.COOLANT_SETPOINT,),
        serves=('~/reset', *STANDARD_SERVICES)),
    'controller': Access(
        publishes=(topics.COOLANT_SETPOINT, topics.ACTIVE_SETPOINT,
                   topics.PREDICTED_TEMPERATURE, topics.CONTROLLER_STATE,
                   topics.CONTROLLER_EVENTS, topics.DIAGNOSTICS, *STANDARD_TOPICS),
        subscribes=(topics.TEMPERATURE, topics.COOLANT_TEMPERATURE, topics.SETPOINT,
                    topics.MANUAL_COOLANT_SETPOINT, topics.CLOCK),
        serves=('~/set_automatic', '~/reload_model', *STANDARD_SERVICES)),
    'trainer': Access(
        publishes=(*EXPERIMENT_TOPICS, topics.DIAGNOSTICS,
                   *STANDARD_TOPICS),
        subscribes=(*LOOP_TOPICS, topics.CLOCK),
        serves=('~/record', '~/experiment', '~/train', '~/cancel_training',
                *STANDARD_SERVICES)),
    'player': Access(
        publishes=(*PlayerParameters().topics, topics.CLOCK,
                   *STANDARD_TOPICS),
        subscribes=(topics.COOLANT_SETPOINT,),
        serves=STANDARD_SERVICES),
    'replay': Access(publishes=(_PARAMETER_EVENTS,), serves=(_TYPE_SERVICE,)),
}

# whoever moves the set-point, calls the services, tunes and watches: a person or a panel
OPERATOR = Access(
    publishes=(topics.SETPOINT, topics.MANUAL_COOLANT_SETPOINT, *STANDARD_TOPICS),
    subscribes=(*_LOOP, topics.CLOCK, *STANDARD_TOPICS),
    serves=(*STANDARD_SERVICES, _COMMAND_LINE_SERVICE),
    calls=tuple(f'{node}/{service.removeprefix("~/")}' for node, access in NODES.items()
                if node != 'replay' for service in access.serves))


def policy() -> str:
    """Return the text of the SROS2 policy: one enclave for each node, and one for operators."""
    root = ElementTree.Element('policy', version='0.2.0')
    root.append(ElementTree.Comment(
        ' Least privilege for each node, written by `make config`: see docs/security.md. For '
        'nodes in\n       a namespace replace every ns="/" by it. '))
    enclaves = ElementTree.SubElement(root, 'enclaves')
    for name, access in {**NODES, 'operator': OPERATOR}.items():
        enclave = ElementTree.SubElement(enclaves, 'enclave', path=f'/koopman_ros/{name}')
        profiles = ElementTree.SubElement(enclave, 'profiles')
        profile = ElementTree.SubElement(profiles, 'profile', ns='/', node=name)
        for kind, verb, names in (
                ('topic', 'publish', access.publishes), ('topic', 'subscribe', access.subscribes),
                ('service', 'reply', access.serves), ('service', 'request', access.calls)):
            if names:
                rules = ElementTree.SubElement(profile, f'{kind}s', {verb: 'ALLOW'})
                for granted in sorted(set(names)):
                    ElementTree.SubElement(rules, kind).text = granted
    ElementTree.indent(root)
    return ('<?xml version="1.0" encoding="UTF-8"?>\n'
            + ElementTree.tostring(root, encoding='unicode') + '\n')
