# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Measurements of a controller: its messages put together, with the measured inputs."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

from koopman_ros.core.arrays import Array
from koopman_ros.core.synchronizer import SampleSynchronizer
from koopman_ros.core.time_base import TimeBase
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.parameters.signal_topics import LONGEST_FRAME_ID, SignalTopics
from koopman_ros.ros import topics
from koopman_ros.ros.hosted import HostedNode
from koopman_ros.ros.signals import InputWait, MeasuredInputs, SignalSample, SignalSubscriber
from koopman_ros.ros.timing import Timing


class Sample(NamedTuple):
    """A measurement that is to be answered."""

    stamp_ns: int
    values: Array  #: (n_y,) in the units of the signals
    two_sources: bool  #: whether several publishers send such measurements in turn


class Measurements:
    """
    Hand over measurements when they are complete.

    :param exclusive: topics on which only one node may publish.
    :param tolerance: s by which stamps of one measurement may differ.
    :param answer: called with each measurement.
    """

    def __init__(self, node: HostedNode, endpoints: topics.EndpointMonitor, wiring: SignalTopics,
                 exclusive: Mapping[str, str], tolerance: float,
                 answer: Callable[[Sample], None]) -> None:
        signals = wiring.signals
        self._endpoints = endpoints
        self.assembler = SampleSynchronizer(tuple(signals.states), round(tolerance * NANOSECONDS))
        self.applied = MeasuredInputs(signals.inputs)
        self.disturbances = MeasuredInputs(signals.disturbances)
        self.frame_id, self._frame_length = '', 0
        # by topic of the measurements with one publisher: the numbers of its messages
        self._sources = {place.topic: TimeBase(late=-1) for place in wiring.measured.values()
                         if place.topic in exclusive}
        self._inputs = SignalSubscriber(
            node, endpoints.subscribe, wiring.applied, signals.inputs, self._on_applied)
        # the first command begins from them
        self._wait = InputWait[Sample](node, lambda: (
            not self._begun() and not self.applied.complete and self._inputs.published()), answer)
        SignalSubscriber(node, endpoints.subscribe, wiring.measured_disturbances,
                         signals.disturbances, self.disturbances.take)
        measured = SignalSubscriber(
            node, endpoints.subscribe, wiring.measured, signals.states, self._on_measurement)
        if measured.unstamped:
            node.get_logger().warning(
                f'messages of {", ".join(measured.unstamped)} have no stamp: the time of receipt '
                'is used')
        self._active = False

    def begin(self, timing: Timing, window: Callable[[], float], begun: Callable[[], bool]
              ) -> None:
        """
        Hand over measurements from now on.

        :param window: s between two changes of the source within which one may take over.
        :param begun: whether there was a command, before which the measured inputs are awaited.
        """
        self._timing, self._window, self._begun, self._active = timing, window, begun, True
        self._sources = {topic: TimeBase(late=-1) for topic in self._sources}
        self._wait.clear()

    def end(self) -> None:
        """Hand over no measurement, not even one that waits."""
        self._active = False
        self._wait.clear()

    @property
    def complaint(self) -> str:
        """The defect of the messages, or an empty string."""
        return '' if self._frame_length <= LONGEST_FRAME_ID else (
            f'the frame_id of the measurement has {self._frame_length} characters; only the first '
            f'{LONGEST_FRAME_ID} are forwarded: shorten it at the sensor')

    def _on_measurement(self, received: SignalSample) -> None:
        self.frame_id = received.frame_id[:LONGEST_FRAME_ID]
        self._frame_length = len(received.frame_id)
        late = self.assembler.late.total()
        complete = self.assembler.take(received.stamp_ns, received.values)
        if not self._active:
            return
        source, at = self._sources.get(received.topic), self._timing.now()
        if source is not None and received.number is not None:
            source.take(received.number, at[0], self._window())
        if self.assembler.late.total() > late:
            self._timing.ignore(at)
        if complete is None:
            return
        sample = Sample(*complete, two_sources=any(
            one.conflict or (one.newest is None and self._endpoints.shared(topic))
            for topic, one in self._sources.items()))
        self._wait.take(sample)

    def _on_applied(self, received: SignalSample) -> None:
        self.applied.take(received)
        self._wait.look()
