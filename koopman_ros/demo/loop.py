# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""One closed loop of plant, controller and trainer in lock-step, with an operator beside it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
import contextlib
from dataclasses import dataclass, field
from pathlib import Path
import signal
import time
from typing import Any, TypeVar

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
import rclpy
from rclpy.client import Client
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import Temperature

from koopman_ros.demo.processes import isolated_domain, NodeProcess
from koopman_ros.nodes import topics
from koopman_ros.nodes.messages import NANOSECONDS, stamp_nanoseconds, temperature_message

T = TypeVar('T')

_START_TIME = 1.0  # s of plant time at the first measurement
_START_TIMEOUT = 30.0  # s for the processes to find each other
_STALL_TIMEOUT = 30.0  # s without a command before the run is given up


class LoopError(RuntimeError):
    """A closed loop did not run to its end; the message says which process failed and how."""


@dataclass(frozen=True)
class Scenario:
    """
    What a closed loop does.

    :param model: name or path of the controller's model.
    :param setpoint: new set-point in K.
    :param step_time: when it takes effect, in s after the first measurement.
    :param duration: length of the run in s of plant time, 0 for endless.
    :param sample_period: s between measurements.
    :param speed: simulated seconds per second, 0 for as fast as the machine can.
    :param plant: further parameters of the plant node.
    """

    model: str
    setpoint: float
    step_time: float = 60.0
    duration: float = 600.0
    sample_period: float = 1.0
    speed: float = 0.0
    plant: Mapping[str, object] = field(default_factory=dict)

    @property
    def first_stamp_ns(self) -> int:
        """Stamp of the first measurement."""
        return round(_START_TIME * NANOSECONDS)


@dataclass(frozen=True)
class Row:
    """
    What the operator sees at one command, temperatures in degrees Celsius.

    :param seconds: plant time since the first measurement.
    :param temperature: measured.
    :param setpoint: tracked, or None before it is known.
    :param coolant: commanded.
    """

    seconds: float
    temperature: float
    setpoint: float | None
    coolant: float


class Operator(Node):
    """Set the set-point through its topic and watch the loop and the status of each task."""

    def __init__(self, scenario: Scenario, context: Context,
                 on_row: Callable[[Row], None]) -> None:
        super().__init__('operator', context=context)
        self.scenario = scenario
        self._on_row = on_row
        self.statuses: dict[str, DiagnosticStatus] = {}
        # two topics: either message of a pair may come first
        self._measured: dict[int, float] = {}
        self._commanded: dict[int, float] = {}
        self._active: float | None = None
        self.last_stamp_ns = 0
        self.setpoint = self.create_publisher(Temperature, topics.SETPOINT, topics.LOOP_QOS)
        self.create_subscription(
            Temperature, topics.TEMPERATURE, self._on_temperature, topics.LOOP_QOS)
        self.create_subscription(
            Temperature, topics.ACTIVE_SETPOINT, self._on_active, topics.LATCHED_QOS)
        self.create_subscription(
            DiagnosticArray, topics.DIAGNOSTICS, self._on_diagnostics, topics.LOOP_QOS)
        self._commands = self.create_subscription(
            Temperature, topics.COOLANT_SETPOINT, self._on_command, topics.LOOP_QOS)

    @property
    def found_loop(self) -> bool:
        """Whether controller and trainer are there and hear the set-point."""
        return (self.setpoint.get_subscription_count() >= 2
                and self._commands.get_publisher_count() >= 1)

    def hears_more_than(self, stamp_ns: int) -> Callable[[], bool]:
        """Return the condition that the answer to a later measurement than this was heard."""
        return lambda: self.last_stamp_ns > stamp_ns

    def request_setpoint(self) -> None:
        """Publish the set-point, stamped with the plant time from which it holds."""
        stamp = self.scenario.first_stamp_ns + round(self.scenario.step_time * NANOSECONDS)
        message = temperature_message(
            self.scenario.setpoint, rclpy.time.Time(nanoseconds=stamp).to_msg(), 'operator')
        self.setpoint.publish(message)

    def _on_temperature(self, message: Temperature) -> None:
        stamp = stamp_nanoseconds(message.header.stamp)
        self._measured[stamp] = message.temperature
        self._show_pair(stamp)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self.statuses.update({status.name: status for status in message.status})

    def _on_active(self, message: Temperature) -> None:
        self._active = message.temperature

    def _on_command(self, message: Temperature) -> None:
        stamp = stamp_nanoseconds(message.header.stamp)
        self._commanded[stamp] = message.temperature
        self._show_pair(stamp)

    def _show_pair(self, stamp: int) -> None:
        if stamp in self._measured and stamp in self._commanded:
            self.last_stamp_ns = stamp
            self._on_row(Row((stamp - self.scenario.first_stamp_ns) / NANOSECONDS,
                             self._measured.pop(stamp), self._active,
                             self._commanded.pop(stamp)))


