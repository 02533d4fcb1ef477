# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Faults of a loop whose input acts late: its model, the quality of its sensor, its safe state."""

from dataclasses import replace

import numpy as np
from std_msgs.msg import UInt8

from koopman_ros.core.paths import model_path
from koopman_ros.model import load, save
from koopman_ros.ros import topics
from studies.faults.harness import FaultHarness
from studies.faults.interceptor import Alteration

QUALITY = 'temperature_quality'
_BAD = 2


def reloaded(loop: FaultHarness, seconds: float) -> None:
    """Reload the model with another dead time while inputs are on their way."""
    model = load(model_path(loop.on.name))
    file = loop.folder / 'late.safetensors'
    save(replace(model, dead_time=np.full(model.n_u, seconds)), file)
    loop.request(*loop.on.other)
    loop.run_for(20.0)
    with loop.fault():
        # on a busy machine reading takes longer than the loop may stand still for it
        while 'still being read' in (rejected := str(loop.set_parameters(
                'controller', model=str(file)))):
            pass
        loop.expect(rejected == '[]', f'the model was rejected: {rejected}')


def modes_in_a_step(loop: FaultHarness) -> None:
    """Change between manual and automatic mode, each while inputs are on their way."""
    loop.request(*loop.on.other)
    with loop.fault():
        for number in range(6):
            loop.run_for(15.0)
            loop.by_hand(*loop.on.by_hand)
            loop.ros.set_bool('controller/set_automatic', bool(number % 2))


def bad_quality(loop: FaultHarness, seconds: float) -> None:
    """Report the temperature as bad for a plant time."""
    publisher = loop.ros.node.create_publisher(UInt8, QUALITY, topics.LOOP_QOS)
    loop.wait(publisher.get_subscription_count, 'the quality has no subscription')
    with loop.fault():
        publisher.publish(UInt8(data=_BAD))
        loop.run_for(seconds)
        publisher.publish(UInt8(data=0))


def latched(loop: FaultHarness, alteration: Alteration, seconds: float) -> None:
    """Lose the temperature until the safe input is latched, and clear that."""
    with loop.fault():
        loop.alter(seconds, measurements=alteration)
        loop.run_for(100.0)
        safe = loop.on.default(f'{loop.on.inputs[0]}.safe_value')
        loop.expect(loop.trace.commands[-1].values == (safe,), 'the safe input is not latched')
        answer = loop.ros.trigger('controller/clear_safe_state')
        loop.expect(answer.success, f'the safe state was not cleared: {answer.message}')
