# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The SROS2 policy grants each node what the real node does on the network, and no more."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import rclpy
from rclpy.node import Node, NodeNameNonExistentError
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Temperature
from std_srvs.srv import SetBool

from koopman_ros.bags import BagWriter, message_definition
from koopman_ros.nodes import replay
from koopman_ros.parameters.player import PlayerParameters
from koopman_ros.ros import topics
from koopman_ros.ros.node import LoopNode
from koopman_ros.ros.programs import OPERATOR, policy, Program, PROGRAMS
from koopman_ros.testing import Harness
from support.messages import temperature


def resolved(access: Program, node: str) -> dict[str, set[str]]:
    """Return the names of a node in the root namespace in full, by what it does with them."""
    def full(names: tuple[str, ...]) -> set[str]:
        return {name if name.startswith('/') else f'/{name.replace("~", node, 1)}'
                for name in names}

    return {'publishes': full(access.publishes), 'subscribes': full(access.subscribes),
            'serves': full(access.serves), 'calls': full(access.calls)}


def done(observer: Node, node: str) -> dict[str, set[str]]:
    """Return what a node does at this moment, by the graph."""
    questions = {
        'publishes': observer.get_publisher_names_and_types_by_node,
        'subscribes': observer.get_subscriber_names_and_types_by_node,
        'serves': observer.get_service_names_and_types_by_node,
        'calls': observer.get_client_names_and_types_by_node}
    try:
        return {verb: {name for name, _ in ask(node, '/')} for verb, ask in questions.items()}
    except NodeNameNonExistentError:
        return {verb: set() for verb in questions}


Seen = dict[str, set[str]]


def watch(ros: Harness, node: str, seen: Seen, **wanted: set[str]) -> None:
    """Add to what was seen of a node, until all that is wanted was."""
    def found() -> bool:
        for verb, names in done(ros.node, node).items():
            seen.setdefault(verb, set()).update(names)
        return all(names <= seen[verb] for verb, names in wanted.items())

    ros.wait_until(found)


def check(ros: Harness, node: str, seen: Seen) -> None:
    """Compare what a node does, and did, with what is granted."""
    granted = resolved(PROGRAMS[node], node)
    watch(ros, node, seen, **granted)
    assert seen == granted


@pytest.mark.parametrize(('node', 'parameters'), [
    ('plant', {'reactor': 'two_state', 'speed': 2.0}),
    ('controller', {'use_sim_time': True}),
])
def test_a_node_does_what_it_is_granted(shared_ros: Harness, node: str,
                                        parameters: dict[str, Any]) -> None:
    shared_ros.start(node, parameters)
    check(shared_ros, node, {})


def test_the_trainer_does_what_it_is_granted(ros: Harness, tmp_path: Path) -> None:
    seen: Seen = {}
    ros.start('trainer', {'use_sim_time': True, 'output': tmp_path / 'run.mcap',
                          'experiment_timeout': 0.5})
    client = ros.node.create_client(SetBool, '/trainer/experiment')
    ros.wait_until(client.service_is_ready)
    for topic in (topics.COOLANT_SETPOINT, topics.MANUAL_COOLANT_SETPOINT):
        assert ros.set_parameters('/trainer', experiment_topic=topic)[0].successful
        # it publishes while it waits for the measurement that does not come
        waiting = client.call_async(SetBool.Request(data=True))
        watch(ros, 'trainer', seen, publishes={f'/{topic}'})
        ros.wait_until(waiting.done)
        # without a controller nobody drives it by hand
        ros.node.create_publisher(Temperature, topics.COOLANT_SETPOINT, topics.LOOP_QOS)
    check(ros, 'trainer', seen)


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    path = tmp_path / 'all.mcap'
    with BagWriter(path) as writer:
        for number, name in enumerate(PlayerParameters().topics):
            writer.add_topic(f'/{name}', message_definition('sensor_msgs/msg/Temperature'), ())
            writer.write(f'/{name}', serialize_message(temperature(40.0, 1.0)), number)
    return path


def test_the_player_does_what_it_is_granted(ros: Harness, bag: Path) -> None:
    ros.start('player', {'bag': bag, 'rate': 0.0, 'clock': True})
    check(ros, 'player', {})


@pytest.fixture
def context(ros: Harness) -> Iterator[None]:
    rclpy.init(args=['--ros-args', '-p', 'bags:=[run_1]'])
    yield
    rclpy.try_shutdown()


def test_the_replay_does_what_it_is_granted(context: None, monkeypatch: pytest.MonkeyPatch
                                            ) -> None:
    """It is gone before others have found it, so that it is asked itself, at its end."""
    seen: list[dict[str, set[str]]] = []

    class Asked(LoopNode):
        def destroy_node(self) -> None:
            seen.append(done(self, 'replay'))
            super().destroy_node()

    monkeypatch.setattr(replay, 'LoopNode', Asked)
    replay._prepare()
    assert seen == [resolved(PROGRAMS['replay'], 'replay')]


def test_an_operator_asks_and_watches_all_and_commands_by_the_set_points_alone() -> None:
    operator = resolved(OPERATOR, 'operator')
    loop = {node: resolved(access, node) for node, access in PROGRAMS.items() if node != 'replay'}
    assert operator['subscribes'] >= set().union(*(do['publishes'] for do in loop.values()))
    assert operator['calls'] == set().union(*(do['serves'] for do in loop.values()))
    assert operator['publishes'] == {
        '/setpoint', '/manual_coolant_setpoint', '/rosout', '/parameter_events'}


def test_policy_has_the_form_that_sros2_reads() -> None:
    """Policy version 0.2.0: enclaves, profiles, and lists that are not empty and allow."""
    root = ElementTree.fromstring(policy())
    assert (root.tag, root.attrib) == ('policy', {'version': '0.2.0'})
    assert [child.tag for child in root] == ['enclaves']
    assert {enclave.get('path') for enclave in root[0]} == {
        f'/koopman_ros/{name}' for name in (*PROGRAMS, 'operator')}
    for enclave in root[0]:
        (profiles,) = enclave
        (profile,) = profiles
        assert (enclave.tag, profiles.tag, profile.tag) == ('enclave', 'profiles', 'profile')
        name = enclave.get('path', '').removeprefix('/koopman_ros/')
        assert profile.attrib == {'ns': '/', 'node': name}
        access = OPERATOR if name == 'operator' else PROGRAMS[name]
        granted: dict[str, set[str]] = {}
        for rules in profile:
            ((verb, qualifier),) = rules.attrib.items()
            assert qualifier == 'ALLOW'
            assert len(rules) > 0
            assert {rule.tag for rule in rules} == {
                'topic' if verb in ('publish', 'subscribe') else 'service'}
            assert rules.tag == f'{rules[0].tag}s'
            granted[verb] = {str(rule.text) for rule in rules}
        assert granted == {verb: set(names) for verb, names in (
            ('publish', access.publishes), ('subscribe', access.subscribes),
            ('reply', access.serves), ('request', access.calls)) if names}
