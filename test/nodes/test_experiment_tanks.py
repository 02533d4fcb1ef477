# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Experiments with two inputs, and on set-points, across processes: two tanks and their pumps."""

import itertools
from pathlib import Path
import re
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np
import pytest
from sensor_msgs.msg import JointState

from koopman_ros.core.units import NANOSECONDS
from koopman_ros.nodes.trainer import TrainerNode
from koopman_ros.ros import topics
from koopman_ros.ros.time_conversion import stamp_message
from koopman_ros.testing import Harness
from support.nodes import RunNode
from support.tanks import LEVELS, linear, PUMPS, TANKS

STATUS, SERVICE = 'trainer: experiment', 'trainer/experiment'
LOW, HIGH, RATE, SAFE = (5.0, 1.0), (7.5, 3.0), (0.5, 0.125), (6.0, 2.0)  # V, V/s
TRAINER = {
    'system': 'two_tanks', 'record_at_start': False, 'experiment_min_hold_time': 5.0,
    'experiment_max_hold_time': 20.0, **{
        f'{name}.{key}': numbers[i] for i, name in enumerate(PUMPS) for key, numbers in (
            ('experiment_min', LOW), ('experiment_max', HIGH), ('experiment_rate_limit', RATE),
            ('safe_value', SAFE))},
    **{f'{name}.experiment_{end}': bound for name in LEVELS
       for end, bound in (('min', 0.02), ('max', 0.5))}}
PLANT = {'system': 'two_tanks', 'sample_period': 2.0, 'lockstep': True, 'speed': 0.0}


def numbers(messages: list[Any]) -> np.ndarray:
    return np.array([message.position[0] for message in messages])


