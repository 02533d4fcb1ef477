# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Others on the same topics, in the same domain, on the same processor."""

from __future__ import annotations

import os
import signal
import sys

from validation.faults.case import Case
from validation.faults.cases.processes import RUNNING, RUNNING_STEP
from validation.faults.rig import Rig

GROUP = 'neighbours'
_BUSY = (sys.executable, '-c', 'while True: pass')
_PARTICIPANTS = 12  # at once; those of one machine find each other up to 32


def _second_controller(rig: Rig) -> None:
    rig.begin()
    rig.start('controller', {'coolant_weight': 0.1}, ('-r', '__node:=controller_2'),
              called='controller_2')
    rig.wait(lambda: 'controller_2' in rig.node.get_node_names(), 'it does not start')
    rig.operator.ask(45.0)
    rig.linger(3.0)
    rig.kill('controller_2', signal.SIGINT)
    rig.end()


def _second_plant(rig: Rig) -> None:
    rig.begin()
    rig.start('plant', {'speed': 20.0, 'start_time': 5000.0}, (
        '-r', '__node:=plant_2', '-r', 'coolant_temperature:=plant_2/coolant_temperature'),
              called='plant_2')
    rig.wait(lambda: 'plant_2' in rig.node.get_node_names(), 'it does not start')
    rig.linger(3.0)
    rig.kill('plant_2', signal.SIGINT)
    rig.end()


def _flood(rig: Rig) -> None:
    rig.begin()
    flood = rig.start('flood', command=(sys.executable, '-m', 'validation.faults.flood', '5.0',
                                        str(_PARTICIPANTS)))
    # it ends by itself
    rig.processes.pop('flood').told_to_end = True
    rig.operator.ask(44.0)
    try:
        rig.wait(lambda: not flood.running, 'the flood does not end', 25.0)
    finally:
        code = flood.stop(signal.SIGKILL)
    come = flood.output().strip()
    rig.expect(code == 0 and come.isdigit(), f'the flood failed: {come}')
    rig.course.notes.append(f'{come} participants came and went')
    rig.end()


def _starved(rig: Rig) -> None:
    rig.begin()
    busy = [rig.start('busy', command=_BUSY, called=f'busy_{number}')
            for number in range(2 * (os.cpu_count() or 1))]
    rig.operator.ask(44.0)
    rig.linger(8.0)
    rig.course.notes.append(f'{len(busy)} busy neighbours')
    for number in range(len(busy)):
        rig.kill(f'busy_{number}')
    rig.end()


CASES = (
    Case('two-controllers', GROUP, 'a second controller, tuned otherwise, commands the '
         'same plant, in turn',
         _second_controller, largest_step=27.0,
         says=('^controller: control: 2 nodes command the coolant',
               '^plant: simulation: 2 nodes command the coolant')),
    Case('two-plants', GROUP, 'a second plant, 5 K warmer and at another time, measures, too',
         _second_plant, between=True, largest_step=2.0,
         says=('^controller: control: .*2 nodes publish the temperature',)),
    Case('participants', GROUP, f'{_PARTICIPANTS} participants at a time come and go for 5 s',
         _flood),
    Case('starved', GROUP, 'two busy processes on each core, while the set-point steps',
         _starved, plant=RUNNING, largest_step=RUNNING_STEP, settle=100.0, afterwards=100.0,
         recovery=100.0),
)
