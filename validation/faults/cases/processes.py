# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Processes that end, hang and come back, and the files that they live on."""

import functools
from pathlib import Path
import re
import shutil
import signal
import subprocess
import sys

from sensor_msgs.msg import Temperature

from koopman_ros.bags import read_messages
from koopman_ros.resources import model_path
from koopman_ros.ros import topics
from validation.faults.case import case, SETPOINT, SkipError
from validation.faults.harness import FaultHarness, LOCKSTEP

GROUP = 'processes'
# While a controller is dead, the plant goes on at twenty times real time.
PATIENT = {**LOCKSTEP, 'lockstep_timeout': 0.05}
RUNNING = {'speed': 20.0}  # without lock-step
RUNNING_STEP = 5.0  # K; what is late by a few samples may step as far as in these
_DISK = '1m'  # size of a small disk


def _plant_again(number: int, loop: FaultHarness) -> None:
    loop.begin()
    loop.kill('plant', number)
    before = loop.now
    loop.start('plant', {**LOCKSTEP, 'lockstep_subscribers': 2})
    loop.wait(lambda: loop.now > before, 'the new plant does not measure')
    loop.end()


def _plant_reset(loop: FaultHarness) -> None:
    loop.begin()
    answer = loop.ros.trigger('plant/reset')
    loop.expect(answer.success, f'the reset was refused: {answer.message}')
    loop.end()


def _controller_again(loop: FaultHarness, setpoint: float = SETPOINT, dead: float = 0.0) -> None:
    loop.begin()
    loop.kill('controller')
    loop.run_for(dead)
    loop.start('controller')
    loop.request_until_tracked(setpoint)
    loop.end()


def _controller_in_a_step(loop: FaultHarness) -> None:
    loop.request(41.0)
    loop.run_for(15.0)
    _controller_again(loop, 41.0)


def _controller_while_disturbed(loop: FaultHarness) -> None:
    loop.set_parameters('plant', feed_temperature=78.85)
    loop.run_for(30.0)
    _controller_again(loop, dead=60.0)


def _controller_in_manual_mode(loop: FaultHarness) -> None:
    loop.ros.set_bool('controller/set_automatic', False)
    loop.publisher(topics.MANUAL_COOLANT_SETPOINT).publish(Temperature(temperature=22.0))
    loop.run_for(120.0)
    _controller_again(loop)


def _controller_stopped(loop: FaultHarness) -> None:
    loop.request(44.0)
    loop.run_for(20.0)
    loop.begin()
    loop.pause('controller', 4.0)
    loop.linger(0.2)
    loop.end()


def _plant_stopped(loop: FaultHarness) -> None:
    loop.begin()
    loop.pause('plant', 3.0)
    loop.run_for(1.0)
    loop.end()


# The trainer, and the disk.


def _recording(loop: FaultHarness, bag: Path, command: tuple[str, ...] | None = None) -> None:
    loop.start('trainer', {'output': bag, 'min_free_disk': 0.0}, command=command)
    loop.wait(lambda: (status := loop.trace.last('trainer: recording')) is not None
              and int(status.values.get('messages', 0)) > 100, 'the trainer does not record')


def _trainer_killed(loop: FaultHarness) -> None:
    bag = loop.folder / 'killed.mcap'
    bag.unlink(missing_ok=True)
    _recording(loop, bag)
    loop.begin()
    loop.kill('trainer')
    loop.end()
    count = sum(1 for _ in read_messages(bag, recover=True))
    loop.trace.notes.append(f'{count} messages were read from the bag that it left')
    loop.expect(count > 100, f'the bag that it left holds {count} messages only')


