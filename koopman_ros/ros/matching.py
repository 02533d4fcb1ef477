# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Others on a node's topics that should not be: whose messages cannot pass, or who conflict."""

from __future__ import annotations

from collections.abc import Callable, Mapping
import copy
from dataclasses import dataclass
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.duration import Infinite
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import (
    DurabilityPolicy,
    LivelinessPolicy,
    qos_check_compatible,
    qos_policy_name_from_kind,
    QoSCompatibility,
    QoSProfile,
    ReliabilityPolicy,
)
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from koopman_ros.ros import topics
from koopman_ros.ros.owned import Owned

_LOOK_PERIOD = 0.5  # s
# What does not pass: policy, offered, asked for.
_CONFLICTS = (('reliability', ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE),
              ('durability', DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL))


@dataclass(frozen=True)
class _Endpoint:
    """
    One of the node's own.

    :param topic: with its namespace.
    :param type_name: of its messages.
    :param qos: what it offers or asks for.
    :param subscribes: whether it hears.
    :param overridable: whether a parameter can change its quality of service.
    """

    topic: str
    type_name: str
    qos: QoSProfile
    subscribes: bool
    overridable: bool


class Matching:
    """
    Make a node's publishers and subscriptions, and say which others conflict or do not match.

    The middleware tells when one is found; whether it is still there is looked up.

    :param node: whose endpoints they are.
    :param on_change: called when the complaint is another.
    :param single: what a publisher does, e.g. 'command the coolant', by topic of the loop on
        which only one node may publish.
    """

    def __init__(self, node: Node, on_change: Callable[[], None],
                 single: Mapping[str, str] | None = None) -> None:
        self._node = node
        self._on_change = on_change
        self._single = single or {}
        self._owned = Owned(node)
        self._own: list[_Endpoint] = []
        self._policies: dict[str, str] = {}  # last reported by the middleware, by topic
        self._said: tuple[str, ...] = ('', '')
        self._owned.keep(node.create_timer(
            _LOOK_PERIOD, self._look, clock=Clock(clock_type=ClockType.STEADY_TIME)))

    @property
    def complaint(self) -> str:
        """Names topic, nodes, what is wrong and what to do; conflicts first; or is empty."""
        return next(filter(None, self._said), '')

    def destroy(self) -> None:
        """Take down the publishers and subscriptions that were made here, and look no more."""
        self._owned.destroy()

    def subscribe(self, kind: Any, topic: str, callback: Callable[[Any], None], qos: QoSProfile,
                  **options: Any) -> Subscription:
        """Create a subscription; the arguments are those of rclpy."""
        # overriding parameters change the profile itself
        made = self._owned.keep(self._node.create_subscription(
            kind, topic, callback, copy.copy(qos), event_callbacks=SubscriptionEventCallbacks(
                incompatible_qos=self._found(topic), incompatible_type=lambda _: self._look()),
            **options))
        self._own.append(_Endpoint(made.topic_name, type_name(kind), made.qos_profile, True,
                                   'qos_overriding_options' in options))
        return made

    def publish(self, kind: Any, topic: str, qos: QoSProfile,
                matched: Callable[[Any], None] | None = None) -> Publisher:
        """Create a publisher; the arguments are those of rclpy and of its event callbacks."""
        made = self._owned.keep(self._node.create_publisher(
            kind, topic, copy.copy(qos), event_callbacks=PublisherEventCallbacks(
                incompatible_qos=self._found(topic), incompatible_type=lambda _: self._look(),
                matched=matched)))
        self._own.append(_Endpoint(
            made.topic_name, type_name(kind), made.qos_profile, False, False))
        return made

    def _found(self, topic: str) -> Callable[[Any], None]:
        name = self._node.resolve_topic_name(topic)

        def note(event: Any) -> None:
            self._policies[name] = qos_policy_name_from_kind(event.last_policy_kind).lower()
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
        """Return who publishes a topic if there are several, or an empty string."""
        # who publishes something else there is not in conflict
        publishers = [info for info in self._node.get_publishers_info_by_topic(topic)
                      if info.topic_type == type_name(topics.TYPES[topic])]
        names = sorted(map(node_name, publishers))
        # publishers, not names: a node may have been started twice under the same
        return '' if len(names) < 2 else (
            f'{len(names)} nodes {self._single[topic]}: {", ".join(names)}; end all but one')

    def _complaints(self, own: _Endpoint) -> list[str]:
        publishers = self._node.get_publishers_info_by_topic(own.topic)
        subscriptions = self._node.get_subscriptions_info_by_topic(own.topic)
        said = [f'{own.topic}: {node_name(other)} uses it for {other.topic_type[:100]}, here it '
                f'is {own.type_name}: end that node, or remap its topic'
                for other in (*publishers, *subscriptions) if other.topic_type != own.type_name]
        others = publishers if own.subscribes else subscriptions
        return said + [self._qos_complaint(own, other) for other in others
                       if other.topic_type == own.type_name and not _passes(own, other)]

    def _qos_complaint(self, own: _Endpoint, other: TopicEndpointInfo) -> str:
        offered, asked = _in_order(own, other)
        policy, wanted = self._policies.get(own.topic, 'quality of service'), 'the default'
        does = 'publishes' if own.subscribes else 'subscribes'
        for name, too_little, too_much in _CONFLICTS:
            if (getattr(offered, name), getattr(asked, name)) == (too_little, too_much):
                policy, wanted = name, (too_much if own.subscribes else too_little).short_key
                does += f' with {(too_little if own.subscribes else too_much).short_key}'
                break
        remedy = f'use {wanted} there'
        if own.overridable and policy == 'reliability':
            remedy += (f', or start this node with -p qos_overrides.{own.topic}.subscription.'
                       'reliability:=best_effort')
        return (f'{own.topic}: {node_name(other)} {does}, which is incompatible in {policy}, so '
                f'that no message passes: {remedy}')


def _passes(own: _Endpoint, other: TopicEndpointInfo) -> bool:
    compatible, _ = qos_check_compatible(*_in_order(own, other))
    return bool(compatible != QoSCompatibility.ERROR)


def _in_order(own: _Endpoint, other: TopicEndpointInfo) -> tuple[QoSProfile, QoSProfile]:
    """Return what is offered and what is asked for."""
    ours, theirs = _explicit(own.qos), _explicit(other.qos_profile)
    return (theirs, ours) if own.subscribes else (ours, theirs)


def _explicit(profile: QoSProfile) -> QoSProfile:
    """Write out what a profile leaves to the default, which else passes for a difference."""
    filled = copy.copy(profile)
    for name in ('deadline', 'liveliness_lease_duration'):
        if not getattr(filled, name).nanoseconds:
            setattr(filled, name, Infinite)
    if filled.liveliness == LivelinessPolicy.SYSTEM_DEFAULT:
        filled.liveliness = LivelinessPolicy.AUTOMATIC
    return filled


def node_name(info: TopicEndpointInfo) -> str:
    """Return the name of the node that has an endpoint, with its namespace."""
    return f'{info.node_namespace.rstrip("/")}/{info.node_name}'


def type_name(kind: Any) -> str:
    """Return the name of a message type, ``package/msg/Name``."""
    return f'{kind.__module__.split(".")[0]}/msg/{kind.__name__}'
