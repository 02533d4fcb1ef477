# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Plant and controller as real processes for fault injection, with an operator."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
import contextlib
from functools import partial
import math
from pathlib import Path
import re
import signal
import sys
import time
from types import TracebackType
from typing import Any, TypeVar

from koopman_ros.ros import topics
from koopman_ros.ros.signals import by_topic
from koopman_ros.testing import Harness, HarnessError, NodeProcess
from studies.faults.case import FaultCase, LoopTrace
from studies.faults.interceptor import (
    Alteration,
    Interceptor,
    Packet,
    remapped,
    Sender,
    unchanged,
)
from studies.faults.judge import judge
from studies.faults.plants import FaultPlant, REACTOR

T = TypeVar('T')
_STEADY = 0.3  # s of wall time that a set-point must stay the one tracked
_ASK_AGAIN = 0.2  # s of wall time
# s of wall time for anything that is waited for, also on a machine that is busy otherwise
PATIENCE = 120.0
LIMIT = 300.0  # s of wall time for a case, on a machine that is busy otherwise


class SkipError(Exception):
    """A case cannot be tried on this machine; the message says why."""


def run(case: FaultCase, folder: Path, check: Callable[[], None] = lambda: None
        ) -> tuple[dict[str, Any], LoopTrace]:
    """
    Run a case in a domain of its own and judge it.

    :param folder: for the output of the processes.
    :param check: called all the time; may raise to end the case, whose processes end then, too.
    :return: figures by name, as of :func:`judge`, or why it was `skipped`; and the observations.
    """
    started = time.monotonic()
    folder.mkdir(parents=True, exist_ok=True)
    skipped = ''
    with FaultHarness(folder, LIMIT, check, case.between, case.on) as loop:
        try:
            loop.start_loop(case.setpoint, case.plant, case.controller, case.missing)
            loop.run_until(case.settle)
            case.play(loop)
            loop.run_for(case.afterwards)
            loop.expect(any('"command"' in text for _, text in loop.trace.records),
                        'the controller recorded no command')
        except HarnessError as error:
            loop.trace.complaints.append(str(error))
        except SkipError as reason:
            skipped = str(reason)
    figures = {'survived': False, 'skipped': skipped} if skipped else judge(loop.trace, case)
    return {'plant': case.on.name, 'group': case.group, 'does': case.does,
            'notes': loop.trace.notes, **figures,
            'wall_seconds': round(time.monotonic() - started, 2)}, loop.trace


def _without(missing: Sequence[str]) -> tuple[str, ...] | None:
    """Return how a controller is started that cannot import some packages; None for as usual."""
    return (sys.executable, '-c', (
        f'import sys; sys.modules |= dict.fromkeys({list(missing)}); '
        'from koopman_ros.nodes.controller import main; sys.exit(main())')) if missing else None


