# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What the controller tells of itself: figures for an operator, internals to plot, conflicts."""

from dataclasses import replace
import math
from pathlib import Path
import sys
import time

from diagnostic_msgs.msg import DiagnosticStatus
import pytest
from rclpy.node import Node
from sensor_msgs.msg import JointState, Temperature

from koopman_ros.lifting import load, save
from koopman_ros.resources import model_path
from koopman_ros.ros import topics
from koopman_ros.testing import Harness
from support.controller_bench import Bench, STATUS, STEADY
from support.messages import seconds, temperature, value


@pytest.fixture(scope='module')
def shared_bench(shared_ros: Harness) -> Bench:
    # whole seconds of the clock of the node, so that ages are known
    return Bench(shared_ros, {'observer_bandwidth': 6.0}, first=float(int(time.time()) - 40))


def measure_on(bench: Bench, count: int) -> float:
    """Measure a falling temperature once a second; return the time of the last."""
    last = seconds(bench.commands[-1])
    for k in range(count):
        bench.measure(STEADY - 0.02 * k, last + 1.0 + k)
    return last + count


def test_status_tells_mode_law_reason_and_figures(shared_bench: Bench) -> None:
    bench = shared_bench
    last = measure_on(bench, 20)
    status = bench.status()
    assert value(status, 'measurements') == '21'
    assert {key: value(status, key) for key in ('mode', 'active law', 'law', 'reason')} == {
        'mode': 'automatic', 'active law': 'learned law', 'law': 're-centred', 'reason': 'none'}
    figures = {item.key: item.value for item in status.values}
    assert float(figures['coolant [degC]']) == pytest.approx(
        bench.commands[-1].temperature, abs=1e-6)
    assert float(figures['disturbance [K of coolant]']) < -0.1
    bias = float(figures['equivalent sensor bias [K]'])
    assert math.isfinite(bias)
    assert bias != 0.0
    assert 0.0 < float(figures['gain norm']) < 1000.0
    assert 0.0 <= float(figures['Riccati residual']) < 1e-8
    assert 0.0 < float(figures['predicted growth per sample']) < 1.0
    assert float(figures['transfer [K]']) == 0.0
    age, latency = (float(figures[key]) for key in (
        'age of measurement [s]', 'latency from stamp to command [s]'))
    assert 0.0 < time.time() - last - age < 10.0
    assert 0.0 < float(figures['latency from arrival to command [s]']) < 1.0
    assert latency == pytest.approx(
        age + float(figures['latency from arrival to command [s]']), abs=1e-6)


def test_missed_measurements_are_counted(shared_bench: Bench) -> None:
    bench = shared_bench
    last = measure_on(bench, 3)
    missed = int(value(bench.status(), 'missed measurements'))
    bench.measure(STEADY, last + 4.0)
    assert value(bench.status(), 'missed measurements') == str(missed + 3)


def test_measurements_that_arrive_late_are_told(shared_bench: Bench) -> None:
    bench = shared_bench
    (result,) = bench.ros.set_parameters('controller', max_measurement_age=1.0)
    assert result.successful, result.reason
    bench.measure(STEADY, seconds(bench.commands[-1]) + 1.0)
    status = bench.status(lambda s: 'old when they arrive' in s.message)
    assert status.level == DiagnosticStatus.WARN
    assert 'at most 1 s are expected' in status.message
    bench.ros.set_parameters('controller', max_measurement_age=0.0)
    bench.status(lambda s: s.level == DiagnosticStatus.OK)


def test_internals_carry_the_stamp_of_the_measurement(shared_bench: Bench) -> None:
    bench = shared_bench
    internals = bench.ros.listen(JointState, topics.CONTROLLER_STATE)
    predicted = bench.ros.listen(Temperature, topics.PREDICTED_TEMPERATURE)
    bench.ros.meet('controller')
    last = measure_on(bench, 10)
    bench.ros.wait_until(lambda: all(
        heard and seconds(heard[-1]) == last for heard in (internals, predicted)))
    stamps = [last - 9.0 + k for k in range(10)]
    # those of the measurement before may have been on their way
    assert [seconds(message) for message in internals[-10:]] == stamps
    assert [seconds(message) for message in predicted[-10:]] == stamps
    # what the model expected of a temperature that falls
    assert predicted[-1].temperature == pytest.approx(STEADY - 0.02 * 9, abs=0.5)
    assert predicted[-1].temperature != STEADY - 0.02 * 9
    names = internals[-1].name
    assert {name.split(' [')[0] for name in names} >= {
        'disturbance', 'estimated_temperature', 'distance_outside', 'level', 'gain',
        'riccati_residual', 'growth_per_sample', 'transfer', 'setpoint'}
    found = {name.split(' [')[0]: position
             for name, position in zip(names, internals[-1].position, strict=True)}
    assert found['estimated_temperature'] == pytest.approx(STEADY - 0.18, abs=0.5)
    assert found['level'] == 0.0
    assert 0.0 < found['gain'] < 1000.0


