# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""One closed loop of plant, controller and trainer in lock-step, with an operator beside it."""

from collections.abc import Callable, Iterator, Mapping
import contextlib
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticStatus
import rclpy
from sensor_msgs.msg import Temperature

from koopman_ros.ros import topics
from koopman_ros.ros.codec import stamp_nanoseconds, temperature_message
from koopman_ros.testing import deferred_interrupt, Harness, HarnessError
from koopman_ros.units import NANOSECONDS

_START_TIME = 1.0  # s of plant time at the first measurement
_FIRST_STAMP_NS = round(_START_TIME * NANOSECONDS)
_TIMEOUT = 30.0  # s for the processes to find each other, and from one command to the next


@dataclass(frozen=True)
class Scenario:
    """What a closed loop does."""

    model: str  #: name or path of the controller's model
    setpoint: float  #: new set-point in K
    step_time: float = 60.0  #: when it takes effect, in s after the first measurement
    duration: float = 600.0  #: length of the run in s of plant time, 0 for endless
    sample_period: float = 1.0  #: s between measurements
    speed: float = 0.0  #: simulated seconds per second, 0 for as fast as the machine can
    #: further parameters of the plant node
    plant: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class Row:
    """What the operator sees at one command, temperatures in degrees Celsius."""

    seconds: float  #: plant time since the first measurement
    temperature: float  #: measured
    setpoint: float | None  #: tracked, or None before it is known
    coolant: float  #: commanded


class Operator:
    """Set the set-point through its topic and watch the loop, whose processes `harness` runs."""

    def __init__(self, scenario: Scenario, harness: Harness, on_row: Callable[[Row], None]
                 ) -> None:
        self.scenario = scenario
        self.harness = harness
        self._on_row = on_row
        # two topics: either message of a pair may come first
        self._measured: dict[int, float] = {}
        self._commanded: dict[int, float] = {}
        self._active: float | None = None
        self.last_stamp_ns = 0
        node = harness.node
        self.setpoint = node.create_publisher(Temperature, topics.SETPOINT, topics.LOOP_QOS)
        node.create_subscription(
            Temperature, topics.TEMPERATURE, self._on_temperature, topics.LOOP_QOS)
        node.create_subscription(
            Temperature, topics.ACTIVE_SETPOINT, self._on_active, topics.LATCHED_QOS)
        self._commands = node.create_subscription(
            Temperature, topics.COOLANT_SETPOINT, self._on_command, topics.LOOP_QOS)

    @property
    def found_loop(self) -> bool:
        """Whether controller and trainer are there and hear the set-point."""
        return (self.setpoint.get_subscription_count() >= 2
                and self._commands.get_publisher_count() >= 1)

    @property
    def seconds(self) -> float:
        """Plant time of the last command since the first measurement, in s; 0 before it."""
        return max(0.0, (self.last_stamp_ns - _FIRST_STAMP_NS) / NANOSECONDS)

    def run_until(self, seconds: float) -> None:
        """Let the loop go on until so many seconds of plant time after its first measurement."""
        end = _FIRST_STAMP_NS + round(seconds * NANOSECONDS)
        while self.last_stamp_ns < end:
            self.harness.wait_until(partial(self._answered_after, self.last_stamp_ns),
                                    'the loop stands still: no command')

    def _answered_after(self, stamp_ns: int) -> bool:
        return self.last_stamp_ns > stamp_ns

    def request_setpoint(self) -> None:
        """Publish the set-point, stamped with the plant time from which it holds."""
        stamp = _FIRST_STAMP_NS + round(self.scenario.step_time * NANOSECONDS)
        message = temperature_message(
            self.scenario.setpoint, rclpy.time.Time(nanoseconds=stamp).to_msg(), 'operator')
        self.setpoint.publish(message)

    def _on_temperature(self, message: Temperature) -> None:
        stamp = stamp_nanoseconds(message.header.stamp)
        self._measured[stamp] = message.temperature
        self._show_pair(stamp)

    def _on_active(self, message: Temperature) -> None:
        self._active = message.temperature

    def _on_command(self, message: Temperature) -> None:
        stamp = stamp_nanoseconds(message.header.stamp)
        self._commanded[stamp] = message.temperature
        self._show_pair(stamp)

    def _show_pair(self, stamp: int) -> None:
        if stamp in self._measured and stamp in self._commanded:
            self.last_stamp_ns = stamp
            self._on_row(Row((stamp - _FIRST_STAMP_NS) / NANOSECONDS,
                             self._measured.pop(stamp), self._active,
                             self._commanded.pop(stamp)))


@contextlib.contextmanager
def running_loop(scenario: Scenario, logs: Path, trainer: Mapping[str, object],
                 on_row: Callable[[Row], None] = lambda _: None) -> Iterator[Operator]:
    """
    Run plant, controller and trainer in lock-step, the set-point requested, until it is left.

    To be called from the main thread: it takes over Ctrl-C, so that the processes end.

    :param logs: folder for what the processes print.
    :param trainer: parameters of the trainer, which records from its start.
    :param on_row: called with what the operator sees, at every command.
    :raises HarnessError: when a process ends early or the loop stands still.
    """
    with (deferred_interrupt() as check_interrupt,
          Harness(logs, name='operator', timeout=_TIMEOUT, lasting=True,
                  each_turn=check_interrupt) as harness):
        operator = Operator(scenario, harness, on_row)
        # the observer would make up for what a model does not know, which is what is to be seen
        harness.start('controller', {'model': scenario.model, 'observer_bandwidth': 0.0})
        harness.start('trainer', trainer)
        harness.wait_until(lambda: operator.found_loop,
                           'controller and trainer did not find each other')
        operator.request_setpoint()
        plant = harness.start('plant', {
            **scenario.plant,
            'lockstep': True, 'speed': scenario.speed, 'duration': scenario.duration,
            'sample_period': scenario.sample_period, 'start_time': _START_TIME,
            # controller, trainer and operator: nobody misses the first measurement
            'lockstep_subscribers': 3,
        })
        # the others hear its last measurement
        with plant:
            yield operator
        if (code := plant.stop()) != 0:
            raise HarnessError(f'plant ended with code {code}: {plant.output()[-1000:]}')


def run_loop(scenario: Scenario, bag: Path, logs: Path,
             on_row: Callable[[Row], None] = lambda _: None) -> None:
    """Run a loop until the scenario's end, recorded whole by the trainer in a new bag."""
    samples = round(scenario.duration / scenario.sample_period) + 1

    def recorded(status: DiagnosticStatus) -> bool:
        counts = {item.key: item.value for item in status.values}
        return all(int(counts.get(f'messages on /{topic}', 0)) >= samples
                   for topic in (topics.TEMPERATURE, topics.COOLANT_SETPOINT))

    with running_loop(scenario, logs, {'output': bag}, on_row) as operator:
        operator.run_until(scenario.duration)
        # what the operator has heard may still be on its way to the trainer, where it is lost
        # with its sender
        operator.harness.wait_for_status('trainer: recording', recorded)
