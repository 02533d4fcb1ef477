# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A controller's parameters as `ros2 param` changes them, and bad, missing or odd measurements."""

from collections.abc import Callable
import itertools
import math
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np
import pytest
from rcl_interfaces.srv import DescribeParameters
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import Float64, String

from koopman_ros.core.units import LAST_STAMP_SECONDS
from koopman_ros.demo import reactor
from koopman_ros.event_log.records import parse
from koopman_ros.nodes.controller import ControllerNode
from koopman_ros.nodes.plant import PlantNode
from koopman_ros.ros import topics
from koopman_ros.ros.node import range_of
from koopman_ros.testing import Harness
from support.controller_bench import Bench, PATIENT, reproduced, STATUS, STEADY, TABLE
from support.nodes import RunNode, seconds, SharedHarness, temperature, value

CONTROLLER = '/controller'
SAFE = 5.0  # degC


@pytest.fixture(scope='module')
def running(shared_ros: Harness) -> Harness:
    """Start one controller for several tests."""
    shared_ros.start('controller')
    return shared_ros


@pytest.mark.parametrize(('change', 'words'), [
    ({'coolant_temperature.max': 2e9}, 'must be in [-273.15, 1000000000] degC'),
    ({'temperature.setpoint_ramp': math.nan}, 'temperature.setpoint_ramp = nan K/s must be in'),
    ({'coolant_temperature.weight': 1}, "expected 'Type.DOUBLE' got 'Type.INTEGER'"),
    ({'coolant_temperature.min': 40.0}, 'coolant_temperature.min = 40.0 degC must be below '
     'coolant_temperature.max = 32.0 degC: change the other one first'),
    ({'model': 'reactor_nz5'}, 'model is kept: no model file at'),
    ({'no_such_thing': 1.0}, 'undeclared parameter'),
    ({'temperature.topic': 'elsewhere'}, 'read-only'),
    ({'learned_model_margin': 2.0}, 'learned_model_margin = 2.0 must be at most '),
])
def test_change_that_does_not_fit_is_rejected_with_the_reason(
        running: Harness, change: dict[str, Any], words: str) -> None:
    (result,) = running.set_parameters(CONTROLLER, **change)
    assert not result.successful
    assert words in result.reason
    (name,) = change
    if name in TABLE.rows:
        assert running.get_parameters(CONTROLLER, name) == [TABLE.rows[name].default]


def test_a_shared_process_gets_back_what_a_test_has_set(running: SharedHarness) -> None:
    changed = {'max_gain': 7.0, 'coolant_temperature.max': 30.0, 'recovery_time': 3.0}
    assert all(result.successful for result in running.set_parameters(CONTROLLER, **changed))
    assert running.set_parameters_atomically(CONTROLLER, max_gain=8.0).successful
    running.set_parameters(CONTROLLER, no_such_thing=1.0)
    running.restore()
    assert running.get_parameters(CONTROLLER, *changed) == [
        TABLE.rows[name].default for name in changed]


def test_two_limits_that_cross_on_the_way_change_together(running: Harness) -> None:
    limits = {'coolant_temperature.min': 40.0, 'coolant_temperature.max': 60.0}
    result = running.set_parameters_atomically(CONTROLLER, **limits)
    assert result.successful, result.reason
    assert running.get_parameters(CONTROLLER, *limits) == list(limits.values())


@pytest.mark.parametrize(('changes', 'words'), [
    ({'max_gain': 7.0, 'coolant_temperature.max': 2e9},
     'coolant_temperature.max = 2000000000.0 degC must be in '),
    # equal in K
    ({'temperature.sensor_min': 20.0, 'temperature.sensor_max': 20.00000000000001},
     'temperature.sensor_min = 20.0 degC must be below temperature.sensor_max = ')])
def test_atomic_change_is_rejected_as_a_whole(
        running: Harness, changes: dict[str, float], words: str) -> None:
    result = running.set_parameters_atomically(CONTROLLER, **changes)
    assert not result.successful
    assert result.reason.startswith(words)
    assert running.get_parameters(CONTROLLER, *changes) == [
        TABLE.rows[name].default for name in changes]
    running.wait_until(lambda: f'parameter change rejected: {words}' in running.printed())


