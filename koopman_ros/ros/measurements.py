# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Measurements of a controller: its messages put together, with the measured inputs."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from koopman_ros.core.arrays import Array
from koopman_ros.core.time_base import TimeBase
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.parameters.controller import ControllerParameters
from koopman_ros.parameters.signal_topics import LONGEST_FRAME_ID, QUALITY, SignalTopics
from koopman_ros.ros import topics
from koopman_ros.ros.hosted import HostedNode
from koopman_ros.ros.signals import (
    InputWait,
    MeasuredInputs,
    SignalSample,
    SignalSubscriber,
    synchroniser,
)
from koopman_ros.ros.timing import Timing


class Sample(NamedTuple):
    """A measurement that is to be answered."""

    stamp_ns: int
    values: Array  #: (n_y,) in the units of the signals
    two_sources: bool  #: whether several publishers send such measurements in turn
    quality: tuple[int, ...] | None  #: (n_y,) as of an event; None where all are good


class Measurements:
    """
    Pass on measurements when they are complete.

    A signal that is reported on change has its last value until its heartbeat is over. If all
    signals are, there is a measurement every `sample_time`.

    :param exclusive: topics on which only one node may publish.
    :param answer: called with each measurement.
    """

    def __init__(self, node: HostedNode, endpoints: topics.EndpointMonitor, wiring: SignalTopics,
                 exclusive: Mapping[str, str], settings: ControllerParameters,
                 answer: Callable[[Sample], None]) -> None:
        signals = wiring.signals
        self._endpoints, self._names = endpoints, tuple(signals.states)
        #: ns for which the last value holds, by signal that is reported on change
        self._heartbeats = {
            name: round(seconds * NANOSECONDS) for name, seconds in zip(
                signals.states, settings.tuning.sensor.report_on_change.tolist(), strict=True)
            if seconds > 0.0}
        self._clock = node.get_clock()
        self._reported: dict[str, tuple[int, float]] = {}  # when it came, in ns, and value
        self.assembler = synchroniser(
            wiring.measured, [name for name in signals.states if name not in self._heartbeats],
            settings.synchronisation_tolerance)
        if not self.assembler.names:
            self._ticked_ns = -1
            self._shortest_ns = round(0.5 * settings.sample_time * NANOSECONDS)
            node.create_timer(settings.sample_time, self._on_sample_time)
        self.applied = MeasuredInputs(signals.inputs)
        self.disturbances = MeasuredInputs(signals.disturbances)
        self.frame_id, self._frame_length = '', 0
        # by topic of the measurements with one publisher: the numbers of its messages
        self._sources = {place.topic: TimeBase(late=-1) for place in wiring.measured.values()
                         if place.topic in exclusive}
        endpoints.sources = self._sources
        self._inputs = SignalSubscriber(
            node, endpoints.subscribe, wiring.applied, signals.inputs, self._on_applied)
        # the first command begins from them
        self._wait = InputWait[Sample](node, lambda: (
            not (self._commanded() or self.applied.complete) and self._inputs.published()), answer)
        SignalSubscriber(node, endpoints.subscribe, wiring.measured_disturbances,
                         signals.disturbances, self.disturbances.take)
        self._quality: dict[str, float] = {}
        SignalSubscriber(node, endpoints.subscribe, wiring.quality,
                         dict.fromkeys(wiring.quality, QUALITY),
                         lambda received: self._quality.update(received.values))
        measured = SignalSubscriber(
            node, endpoints.subscribe, wiring.measured, signals.states, self._on_measurement)
        if measured.unstamped:
            node.get_logger().warning(
                f'messages of {", ".join(measured.unstamped)} have no stamp: the time of receipt '
                'is used' + ('; messages of one measurement may be half a sample period apart, or '
                             'synchronisation_tolerance, if it is set' * (
                                 self.assembler.tolerance_ns is None)))
        self._active = False

    def begin(self, timing: Timing, window: Callable[[], float], commanded: Callable[[], bool]
              ) -> None:
        """
        Pass on measurements from now on.

        :param window: s between two changes of the source within which one may take over.
        :param begun: whether there was a command, before which the measured inputs are awaited.
        """
        self._timing, self._window, self._commanded, self._active = timing, window, commanded, True
        self._sources.update((topic, TimeBase(late=-1)) for topic in self._sources)
        self._wait.clear()

    def end(self) -> None:
        """Pass on no measurement, not even a waiting one."""
        self._active = False
        self._wait.clear()

    @property
    def awaited(self) -> str:
        """The signals that are missing in the next measurement, or an empty string."""
        return self.assembler.awaited or ', '.join(self._silent(self._clock.now().nanoseconds))

    def _silent(self, now_ns: int) -> list[str]:
        """Return the signals whose heartbeat is over."""
        return [name for name, heartbeat_ns in self._heartbeats.items() if name not in
                self._reported or abs(now_ns - self._reported[name][0]) > heartbeat_ns]

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
        sampled = received.values
        if self._heartbeats:
            now_ns = self._clock.now().nanoseconds
            self._reported |= {name: (now_ns, value) for name, value in sampled.items()
                               if name in self._heartbeats}
            sampled = {name: value for name, value in sampled.items()
                       if name not in self._heartbeats}
        complete = self.assembler.take(received.stamp_ns, sampled) if sampled else None
        if not self._active:
            return
        source, at = self._sources.get(received.topic), self._timing.now()
        if source is not None and received.number is not None:
            source.take(received.number, at[0], self._window())
        if self.assembler.late.total() > late:
            self._timing.ignore(at)
        if complete is not None:
            self._sampled(*complete)

    def _on_sample_time(self) -> None:
        now_ns = self._clock.now().nanoseconds
        # simulated time may stand between two calls that are late
        if self._active and not 0 <= now_ns - self._ticked_ns < self._shortest_ns:
            self._ticked_ns = now_ns
            self._sampled(now_ns, np.zeros(0))

    def _sampled(self, stamp_ns: int, values: Array) -> None:
        """Pass on a measurement, unless a signal that is reported on change is missing."""
        if self._heartbeats:
            if self._silent(self._clock.now().nanoseconds):
                return
            known = dict(zip(self.assembler.names, values.tolist(), strict=True)) | {
                name: value for name, (_, value) in self._reported.items()}
            values = np.array([known[name] for name in self._names])
        quality = tuple(int(self._quality.get(name, 0)) for name in self._names) if (
            any(self._quality.values())) else None
        self._wait.take(Sample(stamp_ns, values, any(
            one.conflict or (one.newest is None and self._endpoints.shared(topic))
            for topic, one in self._sources.items()), quality))

    def _on_applied(self, received: SignalSample) -> None:
        self.applied.take(received)
        self._wait.look()
