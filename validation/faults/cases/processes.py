# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Processes that end, hang and come back, and the files that they live on."""

from __future__ import annotations

import functools
from pathlib import Path
import shutil
import signal
import subprocess
import sys

from sensor_msgs.msg import Temperature

from koopman_ros.bags import read_messages
from koopman_ros.resources import model_path
from validation.faults.case import Case, SETPOINT, SkipError
from validation.faults.rig import LOCKSTEP, Rig

GROUP = 'processes'
# While a controller is dead, the plant goes on at twenty times real time.
PATIENT = {**LOCKSTEP, 'lockstep_timeout': 0.05}
RUNNING = {'speed': 20.0}  # without lock-step
RUNNING_STEP = 5.0  # K; what is late by a few samples may step as far as in these
_DISK = '1m'  # size of a small disk
_READINGS = 10  # that an operator tries


def _plant_again(number: int, rig: Rig) -> None:
    rig.begin()
    rig.kill('plant', number)
    before = rig.now
    rig.start('plant', {**LOCKSTEP, 'lockstep_subscribers': 2})
    rig.wait(lambda: rig.now > before, 'the new plant does not measure')
    rig.end()


def _plant_reset(rig: Rig) -> None:
    rig.begin()
    answer = rig.operator.trigger('plant/reset')
    rig.expect(answer.success, f'the reset was refused: {answer.message}')
    rig.end()


def _controller_again(rig: Rig, setpoint: float = SETPOINT, dead: float = 0.0) -> None:
    rig.begin()
    rig.kill('controller')
    rig.run_for(dead)
    rig.start('controller')
    rig.operator.insist(setpoint)
    rig.end()


def _controller_in_a_step(rig: Rig) -> None:
    rig.operator.ask(41.0)
    rig.run_for(15.0)
    _controller_again(rig, 41.0)


def _controller_while_disturbed(rig: Rig) -> None:
    rig.operator.set_parameters('plant', feed_temperature=78.85)
    rig.run_for(30.0)
    _controller_again(rig, dead=60.0)


def _controller_in_manual_mode(rig: Rig) -> None:
    rig.operator.set_bool('controller/set_automatic', False)
    rig.operator.speak('manual_coolant_setpoint').publish(Temperature(temperature=22.0))
    rig.run_for(120.0)
    _controller_again(rig)


def _controller_stopped(rig: Rig) -> None:
    rig.operator.ask(44.0)
    rig.run_for(20.0)
    rig.begin()
    rig.processes['controller'].process.send_signal(signal.SIGSTOP)
    rig.linger(4.0)
    rig.processes['controller'].process.send_signal(signal.SIGCONT)
    rig.linger(0.2)
    rig.end()


def _plant_stopped(rig: Rig) -> None:
    rig.begin()
    rig.processes['plant'].process.send_signal(signal.SIGSTOP)
    rig.linger(3.0)
    rig.processes['plant'].process.send_signal(signal.SIGCONT)
    rig.run_for(1.0)
    rig.end()


# The trainer, and the disk.


def _recording(rig: Rig, bag: Path, command: tuple[str, ...] | None = None) -> None:
    rig.start('trainer', {'output': bag, 'min_free_disk': 0.0}, command=command)
    rig.wait(lambda: any(said.name == 'trainer: recording'
                         and int(said.values.get('messages', 0)) > 100
                         for said in rig.course.said[-100:]), 'the trainer does not record')


def _trainer_killed(rig: Rig) -> None:
    bag = rig.folder / 'killed.mcap'
    bag.unlink(missing_ok=True)
    _recording(rig, bag)
    rig.begin()
    rig.kill('trainer')
    rig.end()
    count = sum(1 for _ in read_messages(bag, recover=True))
    rig.course.notes.append(f'{count} messages were read from the bag that it left')
    rig.expect(count > 100, f'the bag that it left holds {count} messages only')