def test_every_parameter_is_described_with_unit_and_range(running: Harness) -> None:
    names = list(TABLE.rows)
    response = running.call(DescribeParameters, f'{CONTROLLER}/describe_parameters',
                            DescribeParameters.Request(names=names))
    described = {item.name: item for item in response.descriptors}
    assert list(described) == names
    for name, row in TABLE.rows.items():
        assert described[name].description.startswith(row.description)
        assert described[name].description.endswith(f'[{row.unit}]' if row.unit else '')
        assert described[name].additional_constraints == row.range_text
        assert described[name].read_only == row.read_only
        found = [*described[name].floating_point_range, *described[name].integer_range]
        assert found == ([limits] if (limits := range_of(row)) else [])
    lowest, weight = (described[f'coolant_temperature.{name}'] for name in ('min', 'weight'))
    assert lowest.description.endswith(' [degC]')
    assert weight.additional_constraints == '(0, 1e+30] 1/K^2'


def own_commands(bench: Bench, after: float) -> list[Temperature]:
    """Return what was commanded later than the last measurement."""
    return [message for message in bench.commands if seconds(message) > after]


def test_time_may_begin_at_zero_jump_by_an_hour_and_back_and_come_to_its_end(ros: Harness) -> None:
    bench = Bench(ros, first=0.0)
    assert seconds(bench.commands[0]) == 0.0
    commands = [bench.commands[0].temperature]
    for first in (1, 3621, 26):
        commands += [bench.measure(STEADY + 0.05 * math.sin(0.3 * k), float(k)).temperature
                     for k in range(first, first + 5)]
    assert np.max(np.abs(np.diff(commands))) < 0.05
    assert np.ptp(commands) > 0.0
    ros.wait_until(lambda: 'controller time is reset' in bench.process.output())
    status = bench.status()
    assert value(status, 'measurements') == '16'
    assert status.level == DiagnosticStatus.OK

    ros.set_parameters('controller', measurement_timeout=0.1)
    last = float(LAST_STAMP_SECONDS)
    bench.measure(STEADY, last)
    ros.wait_until(lambda: len(own_commands(bench, last)) >= 2)
    assert {message.header.stamp.sec for message in own_commands(bench, last)} == {
        LAST_STAMP_SECONDS}
    assert all(math.isfinite(message.temperature) for message in bench.commands)


def test_missing_simulated_time_is_reported_and_its_silence_leads_to_the_safe_coolant(
        ros: Harness, run_node: RunNode) -> None:
    """The clock goes fifty times faster than the wall's."""
    bench = Bench(ros, {'measurement_timeout': 10.0, 'hold_timeout': 20.0},
                  ('-p', 'use_sim_time:=true'))
    times = itertools.count(2)

    def told() -> DiagnosticStatus | None:
        # measurements come all the time
        bench.measure(STEADY, float(next(times)))
        return next((s for s in ros.statuses if '/clock is not published' in s.message), None)

    status = ros.wait_until(told)
    assert status.level == DiagnosticStatus.WARN
    assert 'set use_sim_time to false' in status.message
    assert value(status, 'age of measurement [s]') == 'nan'

    # a plant of which the controller hears the time alone
    elsewhere = [part for name in (reactor.TEMPERATURE, reactor.COOLANT_SETPOINT,
                                   reactor.COOLANT_TEMPERATURE)
                 for part in ('-r', f'{name}:=elsewhere/{name}')]
    clock = ros.listen(Clock, topics.CLOCK, topics.CLOCK_QOS)
    run_node(PlantNode, {'speed': 50.0}, *elsewhere)
    ros.wait_until(lambda: clock)
    last = float(next(times))
    held = bench.measure(STEADY, last).temperature
    begun = clock[-1].clock.sec
    status = bench.status(lambda s: s.level == DiagnosticStatus.ERROR)
    assert status.message.startswith(
        f'no measurement for more than 10 s: the last command is held, coolant at {held:.2f} degC')
    ros.wait_until(lambda: bench.commands[-1].temperature == SAFE)
    # what the bench has heard of the clock may be older
    ticks = len(clock)
    ros.wait_until(lambda: len(clock) > ticks + 1)
    status = bench.status(lambda s: 'the safe coolant is commanded' in s.message)
    assert status.level == DiagnosticStatus.ERROR
    assert value(status, 'active law') == 'safe input'
    # 10 s until it holds and 20 s until it gives up, then at 60 K/min
    assert clock[-1].clock.sec - begun > 30.0 + (held - SAFE)
    own = own_commands(bench, last)
    stamps = np.array([seconds(message) for message in own])
    commands = np.array([message.temperature for message in own])
    assert stamps[0] > last + 10.0
    assert np.all(np.diff(stamps) > 0.0)
    assert np.all(commands[stamps < last + 30.0] == held)
    assert np.all(-np.diff(commands) <= np.diff(stamps) * (1.0 + 1e-6))
    # the plant was not forgotten: the law takes over from there
    command = bench.measure(STEADY - 0.5, math.floor(stamps[-1]) + 5.0).temperature
    assert command == pytest.approx(SAFE, abs=5.0)
    bench.status(lambda s: 'the measured' not in s.message)


