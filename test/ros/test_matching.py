# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Complaints about others whose messages cannot pass, between two nodes of one process."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import time

import pytest
import rclpy
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Temperature

from koopman_ros.ros import topics
from koopman_ros.ros.matching import Matching
from koopman_ros.testing import isolated_domain

TIMEOUT = 20.0  # s


class Pair:
    """A node that watches what matches it, and another one."""

    def __init__(self) -> None:
        self.context = Context()
        rclpy.init(context=self.context)
        self.own, self.other = (Node(name, context=self.context) for name in ('own', 'other'))
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.own)
        self.executor.add_node(self.other)
        self.matching = Matching(self.own, lambda: None)
        self.speaker = self.matching.publish(Temperature, 'command', topics.LOOP_QOS)
        self.matching.subscribe(Temperature, 'temperature', lambda _: None, topics.LOOP_QOS)

    def wait(self, condition: Callable[[], bool]) -> None:
        deadline = time.monotonic() + TIMEOUT
        while not condition():
            assert time.monotonic() < deadline, self.matching.complaint
            self.executor.spin_once(timeout_sec=0.05)

    def close(self) -> None:
        self.executor.shutdown()
        self.own.destroy_node()
        self.other.destroy_node()
        rclpy.shutdown(context=self.context)


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


def test_publisher_that_offers_less_than_is_asked_for(pair: Pair) -> None:
    offering = pair.other.create_publisher(
        Temperature, 'temperature', QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
    pair.wait(lambda: pair.matching.complaint == (
        '/temperature: /other publishes with best_effort, which is incompatible in reliability, '
        'so that no message passes: use reliable there'))
    pair.other.destroy_publisher(offering)
    pair.wait(lambda: not pair.matching.complaint)


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