def _disk_full(rig: Rig) -> None:
    (disk := rig.folder / 'disk').mkdir(exist_ok=True)
    private = ('unshare', '--user', '--map-root-user', '--mount', 'sh', '-c',
               f'mount -t tmpfs -o size={_DISK} tmpfs {disk} && exec "$@"', 'sh')
    if subprocess.run([*private, 'true'], capture_output=True, check=False).returncode:
        raise SkipError('this machine lends no disk of its own to a process')
    rig.begin()
    _recording(rig, disk / 'full.mcap',
               (*private, sys.executable, '-m', 'koopman_ros.nodes.trainer'))
    rig.wait(lambda: rig.hears(f'recording to {disk}/full.mcap stopped'),
             'the trainer never said that the disk is full', 20.0)
    rig.end()


# The model file.


def _reload(rig: Rig, spoil: str) -> None:
    file = rig.folder / 'lift.safetensors'
    shutil.copy(model_path('reactor_nz4'), file)
    reasons = rig.operator.set_parameters('controller', model=str(file))
    for _ in range(_READINGS):
        # on a busy machine reading takes longer than the loop may stand still for it
        if not any('still being read' in reason for reason in reasons):
            break
        reasons = rig.operator.set_parameters('controller', model=str(file))
    rig.expect(not any(reasons), f'the model was refused: {reasons}')
    rig.begin()
    if spoil == 'deleted':
        file.unlink()
    elif spoil == 'garbage':
        file.write_bytes(b'\x07' * file.stat().st_size)
    elif spoil == 'cut':
        file.write_bytes(file.read_bytes()[:-100])
    else:
        shutil.copy(model_path(spoil), file)
    answer = rig.operator.trigger('controller/reload_model')
    if spoil.startswith('reactor'):
        rig.expect(answer.success, f'the reload was refused: {answer.message}')
    else:
        rig.expect(not answer.success, 'a spoilt model was accepted')
        rig.expect('the old model is kept' in answer.message, f'said only: {answer.message}')
    rig.end()


def _reloaded(spoil: str) -> functools.partial[None]:
    return functools.partial(_reload, spoil=spoil)


KEPT = ('^controller: control: .*the old model is kept',)
CASES = (
    Case('plant-restart', GROUP, 'the plant is ended and started again, 5 K too warm and at time '
         '1 s', functools.partial(_plant_again, signal.SIGINT)),
    Case('plant-killed', GROUP, 'the plant is killed and started again',
         functools.partial(_plant_again, signal.SIGKILL)),
    Case('plant-reset', GROUP, 'the plant is reset, which makes it 5 K warmer at once',
         _plant_reset),
    Case('plant-stopped', GROUP, 'the plant is stopped (SIGSTOP) for 3 s of wall time',
         _plant_stopped),
    Case('controller-killed', GROUP, 'the controller is killed at rest and started again',
         _controller_again, plant=PATIENT, bump=0.01),
    Case('controller-killed-in-a-step', GROUP, 'killed 15 s after a step of the set-point, and '
         'started again', _controller_in_a_step, plant=PATIENT),
    Case('controller-killed-while-disturbed', GROUP, 'killed while the feed is 2 K too warm, and '
         'started again after a minute', _controller_while_disturbed, plant=PATIENT,
         afterwards=420.0, recovery=360.0),
    Case('controller-killed-in-manual-mode', GROUP, 'killed in manual mode, and started again',
         _controller_in_manual_mode, plant=PATIENT),
    Case('controller-stopped', GROUP, 'stopped (SIGSTOP) for 4 s of wall time, 80 s of plant '
         'time, while the set-point steps', _controller_stopped, plant=RUNNING, settle=100.0,
         largest_step=RUNNING_STEP, afterwards=120.0, recovery=120.0),
    Case('trainer-killed', GROUP, 'the trainer is killed while it records', _trainer_killed),
    Case('disk-full', GROUP, f'the trainer records to a disk of {_DISK}B until it is full',
         _disk_full, excused=('trainer: recording',),
         says=('^trainer: recording: recording to .* stopped',)),
    Case('model-garbage', GROUP, 'the model file is overwritten by garbage and read again',
         _reloaded('garbage'), bump=0.01, says=KEPT),
    Case('model-cut', GROUP, 'the model file is cut short and read again', _reloaded('cut'),
         bump=0.01, says=KEPT),
    Case('model-deleted', GROUP, 'the model file is deleted and read again',
         _reloaded('deleted'), bump=0.01, says=KEPT),
    Case('model-changed', GROUP, 'another lift takes the place of the model file and is read',
         _reloaded('reactor_nz3'), bump=0.01),
)