def _disk_full(loop: FaultHarness) -> None:
    (disk := loop.folder / 'disk').mkdir(exist_ok=True)
    private = ('unshare', '--user', '--map-root-user', '--mount', 'sh', '-c',
               f'mount -t tmpfs -o size={_DISK} tmpfs {disk} && exec "$@"', 'sh')
    if subprocess.run([*private, 'true'], capture_output=True, check=False).returncode:
        raise SkipError('this machine lends no disk of its own to a process')
    loop.begin()
    _recording(loop, disk / 'full.mcap',
               (*private, sys.executable, '-m', 'koopman_ros.nodes.trainer'))
    loop.wait_for_report(f'recording to {re.escape(str(disk))}/full.mcap stopped')
    loop.end()


# The model file.


def _reload(loop: FaultHarness, spoil: str) -> None:
    file = loop.folder / 'lift.safetensors'
    shutil.copy(model_path('reactor_nz4'), file)
    # on a busy machine reading takes longer than the loop may stand still for it
    while 'still being read' in (refused := str(loop.set_parameters(
            'controller', model=str(file)))):
        pass
    loop.expect(refused == '[]', f'the model was refused: {refused}')
    loop.begin()
    if spoil == 'deleted':
        file.unlink()
    elif spoil == 'garbage':
        file.write_bytes(b'\x07' * file.stat().st_size)
    elif spoil == 'cut':
        file.write_bytes(file.read_bytes()[:-100])
    else:
        shutil.copy(model_path(spoil), file)
    answer = loop.ros.trigger('controller/reload_model')
    if spoil.startswith('reactor'):
        loop.expect(answer.success, f'the reload was refused: {answer.message}')
    else:
        loop.expect(not answer.success, 'a spoilt model was accepted')
        loop.expect('the old model is kept' in answer.message, f'the reason: {answer.message}')
    loop.end()


KEPT = ('^controller: control: .*the old model is kept',)
CASES = (
    case(GROUP, 'plant-restart', 'the plant is ended and started again, 5 K too warm and at time '
         '1 s', functools.partial(_plant_again, signal.SIGINT)),
    case(GROUP, 'plant-killed', 'the plant is killed and started again',
         functools.partial(_plant_again, signal.SIGKILL)),
    case(GROUP, 'plant-reset', 'the plant is reset, which makes it 5 K warmer at once',
         _plant_reset),
    case(GROUP, 'plant-stopped', 'the plant is stopped (SIGSTOP) for 3 s of wall time',
         _plant_stopped),
    case(GROUP, 'controller-killed', 'the controller is killed at rest and started again',
         _controller_again, plant=PATIENT, bump=0.01),
    case(GROUP, 'controller-killed-in-a-step', 'killed 15 s after a step of the set-point, and '
         'started again', _controller_in_a_step, plant=PATIENT),
    case(GROUP, 'controller-killed-while-disturbed', 'killed while the feed is 2 K too warm, and '
         'started again after a minute', _controller_while_disturbed, plant=PATIENT,
         afterwards=420.0, recovery=360.0),
    case(GROUP, 'controller-killed-in-manual-mode', 'killed in manual mode, and started again',
         _controller_in_manual_mode, plant=PATIENT),
    case(GROUP, 'controller-stopped', 'stopped (SIGSTOP) for 4 s of wall time, 80 s of plant '
         'time, while the set-point steps', _controller_stopped, plant=RUNNING, settle=100.0,
         largest_step=RUNNING_STEP, afterwards=120.0, recovery=120.0),
    case(GROUP, 'trainer-killed', 'the trainer is killed while it records', _trainer_killed),
    case(GROUP, 'disk-full', f'the trainer records to a disk of {_DISK}B until it is full',
         _disk_full, allowed_errors=('trainer: recording',),
         says=('^trainer: recording: recording to .* stopped',)),
    *(case(GROUP, f'model-{name}', does, functools.partial(_reload, spoil=spoil), bump=0.01,
           says=KEPT if spoil == name else ())
      for name, spoil, does in (
          ('garbage', 'garbage', 'the model file is overwritten by garbage and read again'),
          ('cut', 'cut', 'the model file is cut short and read again'),
          ('deleted', 'deleted', 'the model file is deleted and read again'),
          ('changed', 'reactor_nz3', 'another lift takes the place of the model file and is '
           'read'))),
)
