# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A sensor and an actuator in one: publishes measurements, and notes when their commands come."""

import time

import numpy as np
from sensor_msgs.msg import Temperature

from koopman_ros.ros import topics
from koopman_ros.ros.codec import stamp_message, stamp_nanoseconds
from koopman_ros.testing import Harness, HarnessError
from koopman_ros.units import NANOSECONDS

TIMEOUT = 30.0  # s, until somebody answers
_CELSIUS = 51.0  # about the nominal point of the shipped lifts
_NOISE = 0.01  # K, standard deviation
_RETRY = 0.01  # s between measurements that nobody may hear yet


class Loop:
    """
    The two topics of one controller, under a namespace.

    :param harness: whose node measures.
    :param namespace: of whoever answers, e.g. ``/ours``.
    """

    def __init__(self, harness: Harness, namespace: str) -> None:
        self._harness = harness
        self._rng = np.random.default_rng(0)
        self._answers: dict[int, int] = {}  # stamp -> arrival
        self._measurements = harness.node.create_publisher(
            Temperature, f'{namespace}/{topics.TEMPERATURE}', topics.LOOP_QOS)
        harness.node.create_subscription(
            Temperature, f'{namespace}/{topics.COOLANT_SETPOINT}', self._on_command,
            topics.LOOP_QOS)

    def wait_for_first_answer(self) -> int:
        """Publish until somebody answers; return when the answer came [ns of time.time_ns]."""
        self._answers.clear()
        begun, deadline = time.time_ns(), time.monotonic() + TIMEOUT
        # answers of somebody who has ended meanwhile may still come in
        while not (news := [came for stamp, came in self._answers.items() if stamp >= begun]):
            if time.monotonic() > deadline:
                raise HarnessError(f'nobody answers within {TIMEOUT:g} s')
            self.publish()
            self._harness.spin_once(_RETRY)
        return news[0]

    def settle(self) -> None:
        """Handle all answers that are still on their way."""
        last = self.publish()
        self._harness.wait_until(lambda: last in self._answers, 'the answer to a measurement')

    def ask(self) -> float:
        """Publish a measurement and wait for its command; return the seconds between."""
        stamp = self.publish()
        self._harness.wait_until(lambda: stamp in self._answers, 'the answer to a measurement')
        return self.seconds(stamp)

    def publish(self) -> int:
        """Publish a measurement of now; return its stamp."""
        message = Temperature(temperature=_CELSIUS + _NOISE * self._rng.normal())
        stamp = time.time_ns()
        message.header.stamp = stamp_message(stamp)
        self._measurements.publish(message)
        return stamp

    def seconds(self, stamp: int) -> float:
        """Return the time from a measurement to its command; infinity where none came."""
        arrival = self._answers.get(stamp)
        return np.inf if arrival is None else (arrival - stamp) / NANOSECONDS

    def _on_command(self, message: Temperature) -> None:
        self._answers[stamp_nanoseconds(message.header.stamp)] = time.time_ns()
