# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A controller, with a thermometer and an operator in the test."""

from collections.abc import Callable, Mapping, Sequence
import math
import time as clock

from diagnostic_msgs.msg import DiagnosticStatus
import pytest
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Temperature
from std_msgs.msg import String

from koopman_ros.core.paths import model_path
from koopman_ros.core.units import to_celsius
from koopman_ros.demo import reactor
from koopman_ros.event_log.records import EventRecord, parse
from koopman_ros.event_log.run import replay_records
from koopman_ros.model import load
from koopman_ros.nodes.controller import ControllerNode
from koopman_ros.parameters.controller import table_of
from koopman_ros.ros import topics
from koopman_ros.testing import Harness
from support.nodes import RunNode, seconds, temperature, TIMEOUT, value

STATUS = 'controller: control'
TABLE = table_of(load(model_path(reactor.MODEL)))
STEADY = 51.8  # degC, near the plant's steady state
# Silence is told by the wall clock, and a busy machine may be silent where no test means it.
PATIENT = {'measurement_timeout': 0.0}
# The law alone, which the temperature of a moment determines.
PURE = {'observer_bandwidth': 0.0, 'bumpless_transfer_time': 0.0, 'stuck_sensor_timeout': 0.0,
        **PATIENT}


def reproduced(messages: Sequence[String]) -> tuple[list[EventRecord], list[float]]:
    """Return records, and the commands in them in degC, which a replay finds bit for bit."""
    records = [parse(message.data) for message in messages]
    samples = replay_records(records).samples
    assert [sample.recorded for sample in samples] == [sample.replayed for sample in samples]
    return records, [to_celsius(float(sample.recorded[0])) for sample in samples]


class Bench:
    """
    A controller with a thermometer, which measures once at a first time, and an operator.

    It is a process, or a node in the thread of the test where `run_node` is given.
    """

    def __init__(self, ros: Harness, parameters: Mapping[str, object] | None = None,
                 arguments: tuple[str, ...] = (), qos: QoSProfile = topics.LOOP_QOS,
                 first: float = 1.0, run_node: RunNode | None = None) -> None:
        self.ros = ros
        self.sent = 0  # measurements
        given = {**PATIENT, **(parameters or {})}
        if run_node is None:
            self.process = ros.start('controller', given, arguments)
        else:
            run_node(ControllerNode, given, *arguments)
        self.commands = ros.listen(Temperature, reactor.COOLANT_SETPOINT)
        self.tracked = ros.listen(Temperature, reactor.ACTIVE_SETPOINT, topics.LATCHED_QOS)
        self.thermometer = ros.speak(Temperature, reactor.TEMPERATURE, qos, to='controller')
        self._setpoint = ros.speak(Temperature, reactor.SETPOINT, to='controller')
        self.measure(STEADY, first)
        self.active_since(STEADY)

    def start_afresh(self) -> None:
        """Bring the controller back to its steady state at the time 1 s, and forget the rest."""
        self.ros.set_bool('controller/set_automatic', True)
        self.ask(STEADY)
        # no gap, which would be the interval of the samples
        now = seconds(self.commands[-1]) + 1.0
        self.settle(STEADY, self.measure_until_active(STEADY, now))
        del self.commands[:], self.tracked[:-1], self.ros.statuses[:]
        # the clock goes back
        self.measure(STEADY, 1.0)

    def send(self, celsius: float, time: float) -> None:
        self.sent += 1
        self.thermometer.publish(temperature(celsius, time))

    def measure(self, celsius: float, time: float) -> Temperature:
        return self.answer_to(temperature(celsius, time))

    def answer_to(self, measurement: Temperature) -> Temperature:
        first, time = len(self.commands), seconds(measurement)
        self.sent += 1
        self.thermometer.publish(measurement)
        return self.ros.wait_until(
            lambda: next((m for m in self.commands[first:] if seconds(m) == time), None))

    def status(self, condition: Callable[[DiagnosticStatus], bool] = lambda _: True
               ) -> DiagnosticStatus:
        """Wait until a condition is met by the last status, collected after all measurements."""
        return self.ros.wait_for_status(STATUS, lambda s: self.sent <= int(
            value(s, 'measurements')) and condition(s))

    def ask(self, celsius: float, time: float = 0.0) -> None:
        """Turn the set-point, in force from a time, and wait until the controller knows it."""
        self._setpoint.publish(temperature(celsius, time))
        self.ros.meet('controller')

    def active_since(self, celsius: float) -> float:
        """Wait until a set-point is tracked; return since when."""
        return seconds(self.ros.wait_until(lambda: next(
            (m for m in self.tracked if m.temperature == pytest.approx(celsius)), None)))

    @property
    def active(self) -> float:
        return float(self.tracked[-1].temperature)

    def measure_until(self, condition: Callable[[Temperature], bool], time: float) -> float:
        """Measure once a second from a time on until a command meets a condition; say when."""
        deadline = clock.monotonic() + TIMEOUT
        while not condition(self.measure(STEADY, time)):
            assert clock.monotonic() < deadline
            time += 1.0
        return time

    def settle(self, celsius: float, time: float) -> tuple[float, float]:
        """Measure the same until the command stays the same; return the time and the command."""
        before, command = math.nan, self.measure(celsius, time).temperature
        while abs(command - before) > 1e-9 or math.isnan(before):
            time += 1.0
            before, command = command, self.measure(celsius, time).temperature
        return time, command

    def measure_until_active(self, celsius: float, time: float) -> float:
        """Measure once a second from a time on until a set-point is tracked; say when."""
        return self.measure_until(lambda _: self.active == pytest.approx(celsius), time)
