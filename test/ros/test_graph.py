# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Nodes among others: the policy grants what each does, and no more; messages that do not pass."""

from collections.abc import Callable, Iterator
from pathlib import Path
import re
from xml.etree import ElementTree

import pytest
import rclpy
from rclpy import qos
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.node import Node, NodeNameNonExistentError
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from rclpy.topic_endpoint_info import TopicEndpointInfo
from sensor_msgs.msg import JointState, Temperature
from std_srvs.srv import SetBool

from koopman_ros.core.paths import config_directory
from koopman_ros.demo import reactor
from koopman_ros.nodes import replay
from koopman_ros.nodes.controller import ControllerNode
from koopman_ros.nodes.plant import PlantNode
from koopman_ros.nodes.trainer import TrainerNode
from koopman_ros.parameters.player import player_table
from koopman_ros.parameters.trainer import COMMAND, MANUAL, SETPOINT
from koopman_ros.records import BagWriter, message_definition
from koopman_ros.ros import topics
from koopman_ros.ros.hosted import HostedNode
from koopman_ros.ros.node import LoopNode
from koopman_ros.ros.node_descriptions import OPERATOR, policy, Program, PROGRAMS, programs
from koopman_ros.testing import Harness
from support.nodes import RunNode, temperature

Seen = dict[str, set[str]]
BEST_EFFORT = QoSProfile(depth=1, reliability=qos.ReliabilityPolicy.BEST_EFFORT)


def resolved(access: Program, node: str) -> Seen:
    """Return the names of a node in the root namespace in full, by what it does with them."""
    return {verb: {name if name.startswith('/') else f'/{name.replace("~", node, 1)}'
                   for name in getattr(access, verb)}
            for verb in ('publishes', 'subscribes', 'serves', 'calls')}


def done(observer: Node, node: str) -> Seen:
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


def watch(ros: Harness, node: str, seen: Seen, **wanted: set[str]) -> None:
    """Add to what was seen of a node, until all that is wanted was."""
    def found() -> bool:
        for verb, names in done(ros.node, node).items():
            seen.setdefault(verb, set()).update(names)
        return all(names <= seen[verb] for verb, names in wanted.items())

    ros.wait_until(found)


def check(ros: Harness, node: str, seen: Seen, system: str = 'reactor') -> None:
    """Compare what a node does, and did, with what is granted."""
    granted = resolved(programs({'system': system})[node], node)
    watch(ros, node, seen, **granted)
    assert seen == granted


def test_nodes_use_exactly_the_names_that_their_policy_grants(
        ros: Harness, tmp_path: Path, run_node: RunNode, capfd: pytest.CaptureFixture[str]
        ) -> None:
    run_node(PlantNode, {'system': 'two_state', 'speed': 2.0})
    check(ros, 'plant', {})
    # by the file of the whole loop
    run_node(ControllerNode, {'use_sim_time': True}, '--params-file',
             str(config_directory() / 'plants' / 'two_tanks.yaml'))
    check(ros, 'controller', {}, 'two_tanks')
    assert 'ignored' not in capfd.readouterr().err
    bag = tmp_path / 'all.mcap'
    with BagWriter(bag) as writer:
        for number, name in enumerate(player_table().snapshot({}).topics):
            writer.add_topic(f'/{name}', message_definition('sensor_msgs/msg/Temperature'), ())
            writer.write(f'/{name}', serialize_message(temperature(40.0, 1.0)), number)
    player = ros.start('player', {'rate': 0.0, 'clock': True, 'bag': bag})
    check(ros, 'player', {})
    assert 'ignored' not in player.output()