def test_silence_by_the_wall_clock_ends_at_the_safe_coolant_or_with_the_operator(
        ros: Harness) -> None:
    bench = Bench(ros, {'measurement_timeout': 0.3, 'hold_timeout': 1.5,
                        'stuck_sensor_timeout': 0.0,
                        'coolant_temperature.rate_limit': 100.0,
                        'coolant_temperature.safe_value': 10.0})
    held = bench.commands[0].temperature
    ros.wait_until(lambda: bench.commands[-1].temperature == 10.0)
    own = own_commands(bench, 1.0)
    assert own[0].temperature == held
    # it is held for 1.5 s, or longer where a busy machine looks for it late
    safe = next(message for message in own if message.temperature != held)
    assert seconds(own[0]) > 1.3
    assert seconds(safe) > 2.8
    bench.status(lambda s: s.level == DiagnosticStatus.ERROR and (
        'the safe coolant is commanded, coolant at 10.00 degC' in s.message))
    assert 'learned law -> hold' in bench.process.output()

    # in manual mode the coolant is left to the operator
    ros.set_parameters('controller', hold_timeout=0.0)
    ros.set_bool('controller/set_automatic', False)
    last = math.floor(seconds(bench.commands[-1])) + 60.0
    held = bench.measure(STEADY, last).temperature
    manual = ros.speak(Temperature, reactor.MANUAL_COOLANT_SETPOINT, to='controller')
    manual.publish(temperature(held - 0.5))
    ros.wait_until(lambda: bench.commands[-1].temperature == pytest.approx(held - 0.5))
    assert own_commands(bench, last)
    bench.status(lambda s: s.level == DiagnosticStatus.ERROR and (
        'no measurement for more than 0.3 s: manual mode' in s.message))

    # stamps that cycle are a silence, too
    ros.set_parameters('controller', measurement_timeout=0.5, hold_timeout=0.5,
                       recovery_time=0.0)
    ros.set_bool('controller/set_automatic', True)
    begin, tenths = math.floor(seconds(bench.commands[-1])) + 60.0, itertools.cycle(range(10))
    for k in range(10):
        bench.measure(STEADY, begin + 0.1 * k)

    def cycles(condition: Callable[[], object]) -> None:
        def done() -> object:
            bench.send(STEADY + 1.0, begin + 0.1 * next(tenths))
            return condition()
        ros.wait_until(done)

    cycles(lambda: bench.commands[-1].temperature == 10.0)
    cycles(lambda: (status := ros.last_status(STATUS)) and (
        status.level == DiagnosticStatus.ERROR and 'have not advanced for more than 0.5 s: the '
        'safe coolant is commanded' in status.message))
    # one that advances again is answered by the law
    bench.measure_until(lambda message: message.temperature != 10.0,
                        seconds(bench.commands[-1]) + 1.0)


def test_a_latched_safe_state_outlasts_silence_and_restart_until_it_is_cleared(
        ros: Harness, tmp_path: Path) -> None:
    ros.environment['ROS_HOME'] = str(tmp_path)
    patience = {'safe_latch': True, 'recovery_time': 2.0}
    bench = Bench(ros, {**patience, 'measurement_timeout': 0.3, 'hold_timeout': 0.2})
    found = bench.status(lambda s: 'the safe state is latched' in s.message)
    assert (value(found, 'safe state'), found.level) == ('latched', DiagnosticStatus.ERROR)
    assert bench.process.stop() == 0
    bench = Bench(ros, patience)
    answer = ros.trigger('controller/clear_safe_state')
    assert not answer.success
    assert 'the safe state was reached before the restart' in answer.message
    for k in range(2, 5):
        assert bench.measure(STEADY, float(k)).temperature < STEADY
    bench.status(lambda s: 'clear it on the panel or by the service' in s.message)
    assert ros.trigger('controller/clear_safe_state').success
    bench.measure(STEADY, 5.0)
    assert value(bench.status(), 'active law') == 'learned law'
    ros.wait_until(lambda: not [*tmp_path.rglob('*.latched')])


