# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Complaints about others whose messages cannot pass, between two nodes of one process."""

from collections.abc import Callable, Iterator
import re
import time

import pytest
import rclpy
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    LivelinessPolicy,
    QoSPolicyKind,
    QoSProfile,
    ReliabilityPolicy,
)
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import JointState, Temperature

from koopman_ros.ros import topics
from koopman_ros.ros.matching import Matching
from koopman_ros.testing import isolated_domain
from support.messages import TIMEOUT


class Pair:
    """A node that watches what matches it, and another one."""

    def __init__(self) -> None:
        # no participant may use a topic for two types
        self.own, self.other = (self._node(name) for name in ('own', 'other'))
        self.executor = SingleThreadedExecutor(context=self.own.context)
        self.executor.add_node(self.own)
        self.matching = Matching(self.own, lambda: None)
        self.speaker = self.matching.publish('command', Temperature)
        self.matching.subscribe(
            'temperature', lambda _: None,
            qos_overriding_options=QoSOverridingOptions((QoSPolicyKind.RELIABILITY,)))

    def _node(self, name: str) -> Node:
        context = Context()
        rclpy.init(context=context)
        return Node(name, context=context)

    def wait(self, condition: Callable[[], bool]) -> None:
        deadline = time.monotonic() + TIMEOUT
        while not condition():
            assert time.monotonic() < deadline, self.matching.complaint
            self.executor.spin_once(timeout_sec=0.05)

    def close(self) -> None:
        self.executor.shutdown()
        for node in (self.own, self.other):
            node.destroy_node()
            rclpy.shutdown(context=node.context)


@pytest.fixture(scope='module')
def pair() -> Iterator[Pair]:
    with isolated_domain():
        pair = Pair()
        yield pair
        pair.close()


@pytest.mark.parametrize(('qos', 'complaint'), [
    (QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL),
     '/command: /other subscribes with transient_local, which is incompatible in durability, so '
     'that no message passes: use volatile there'),
    (QoSProfile(depth=1, deadline=Duration(seconds=1)),
     '/command: /other subscribes, which is incompatible in deadline, so that no message passes: '
     'use the default there'),
    (QoSProfile(depth=1, liveliness=LivelinessPolicy.MANUAL_BY_TOPIC),
     '/command: /other subscribes, which is incompatible in liveliness, so that no message '
     'passes: use the default there'),
])
def test_subscription_that_asks_for_more_than_is_offered(
        pair: Pair, qos: QoSProfile, complaint: str) -> None:
    asking = pair.other.create_subscription(Temperature, 'command', lambda _: None, qos)
    pair.wait(lambda: pair.matching.complaint == complaint)
    pair.other.destroy_subscription(asking)
    pair.wait(lambda: not pair.matching.complaint)


@pytest.mark.parametrize(('kind', 'qos', 'complaint'), [
    (Temperature, QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT),
     '/temperature: /other publishes with best_effort, which is incompatible in reliability, '
     'so that no message passes: use reliable there, or start this node with -p '
     'qos_overrides./temperature.subscription.reliability:=best_effort'),
    (JointState, topics.LOOP_QOS,
     '/temperature: /other uses it for sensor_msgs/msg/JointState, here it is '
     'sensor_msgs/msg/Temperature: end that node, or remap its topic'),
])
def test_publisher_whose_messages_cannot_be_heard(
        pair: Pair, capfd: pytest.CaptureFixture[str], kind: type, qos: QoSProfile, complaint: str
        ) -> None:
    offering = pair.other.create_publisher(kind, 'temperature', qos)
    # found, perhaps, before its name is
    pair.wait(lambda: pair.matching.complaint == complaint)
    pair.other.destroy_publisher(offering)
    pair.wait(lambda: not pair.matching.complaint)
    assert f'[WARN] [own]: {complaint}\n' in re.sub(r' \[[0-9.]+\]', '', capfd.readouterr().err)


@pytest.mark.parametrize('qos', [
    topics.LOOP_QOS, QoSProfile(depth=1),
    QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)])
def test_subscription_that_matches_is_no_complaint(pair: Pair, qos: QoSProfile) -> None:
    hearing = pair.other.create_subscription(Temperature, 'command', lambda _: None, qos)
    pair.wait(lambda: pair.speaker.get_subscription_count() == 1)
    pair.wait(lambda: len(pair.own.get_subscriptions_info_by_topic('command')) == 1)
    pair.matching._look()
    assert not pair.matching.complaint
    pair.other.destroy_subscription(hearing)
    pair.wait(lambda: not pair.own.get_subscriptions_info_by_topic('command'))
