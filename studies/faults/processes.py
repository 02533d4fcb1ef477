# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Processes that end, hang and come back, their files, and their neighbours on the machine."""

from dataclasses import replace
import os
from pathlib import Path
import re
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import rclpy
from rclpy.context import Context
from rclpy.node import Node
from sensor_msgs.msg import Temperature

from koopman_ros.core.paths import model_path
from koopman_ros.model import load, save
from koopman_ros.records import read_messages
from studies.faults.harness import FaultHarness, SkipError
from studies.faults.plants import LOCKSTEP

RUNNING = {'speed': 20.0}  # without lock-step
RUNNING_STEP = 5.0  # K; what is late by a few samples may step as far as in these
DISK = '1m'  # size of a small disk
_BUSY = (sys.executable, '-c', 'while True: pass')
PARTICIPANTS = 12  # at once; those of one machine find each other up to 32
_FLOOD = (sys.executable, '-c', f'from {__name__} import flood; flood(5.0, {PARTICIPANTS})')
KEPT = ('^controller: control: .*the current model is kept',)
TWO_CONTROLLERS = ('^controller: control: 2 nodes command the coolant',
                   '^plant: simulation: 2 nodes command the coolant')
TWO_PLANTS = ('^controller: control: .*2 nodes publish the temperature',)


def plant_again(loop: FaultHarness, number: int) -> None:
    """End the plant by a signal, and start another."""
    with loop.fault():
        loop.kill('plant', number)
        before = loop.now
        loop.start('plant', {**LOCKSTEP, 'lockstep_subscribers': 2})
        loop.wait(lambda: loop.now > before, 'the new plant does not measure')


def plant_reset(loop: FaultHarness) -> None:
    """Put the plant back to where it started."""
    with loop.fault():
        answer = loop.ros.trigger('plant/reset')
        loop.expect(answer.success, f'the reset was rejected: {answer.message}')


def controller_again(loop: FaultHarness, setpoint: tuple[float, ...] = (), dead: float = 0.0
                     ) -> None:
    """Kill the controller, and start another some plant time later."""
    with loop.fault():
        loop.kill('controller')
        loop.run_for(dead)
        loop.start('controller')
        loop.request_until_tracked(*setpoint or loop.on.setpoint)


def controller_in_a_step(loop: FaultHarness) -> None:
    """Kill the controller after a step of the set-point."""
    loop.request(*loop.on.other)
    loop.run_for(15.0)
    controller_again(loop, loop.on.other)


def controller_while_disturbed(loop: FaultHarness) -> None:
    """Kill the controller while the feed is too warm."""
    loop.set_parameters('plant', **{'constants.feed_temperature': 78.85})
    loop.run_for(30.0)
    controller_again(loop, dead=60.0)


def controller_in_manual_mode(loop: FaultHarness) -> None:
    """Kill the controller in manual mode, and start another."""
    loop.ros.set_bool('controller/set_automatic', False)
    loop.by_hand(*loop.on.by_hand)
    loop.run_for(120.0)
    controller_again(loop)


def controller_stopped(loop: FaultHarness) -> None:
    """Stop the controller while the set-point steps."""
    loop.request(44.0)
    loop.run_for(20.0)
    with loop.fault():
        loop.pause('controller', 4.0)
        loop.linger(0.2)


def plant_stopped(loop: FaultHarness) -> None:
    """Stop the plant for some seconds."""
    with loop.fault():
        loop.pause('plant', 3.0)
        loop.run_for(1.0)


def _recording(loop: FaultHarness, bag: Path, command: tuple[str, ...] | None = None) -> None:
    loop.start('trainer', {'output': bag, 'min_free_disk': 0.0}, command=command)
    loop.wait(lambda: (status := loop.trace.last('trainer: recording')) is not None
              and int(status.values.get('messages', 0)) > 100, 'the trainer does not record')


def trainer_killed(loop: FaultHarness) -> None:
    """Kill the trainer while it records, and read its bag."""
    bag = loop.folder / 'killed.mcap'
    bag.unlink(missing_ok=True)
    _recording(loop, bag)
    with loop.fault():
        loop.kill('trainer')
    count = sum(1 for _ in read_messages(bag, recover=True))
    loop.trace.notes.append(f'{count} messages were read from the bag that it left')
    loop.expect(count > 100, f'the bag that it left holds {count} messages only')