def test_the_quality_of_a_measurement_is_taken_into_account_and_recorded(
        ros: Harness, run_node: RunNode) -> None:
    records = ros.listen(String, topics.EVENT_LOG)
    bench = Bench(ros, {
        'temperature.quality_topic': 'temperature_quality',
        'temperature.quality_type': 'diagnostic_msgs/msg/DiagnosticStatus'}, run_node=run_node)
    quality = ros.speak(DiagnosticStatus, 'temperature_quality', to='controller')
    for time, level, severity, words in (
            (2.0, DiagnosticStatus.ERROR, DiagnosticStatus.ERROR, 'temperature is bad'),
            (3.0, DiagnosticStatus.WARN, DiagnosticStatus.WARN, 'temperature is uncertain'),
            (4.0, DiagnosticStatus.OK, DiagnosticStatus.OK, 'automatic')):
        quality.publish(DiagnosticStatus(level=level))
        ros.meet('controller')
        bench.measure(STEADY, time)
        assert bench.status(lambda s, words=words: words in s.message).level == severity
    ros.wait_until(lambda: '"stamp_ns":4000000000' in ''.join(m.data for m in records))
    assert [record.fields['quality'] for record in reproduced(records)[0]
            if record.event == 'measurement'][-3:] == [[2], [1], None]


def test_a_loop_runs_on_its_own_clock_with_a_sensor_that_reports_on_change(
        ros: Harness, run_node: RunNode) -> None:
    run_node(ControllerNode, {
        'temperature.report_on_change': 60.0, 'temperature.deadband': 0.2, 'sample_time': 0.5,
        'measurement_timeout': 5.0, 'coolant_temperature.rate_limit': 0.0, 'use_sim_time': True})
    commands = ros.listen(Temperature, reactor.COOLANT_SETPOINT)
    clock, ask, manual, thermometer = (
        ros.speak(kind, topic, to='controller') for kind, topic in (
            (Clock, topics.CLOCK), (Temperature, reactor.SETPOINT),
            (Temperature, reactor.MANUAL_COOLANT_SETPOINT), (Temperature, reactor.TEMPERATURE)))
    now = 10.0

    def pass_until(condition: Callable[[], bool], step: float = 0.25) -> None:
        def found() -> bool:
            nonlocal now
            now += step
            clock.publish(Clock(clock=temperature(0.0, now).header.stamp))
            return condition()

        ros.wait_until(found)

    def told(level: bytes, words: str) -> bool:
        status = ros.last_status(STATUS)
        return status is not None and status.level == level and words in status.message

    # stamped by another clock, and the only one
    thermometer.publish(temperature(STEADY, 5.0))
    pass_until(lambda: len(commands) > 5)
    assert np.diff([seconds(m) for m in commands]).min() >= 0.25
    held = commands[-1].temperature
    ask.publish(temperature(STEADY - 5.0))
    pass_until(lambda: commands[-1].temperature < held - 1.0)
    ros.set_bool('controller/set_automatic', False)
    manual.publish(temperature(20.0))
    pass_until(lambda: commands[-1].temperature == pytest.approx(20.0))
    pass_until(lambda: told(DiagnosticStatus.OK, 'manual'))
    # behind its heartbeat the signal is missing
    pass_until(lambda: told(
        DiagnosticStatus.ERROR, 'no measurement of temperature for more than 5 s'), 2.0)
    # it was received before the first /clock, and waited for by a clock of 0.5 s
    assert now >= 60.0 + 5.0 - 0.5
    # a clock that is set back to before its last report makes it no newer
    reported = now = now + 1000.0
    thermometer.publish(temperature(STEADY, 5.0))
    pass_until(lambda: told(DiagnosticStatus.OK, 'manual'))
    pass_until(lambda: told(DiagnosticStatus.ERROR, 'no measurement of temperature'), 2.0)

    def silence() -> float:
        return float(value(ros.last_status(STATUS), 'since last measurement [s]'))

    now, before = reported - 500.0, silence()
    pass_until(lambda: silence() > before + 1.5, 0.01)
    assert now < reported


