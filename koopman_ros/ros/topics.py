# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Topics: names, types, quality of service, and others who do not match."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
import copy
import reprlib
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy import qos as rclpy_qos
from rclpy.duration import Infinite
from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo
from rclpy.validate_topic_name import validate_topic_name
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

from koopman_ros.core.plugins import load_plugin
from koopman_ros.core.time_base import TimeBase
from koopman_ros.parameters.signal_topics import (
    ACTIVE_CONSTRAINTS,
    AUDIT_LOG,
    CLOCK,
    CONTROLLER_INTERNALS,
    DIAGNOSTICS,
    EVENT_LOG,
    PREDICTED_TRAJECTORY,
    SignalTopics,
)
from koopman_ros.ros.hosted import HostedNode, wall_timer
from koopman_ros.ros.managed import one_line

# JointState is the one stamped type of common_interfaces that carries named float64 values,
# JointTrajectory the one with their course in time.
# Records are lines of JSON, which keep a float64 bit-identical at a third of the time.
TYPES = {CONTROLLER_INTERNALS: JointState, PREDICTED_TRAJECTORY: JointTrajectory,
         ACTIVE_CONSTRAINTS: JointState, EVENT_LOG: String, AUDIT_LOG: String,
         DIAGNOSTICS: DiagnosticArray, CLOCK: Clock}

# Every message counts: reliable, with room for a receiver that falls behind a fast plant.
LOOP_QOS = QoSProfile(depth=1000)
# Late joiners receive the tracked set-point and the applied inputs.
LATCHED_QOS = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
CLOCK_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)

_LOOK_PERIOD = 0.5  # s
_LOOK_SHARE = 0.05  # of a processor, for the looks of all loops of a process


def overridable() -> QoSOverridingOptions:
    """Return options by which history, depth and reliability can be set by parameter."""
    return QoSOverridingOptions.with_default_policies()


def expected_topics(wiring: SignalTopics) -> dict[str, tuple[Any, QoSProfile]]:
    """Return type and quality of service of all topics that are known beforehand."""
    found = {place.topic: (message_class(place.type), LATCHED_QOS if (
        kind in ('active_setpoints', 'applied')) else LOOP_QOS)
        for kind in wiring.kinds for place in getattr(wiring, kind).values()}
    return {**found, **{topic: (kind, LOOP_QOS) for topic, kind in TYPES.items()}}


def unusable(node: Node, names: Collection[str]) -> str:
    """Return which name is not valid for a topic, as with a substitution; '' for none."""
    for name in names:
        try:
            validate_topic_name(name)
        except InvalidTopicNameException as error:
            return f'topics: {one_line(error)}'
        try:
            node.resolve_topic_name(name)
        except (RuntimeError, ValueError) as error:
            return (f'topics: {reprlib.repr(name)} cannot be used ({one_line(error)}): choose '
                    'another name')
    return ''


def profile(depth: int, *, reliable: bool, latched: bool = False) -> QoSProfile:
    """Return a quality of service that keeps the last `depth` messages."""
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE)


def matching_profile(usual: QoSProfile, publishers: Collection[TopicEndpointInfo], depth: int
                     ) -> QoSProfile:
    """Request reliability and history only where every publisher offers them."""
    offers = [info.qos_profile for info in publishers] or [usual]
    return profile(
        depth,
        reliable=all(o.reliability is not ReliabilityPolicy.BEST_EFFORT for o in offers),
        latched=all(o.durability is DurabilityPolicy.TRANSIENT_LOCAL for o in offers))


def followed(topic: str, profile: QoSProfile, publishers: Collection[TopicEndpointInfo]) -> str:
    """Return the text by which a subscription says that it is as reliable as its publishers."""
    return (f'{topic}: subscribed {profile.reliability.short_key.replace("_", " ")}, as published '
            f'by {", ".join(sorted(map(node_name, publishers)))}')


def message_class(type_name: str) -> Any:
    """Return the class of a ``package/msg/Name``; LookupError where it is not installed."""
    try:
        package, kind, name = type_name.split('/')
        return load_plugin(f'{package}.{kind}:{name}', 'message type', {})
    except ValueError as error:
        raise LookupError(
            f'message type {type_name!r} is not installed: source its workspace') from error