class FaultHarness:
    """
    A loop to put faults into; leaving the context ends its processes.

    :param limit: wall time of the case, s.
    :param check: called at every turn; may raise to end the case.
    :param between: whether the interceptor stands between plant and controller.
    :param on: plant of the loop.

    :ivar ros: the processes' harness, whose node is the operator's.
    :ivar interceptor: traces the messages between plant and controller, and alters them.
    :ivar processes: by name; those that are missed when they end.
    """

    def __init__(self, folder: Path, limit: float, check: Callable[[], None],
                 between: bool = False, on: FaultPlant = REACTOR) -> None:
        self.folder, self.on = folder, on
        self.processes: dict[str, NodeProcess] = {}
        self._deadline = time.monotonic() + limit
        self._check = check
        self._between = between
        self.ros = Harness(folder, name='operator', timeout=PATIENCE, lasting=True,
                           each_turn=self._each_turn)
        self.interceptor = Interceptor(self.ros.node, on, between)
        self.trace = self.interceptor.trace
        self._setpoints, self._manual = (
            Sender(self.ros.node, places) for places in (on.wiring.setpoints, on.wiring.manual))

    def __enter__(self) -> FaultHarness:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 traceback: TracebackType | None) -> None:
        for name, code in self.ros.close().items():
            self.expect(not code, f'{name} ended with code {code}, see {self.folder / name}.log')
        for process in self.ros.processes:
            self.expect('Traceback' not in process.output(), f'{process.log} holds a traceback')

    def _each_turn(self) -> None:
        self._check()
        if time.monotonic() > self._deadline:
            raise HarnessError('the case takes too long')

    # Processes.

    def start(self, name: str, parameters: Mapping[str, object] | None = None,
              arguments: tuple[str, ...] = (), command: tuple[str, ...] | None = None,
              called: str = '') -> NodeProcess:
        """Start a process as :class:`Harness` does; it is `called` as the node by default."""
        called = called or name
        if name in ('plant', 'controller'):
            parameters = {'system': self.on.system, **self.on.wired,
                          **(self.on.tuned if name == 'controller' else self.on.simulated),
                          **(parameters or {})}
        if self._between and called == 'plant':
            arguments += remapped(self.on)
        process = self.ros.start(name, parameters, arguments, command, called)
        self.processes[called] = process
        return process

    def start_loop(self, setpoint: Sequence[float], plant: Mapping[str, object],
                   controller: Mapping[str, object], missing: Sequence[str] = ()) -> None:
        """Start plant and controller, and ask for a set-point before the first measurement."""
        lockstep = bool(plant.get('lockstep'))
        # the plant is traced once the controller is known: a lock-step waits for it
        subscribers = {'lockstep_subscribers': 1 if self._between else 2} if lockstep else {}
        self.start('controller', controller, command=_without(missing))
        if lockstep:
            self.start('plant', {**plant, **subscribers})
        self._meet_controller()
        self.request(*setpoint)
        if 'trainer' in self.processes:
            self.wait(lambda: self.trace.last('trainer: recording'), 'the trainer does not start')
            # it finds the controller meanwhile
            self.linger(3.0)
        self.interceptor.open()
        if not lockstep:
            self.start('plant', plant)
        self.wait(lambda: self.trace.samples, 'no measurement')

    def kill(self, called: str, number: int = signal.SIGKILL) -> None:
        """End a process the hard way; it is not missed."""
        self.processes.pop(called).stop(number)

    def pause(self, name: str, seconds: float) -> None:
        """Stop a process for a wall time, and let it go on."""
        self.processes[name].process.send_signal(signal.SIGSTOP)
        self.linger(seconds)
        self.processes[name].process.send_signal(signal.SIGCONT)

    # The operator.

    def _meet_controller(self) -> None:
        self.ros.meet('controller')
        for publisher in (*self._setpoints.publishers, *self._manual.publishers):
            self.wait(publisher.get_subscription_count,
                      f'no node subscribes to {publisher.topic_name}')

    def ask(self, **values: float) -> None:
        """Ask for set-points by signal, which the trace is not to hold."""
        self._setpoints(Packet(0, values))

    def by_hand(self, *values: float) -> None:
        """Command the inputs as an operator does in manual mode."""
        self._manual(Packet(0, dict(zip(self.on.inputs, values, strict=True))))

    def request(self, *values: float) -> None:
        """Request set-points of all controlled states."""
        self.trace.setpoints.append((self.now, values))
        self.ask(**dict(zip(self.on.controlled, values, strict=True)))

    def request_until_tracked(self, *values: float) -> None:
        """Request set-points until the controller, which may be new, reports to track them."""
        wanted = dict(zip(self.on.controlled, values, strict=True))
        places, tracked, node = self.on.wiring.active_setpoints, dict[str, float](), self.ros.node

        def hear(names: list[str], message: Any) -> None:
            tracked.update({name: places[name].get(message) for name in names})

        subscriptions = [node.create_subscription(
            kind, topic, partial(hear, names), topics.LATCHED_QOS)
            for topic, kind, names in by_topic(places)]
        self._meet_controller()
        due = steady_since = 0.0

        def steady() -> bool:
            nonlocal due, steady_since
            if (now := time.monotonic()) >= due:
                self.ask(**wanted)
                due = now + _ASK_AGAIN
            if any(not abs(tracked.get(name, math.nan) - value) <= 1e-6
                   for name, value in wanted.items()):
                steady_since = now
            return now - steady_since > _STEADY

        self.wait(steady, 'the controller does not track the set-point requested')
        for subscription in subscriptions:
            node.destroy_subscription(subscription)
        self.trace.setpoints.append((self.now, values))

    def set_parameters(self, node: str, **values: Any) -> None:
        """Set parameters, none of which may be rejected."""
        reasons = self.ros.rejected_parameters(node, **values)
        self.expect(not reasons, f'{node}: rejected: {reasons}')

    @property
    def now(self) -> float:
        """Plant time in s since the first measurement."""
        return self.interceptor.now

    def wait(self, done: Callable[[], T], complaint: str) -> T:
        """
        Wait until a condition holds and return its value.

        :raises HarnessError: when it never does, or a process ends by itself.
        """
        return self.ros.wait_until(done, lambda: f'{complaint}; plant time is {self.now:.0f} s')

    def run_until(self, seconds: float) -> None:
        """Let the loop run until a plant time."""
        while self.now < seconds:
            reached = self.now
            self.wait(lambda reached=reached: self.now > reached,  # type: ignore[misc]
                      'no measurement arrives')

    def run_for(self, seconds: float) -> None:
        """Let the loop run for a plant time."""
        self.run_until(self.now + seconds)

    def linger(self, seconds: float) -> None:
        """Let the loop run for a wall time."""
        end = time.monotonic() + seconds
        self.wait(lambda: time.monotonic() > end, 'no time to linger')

    @contextlib.contextmanager
    def fault(self) -> Iterator[None]:
        """Mark when the fault begins, and when it is over or stays from then on."""
        self.trace.begin = self.now
        yield
        self.trace.end = self.now

    def alter(self, seconds: float, **what: Alteration) -> None:
        """Alter `measurements`, `commands`, `disturbances` or `late` for a plant time."""
        for name, alteration in what.items():
            setattr(self.interceptor, name, alteration)
        self.run_for(seconds)
        for name in what:
            setattr(self.interceptor, name, unchanged)

    def expect(self, holds: bool, complaint: str) -> None:
        """Hold a sentence against the case where something does not hold."""
        if not holds:
            self.trace.complaints.append(complaint)

    def wait_for_report(self, *patterns: str) -> None:
        """Wait until diagnostics have reported a match of each pattern since the fault began."""
        for pattern in patterns:
            self.wait(lambda pattern=pattern: any(  # type: ignore[misc]
                re.search(pattern, text) for text in self.trace.reported()),
                f'diagnostics do not report "{pattern}"')
