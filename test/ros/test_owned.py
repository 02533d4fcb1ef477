# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What a part of a node has created goes with the part."""

from collections.abc import Callable
from pathlib import Path
import threading

import pytest
from rclpy.node import Node
from sensor_msgs.msg import Temperature

from koopman_ros.bags import BagWriter
from koopman_ros.parameters.trainer import TrainerParameters
from koopman_ros.ros import topics
from koopman_ros.ros.diagnostics import DiagnosticsPublisher, Level, Status
from koopman_ros.ros.experiment import CoolantExperiment
from koopman_ros.ros.matching import Matching
from koopman_ros.ros.recorder import Recorder
from koopman_ros.ros.recording import Recording
from koopman_ros.ros.sensors import Instruments
from koopman_ros.ros.training import Training
from koopman_ros.ros.watchdog import Watchdog
from koopman_ros.testing import Harness

# Makes a part, and returns what takes it down.
Make = Callable[[Node, Path], Callable[[], object]]


def diagnostics(node: Node, _: Path) -> Callable[[], object]:
    return DiagnosticsPublisher(
        node, 'task', 'hardware', lambda: Status(Level.OK, 'well')).destroy


def matching(node: Node, _: Path) -> Callable[[], object]:
    part = Matching(node, lambda: None, {topics.TEMPERATURE: 'publish the temperature'})
    part.publish('mine', Temperature)
    part.subscribe('other', lambda _: None, Temperature)
    return part.destroy


def instruments(node: Node, _: Path) -> Callable[[], object]:
    loop = Matching(node, lambda: None)
    part = Instruments(node, loop, clock=True, concentration=True)

    def destroy() -> None:
        part.destroy()
        loop.destroy()

    return destroy


def recorder(node: Node, folder: Path) -> Callable[[], object]:
    return Recorder(node, BagWriter(folder / 'bag'), (topics.TEMPERATURE, topics.SETPOINT)).close


def recording(node: Node, folder: Path) -> Callable[[], object]:
    part = Recording(node, TrainerParameters(output=str(folder / 'bag')))
    part.start()
    return part.destroy


def experiment(node: Node, _: Path) -> Callable[[], object]:
    part = CoolantExperiment(node, TrainerParameters(experiment_topic=topics.COOLANT_SETPOINT))
    assert part._start() == ''
    return part.destroy


def training(node: Node, folder: Path) -> Callable[[], object]:
    part = Training(node, TrainerParameters(), lambda: str(folder / 'missing'))
    part.start()
    return part.destroy


def watchdog(_: Node, __: Path) -> Callable[[], object]:
    part = Watchdog(lambda _: None)
    part.start()
    return part.end


@pytest.mark.parametrize('make', [diagnostics, matching, instruments, recorder, recording,
                                  experiment, training, watchdog])
def test_what_a_part_has_created_goes_with_it(
        shared_ros: Harness, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make: Make) -> None:
    # a training that loads no library, and ends when it is asked to
    monkeypatch.setattr('koopman_ros.jobs.training._command', lambda: (
        'sh', '-c', 'cat > /dev/null'))
    node = shared_ros.node

    def created() -> tuple[object, ...]:
        return (*map(set, (node.publishers, node.subscriptions, node.services, node.timers)),
                set(threading.enumerate()))

    before = created()
    destroy = make(node, tmp_path)
    assert created() != before
    destroy()
    assert created() == before