def disk_full(loop: FaultHarness) -> None:
    """Let the trainer record until a small disk is full."""
    (disk := loop.folder / 'disk').mkdir(exist_ok=True)
    private = ('unshare', '--user', '--map-root-user', '--mount', 'sh', '-c',
               f'mount -t tmpfs -o size={DISK} tmpfs {disk} && exec "$@"', 'sh')
    if subprocess.run([*private, 'true'], capture_output=True, check=False).returncode:
        raise SkipError('this machine lends no disk of its own to a process')
    with loop.fault():
        _recording(loop, disk / 'full.mcap',
                   (*private, sys.executable, '-m', 'koopman_ros.nodes.trainer'))
        loop.wait_for_report(f'recording to {re.escape(str(disk))}/full.mcap stopped')


def reload(loop: FaultHarness, spoil: str) -> None:
    """Spoil or change the model file, and load it again."""
    file = loop.folder / 'lift.safetensors'
    shutil.copy(model_path('reactor_nz4'), file)
    loop.set_parameters('controller', model=str(file))
    with loop.fault():
        if spoil == 'deleted':
            file.unlink()
        elif spoil == 'garbage':
            file.write_bytes(b'\x07' * file.stat().st_size)
        elif spoil == 'cut':
            file.write_bytes(file.read_bytes()[:-100])
        else:
            shutil.copy(model_path('reactor_nz3'), file)
        answer = loop.ros.trigger('controller/reload_model')
        if spoil == 'changed':
            loop.expect(answer.success, f'the reload was rejected: {answer.message}')
        else:
            loop.expect(not answer.success, 'a spoilt model was accepted')
            loop.expect('the current model is kept' in answer.message,
                        f'the reason: {answer.message}')


def reload_later(loop: FaultHarness, seconds: float) -> None:
    """Load the model with another dead time while inputs are on their way."""
    model = load(model_path(loop.on.name))
    file = loop.folder / 'late.safetensors'
    save(replace(model, dead_time=np.full(model.n_u, seconds)), file)
    loop.request(*loop.on.other)
    loop.run_for(20.0)
    with loop.fault():
        loop.set_parameters('controller', model=str(file))


def second_controller(loop: FaultHarness, says: tuple[str, ...] = TWO_CONTROLLERS) -> None:
    """Let a controller with another weight command, too, until both nodes say so."""
    weight = f'{loop.on.inputs[0]}.weight'
    with loop.fault():
        loop.start('controller', {weight: 0.1 * loop.on.default(weight)},
                   ('-r', '__node:=controller_2'), called='controller_2')
        loop.request(*loop.on.other)
        loop.wait_for_report(*says)
        loop.linger(1.0)
        loop.kill('controller_2', signal.SIGINT)


def second_plant(loop: FaultHarness, says: tuple[str, ...] = TWO_PLANTS) -> None:
    """Let another plant measure, too, until the controller says so."""
    away = (word for place in loop.on.wiring.applied.values()
            for word in ('-r', f'{place.topic}:=plant_2/{place.topic}'))
    with loop.fault():
        loop.start('plant', {'speed': 20.0, 'start_time': 5000.0},
                   ('-r', '__node:=plant_2', *away), called='plant_2')
        loop.wait_for_report(*says)
        loop.linger(1.0)
        loop.kill('plant_2', signal.SIGINT)


def flood(seconds: float, count: int) -> None:
    """Create and remove this number of participants at once, and print their number."""
    end, come = time.monotonic() + seconds, 0
    while time.monotonic() < end:
        present = []
        for number in range(count):
            context = Context()
            rclpy.init(context=context)
            node = Node(f'flood_{number}', context=context)
            node.create_publisher(Temperature, f'flood_{number}', 10)
            present.append((context, node))
        come += count
        for context, node in present:
            node.destroy_node()
            rclpy.shutdown(context=context)
    print(come)


def flooded(loop: FaultHarness) -> None:
    """Let many participants of the middleware come and go."""
    with loop.fault():
        process = loop.start('flood', command=_FLOOD)
        # it ends by itself
        loop.processes.pop('flood').told_to_end = True
        loop.request(44.0)
        try:
            loop.wait(lambda: not process.running, 'the flood does not end')
        finally:
            code = process.stop(signal.SIGKILL)
        come = process.output().strip()
        loop.expect(code == 0 and come.isdigit(), f'the flood failed: {come}')
        loop.trace.notes.append(f'{come} participants came and went')


def starved(loop: FaultHarness) -> None:
    """Start more busy processes than there are cores."""
    with loop.fault():
        busy = [loop.start('busy', command=_BUSY, called=f'busy_{number}')
                for number in range(2 * (os.cpu_count() or 1))]
        loop.request(44.0)
        loop.linger(8.0)
        loop.trace.notes.append(f'{len(busy)} busy neighbours')
        for number in range(len(busy)):
            loop.kill(f'busy_{number}')
