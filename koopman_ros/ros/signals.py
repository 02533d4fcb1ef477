# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Messages to the numbers of signals and back, once, at the boundary."""

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
import inspect
import math
from typing import Any, Generic, TypeVar

from builtin_interfaces.msg import Time
import numpy as np
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription
from rclpy.timer import Timer

from koopman_ros.core.arrays import Array
from koopman_ros.core.message_fields import MessageField
from koopman_ros.core.synchronizer import SampleSynchronizer
from koopman_ros.core.units import Conversion, conversion, in_steps, NANOSECONDS
from koopman_ros.parameters.table import ConfigurationError
from koopman_ros.ros import topics
from koopman_ros.ros.hosted import HostedNode, wall_timer
from koopman_ros.ros.time_conversion import stamp_nanoseconds

_PATIENCE = 0.5  # s that the first samples wait for the measured inputs
T = TypeVar('T')


@dataclass(frozen=True, slots=True)
class SignalSample:
    """The values of some signals in a message."""

    stamp: Time  #: of the message, or of its arrival where it has none
    frame_id: str  #: of the message, or empty
    values: Mapping[str, float]  #: of the signals that it carries, in their own units
    stamped: bool  #: whether the message has a stamp
    topic: str = ''  #: on which it came, as it is named in the places
    #: of the message among those of its publisher; None where the middleware does not count them
    number: int | None = None

    @property
    def stamp_ns(self) -> int:
        """The stamp in integer nanoseconds."""
        return stamp_nanoseconds(self.stamp)


def by_topic(places: Mapping[str, MessageField]) -> Iterator[tuple[str, Any, list[str]]]:
    """
    Yield each topic, the class of its messages and the names of the signals in them.

    :raises ConfigurationError: for a place that is in no message of its type.
    """
    for topic in dict.fromkeys(place.topic for place in places.values()):
        names = [name for name, place in places.items() if place.topic == topic]
        if len(kinds := dict.fromkeys(places[name].type for name in names)) > 1:
            raise ConfigurationError(
                f'{" and ".join(names)} share the topic {topic} but have different message types, '
                f'{" and ".join(kinds)}: use one type, or separate topics')
        for name in names:
            try:
                kind = topics.message_class(places[name].type)
                places[name].expect(kind())
            except LookupError as error:
                raise ConfigurationError(f'{name}: {error}') from error
        yield topic, kind, names


def _converted(name: str, unit: str, target_unit: str) -> Conversion:
    try:
        return conversion(unit, target_unit)
    except ValueError as error:
        raise ConfigurationError(f'{name}: {error}: set another unit') from error


def _with_info(take: Callable[[Any, Mapping[str, Any]], None]) -> Callable[..., None]:
    """Return a callback to which rclpy passes a message with its middleware information."""
    def callback(*arrived: Any) -> None:
        # rclpy's EventsExecutor of Jazzy hands over both as one tuple
        message, info = arrived if len(arrived) == 2 else arrived[0]
        take(message, info)

    # rclpy chooses the arguments by the callback's signature
    callback.__signature__ = inspect.signature(  # type: ignore[attr-defined]
        lambda message, info: None)
    return callback


def synchroniser(places: Mapping[str, MessageField], names: Collection[str], tolerance: float
                 ) -> SampleSynchronizer:
    """
    Return a synchroniser of the messages of measurements.

    Where one of several topics has no stamps, and no tolerance is set, it follows from the
    intervals between the messages.

    :param places: by name of the signal.
    :param names: of the signals in a measurement.
    :param tolerance: s between the stamps of one measurement; 0 for the default.
    """
    kinds = [kind for _, kind, _ in by_topic({name: places[name] for name in names})]
    unstamped = len(kinds) > 1 and not all(hasattr(kind, 'header') for kind in kinds)
    return SampleSynchronizer(
        tuple(names), None if unstamped and not tolerance else round(tolerance * NANOSECONDS))


class SignalSubscriber:
    """
    Subscribe to some signals.

    A number that its type of message cannot mean, as a temperature below absolute zero, is NaN; a
    message without any of the signals is ignored.

    Both ends raise ConfigurationError for a place that is in no message of its type.

    :param subscribe: makes a subscription of topic, callback and message class.
    :param places: by name of the signal.
    :param units: of the signals, in which the numbers are handed over.
    """

    def __init__(self, node: Node, subscribe: Callable[..., Subscription],
                 places: Mapping[str, MessageField], units: Mapping[str, str],
                 callback: Callable[[SignalSample], None]) -> None:
        self._node, self._callback = node, callback
        self.topics: list[str] = []  #: with their namespace
        self.unstamped: list[str] = []  #: topics whose messages are stamped at their arrival
        for topic, kind, names in by_topic(places):
            own = {name: (places[name], _converted(name, places[name].unit, units[name]))
                   for name in names}
            if not hasattr(kind, 'header'):
                self.unstamped.append(topic)
            subscribe(topic, _with_info(partial(self._take, topic, own)), kind)
            self.topics.append(node.resolve_topic_name(topic))

    def _take(self, topic: str, own: Mapping[str, Any], message: Any, info: Mapping[str, Any]
              ) -> None:
        values = {}
        for name, (place, converted) in own.items():
            try:
                number = place.get(message)
            except LookupError:
                continue
            lowest, highest = place.range
            values[name] = converted(number) if lowest <= number <= highest else math.nan
        if values:
            header = getattr(message, 'header', None)
            self._callback(SignalSample(
                self._node.get_clock().now().to_msg() if header is None else header.stamp,
                header.frame_id if header else '', values, header is not None, topic,
                info['publication_sequence_number']))

    def published(self) -> bool:
        """Whether one of the topics is published."""
        return any(map(self._node.count_publishers, self.topics))


