# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The uses of rclpy beyond its public API: all in one module, and all work with this rclpy."""

import ast
from collections.abc import Iterator
import inspect
from pathlib import Path
import re

import pytest
from rclpy import lifecycle
from rclpy import node as rclpy_node
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.service import Service
from rclpy.subscription import Subscription
from std_msgs.msg import String
from std_srvs.srv import Trigger

from koopman_ros.ros import rclpy_internals as internals
from koopman_ros.ros.topics import profile
from koopman_ros.testing import Harness

ROOT = Path(__file__).parents[2]
# what rclpy's nodes, publishers, subscriptions and services keep for themselves
PRIVATE = set(re.findall(r'\bself\.(_[a-z]\w*)', ''.join(map(inspect.getsource, (
    rclpy_node, lifecycle.node, Publisher, Service, Subscription)))))
HANDLES = {'handle', 'take_message', 'service_take_request', 'destroy_when_not_in_use'}


def beyond_the_public_api(text: str) -> set[str]:
    """Return what a file uses of rclpy beyond its public API."""
    found, nodes = set(), list(ast.walk(ast.parse(text)))
    # a node's class may not use the attributes of its base, other classes have their own
    own = {attribute for part in nodes if isinstance(part, ast.ClassDef) and not any(
        'Node' in ast.unparse(base) for base in part.bases) for attribute in ast.walk(part)
        if isinstance(attribute, ast.Attribute) and ast.unparse(attribute.value) == 'self'}
    for part in nodes:
        match part:
            case ast.Import(names=names):
                found |= {one.name for one in names if re.search(
                    r'rclpy\.(\w+\.)*(_|impl|experimental)', one.name)}
            case ast.ImportFrom(module=str(module), names=names) if module.startswith('rclpy'):
                found |= {f'{module}.{one.name}' for one in names if re.search(
                    r'\.(_|impl\b|experimental\b)', f'{module}.{one.name}')}
            case ast.Attribute(attr=name) if part not in own and (
                    name in PRIVATE | HANDLES or '_Node__' in name):
                found.add(ast.unparse(part))
    return found


def test_one_module_alone_goes_beyond_the_public_api() -> None:
    module = Path(internals.__file__)
    found = {path.relative_to(ROOT): used for folder in ('koopman_ros', 'examples', 'studies')
             for path in ROOT.glob(f'{folder}/**/*.py') if 'rclpy' in (text := path.read_text())
             and path != module and (used := beyond_the_public_api(text))}
    assert found == {}
    assert beyond_the_public_api(module.read_text()) >= {
        'rclpy.experimental.EventsExecutor', 'node._state_machine', 'subscription.handle'}


def use(ros: Harness, topic: str) -> Iterator[tuple[Node, Subscription]]:
    """Yield a node beside the bench, in no executor, that has one message."""
    node = Node('beside', context=ros.node.context)
    subscription = node.create_subscription(String, topic, lambda _: None, 10)
    publisher = ros.node.create_publisher(String, topic, 10)
    ros.wait_until(lambda: publisher.get_subscription_count() == 1)
    publisher.publish(String(data='one'))
    assert publisher.wait_for_all_acked()
    yield node, subscription
    ros.node.destroy_publisher(publisher)
    node.destroy_node()


@pytest.mark.parametrize('raw', [False, True])
def test_take_message(shared_ros: Harness, raw: bool) -> None:
    for _, subscription in use(shared_ros, f'words_{raw}'):
        taken = internals.take_message(subscription, raw)
        assert taken is not None
        message, info = taken
        assert b'one' in message if raw else message == String(data='one')
        assert info['source_timestamp'] > 0
        assert {'received_timestamp', 'publication_sequence_number'} <= set(info)
        assert internals.take_message(subscription) is None


def test_take_request(shared_ros: Harness) -> None:
    ros = shared_ros
    node = Node('beside', context=ros.node.context)
    service = node.create_service(Trigger, 'serve', lambda _, response: response)
    client = ros.node.create_client(Trigger, 'serve')
    ros.wait_until(client.service_is_ready)
    assert internals.take_request(service) is None
    future = client.call_async(Trigger.Request())
    headers = list[object]()
    ros.wait_until(lambda: bool(headers.append(internals.take_request(service)) or headers[-1]))
    service.send_response(Trigger.Response(message='taken'), headers[-1])
    ros.wait_until(future.done)
    assert future.result().message == 'taken'
    ros.node.destroy_client(client)
    node.destroy_node()


def test_end_lifecycle(shared_ros: Harness) -> None:
    """A node that is only destroyed keeps its name as long as its object lives."""
    ros = shared_ros
    node = LifecycleNode('managed', context=ros.node.context)
    ros.wait_until(lambda: 'managed' in ros.node.get_node_names())
    node.destroy_node()
    internals.end_lifecycle(node)
    ros.wait_until(lambda: 'managed' not in ros.node.get_node_names())


def test_lost_messages(shared_ros: Harness) -> None:
    ros = shared_ros
    for node, _ in use(ros, 'other'):
        subscription = node.create_subscription(
            String, 'many', lambda _: None, profile(1, reliable=False))
        lost = internals.LostMessages(subscription)
        assert lost.take() == 0
        lost.end()


def test_events_executor(shared_ros: Harness) -> None:
    executor = internals.events_executor(shared_ros.node.context)
    assert not isinstance(executor, SingleThreadedExecutor)
    called = list[int]()
    for node, _ in use(shared_ros, 'timed'):
        node.create_timer(0.01, lambda: called.append(1))
        executor.add_node(node)
        shared_ros.wait_until(lambda: executor.spin_once(timeout_sec=0.05) or called)
        executor.remove_node(node)
    executor.shutdown()
