# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Others on the same topics, in the same domain, on the same processor."""

import os
import signal
import sys

from validation.faults.case import case
from validation.faults.cases.processes import RUNNING, RUNNING_STEP
from validation.faults.harness import FaultHarness

GROUP = 'neighbours'
_BUSY = (sys.executable, '-c', 'while True: pass')
_PARTICIPANTS = 12  # at once; those of one machine find each other up to 32
_TWO_CONTROLLERS = ('^controller: control: 2 nodes command the coolant',
                    '^plant: simulation: 2 nodes command the coolant')
_TWO_PLANTS = ('^controller: control: .*2 nodes publish the temperature',)


def _second_controller(loop: FaultHarness) -> None:
    loop.begin()
    loop.start('controller', {'coolant_weight': 0.1}, ('-r', '__node:=controller_2'),
              called='controller_2')
    loop.request(45.0)
    loop.wait_for_report(*_TWO_CONTROLLERS)
    loop.linger(1.0)
    loop.kill('controller_2', signal.SIGINT)
    loop.end()


def _second_plant(loop: FaultHarness) -> None:
    loop.begin()
    loop.start('plant', {'speed': 20.0, 'start_time': 5000.0}, (
        '-r', '__node:=plant_2', '-r', 'coolant_temperature:=plant_2/coolant_temperature'),
              called='plant_2')
    loop.wait_for_report(*_TWO_PLANTS)
    loop.linger(1.0)
    loop.kill('plant_2', signal.SIGINT)
    loop.end()


def _flood(loop: FaultHarness) -> None:
    loop.begin()
    flood = loop.start('flood', command=(sys.executable, '-m', 'validation.faults.flood', '5.0',
                                        str(_PARTICIPANTS)))
    # it ends by itself
    loop.processes.pop('flood').told_to_end = True
    loop.request(44.0)
    try:
        loop.wait(lambda: not flood.running, 'the flood does not end')
    finally:
        code = flood.stop(signal.SIGKILL)
    come = flood.output().strip()
    loop.expect(code == 0 and come.isdigit(), f'the flood failed: {come}')
    loop.trace.notes.append(f'{come} participants came and went')
    loop.end()


def _starved(loop: FaultHarness) -> None:
    loop.begin()
    busy = [loop.start('busy', command=_BUSY, called=f'busy_{number}')
            for number in range(2 * (os.cpu_count() or 1))]
    loop.request(44.0)
    loop.linger(8.0)
    loop.trace.notes.append(f'{len(busy)} busy neighbours')
    for number in range(len(busy)):
        loop.kill(f'busy_{number}')
    loop.end()


CASES = (
    case(GROUP, 'two-controllers', 'a second controller, tuned otherwise, commands the '
         'same plant, in turn',
         _second_controller, largest_step=27.0,
         says=_TWO_CONTROLLERS),
    case(GROUP, 'two-plants', 'a second plant, 5 K warmer and at another time, measures, too',
         _second_plant, between=True, largest_step=2.0,
         says=_TWO_PLANTS),
    case(GROUP, 'participants', f'{_PARTICIPANTS} participants at a time come and go for 5 s',
         _flood),
    case(GROUP, 'starved', 'two busy processes on each core, while the set-point steps',
         _starved, plant=RUNNING, largest_step=RUNNING_STEP, settle=100.0, afterwards=100.0,
         recovery=100.0),
)