class EndpointMonitor:
    """
    Make a node's publishers and subscriptions, and report which others conflict or do not match.

    That is looked for twice a second, or less often where many loops share the process: each look
    asks the whole graph. The events of the middleware for it cost more than the answer to a
    message. Subscriptions are as reliable as their publishers, unless a parameter says otherwise.

    :param on_change: called when the complaint is another.
    :param exclusive: the verb phrase for topics on which only one node may publish.
    :ivar sources: numbers of the messages on those of these topics that the node receives. Of two
        publishers of one name, one may have died: they conflict if these numbers alternate.
    """

    def __init__(self, node: HostedNode, on_change: Callable[[], None],
                 exclusive: Mapping[str, str] | None = None) -> None:
        self._node, self._on_change, self._exclusive = node, on_change, exclusive or {}
        self.sources: Mapping[str, TimeBase] = {}
        self._publishers: list[Publisher] = []
        # with a function that subscribes by another profile, None where a parameter sets it
        self._subscriptions: list[tuple[
            Subscription, Callable[[QoSProfile], Subscription] | None]] = []
        self._last_complaints: tuple[str, ...] = ('', '')
        self._shared: dict[str, bool] = {}
        self._next_look = 0.0  # by the steady clock
        self._loops = 1 if node.hosting is None else node.hosting.loops
        self._timer = wall_timer(node, _LOOK_PERIOD, self._look_in_turn)

    def destroy(self) -> None:
        """Destroy the publishers and subscriptions, and look no more."""
        self._node.destroy_timer(self._timer)
        self._node.await_delivery(self._publishers)
        for publisher in self._publishers:
            self._node.destroy_publisher(publisher)
        for subscription in self.subscriptions:
            self._node.destroy_subscription(subscription)

    @property
    def subscriptions(self) -> list[Subscription]:
        """Those at present: another one replaces one whose publishers are less reliable."""
        return [own for own, _ in self._subscriptions]

    @property
    def complaint(self) -> str:
        """Names topic, nodes, problem and remedy; conflicts first; or is empty."""
        return next(filter(None, self._last_complaints), '')

    def shared(self, topic: str) -> bool:
        """Whether several nodes publish on a topic on which only one may."""
        return self._shared.get(topic, False)

    def subscribe(self, topic: str, callback: Callable[[Any], Any], kind: Any = None,
                  qos: QoSProfile = LOOP_QOS) -> Subscription:
        """Subscribe to a topic, by default of its type in `TYPES`."""
        name = self._node.resolve_topic_name(topic)

        def make(profile: QoSProfile) -> Subscription:
            # overriding parameters change the profile itself
            return self._node.create_subscription(
                kind or TYPES[topic], topic, callback, copy.copy(profile),
                qos_overriding_options=overridable() if fixed else QoSOverridingOptions(
                    [QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH]))

        fixed = self._node.has_parameter(f'qos_overrides.{name}.subscription.reliability')
        self._subscriptions.append((made := make(qos), None if fixed else make))
        return made

    def publish(self, topic: str, kind: Any = None, qos: QoSProfile = LOOP_QOS) -> Publisher:
        """Publish a topic, by default of its type in `TYPES`."""
        made = self._node.create_publisher(
            kind or TYPES[topic], topic, copy.copy(qos), qos_overriding_options=overridable())
        self._publishers.append(made)
        return made

    def _look_in_turn(self) -> None:
        if (now := time.monotonic()) < self._next_look:
            return
        started = time.thread_time()
        self._look()
        self._next_look = now + (time.thread_time() - started) * self._loops / _LOOK_SHARE

    def _look(self) -> None:
        conflicts = {topic: self._conflict(topic) for topic in self._exclusive}
        self._shared = {topic: bool(conflict) for topic, conflict in conflicts.items()}
        self._subscriptions = [(self._adapted(own, make), make)
                               for own, make in self._subscriptions]
        complaints = dict.fromkeys(
            complaint for own in self._own for complaint in self._complaints(own))
        texts = '; '.join(filter(None, conflicts.values())), '; '.join(complaints)
        before, self._last_complaints = self._last_complaints, texts
        for complaint in texts:
            if complaint and complaint not in before:
                self._node.get_logger().warning(complaint)
        if texts != before:
            self._on_change()

    @property
    def _own(self) -> list[Publisher | Subscription]:
        return [*self._publishers, *self.subscriptions]

    def _adapted(self, own: Subscription, make: Callable[[QoSProfile], Subscription] | None
                 ) -> Subscription:
        """Return a subscription, or another one that is as reliable as the publishers now are."""
        topic, profile, kind = own.topic_name, own.qos_profile, type_name(own.msg_type)
        publishers = [info for info in self._node.get_publishers_info_by_topic(topic)
                      if info.topic_type == kind]
        wanted = matching_profile(profile, publishers, profile.depth).reliability
        if make is None or wanted is profile.reliability:
            return own
        profile.reliability = wanted
        self._node.destroy_subscription(own)
        made = make(profile)
        self._node.get_logger().info(followed(topic, profile, publishers))
        return made

    def _conflict(self, topic: str) -> str:
        # who publishes something else is not in conflict; a node may be there twice
        kinds = {type_name(own.msg_type) for own in self._own
                 if own.topic_name == self._node.resolve_topic_name(topic)} | {
            type_name(kind) for name, kind in TYPES.items() if name == topic}
        names = sorted(node_name(info) for info in self._node.get_publishers_info_by_topic(topic)
                       if info.topic_type in kinds)
        # a crashed node is known until its lease has expired; the messages tell whether one sends
        source = self.sources.get(topic, TimeBase())
        if (counted := source.newest is not None) and not source.conflict:
            names = sorted(set(names))
        died = ', unless one has died just now' * (len(set(names)) < len(names) and not counted)
        return '' if len(names) < 2 else (
            f'{len(names)} nodes {self._exclusive[topic]}: {", ".join(names)}; stop all but one'
            f'{died}')

    def _complaints(self, own: Publisher | Subscription) -> list[str]:
        topic, kind = own.topic_name, type_name(own.msg_type)
        subscribes = isinstance(own, Subscription)
        publishers = self._node.get_publishers_info_by_topic(topic)
        subscriptions = self._node.get_subscriptions_info_by_topic(topic)
        texts = [f'{topic}: {node_name(other)} uses it for {other.topic_type[:100]}, this node '
                 f'for {kind}: stop that node, or remap its topic'
                for other in (*publishers, *subscriptions) if other.topic_type != kind]
        for other in publishers if subscribes else subscriptions:
            offered, requested = _explicit(own.qos_profile), _explicit(other.qos_profile)
            if subscribes:
                offered, requested = requested, offered
            compatible, reason = rclpy_qos.qos_check_compatible(offered, requested)
            if other.topic_type != kind or compatible != rclpy_qos.QoSCompatibility.ERROR:
                continue
            remedy = 'use the quality of service of this node there'
            if subscribes and offered.reliability is ReliabilityPolicy.BEST_EFFORT:
                remedy += (f', or start this node with -p qos_overrides.{topic}.subscription.'
                           'reliability:=best_effort')
            texts.append(
                f'{topic}: {node_name(other)} {"publishes" if subscribes else "subscribes"} with '
                'an incompatible quality of service, so no messages are received: '
                f'{reason.replace("ERROR: ", "").strip(";")}; {remedy}')
        return texts


def _explicit(profile: QoSProfile) -> QoSProfile:
    # otherwise defaults of a profile would count as differences
    filled = copy.copy(profile)
    for name in ('deadline', 'liveliness_lease_duration'):
        if not getattr(filled, name).nanoseconds:
            setattr(filled, name, Infinite)
    if filled.liveliness == rclpy_qos.LivelinessPolicy.SYSTEM_DEFAULT:
        filled.liveliness = rclpy_qos.LivelinessPolicy.AUTOMATIC
    return filled


def has_subscribers(publisher: Publisher) -> bool:
    """Whether there is a subscriber: publishing without one takes as long."""
    return publisher.get_subscription_count() > 0


def node_name(info: TopicEndpointInfo) -> str:
    """Return the name of the node that has an endpoint, with its namespace."""
    # an endpoint may be known before its node is
    return 'another node' if info.node_name == '_NODE_NAME_UNKNOWN_' else (
        f'{info.node_namespace.rstrip("/")}/{info.node_name}')


def type_name(kind: Any) -> str:
    """Return the name of a message type, ``package/msg/Name``."""
    return f'{kind.__module__.split(".")[0]}/msg/{kind.__name__}'