def test_the_trainer_uses_exactly_its_granted_topics_and_services(
        ros: Harness, tmp_path: Path, run_node: RunNode) -> None:
    seen: Seen = {}
    # what is not measured is recorded where it is published
    ros.node.create_publisher(JointState, reactor.CONCENTRATION, topics.LOOP_QOS)
    run_node(TrainerNode, {'use_sim_time': True, 'output': tmp_path / 'run.mcap',
                           'experiment_timeout': 0.5})
    client = ros.node.create_client(SetBool, '/trainer/experiment')
    ros.wait_until(client.service_is_ready)
    for on, topic in ((COMMAND, reactor.COOLANT_SETPOINT),
                      (MANUAL, reactor.MANUAL_COOLANT_SETPOINT), (SETPOINT, reactor.SETPOINT)):
        assert ros.set_parameters('/trainer', experiment_signal=on)[0].successful
        # it publishes while it waits for the measurement that does not come
        waiting = client.call_async(SetBool.Request(data=True))
        watch(ros, 'trainer', seen, publishes={f'/{topic}'})
        ros.wait_until(waiting.done)
        if on == COMMAND:
            # without a controller nobody drives it by hand, or by set-points
            ros.node.create_publisher(Temperature, reactor.COOLANT_SETPOINT, topics.LOOP_QOS)
    check(ros, 'trainer', seen)


def test_the_panel_uses_exactly_its_granted_topics_and_services(ros: Harness) -> None:
    ros.start('panel', {'port': 0, 'use_sim_time': True})
    # it publishes there only while it asks for something
    check(ros, 'panel', {'publishes': {
        f'/{reactor.SETPOINT}', f'/{reactor.MANUAL_COOLANT_SETPOINT}'}})


