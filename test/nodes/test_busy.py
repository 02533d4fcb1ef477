# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The controller whose executor does not come to its timers: who commands, and who ends it."""

from collections.abc import Sequence
import os
from pathlib import Path
import sys
import time as clock
from typing import BinaryIO

from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np
import pytest
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Temperature
from std_msgs.msg import String

from koopman_ros.demo import reactor
from koopman_ros.ros import topics
from koopman_ros.ros.watchdog import Watchdog
from koopman_ros.testing import Harness
from support.controller_bench import reproduced, STATUS, STEADY
from support.nodes import opened, seconds, temperature

SAFE = 10.0  # degC
SETTINGS = {'measurement_timeout': 0.3, 'hold_timeout': 0.2,
            'coolant_temperature.rate_limit': 20.0, 'coolant_temperature.safe_value': SAFE}

# A control step that takes as long as somebody keeps the pipe of the second argument open, and a
# watchdog that is five times as quick as it is.
BUSY = """
import os, sys
from koopman_ros.ros import watchdog
watchdog.PERIOD, watchdog._PATIENCE = 0.02, 0.2
from koopman_ros.nodes import controller
from koopman_ros.control import events
from koopman_ros.ros import control_loop
control_loop._WATCH_STEP //= 5
pipe, apply = sys.argv.pop(1), events.apply
def slowly(*args):
    result = apply(*args)
    if isinstance(args[2], events.Measurement) and os.path.exists(pipe):
        open(pipe, 'rb').read()
    return result
events.apply = slowly
sys.exit(controller.main())
"""


class BusyBench:
    """A controller whose control step a pipe can keep from ending, with a thermometer."""

    def __init__(self, ros: Harness, pipe: Path, simulated: bool = False) -> None:
        self.ros, self.pipe = ros, pipe
        time = ros.node.create_publisher(Clock, topics.CLOCK, topics.CLOCK_QOS)
        self.process = ros.start(
            'controller', SETTINGS, ('-p', f'use_sim_time:={simulated}'.lower()),
            (sys.executable, '-c', BUSY, str(pipe)))
        self.commands = ros.listen(Temperature, reactor.COOLANT_SETPOINT)
        self.records = ros.listen(String, topics.EVENT_LOG)
        self.thermometer = ros.speak(Temperature, reactor.TEMPERATURE, to='controller')
        if simulated:
            ros.wait_until(lambda: time.get_subscription_count() > 0)
            time.publish(Clock(clock=temperature(0.0, 100.0).header.stamp))
        # with the snapshot for who listens
        ros.wait_until(lambda: self.records)
        self._begun = clock.monotonic()
        self.thermometer.publish(temperature(STEADY, 1.0))
        ros.wait_until(lambda: self.commands)

    def get_busy(self, time: float) -> BinaryIO:
        """Measure at a time; return what keeps the step from ending while it is open."""
        os.mkfifo(self.pipe)
        self.thermometer.publish(temperature(STEADY, time))
        return opened(self.ros, self.pipe)

    def wait_for_watchdog(self) -> None:
        """Wait for a command, in real time, that was given later than now."""
        now = 1.0 + clock.monotonic() - self._begun
        self.ros.wait_until(lambda: seconds(self.commands[-1]) > now)

    def answered(self, time: float) -> bool:
        return any(seconds(message) == time for message in self.commands)


def wait_for_replay(bench: BusyBench, stamps: Sequence[float]) -> None:
    """Wait until the commands are those that follow from the records, of these measurements."""
    def agrees() -> bool:
        records, recorded = reproduced(bench.records)
        return recorded == [message.temperature for message in bench.commands] and [
            record.stamp_ns / 1e9 for record in records if record.event == 'measurement'
            ] == list(stamps)

    bench.ros.wait_until(agrees)


def test_watchdog_commands_while_the_control_step_is_busy(ros: Harness, tmp_path: Path) -> None:
    """In simulated time, while the clock is not read."""
    bench = BusyBench(ros, tmp_path / 'pipe', simulated=True)
    held = bench.commands[0].temperature
    busy = bench.get_busy(2.03)
    ros.wait_until(lambda: bench.commands[-1].temperature == SAFE)
    ros.wait_for_status(STATUS, lambda s: s.level == DiagnosticStatus.ERROR and (
        'because the node is busy: the safe coolant is commanded' in s.message))
    assert not bench.answered(2.03)
    own = bench.commands[1:]
    stamps = np.array([seconds(message) for message in bench.commands[:-1]])
    assert own[0].temperature == held
    assert np.all(np.diff(stamps) > 0.0)
    steps = np.diff([message.temperature for message in bench.commands[:-1]])
    assert np.all(np.abs(steps) <= 20.0 * np.diff(stamps) * (1.0 + 1e-6))

    bench.pipe.unlink()
    busy.close()
    ros.wait_until(lambda: bench.answered(2.03))
    bench.thermometer.publish(temperature(STEADY, 3.03))
    ros.wait_until(lambda: bench.answered(3.03))
    # what the step had found was thrown away, and found again from what was commanded meanwhile
    wait_for_replay(bench, (1.0, 2.03, 3.03))
    assert 'learned law -> ' in bench.process.output()


def test_step_that_is_always_too_slow_is_given_up_and_the_process_ends_in_it(
        ros: Harness, tmp_path: Path) -> None:
    bench = BusyBench(ros, tmp_path / 'pipe')
    busy = bench.get_busy(2.03)
    bench.wait_for_watchdog()
    again = tmp_path / 'again'
    os.mkfifo(again)
    # the second attempt finds another pipe
    os.replace(again, bench.pipe)
    busy.close()
    busy = opened(ros, bench.pipe)
    bench.wait_for_watchdog()
    bench.pipe.unlink()
    busy.close()
    ros.wait_until(lambda: 'no command for a measurement' in bench.process.output())
    assert not bench.answered(2.03)
    bench.thermometer.publish(temperature(STEADY, 3.03))
    ros.wait_until(lambda: bench.answered(3.03))
    wait_for_replay(bench, (1.0, 3.03))

    busy = bench.get_busy(4.0)
    code = bench.process.stop()
    busy.close()
    assert code == 1
    assert 'controller: still busy 0.2 s after a signal' in bench.process.output()


def test_the_watchdog_acts_only_without_a_heartbeat_and_reports_its_errors() -> None:
    acted: list[float] = []

    def act(busy: float) -> None:
        acted.append(busy)
        if len(acted) == 2:
            raise RuntimeError('the second time')

    watchdog = Watchdog(act)
    # the executor comes by in time, then a little late, then not any more
    for comes in [True] * 20 + ([False] * 9 + [True]) * 2 + [False] * 9:
        if comes:
            watchdog.beat()
        watchdog.look()
    assert not acted
    for _ in range(3):
        watchdog.look()
    assert acted == pytest.approx([1.0, 1.1, 1.2])
    with pytest.raises(RuntimeError, match='the second time'):
        watchdog.beat()
