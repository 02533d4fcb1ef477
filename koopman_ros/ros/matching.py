# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Others on a node's topics that should not be: whose messages cannot pass, or who conflict."""

from collections.abc import Callable, Mapping
import copy
from typing import Any

from rclpy import qos
from rclpy.duration import Infinite
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from koopman_ros.ros import topics
from koopman_ros.ros.node import Owned

# Topics of the loop on which only one node may publish, and what it does.
SINGLE = {topics.COOLANT_SETPOINT: 'command the coolant',
          topics.TEMPERATURE: 'publish the temperature'}

_LOOK_PERIOD = 0.5  # s
# What does not pass: policy, offered, asked for.
_CONFLICTS = (
    ('reliability', qos.ReliabilityPolicy.BEST_EFFORT, qos.ReliabilityPolicy.RELIABLE),
    ('durability', qos.DurabilityPolicy.VOLATILE, qos.DurabilityPolicy.TRANSIENT_LOCAL))


class Matching:
    """
    Make a node's publishers and subscriptions, and say which others conflict or do not match.

    :param on_change: called when the complaint is another.
    :param single: topics that only one node may publish, as in `SINGLE`.
    """

    def __init__(self, node: Node, on_change: Callable[[], None],
                 single: Mapping[str, str] | None = None) -> None:
        self._node, self._on_change, self._single = node, on_change, single or {}
        self._owned = Owned(node)
        self._own: list[Publisher | Subscription] = []
        self._overridable: set[str] = set()  # subscribed, with quality of service by parameter
        self._policies: dict[str, str] = {}  # last reported by the middleware, by topic
        self._said: tuple[str, ...] = ('', '')
        self._owned.timer(_LOOK_PERIOD, self._look)

    @property
    def complaint(self) -> str:
        """Names topic, nodes, what is wrong and what to do; conflicts first; or is empty."""
        return next(filter(None, self._said), '')

    def destroy(self) -> None:
        """Take down the publishers and subscriptions that were made here, and look no more."""
        self._owned.destroy()

    def subscribe(self, topic: str, callback: Callable[[Any], None], kind: Any = None,
                  **options: Any) -> Subscription:
        """Subscribe to a topic of the loop, or to another one of a type; options as in rclpy."""
        # overriding parameters change the profile itself
        made = self._owned.keep(self._node.create_subscription(
            kind or topics.TYPES[topic], topic, callback, copy.copy(topics.qos(topic)),
            event_callbacks=SubscriptionEventCallbacks(
                incompatible_qos=self._found(topic), incompatible_type=lambda _: self._look()),
            **options))
        self._own.append(made)
        if 'qos_overriding_options' in options:
            self._overridable.add(made.topic_name)
        return made

    def publish(self, topic: str, kind: Any = None, matched: Callable[[Any], None] | None = None
                ) -> Publisher:
        """Publish a topic of the loop, or another one of a type; matched is an event of rclpy."""
        made = self._owned.keep(self._node.create_publisher(
            kind or topics.TYPES[topic], topic, copy.copy(topics.qos(topic)),
            event_callbacks=PublisherEventCallbacks(
                incompatible_qos=self._found(topic), incompatible_type=lambda _: self._look(),
                matched=matched)))
        self._own.append(made)
        return made

    def _found(self, topic: str) -> Callable[[Any], None]:
        name = self._node.resolve_topic_name(topic)

        def note(event: Any) -> None:
            self._policies[name] = qos.qos_policy_name_from_kind(event.last_policy_kind).lower()
            self._look()

        return note

    def _look(self) -> None:
        said = ('; '.join(filter(None, map(self._conflict, self._single))),
                '; '.join(dict.fromkeys(
                    complaint for own in self._own for complaint in self._complaints(own))))
        before, self._said = self._said, said
        for complaint in said:
            if complaint and complaint not in before:
                self._node.get_logger().warning(complaint)
        if said != before:
            self._on_change()

    def _conflict(self, topic: str) -> str:
        # who publishes something else is not in conflict; a node may be there twice
        names = sorted(node_name(info) for info in self._node.get_publishers_info_by_topic(topic)
                       if info.topic_type == type_name(topics.TYPES[topic]))
        return '' if len(names) < 2 else (
            f'{len(names)} nodes {self._single[topic]}: {", ".join(names)}; end all but one')

    def _complaints(self, own: Publisher | Subscription) -> list[str]:
        topic, kind = own.topic_name, type_name(own.msg_type)
        subscribes = isinstance(own, Subscription)
        publishers = self._node.get_publishers_info_by_topic(topic)
        subscriptions = self._node.get_subscriptions_info_by_topic(topic)
        said = [f'{topic}: {node_name(other)} uses it for {other.topic_type[:100]}, here it is '
                f'{kind}: end that node, or remap its topic'
                for other in (*publishers, *subscriptions) if other.topic_type != kind]
        return said + [
            self._qos_complaint(own, other) for other in (publishers if subscribes else
                                                          subscriptions)
            if other.topic_type == kind and (
                qos.qos_check_compatible(*_in_order(own, other))[0] == qos.QoSCompatibility.ERROR)]

    def _qos_complaint(self, own: Publisher | Subscription, other: TopicEndpointInfo) -> str:
        topic, subscribes = own.topic_name, isinstance(own, Subscription)
        offered, asked = _in_order(own, other)
        policy, wanted = self._policies.get(topic, 'quality of service'), 'the default'
        does = 'publishes' if subscribes else 'subscribes'
        for name, too_little, too_much in _CONFLICTS:
            if (getattr(offered, name), getattr(asked, name)) == (too_little, too_much):
                policy, wanted = name, (too_much if subscribes else too_little).short_key
                does += f' with {(too_little if subscribes else too_much).short_key}'
                break
        remedy = f'use {wanted} there'
        if subscribes and topic in self._overridable and policy == 'reliability':
            remedy += (f', or start this node with -p qos_overrides.{topic}.subscription.'
                       'reliability:=best_effort')
        return (f'{topic}: {node_name(other)} {does}, which is incompatible in {policy}, so '
                f'that no message passes: {remedy}')


def _in_order(own: Publisher | Subscription, other: TopicEndpointInfo
              ) -> tuple[qos.QoSProfile, qos.QoSProfile]:
    ours, theirs = _explicit(own.qos_profile), _explicit(other.qos_profile)
    return (theirs, ours) if isinstance(own, Subscription) else (ours, theirs)


def _explicit(profile: qos.QoSProfile) -> qos.QoSProfile:
    # what a profile leaves to the default else passes for a difference
    filled = copy.copy(profile)
    for name in ('deadline', 'liveliness_lease_duration'):
        if not getattr(filled, name).nanoseconds:
            setattr(filled, name, Infinite)
    if filled.liveliness == qos.LivelinessPolicy.SYSTEM_DEFAULT:
        filled.liveliness = qos.LivelinessPolicy.AUTOMATIC
    return filled


def node_name(info: TopicEndpointInfo) -> str:
    """Return the name of the node that has an endpoint, with its namespace."""
    return f'{info.node_namespace.rstrip("/")}/{info.node_name}'


def type_name(kind: Any) -> str:
    """Return the name of a message type, ``package/msg/Name``."""
    return f'{kind.__module__.split(".")[0]}/msg/{kind.__name__}'