def test_the_replay_uses_exactly_its_granted_topics_and_services(
        ros: Harness, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is gone before others have found it, so that it is asked itself, at its end."""
    seen: list[Seen] = []

    class Asked(LoopNode):
        def destroy_node(self) -> None:
            seen.append(done(self, 'replay'))
            super().destroy_node()

    monkeypatch.setattr(replay, 'LoopNode', Asked)
    rclpy.init(args=['--ros-args', '-p', 'bags:=[run_1]'])
    try:
        replay._prepare()
    finally:
        rclpy.try_shutdown()
    assert seen == [resolved(PROGRAMS['replay'], 'replay')]


def test_an_operator_asks_and_watches_all_and_commands_by_the_set_points_alone() -> None:
    operator = resolved(OPERATOR, 'operator')
    loop = {node: resolved(access, node) for node, access in PROGRAMS.items() if node != 'replay'}
    assert operator['subscribes'] >= set().union(*(do['publishes'] for do in loop.values()))
    assert operator['calls'] == set().union(*(do['serves'] for do in loop.values()))
    assert operator['publishes'] == {
        '/setpoint', '/manual_coolant_setpoint', '/rosout', '/parameter_events',
        '/events/write_split'}


def test_policy_has_the_form_that_sros2_reads() -> None:
    """Policy version 0.2.0: enclaves, profiles, and lists that are not empty and allow."""
    root = ElementTree.fromstring(policy())
    assert (root.tag, root.attrib) == ('policy', {'version': '0.2.0'})
    profiles = {enclave.get('path'): enclave.find('profiles/profile')
                for enclave in root.findall('enclaves/enclave')}
    assert set(profiles) == {f'/koopman_ros/{name}' for name in (*PROGRAMS, 'operator')}
    for profile in profiles.values():
        for rules in profile:
            assert list(rules.attrib.values()) == ['ALLOW']
            assert len(rules) > 0
    published = profiles['/koopman_ros/controller'].findall("topics[@publish='ALLOW']/topic")
    assert {rule.text for rule in published} == set(PROGRAMS['controller'].publishes)


class Pair:
    """A node that watches what matches it, beside the bench."""

    def __init__(self, ros: Harness, context: Context) -> None:
        self.ros, self.other = ros, ros.node
        self.own = HostedNode('own', None, context=context)
        self.matching = topics.EndpointMonitor(self.own, lambda: None)
        self.speaker = self.matching.publish('command', Temperature)
        self.matching.subscribe('temperature', lambda _: None, Temperature)

    def wait(self, condition: Callable[[], bool]) -> None:
        def met() -> bool:
            self.matching._look()
            return condition()

        self.ros.wait_until(met, lambda: self.matching.complaint)


@pytest.fixture(scope='module')
def pair(shared_ros: Harness) -> Iterator[Pair]:
    # a participant of its own, as none may use a topic for two types
    context = Context()
    rclpy.init(context=context)
    pair = Pair(shared_ros, context)
    yield pair
    pair.own.destroy_node()
    rclpy.shutdown(context=context)


@pytest.mark.parametrize(('topic', 'kind', 'profile', 'words'), [
    ('command', Temperature, QoSProfile(
        depth=1, durability=qos.DurabilityPolicy.TRANSIENT_LOCAL),
     ('/command: /bench subscribes ', 'transient local')),
    ('command', Temperature, QoSProfile(depth=1, deadline=Duration(seconds=1)), ('deadline',)),
    ('command', Temperature, QoSProfile(
        depth=1, liveliness=qos.LivelinessPolicy.MANUAL_BY_TOPIC), ('liveliness',)),
    ('temperature', JointState, topics.LOOP_QOS,
     ('/bench uses it for sensor_msgs/msg/JointState', 'remap'))])
def test_another_end_that_does_not_match_is_reported_and_logged(
        pair: Pair, capfd: pytest.CaptureFixture[str], topic: str, kind: type,
        profile: QoSProfile, words: tuple[str, ...]) -> None:
    if topic == 'command':
        subscription = pair.other.create_subscription(kind, topic, lambda _: None, profile)
    else:
        publisher = pair.other.create_publisher(kind, topic, profile)
    # the node may be known after its publisher or subscription
    pair.wait(lambda: pair.matching.complaint.startswith(f'/{topic}: /bench '))
    complaint = pair.matching.complaint
    assert all(word in complaint for word in words)
    if topic == 'command':
        pair.other.destroy_subscription(subscription)
    else:
        pair.other.destroy_publisher(publisher)
    pair.wait(lambda: not pair.matching.complaint)
    assert f'[WARN] [own]: {complaint}\n' in re.sub(r' \[[0-9.]+\]', '', capfd.readouterr().err)


def test_a_subscription_is_as_reliable_as_its_publishers(
        pair: Pair, capfd: pytest.CaptureFixture[str]) -> None:
    kinds = []
    for profile in (BEST_EFFORT, topics.LOOP_QOS):
        publisher = pair.other.create_publisher(Temperature, 'temperature', profile)

        def subscribed(wanted: qos.ReliabilityPolicy = profile.reliability) -> bool:
            found = pair.other.get_subscriptions_info_by_topic('/temperature')
            return [one.qos_profile.reliability for one in found] == [wanted]

        pair.wait(subscribed)
        kinds.append(profile.reliability.short_key.replace('_', ' '))
        assert not pair.matching.complaint
        assert f'/temperature: subscribed {kinds[-1]}, as published by' in capfd.readouterr().err
        pair.other.destroy_publisher(publisher)
        pair.wait(lambda: pair.own.count_publishers('/temperature') == 0)


def test_a_reliability_that_a_parameter_sets_stays(pair: Pair) -> None:
    name = 'qos_overrides./jacket.subscription.reliability'
    pair.own.declare_parameter(name, 'reliable')
    pair.matching.subscribe('jacket', lambda _: None, Temperature)
    publisher = pair.other.create_publisher(Temperature, 'jacket', BEST_EFFORT)
    pair.wait(lambda: f'-p {name}:=best_effort' in pair.matching.complaint)
    pair.other.destroy_publisher(publisher)


def test_a_node_whose_name_has_not_arrived_is_another_node() -> None:
    for name, namespace, text in (('hx', '/', '/hx'), ('hx', '/line', '/line/hx'), (
            '_NODE_NAME_UNKNOWN_', '_NODE_NAMESPACE_UNKNOWN_', 'another node')):
        assert topics.node_name(TopicEndpointInfo(
            node_name=name, node_namespace=namespace)) == text