# Others where only one may be.


def known(status: DiagnosticStatus) -> bool:
    """Tell whether others are known by their names, which come a moment after their topics."""
    return 'end all but one' in status.message and 'UNKNOWN' not in status.message


def test_second_controller_is_told_by_both_while_it_lasts(ros: Harness) -> None:
    """Beside a coolant that is promised and never told, which delays the first command only."""
    ros.node.create_publisher(Temperature, topics.COOLANT_TEMPERATURE, topics.LATCHED_QOS)
    bench = Bench(ros)
    assert bench.commands[0].temperature > 25.0
    waited = []
    for k in range(2, 12):
        before = time.monotonic()
        bench.measure(STEADY, float(k))
        waited.append(time.monotonic() - before)
    # on a busy machine some may be slow, but if they waited for the coolant all would be
    assert min(waited) < 0.4

    second = ros.start('controller', arguments=('-r', '__node:=controller_2'))
    ros.meet('controller_2')
    bench.measure(STEADY, 12.0)
    for name in ('controller', 'controller_2'):
        status = ros.wait_for_status(f'{name}: control', known)
        assert status.level == DiagnosticStatus.WARN
        assert status.message == (
            '2 nodes command the coolant: /controller, /controller_2; end all but one')
    assert '2 nodes command the coolant' in second.output()
    assert second.stop() == 0
    ros.wait_for_status(STATUS, lambda s: s.level == DiagnosticStatus.OK)


def test_second_thermometer_is_told_by_its_name(shared_bench: Bench) -> None:
    ros = shared_bench.ros
    other = Node('other_plant', context=ros.node.context)
    try:
        other.create_publisher(Temperature, topics.TEMPERATURE, topics.LOOP_QOS)
        status = ros.wait_for_status(STATUS, known)
    finally:
        other.destroy_node()
    assert status.level == DiagnosticStatus.WARN
    assert status.message == (
        '2 nodes publish the temperature: /bench, /other_plant; end all but one')
    ros.wait_for_status(STATUS, lambda s: not known(s))


# A coolant that somebody tells of.


def test_first_command_waits_for_the_coolant_in_force(ros: Harness) -> None:
    """Which has another name here."""
    commands = ros.listen(Temperature, topics.COOLANT_SETPOINT)
    # patient, or a busy machine could be too slow for it
    program = ('import sys\n'
               'from koopman_ros.nodes import controller\n'
               'controller._COOLANT_PATIENCE = 100.0\n'
               'sys.exit(controller.main())\n')
    ros.start('controller', arguments=('-r', f'{topics.COOLANT_TEMPERATURE}:=jacket'),
              command=(sys.executable, '-c', program))
    coolant = ros.speak(Temperature, 'jacket', topics.LATCHED_QOS, to='controller')
    thermometer = ros.speak(Temperature, topics.TEMPERATURE, to='controller')
    thermometer.publish(temperature(STEADY, 1.0))
    ros.meet('controller')
    assert not commands
    coolant.publish(temperature(22.0, 1.0))
    ros.wait_until(lambda: commands)
    assert commands[0].temperature == pytest.approx(22.0, abs=1e-9)
    assert seconds(commands[0]) == 1.0


def test_a_model_that_does_not_reach_to_the_safe_coolant_says_so(
        shared_bench: Bench, tmp_path: Path) -> None:
    bench = shared_bench
    bench.ros.wait_for_status(STATUS, lambda s: value(s, 'safe coolant') == 'within reach')
    model = load(model_path('reactor_nz4'))
    lower, upper = model.states.center - 1.5, model.states.center + 1.5
    narrow = tmp_path / 'narrow.safetensors'
    save(replace(model, states=replace(model.states, lower=lower, upper=upper)), narrow)
    # accepted nevertheless
    (result,) = bench.ros.set_parameters('controller', model=str(narrow))
    assert result.successful, result.reason
    words = 'under safe_coolant = 5'
    status = bench.ros.wait_for_status(STATUS, lambda s: words in value(s, 'safe coolant'))
    assert 'leaves the trained range' in value(status, 'safe coolant')
    bench.ros.wait_until(lambda: words in bench.process.output())
    bench.ros.set_parameters('controller', safe_coolant=27.0)
    bench.ros.wait_for_status(STATUS, lambda s: value(s, 'safe coolant') == 'within reach')
    bench.ros.set_parameters('controller', model='reactor_nz4', safe_coolant=5.0)