def test_setpoints_step_and_return_to_their_previous_values(ros: Harness, tmp_path: Path) -> None:
    before = 1.1 * TANKS.nominal_state
    low, high = 0.85 * TANKS.nominal_state, 1.2 * TANKS.nominal_state
    measured = [ros.listen(JointState, name) for name in LEVELS]
    active = [ros.listen(JointState, f'{name}/active_setpoint', topics.LATCHED_QOS)
              for name in LEVELS]
    model = linear(tmp_path)
    ros.start('controller', {'system': 'two_tanks', 'model': model, **{
        f'{name}.{key}': number for name in PUMPS for key, number in (
            ('min', 0.0), ('max', 12.0), ('safe_value', 2.0))}, **{
        f'{name}.weight': 1e4 for name in LEVELS}})
    asked = [ros.speak(JointState, f'{name}/setpoint', to='controller') for name in LEVELS]
    ros.start('trainer', {
        **TRAINER, 'model': model, 'experiment_signal': 'setpoint', 'experiment_length': 150.0,
        'experiment_min_hold_time': 12.0, 'experiment_max_hold_time': 25.0, **{
            f'{name}.setpoint_{end}': float(bound[i]) for i, name in enumerate(LEVELS)
            for end, bound in (('min', low), ('max', high))}})
    ros.meet('trainer')
    # who asks for set-points beside the experiment is in its way; its name may be known later
    said = ros.set_bool(SERVICE, True).message
    assert re.match('rejected: (/bench|another node) publishes on /level_1/setpoint: stop it, or '
                    'choose', said)
    for name, publisher, level in zip(LEVELS, asked, before, strict=True):
        publisher.publish(JointState(name=[name], position=[float(level)]))
    # no quicker: all of them would work on while something else is waited for
    ros.start('plant', {**PLANT, 'speed': 20.0, 'lockstep_subscribers': 2})
    ros.wait_until(lambda: all(heard and heard[-1].position[0] == level
                               for heard, level in zip(active, before, strict=True)))
    for publisher in asked:
        ros.node.destroy_publisher(publisher)
    ros.wait_until(lambda: ros.node.count_publishers(f'{LEVELS[1]}/setpoint') == 0)

    # until the graph tells the trainer the same
    said = ros.wait_until(lambda: (answer := ros.set_bool(SERVICE, True)).success and answer)
    assert said.message == 'started on /level_1/setpoint, /level_2/setpoint'
    first = len(measured[0])
    status = ros.wait_for_status(STATUS, lambda s: s.message.startswith('finished'))
    home = ', '.join(f'{name} to {level:.6g} m' for name, level in zip(
        LEVELS, before, strict=True))
    assert status.message.startswith(f'finished; {home}')
    last = len(measured[0])
    for heard, level, least, most, true in zip(active, before, low, high, measured, strict=True):
        ros.wait_until(lambda heard=heard, level=level: heard[-1].position[0] == level)
        levels = numbers(heard)
        steps = levels[(levels != level)]
        assert len(steps) > 5
        assert least <= steps.min() < steps.max() <= most
        # the plant went there
        assert np.ptp(numbers(true[first:last])) > 0.5 * np.ptp(steps)
    ros.wait_until(lambda: len(measured[0]) > last + 30)
    assert [heard[-1].position[0] for heard in measured] == pytest.approx(before, rel=0.02)

    # one that the controller rejects
    assert ros.set_bool(SERVICE, False).success
    assert all(result.successful for result in ros.set_parameters(
        'trainer', experiment_length=60000.0, **{'level_2.setpoint_max': 5.0}))
    assert ros.set_bool(SERVICE, True).success
    status = ros.wait_for_status(STATUS, lambda s: s.level == DiagnosticStatus.ERROR)
    assert re.fullmatch(r'aborted: the controller tracks [0-9.]+ m instead of the requested [0-9.]'
                        '+ m: choose set-points that it can hold', status.message)
    ros.wait_until(lambda: ros.node.count_publishers(f'{LEVELS[0]}/setpoint') == 0)

    # in manual mode it moves nothing
    assert ros.set_parameters(
        'trainer', **{'level_2.setpoint_max': float(high[1])})[0].successful
    assert ros.set_bool(SERVICE, True).success
    ros.set_bool('controller/set_automatic', False)
    words = 'the controller is in manual mode: switch it to automatic mode'
    ros.wait_for_status(STATUS, lambda s: s.message == f'aborted: {words}')
    assert ros.set_bool(SERVICE, True).message == f'rejected: {words}'

    # but passes on the pumps that an experiment asks for by hand, until it is automatic again
    ros.set_parameters('trainer', experiment_signal='manual')
    commands = [ros.listen(JointState, f'{name}_setpoint') for name in PUMPS]
    assert ros.set_bool(SERVICE, True).message == (
        'started on /manual_pump_1_setpoint, /manual_pump_2_setpoint')
    ros.wait_until(lambda: all(np.ptp(numbers(heard) if heard else [0.0]) > 1.0
                               for heard in commands))
    ros.set_bool('controller/set_automatic', True)
    status = ros.wait_for_status(STATUS, lambda s: s.level == DiagnosticStatus.ERROR)
    assert status.message.startswith('aborted: the controller commands ')
    assert 'switch it to manual mode' in status.message


def test_an_experiment_of_setpoints_without_a_controller_is_rejected(
        ros: Harness, tmp_path: Path, run_node: RunNode) -> None:
    run_node(TrainerNode, {
        **TRAINER, 'model': linear(tmp_path), 'experiment_signal': 'setpoint',
        'experiment_timeout': 1.0, **{f'{name}.setpoint_{end}': bound for name in LEVELS
                                      for end, bound in (('min', 0.1), ('max', 0.2))}})
    sensors = {name: ros.node.create_publisher(JointState, name, topics.LOOP_QOS)
               for name in LEVELS}
    ros.meet('trainer')
    times = itertools.count(1)

    def measure() -> None:
        stamp = stamp_message(next(times) * NANOSECONDS)
        for (name, sensor), level in zip(sensors.items(), (0.15, 0.25), strict=True):
            message = JointState(name=[name], position=[level])
            message.header.stamp = stamp
            sensor.publish(message)

    ros.node.create_timer(0.02, measure)
    assert ros.set_bool(SERVICE, True).message == (
        'rejected: /pump_1_setpoint is not published: start the controller and switch it to '
        'automatic mode')
    ros.node.create_publisher(JointState, 'pump_1_setpoint', topics.LOOP_QOS)
    # until the graph tells the trainer
    said = ros.wait_until(lambda: 'unknown' in (
        said := ros.set_bool(SERVICE, True).message) and said)
    assert said == (
        'rejected: the active set-points have been unknown for 1 s: switch the controller to '
        'automatic mode, and check sensor and plant')
