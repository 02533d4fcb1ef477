# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
A process that publishes numbered temperatures at a steady rate, and says what it has sent.

The number k of a message is its stamp [ns] and its temperature. Prints a line before the first
message and, once the listener has them all, a line of JSON: the messages sent, the seconds from
the first to the last, and the largest delay behind the schedule in seconds.
"""

import argparse
import json
import sys
import time

from rcl_interfaces.srv import GetParameters
import rclpy
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Temperature

_TIMEOUT = 30.0  # s, until the listener is there and until it has everything


def main(args: list[str] | None = None) -> int:
    """Publish once the listening node is there."""
    parser = argparse.ArgumentParser(description='Publish numbered temperatures.')
    parser.add_argument('--topic', default='temperature')
    parser.add_argument('--listener', default='trainer', help='name of the node that listens')
    parser.add_argument('--rate', type=float, default=1000.0, help='messages per second')
    parser.add_argument('--count', type=int, default=1000, help='number of messages')
    parser.add_argument('--depth', type=int, default=1000, help='messages kept for the listener')
    given = parser.parse_args(args)
    rclpy.init()
    node = Node('numbers')
    publisher = node.create_publisher(Temperature, given.topic, QoSProfile(depth=given.depth))
    _wait_for_listener(node, publisher, given.listener)
    print(f'publishing to {given.listener}', flush=True)
    duration, latest = _publish(publisher, given.rate, given.count)
    if not publisher.wait_for_all_acked(Duration(seconds=_TIMEOUT)):
        sys.exit(f'{given.listener} does not acknowledge within {_TIMEOUT} s')
    print(json.dumps({'sent': given.count, 'seconds': duration, 'latest_seconds': latest}))
    node.destroy_node()
    rclpy.try_shutdown()
    return 0


def _wait_for_listener(node: Node, publisher: Publisher, listener: str) -> None:
    """
    Wait until the listening node knows the publisher.

    It learns of our endpoints in the order in which they were made: where it answers a call, it
    knows the publisher, too.
    """
    client = node.create_client(GetParameters, f'{listener}/get_parameters')
    deadline = time.monotonic() + _TIMEOUT
    while time.monotonic() < deadline:
        if publisher.get_subscription_count() and client.service_is_ready():
            asked = client.call_async(GetParameters.Request(names=['use_sim_time']))
            rclpy.spin_until_future_complete(node, asked, timeout_sec=0.5)
            if asked.done():
                return
        else:
            rclpy.spin_once(node, timeout_sec=0.02)
    sys.exit(f'{listener} does not listen within {_TIMEOUT} s')


def _publish(publisher: Publisher, rate: float, count: int) -> tuple[float, float]:
    """Publish on schedule; return the seconds it took and the largest delay."""
    message = Temperature()
    latest = 0.0
    begun = time.monotonic()
    for k in range(count):
        due = begun + k / rate
        wait = due - time.monotonic()
        if wait > 0.0:
            time.sleep(wait)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(k, 1_000_000_000)
        message.temperature = float(k)
        publisher.publish(message)
        latest = max(latest, time.monotonic() - due)
    return time.monotonic() - begun, latest


if __name__ == '__main__':
    sys.exit(main())