class MeasuredInputs:
    """The inputs, or disturbances, as they were measured last, with their stamps."""

    def __init__(self, names: Collection[str]) -> None:
        self._names = tuple(names)
        self._last: dict[str, tuple[int, float]] = {}  # stamp in ns and value

    def take(self, received: SignalSample) -> None:
        """Process a message."""
        self._last |= {name: (received.stamp_ns, value) for name, value in received.values.items()}

    def get(self, name: str) -> tuple[float, float]:
        """Return stamp in ns and value of an input; -infinity and NaN for none."""
        return self._last.get(name, (-math.inf, math.nan))

    @property
    def complete(self) -> bool:
        """Whether all inputs were measured."""
        return len(self._last) == len(self._names)

    @property
    def latest(self) -> Array | None:
        """(n_u,) the last values; None where one was never measured."""
        return np.array([self._last[name][1] for name in self._names]) if self.complete else None

    def at(self, stamp_ns: int, tolerance_ns: int) -> Array | None:
        """Return the last values (n_u,) if all are of about a time, else None."""
        near = all(abs(self.get(name)[0] - stamp_ns) <= tolerance_ns for name in self._names)
        return self.latest if near else None

    def with_ages(self, stamp_ns: int) -> tuple[Array | None, Array | None]:
        """Return the last values (n,) and their ages in s at a time; None without signals."""
        if not self._names:
            return None, None
        stamps, values = zip(*map(self.get, self._names), strict=True)
        return np.array(values), (stamp_ns - np.array(stamps)) / NANOSECONDS


class InputWait(Generic[T]):
    """
    Hold samples back until the measured inputs are known, for at most 0.5 s.

    :param missing: whether inputs that are expected are not known yet.
    :param answer: called with each sample, at once where nothing is missing.
    """

    def __init__(self, node: HostedNode, missing: Callable[[], bool],
                 answer: Callable[[T], None]) -> None:
        self._node, self._missing, self._answer = node, missing, answer
        self._waiting: list[T] = []
        self._timer: Timer | None = None
        self._waited = False

    def take(self, sample: T) -> None:
        """Answer a sample, now or later; only the first ones wait."""
        if not self._waiting and (self._waited or not self._missing()):
            self._answer(sample)
            return
        self._waiting.append(sample)
        if not self._waited:
            self._waited = True
            self._timer = wall_timer(self._node, _PATIENCE, self.release)

    def look(self) -> None:
        """Answer the samples that wait if nothing is missing any more."""
        if self._waiting and not self._missing():
            self.release()

    def release(self) -> None:
        """Answer the samples that wait."""
        waiting, self._waiting = self._waiting, []
        self.clear()
        for sample in waiting:
            self._answer(sample)

    def clear(self) -> None:
        """Forget the samples that wait."""
        self._waiting.clear()
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
            self._timer = None


class SignalPublisher:
    """
    Publish some signals, those of one topic in one message, which is made once.

    Raises ConfigurationError for a field of integers, too.

    :param places: by name of the signal, in the order of the numbers.
    :param units: of the signals, in which the numbers are given.
    """

    def __init__(self, places: Mapping[str, MessageField], units: Mapping[str, str],
                 make: Callable[[str, Any], Publisher]) -> None:
        self._parts = []
        for topic, kind, names in by_topic(places):
            own = [(i, place, _converted(name, units[name], place.unit))
                   for i, (name, place) in enumerate(places.items()) if name in names]
            message = kind()
            for name in names:
                try:
                    places[name].expect_decimals(message)
                except LookupError as error:
                    raise ConfigurationError(f'{name}: {error}') from error
            self._parts.append((make(topic, kind), message, getattr(message, 'header', None), own))

    @property
    def publishers(self) -> list[Publisher]:
        """All publishers."""
        return [publisher for publisher, *_ in self._parts]

    def has_subscribers(self) -> bool:
        """Whether one of the topics has a subscriber."""
        return any(map(topics.has_subscribers, self.publishers))

    def send(self, values: Array, stamp: Time, frame_id: str, variances: Array | None = None,
             resolutions: Array | None = None) -> None:
        """
        Publish values (n,), of which NaN stands for none.

        :param variances: (n,) in the squares of their units, for types with a variance; 0 for
            unknown.
        :param resolutions: (n,) of their sensors, in their units; 0 for every value.
        """
        for publisher, message, header, own in self._parts:
            for i, place, converted in own:
                number = converted(float(values[i]))
                if resolutions is not None:
                    number = in_steps(number, float(resolutions[i]) * converted.factor)
                place.put(message, number)
                if variances is not None and hasattr(message, 'variance'):
                    message.variance = float(variances[i]) * converted.factor ** 2
            if header is not None:
                header.stamp, header.frame_id = stamp, frame_id
            publisher.publish(message)
