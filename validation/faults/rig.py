# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Plant and controller as real processes, to put faults into, with an operator beside them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
import signal
import subprocess
import time
from types import TracebackType
from typing import TypeVar

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from koopman_ros.testing import NodeProcess
from koopman_ros.testing.process import STOP_TIMEOUT
from validation.faults.line import Line, REMAPPED
from validation.faults.operator import Operator

T = TypeVar('T')
LOCKSTEP = {'lockstep': True, 'speed': 0.0, 'lockstep_timeout': 0.5}
_START_TIMEOUT = 30.0  # s for the processes to find each other


class StalledError(RuntimeError):
    """A case did not go on; the message says what was waited for."""


class Rig:
    """
    A loop to put faults into; leaving the context ends its processes.

    :param environment: variables of the reserved domain.
    :param folder: for what the processes print.
    :param limit: wall time of the case, s.
    :param check: called at every turn; may raise to end the case.
    :param between: whether the rig stands between plant and controller.

    :ivar operator: who is beside the loop.
    :ivar line: what is said between plant and controller.
    :ivar processes: by name; those that are missed when they end.
    """

    def __init__(self, environment: Mapping[str, str], folder: Path, limit: float,
                 check: Callable[[], None], between: bool = False) -> None:
        self.folder = folder
        self.processes: dict[str, NodeProcess] = {}
        # a process that is aborted prints where it was
        self._environment = {**environment, 'PYTHONFAULTHANDLER': '1'}
        self._deadline = time.monotonic() + limit
        self._check = check
        self._between = between
        self._numbers: dict[str, int] = {}
        self._started: list[NodeProcess] = []

        self._context = Context()
        rclpy.init(context=self._context, domain_id=int(environment['ROS_DOMAIN_ID']))
        self.node = Node('rig', context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self.line = Line(self.node, between)
        self.course = self.line.course
        self.operator = Operator(self.node, self.line, self.wait)

    def __enter__(self) -> Rig:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        for process in self.processes.values():
            if process.running:
                # one that was stopped would not hear the interrupt
                process.process.send_signal(signal.SIGCONT)
                process.process.send_signal(signal.SIGINT)
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)
        for name, process in self.processes.items():
            if (code := _code(process)) != 0:
                self.course.complaints.append(f'{name} ended with code {code}, see {process.log}')
        for process in self._started:
            if 'Traceback' in process.output():
                self.course.complaints.append(f'{process.log} holds a traceback')

    # Processes.

    def start(self, name: str, parameters: Mapping[str, object] | None = None,
              arguments: tuple[str, ...] = (), command: tuple[str, ...] | None = None,
              called: str = '') -> NodeProcess:
        """
        Start a node as a process; one that is called otherwise runs beside the first.

        :param name: plant, controller or trainer.
        :param parameters: other than the defaults.
        :param arguments: further ROS arguments.
        :param command: what to run instead.
        :param called: name of the process here, its node's name by default.
        """
        called = called or name
        self._numbers[called] = number = self._numbers.get(called, 0) + 1
        if self._between and called == 'plant':
            arguments += REMAPPED
        process = NodeProcess(name, parameters or {}, self.folder / f'{called}_{number}.log',
                              self._environment, arguments, command)
        self.processes[called] = process
        self._started.append(process)
        return process

    def start_loop(self, celsius: float, plant: Mapping[str, object],
                   controller: Mapping[str, object]) -> None:
        """Start plant and controller, and ask for a set-point before the first measurement."""
        lockstep = bool(plant.get('lockstep'))
        # the rig hears the plant when it knows the controller: a lock-step waits for it
        subscribers = {'lockstep_subscribers': 1 if self._between else 2} if lockstep else {}
        self.start('controller', controller)
        if lockstep:
            self.start('plant', {**plant, **subscribers})
        self.operator.meet_controller()
        self.operator.ask(celsius)
        if 'trainer' in self.processes:
            self.wait(lambda: any(said.name == 'trainer: recording' for said in self.course.said),
                      'the trainer does not start', _START_TIMEOUT)
            # it finds the controller meanwhile
            self.linger(1.0)
        self.line.open()
        if not lockstep:
            self.start('plant', plant)
        self.wait(lambda: self.course.samples, 'no measurement', _START_TIMEOUT)

    def kill(self, called: str, number: int = signal.SIGKILL) -> None:
        """End a process the hard way; it is not missed."""
        process = self.processes.pop(called)
        process.stop(number)

    # Time.

    @property
    def now(self) -> float:
        """Plant time in s since the first measurement."""
        return self.line.now

    def spin(self) -> None:
        """Let the rig hear for a moment."""
        self._executor.spin_once(timeout_sec=0.05)
        self._check()

    def wait(self, done: Callable[[], T], complaint: str, timeout: float = 10.0) -> T:
        """
        Spin until a condition holds and return what it returned.

        :raises StalledError: after `timeout` seconds of wall time, or at the end of the case's.
        """
        end = min(time.monotonic() + timeout, self._deadline)
        while not (found := done()):
            if time.monotonic() > end:
                raise StalledError(f'{complaint}; plant time is {self.now:.0f} s')
            for called, process in self.processes.items():
                if not process.running:
                    raise StalledError(f'{called} ended by itself: {process.output()[-300:]}')
            self.spin()
        return found

    def run_until(self, seconds: float) -> None:
        """Let the loop run until a plant time."""
        while self.now < seconds:
            reached = self.now
            self.wait(self._later_than(reached), 'no measurement arrives', 15.0)

    def _later_than(self, seconds: float) -> Callable[[], bool]:
        return lambda: self.now > seconds

    def run_for(self, seconds: float) -> None:
        """Let the loop run for a plant time."""
        self.run_until(self.now + seconds)

    def linger(self, seconds: float) -> None:
        """Let the loop run for a wall time."""
        end = time.monotonic() + seconds
        self.wait(lambda: time.monotonic() > end, 'no time to linger', seconds + 10.0)

    def begin(self) -> None:
        """Mark that the fault begins."""
        self.course.begin = self.now

    def end(self) -> None:
        """Mark that the fault is over, or stays from now on."""
        self.course.end = self.now

    def expect(self, holds: bool, complaint: str) -> None:
        """Hold a sentence against the case where something does not hold."""
        if not holds:
            self.course.complaints.append(complaint)

    def hears(self, words: str) -> bool:
        """Tell whether diagnostics have said some words since the fault began."""
        return any(words in f'{said.name}: {said.message}' for said in self.course.said
                   if said.seconds >= self.course.begin)


def _code(process: NodeProcess) -> int:
    """Return the exit code of a process that was told to end; one that hangs says where."""
    try:
        return process.process.wait(STOP_TIMEOUT)
    except subprocess.TimeoutExpired:
        return process.stop(signal.SIGABRT)
