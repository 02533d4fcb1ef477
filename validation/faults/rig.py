# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Plant and controller as real processes, to put faults into, with an operator beside them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
import signal
import time
from types import TracebackType
from typing import TypeVar

from koopman_ros.testing import Harness, NodeProcess
from validation.faults.line import Line, REMAPPED
from validation.faults.operator import Operator

T = TypeVar('T')
LOCKSTEP = {'lockstep': True, 'speed': 0.0, 'lockstep_timeout': 0.5}
_START_TIMEOUT = 30.0  # s for the processes to find each other


class Rig:
    """
    A loop to put faults into; leaving the context ends its processes.

    :param folder: for what the processes print.
    :param limit: wall time of the case, s.
    :param check: called at every turn; may raise to end the case.
    :param between: whether the rig stands between plant and controller.

    :ivar operator: who is beside the loop.
    :ivar line: what is said between plant and controller.
    :ivar processes: by name; those that are missed when they end.
    """

    def __init__(self, folder: Path, limit: float, check: Callable[[], None],
                 between: bool = False) -> None:
        self.folder = folder
        self.processes: dict[str, NodeProcess] = {}
        self._deadline = time.monotonic() + limit
        self._between = between
        self._harness = Harness(folder, name='rig', lasting=True, each_turn=check)
        self.node = self._harness.node
        self.line = Line(self.node, between)
        self.course = self.line.course
        self.operator = Operator(self._harness, self.line, self.wait)

    def __enter__(self) -> Rig:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        for name, code in self._harness.close().items():
            if code:
                self.course.complaints.append(
                    f'{name} ended with code {code}, see {self.folder / name}.log')
        for process in self._harness.processes:
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
        if self._between and called == 'plant':
            arguments += REMAPPED
        process = self._harness.start(name, parameters, arguments, command, called)
        self.processes[called] = process
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
        self.processes.pop(called).stop(number)

    # Time.

    @property
    def now(self) -> float:
        """Plant time in s since the first measurement."""
        return self.line.now

    def wait(self, done: Callable[[], T], complaint: str, timeout: float = 10.0) -> T:
        """
        Wait until a condition holds and return what it returned.

        :raises HarnessError: after `timeout` seconds of wall time, or at the end of the case's,
            or when a process ends by itself.
        """
        left = min(timeout, self._deadline - time.monotonic())
        return self._harness.wait_until(
            done, lambda: f'{complaint}; plant time is {self.now:.0f} s', left)

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