class Loop:
    """
    Plant, controller and trainer as three processes, with an operator beside them.

    :param operator: sets the set-point and watches.
    :param spin: lets the operator hear for a moment.
    :param processes: those that must not end before the loop does.
    """

    def __init__(self, operator: Operator, spin: Callable[[], None],
                 processes: list[NodeProcess]) -> None:
        self.operator = operator
        self._spin = spin
        self._processes = processes
        self._clients: dict[str, Client] = {}

    def wait(self, done: Callable[[], T], timeout: float, complaint: str) -> T:
        """
        Spin until a condition holds, and return what it returned.

        :raises LoopError: after `timeout` seconds, or when a process ends.
        """
        deadline = time.monotonic() + timeout
        while not (found := done()):
            self._spin()
            for process in self._processes:
                if not process.running:
                    raise LoopError(f'{process.name} ended early: {process.output()[-1000:]}')
            if time.monotonic() > deadline:
                raise LoopError(f'{complaint} within {timeout:.0f} s; '
                                f'see {self._processes[0].log.parent}')
        return found

    def run_until(self, seconds: float) -> None:
        """Let the loop go on until so many seconds of plant time after its first measurement."""
        end = self.operator.scenario.first_stamp_ns + round(seconds * NANOSECONDS)
        while self.operator.last_stamp_ns < end:
            self.wait(self.operator.hears_more_than(self.operator.last_stamp_ns), _STALL_TIMEOUT,
                      'the loop stands still: no command')

    def meet(self, kind: Any, service: str) -> None:
        """Get to know a service long before it is called: an answer may be lost otherwise."""
        self._clients[service] = self.operator.create_client(kind, service)
        self.wait(self._clients[service].service_is_ready, _START_TIMEOUT,
                  f'the service {service} is missing')

    def call(self, service: str, request: Any) -> Any:
        """Call a service that was met before, and return its response."""
        future = self._clients[service].call_async(request)
        self.wait(future.done, _STALL_TIMEOUT, f'the service {service} does not answer')
        return future.result()


@contextlib.contextmanager
def running_loop(scenario: Scenario, logs: Path, trainer: Mapping[str, object],
                 on_row: Callable[[Row], None] = lambda _: None) -> Iterator[Loop]:
    """
    Run plant, controller and trainer in lock-step, the set-point requested, until it is left.

    To be called from the main thread: it takes over Ctrl-C, so that the processes end.

    :param scenario: what to do.
    :param logs: folder for what the processes print.
    :param trainer: parameters of the trainer.
    :param on_row: called with every answered measurement.
    :raises LoopError: when a process ends early or the loop stands still.
    """
    with deferred_interrupt() as check_interrupt, isolated_domain() as environment:
        context = Context()
        rclpy.init(context=context, domain_id=int(environment['ROS_DOMAIN_ID']))
        operator = Operator(scenario, context, on_row)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(operator)

        def spin() -> None:
            executor.spin_once(timeout_sec=0.1)
            check_interrupt()

        try:
            with _processes(scenario, logs, environment, trainer, operator, spin) as loop:
                yield loop
        finally:
            executor.shutdown()
            operator.destroy_node()
            rclpy.shutdown(context=context)


@contextlib.contextmanager
def _processes(scenario: Scenario, logs: Path, environment: dict[str, str],
               trainer_parameters: Mapping[str, object], operator: Operator,
               spin: Callable[[], None]) -> Iterator[Loop]:
    # the observer would make up for what a model does not know, which is what is to be seen here
    with (NodeProcess('controller', {'model': scenario.model, 'observer_bandwidth': 0.0},
                      logs / 'controller.log',
                      environment) as controller,
          NodeProcess('trainer', trainer_parameters, logs / 'trainer.log', environment
                      ) as trainer):
        processes = [controller, trainer]
        loop = Loop(operator, spin, processes)
        loop.wait(lambda: operator.found_loop, _START_TIMEOUT,
                  'controller and trainer did not find each other')
        operator.request_setpoint()
        plant = NodeProcess('plant', {
            **scenario.plant,
            'lockstep': True, 'speed': scenario.speed, 'duration': scenario.duration,
            'sample_period': scenario.sample_period, 'start_time': _START_TIME,
            # controller, trainer and operator: nobody misses the first measurement
            'lockstep_subscribers': 3,
        }, logs / 'plant.log', environment)
        with plant:
            processes.append(plant)
            yield loop
        codes = {process.name: process.stop() for process in processes}
    for process in processes:
        if codes[process.name] != 0:
            raise LoopError(f'{process.name} ended with code {codes[process.name]}: '
                            f'{process.output()[-1000:]}')


def run_loop(scenario: Scenario, bag: Path, logs: Path,
             on_row: Callable[[Row], None] = lambda _: None) -> None:
    """
    Run a loop until the scenario's end; see :func:`running_loop`.

    :param bag: where the trainer records; must not exist.
    """
    with running_loop(scenario, logs, {'output': bag}, on_row) as loop:
        loop.run_until(scenario.duration)


@contextlib.contextmanager
def deferred_interrupt() -> Iterator[Callable[[], None]]:
    """
    Let a signal raise KeyboardInterrupt where the yielded function is called, and at the end.

    One that comes while Python looks after a child leaves the child's lock taken for ever, and
    one inside the middleware's extension comes out as another error. The processes live in
    sessions of their own: without us nobody would end them.
    """
    pending: list[bool] = []

    def check() -> None:
        if pending:
            raise KeyboardInterrupt

    before = {number: signal.signal(number, lambda *_: pending.append(True))
              for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        yield check
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    check()