def test_a_setpoint_without_a_stamp_takes_effect_at_once(ros: Harness, run_node: RunNode) -> None:
    run_node(ControllerNode, {
        'temperature.type': 'std_msgs/msg/Float64', 'temperature.unit': 'degC'})
    records = ros.listen(String, topics.EVENT_LOG)
    commands = ros.listen(Temperature, reactor.COOLANT_SETPOINT)
    thermometer, setpoint = (ros.speak(Float64, topic, to='controller') for topic in (
        reactor.TEMPERATURE, reactor.SETPOINT))
    thermometer.publish(Float64(data=STEADY))
    ros.wait_until(lambda: commands)
    setpoint.publish(Float64(data=STEADY - 5.0))
    # not at its arrival in the time of the measurements, which another clock may give
    ros.wait_until(lambda: [record.fields['stamp_ns'] for record in map(
        parse, (message.data for message in records)) if record.event == 'setpoint'] == [0])


def test_a_signal_reported_on_change_is_in_each_measurement_and_a_late_one_in_the_estimate(
        ros: Harness, run_node: RunNode) -> None:
    run_node(ControllerNode, {
        **PATIENT, 'system': 'two_tanks', 'level_1.report_on_change': 100.0,
        'estimator': 'extended_kalman_filter', 'level_2.analysis_topic': 'laboratory',
        'level_2.analysis_delay': 60.0})
    records = ros.listen(String, topics.EVENT_LOG)
    commands = ros.listen(JointState, 'pump_1_setpoint')
    sensors = {name: ros.speak(JointState, name, to='controller')
               for name in ('level_1', 'level_2', 'laboratory')}

    def send(name: str, metres: float, time: float) -> None:
        message = JointState(name=['level_2' if name == 'laboratory' else name],
                             position=[metres])
        message.header.stamp = temperature(0.0, time).header.stamp
        sensors[name].publish(message)

    send('level_2', 0.15, 1.0)
    # before that of level_1, which completes it
    ros.meet('controller')
    ros.wait_for_status(STATUS, lambda s: 'first measurement of level_1' in s.message)
    send('level_1', 0.12, 0.5)
    ros.meet('controller')
    for time in (2.0, 3.0, 4.0):
        send('level_2', 0.15, time)
    ros.wait_until(lambda: [seconds(message) for message in commands] == [2.0, 3.0, 4.0])
    for time in (2.5, 1.0):
        send('laboratory', 0.16, time)
    ros.wait_until(lambda: [record.fields['accepted'] for record in map(
        parse, (message.data for message in records)) if record.event == 'analysis'] == [
            True, False])


def test_manual_commands_before_a_measurement_and_commands_without_a_subscriber(
        running: Harness) -> None:
    running.set_bool('controller/set_automatic', False)
    manual = running.speak(Temperature, reactor.MANUAL_COOLANT_SETPOINT, to='controller')
    manual.publish(temperature(20.0))
    running.wait_for_status('controller: control', lambda s: (
        'the applied coolant is unknown' in s.message))
    # before the first measurement, from what is applied
    commands = running.listen(Temperature, reactor.COOLANT_SETPOINT)
    coolant = running.speak(
        Temperature, reactor.COOLANT_TEMPERATURE, topics.LATCHED_QOS, to='controller')
    coolant.publish(temperature(20.5, 1.0))
    running.meet('controller')
    manual.publish(temperature(20.0))
    running.wait_until(lambda: commands and (
        commands[-1].temperature == pytest.approx(20.0)))
    assert commands[0].temperature == pytest.approx(20.5)
    running.set_bool('controller/set_automatic', True)
    running.node.destroy_subscription(next(
        own for own in running.node.subscriptions if own.topic_name == '/coolant_setpoint'))
    thermometer = running.speak(Temperature, reactor.TEMPERATURE, to='controller')
    thermometer.publish(temperature(STEADY, 1.0))
    status = running.wait_for_status('controller: control', lambda s: (
        'no subscriber on /coolant_setpoint' in s.message))
    assert status.level == DiagnosticStatus.WARN
