# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The controller as a process: what it answers, and what it tells of itself."""

from dataclasses import replace
import itertools
import math
from pathlib import Path
import re
import time

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

from koopman_ros.core.paths import model_path
from koopman_ros.demo import reactor
from koopman_ros.event_log.records import EventRecord, parse, SNAPSHOT
from koopman_ros.model import load, save
from koopman_ros.nodes.controller import ControllerNode
from koopman_ros.ros import controller_status, signals, topics
from koopman_ros.testing import Harness
from support.controller_bench import Bench, PURE, reproduced, STATUS, STEADY
from support.nodes import RunNode, seconds, temperature, TIMEOUT, until_read, value


@pytest.fixture(scope='module')
def shared_bench(shared_ros: Harness) -> Bench:
    return Bench(shared_ros, PURE)


@pytest.fixture
def bench(shared_bench: Bench) -> Bench:
    """Return a controller at its steady state, which acts by its law alone."""
    shared_bench.start_afresh()
    return shared_bench


def test_each_command_carries_the_stamp_of_its_measurement(bench: Bench) -> None:
    times = [2.0 + 0.125 * k for k in range(50)]
    for k, at in enumerate(times):
        bench.send(STEADY - 0.01 * k, at)
    # whatever else is still on its way would come before the answer to this
    bench.measure(STEADY, 60.0)
    assert [seconds(message) for message in bench.commands] == [1.0, *times, 60.0]
    last = bench.measure(STEADY - 1.0, 61.0).temperature
    assert bench.measure(STEADY, 60.5).temperature == last
    status = bench.status(lambda s: int(value(s, 'late measurements')) >= 1)
    assert status.level == DiagnosticStatus.OK


def test_odd_stamps_are_answered_with_themselves_and_a_long_frame_id_is_cut(
        bench: Bench) -> None:
    message = temperature(STEADY)
    message.header.stamp.sec, message.header.stamp.nanosec = 2, 1_500_000_000
    assert seconds(bench.answer_to(message)) == seconds(message)
    for at in (-2.0 ** 31, -5.25, -4.25):
        assert math.isfinite(bench.measure(STEADY, at).temperature)

    message = temperature(STEADY, 2.0)
    message.header.frame_id = 'x' * 100_000
    assert bench.answer_to(message).header.frame_id == 'x' * 256
    status = bench.ros.wait_for_status(STATUS, lambda s: 'frame_id' in s.message)
    assert status.level == DiagnosticStatus.WARN
    assert 'has 100000 characters; only the first 256 are forwarded' in status.message
    assert bench.measure(STEADY, 3.0).header.frame_id == ''
    bench.ros.wait_for_status(STATUS, lambda s: s.level == DiagnosticStatus.OK)


def test_who_subscribes_is_sent_the_state_twice_where_nothing_happens(bench: Bench) -> None:
    """The first may come before the subscriber knows the controller, and is lost then."""
    heard = bench.ros.listen(String, topics.EVENT_LOG)

    def snapshots() -> list[EventRecord]:
        records = [parse(message.data) for message in heard]
        return [record for record in records if record.event == SNAPSHOT]

    bench.ros.wait_until(lambda: len(snapshots()) > 1)
    # the event of the last measurement comes after its command, perhaps between the two
    others = len(heard) - len(snapshots())
    assert others <= 1
    first, second = snapshots()[:2]
    assert 1 <= second.number - first.number <= 1 + others


def test_first_command_waits_for_the_coolant_in_force(
        ros: Harness, run_node: RunNode, monkeypatch: pytest.MonkeyPatch) -> None:
    """Which has another name here."""
    commands = ros.listen(Temperature, reactor.COOLANT_SETPOINT)
    # patient, or a busy machine could be too slow for it
    monkeypatch.setattr(signals, '_PATIENCE', 100.0)
    run_node(ControllerNode, {}, '-r', f'{reactor.COOLANT_TEMPERATURE}:=jacket')
    coolant = ros.speak(Temperature, 'jacket', topics.LATCHED_QOS, to='controller')
    thermometer = ros.speak(Temperature, reactor.TEMPERATURE, to='controller')
    thermometer.publish(temperature(STEADY, 1.0))
    ros.meet('controller')
    assert not commands
    coolant.publish(temperature(22.0, 1.0))
    ros.wait_until(lambda: commands)
    assert commands[0].temperature == pytest.approx(22.0, abs=1e-9)
    assert seconds(commands[0]) == 1.0


def test_a_setpoint_of_a_volatile_publisher_is_received_and_the_active_one_latched(
        bench: Bench) -> None:
    """`ros2 topic pub` publishes reliable and volatile."""
    late = bench.ros.listen(Temperature, reactor.ACTIVE_SETPOINT, topics.LATCHED_QOS)
    bench.ros.wait_until(lambda: late)
    assert late[0].temperature == pytest.approx(STEADY)
    setpoint = bench.ros.speak(Temperature, reactor.SETPOINT, QoSProfile(
        depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.VOLATILE),
        to='controller')
    setpoint.publish(temperature(45.0))
    bench.measure_until_active(45.0, 2.0)
    assert bench.active_since(45.0) >= 2.0

    bench.ask(80.0)
    status = bench.status(lambda s: 'set-point' in s.message)
    assert status.level == DiagnosticStatus.WARN
    assert 'set-point 80.00 degC is outside the trained range' in status.message
    assert 'the previous set-point is kept' in status.message
    # a plotting tool that does not match hides it no more than it hides that
    latched = bench.ros.node.create_subscription(
        Temperature, reactor.PREDICTED_TEMPERATURE, lambda _: None, topics.LATCHED_QOS)
    bench.ros.wait_for_status('controller: connections', lambda s: 'transient local' in s.message)
    bench.status(lambda s: 'set-point 80.00' in s.message and 'transient local' in s.message)
    bench.ros.wait_for_status('controller: requests', lambda s: 'set-point 80.00' in s.message)
    bench.ros.node.destroy_subscription(latched)
    bench.ros.wait_for_status('controller: connections', lambda s: s.level == DiagnosticStatus.OK)
    # a change would be tracked and said with the first of these, before the next is answered
    bench.settle(STEADY, 100.0)
    assert bench.active == pytest.approx(45.0)


def test_manual_mode_sends_the_command_of_the_operator(bench: Bench) -> None:
    manual = bench.ros.speak(Temperature, reactor.MANUAL_COOLANT_SETPOINT, to='controller')
    at, held = bench.settle(STEADY, 2.0)
    manual.publish(temperature(20.0))
    bench.status(lambda s: s.level == DiagnosticStatus.WARN and 'switch to manual' in s.message)
    assert bench.measure(STEADY, at + 1.0).temperature == pytest.approx(held, abs=1e-6)

    response = bench.ros.set_bool('controller/set_automatic', False)
    assert (response.success, response.message) == (True, 'manual mode')
    held = bench.measure(STEADY, at + 2.0).temperature
    assert bench.measure(STEADY + 1.0, at + 3.0).temperature == held
    manual.publish(temperature(20.0))
    at = bench.measure_until(lambda m: m.temperature == pytest.approx(20.0), at + 4.0)
    status = bench.status(lambda s: s.message.startswith('manual'))
    assert value(status, 'law') == 'none'
    for wild in (90.0, math.nan):
        manual.publish(temperature(wild))
    bench.status(lambda s: 'manual coolant_temperature nan degC is not finite' in s.message)
    manual.publish(temperature(90.0))
    bench.ros.wait_for_status('controller: requests', lambda s: (
        'coolant 90.00 degC is limited to 32.00 degC' in s.message))
    at = bench.measure_until(lambda m: m.temperature == pytest.approx(32.0), at + 1.0)

    assert bench.ros.set_bool('controller/set_automatic', True).message == 'automatic mode'
    at, command = bench.settle(STEADY, at + 1.0)
    assert command == pytest.approx(held, abs=1e-6)
    assert bench.settle(STEADY + 1.0, at + 1.0)[1] < held - 0.3


def test_limits_ramp_and_weights_change_while_the_loop_runs(bench: Bench) -> None:
    held = bench.measure(STEADY, 2.0).temperature
    assert held > 25.0
    bench.ros.set_parameters('controller', **{'coolant_temperature.rate_limit': 0.1})
    assert bench.measure(STEADY + 3.0, 3.0).temperature == pytest.approx(held - 0.1)
    bench.ros.set_parameters('controller', **{
        'coolant_temperature.rate_limit': 1.0, 'coolant_temperature.max': 24.0})
    commands = [bench.measure(STEADY, float(at)).temperature for at in range(4, 10)]
    # at the rate limit of 1 K/s
    assert max(a - b for a, b in itertools.pairwise(commands)) == pytest.approx(1.0)
    assert commands[-1] == pytest.approx(24.0)

    bench.ros.set_parameters('controller', **{'coolant_temperature.max': 32.0})
    at, held = bench.settle(STEADY, 10.0)
    at, before = bench.settle(STEADY + 1.0, at + 1.0)
    bench.ros.set_parameters('controller', **{'coolant_temperature.weight': 100.0})
    at, dear = bench.settle(STEADY + 1.0, at + 1.0)
    assert before < dear < held

    bench.ros.set_parameters('controller', **{'temperature.setpoint_ramp': 0.1})
    bench.ask(STEADY - 10.0)
    for k in range(1, 12):
        bench.measure(STEADY, at + k)
    # 0.1 K/s since the last measurement before
    assert bench.active_since(STEADY - 1.1) == at + 11.0


def test_two_thermometers_of_one_clock_hold_the_coolant_while_both_measure(
        bench: Bench) -> None:
    ros, times = bench.ros, itertools.count(2)
    ros.set_parameters('controller', recovery_time=0.0)
    second = ros.speak(Temperature, reactor.TEMPERATURE, to='controller')

    def held() -> bool:
        at = next(times)
        bench.measure(STEADY, float(at))
        bench.sent += 1
        second.publish(temperature(STEADY + 1.0, at + 0.5))
        ros.wait_until(lambda: seconds(bench.commands[-1]) == at + 0.5)
        return any(status.level == DiagnosticStatus.ERROR and status.message.startswith(
            'the last command is held: two nodes') for status in ros.statuses)

    ros.wait_until(held)
    ros.node.destroy_publisher(second)
    del ros.statuses[:]
    bench.measure_until(lambda _: bool(ros.statuses) and (
        ros.statuses[-1].level != DiagnosticStatus.ERROR), next(times) + 100.0)


def test_operator_requests_act_without_measurements(bench: Bench) -> None:
    ros = bench.ros
    ros.set_parameters('controller', **{
        'coolant_temperature.rate_limit': 4.0, 'temperature.setpoint_ramp': 4.0})
    for k in range(1, 10):
        bench.measure(STEADY, 1.0 + 0.1 * k)
    manual = ros.speak(Temperature, reactor.MANUAL_COOLANT_SETPOINT, to='controller')
    ros.set_bool('controller/set_automatic', False)
    last, held = len(bench.commands) - 1, bench.commands[-1].temperature
    manual.publish(temperature(held - 3.0))
    ros.wait_until(lambda: bench.commands[-1].temperature == pytest.approx(held - 3.0))
    ros.set_bool('controller/set_automatic', True)
    bench.ask(STEADY - 3.0)
    ros.wait_until(lambda: bench.active == pytest.approx(STEADY - 3.0))
    bench.status(lambda s: s.level == DiagnosticStatus.WARN and (
        'the last measurement is' in s.message))
    # at most a second counts for the first command after a silence
    own = bench.commands[last:]
    for before, after in itertools.pairwise(own):
        passed = seconds(after) - seconds(before)
        assert abs(after.temperature - before.temperature) <= 4.0 * min(passed, 1.0) + 1e-6


def test_of_many_requests_at_once_the_status_shows_few(bench: Bench) -> None:
    received = bench.ros.listen(DiagnosticArray, topics.DIAGNOSTICS)
    setpoint = bench.ros.speak(Temperature, reactor.SETPOINT, to='controller')
    began = time.monotonic()
    for k in range(300):
        setpoint.publish(temperature((STEADY, math.nan, 1e6)[k % 3]))
    setpoint.publish(temperature(-40.0))
    bench.status(lambda s: 'set-point -40.00 degC is outside' in s.message)
    # two in each period of the watch, and two more each second
    assert len(received) < 25 * (time.monotonic() - began) + 20


def measure_on(bench: Bench, count: int, first: float) -> float:
    """Measure a falling temperature once a second; return the time of the last."""
    for k in range(count):
        bench.measure(STEADY - 0.02 * k, first + k)
    return first + count - 1


def test_a_setpoint_beyond_the_input_limits_is_reported(bench: Bench) -> None:
    bench.ros.set_parameters('controller', **{
        'observer_bandwidth': 0.1, 'coolant_temperature.max_disturbance': 100.0})
    for k in range(60):
        # a thermometer that does not follow: the observer takes it for a plant that is cooled
        bench.measure(STEADY - 8.0 - 0.01 * (k % 2), 2.0 + k)
    status = bench.status(lambda s: 'would have to be' in s.message)
    assert status.level == DiagnosticStatus.WARN
    needed = re.search(r'the set-point is not reached: the coolant would have to be ([\d.]+) '
                       r'degC, but its range is 5 to 32', status.message)
    assert needed, status.message
    assert float(needed[1]) > 32.0


def test_the_status_has_mode_law_reason_and_figures(bench: Bench) -> None:
    bench.ros.set_parameters('controller', observer_bandwidth=0.1)
    # whole seconds of the clock of the node, so that ages are known
    last = measure_on(bench, 20, float(int(time.time()) - 40))
    status = bench.status()
    figures = {item.key: item.value for item in status.values}
    assert {key: figures[key] for key in (
        'measurements', 'mode', 'active law', 'law', 'reason')} == {
        'measurements': str(bench.sent), 'mode': 'automatic', 'active law': 'learned law',
        'law': 're-centred', 'reason': 'none'}
    assert float(figures['coolant [degC]']) == pytest.approx(
        bench.commands[-1].temperature, abs=1e-6)
    assert float(figures['disturbance [K of coolant]']) < -0.1
    assert 0.0 < abs(float(figures['equivalent sensor bias [K]'])) < math.inf
    assert 0.0 < float(figures['gain norm']) < 1000.0
    assert 0.0 <= float(figures['Riccati residual']) < 1e-8
    assert 0.0 < float(figures['predicted growth per sample']) < 1.0
    assert float(figures['transfer [K]']) == 0.0
    age, answer, latency = (float(figures[key]) for key in (
        'age of measurement [s]', 'latency from arrival to command [s]',
        'latency from stamp to command [s]'))
    assert 0.0 < time.time() - last - age < 10.0
    assert 0.0 < answer < 1.0
    assert latency == pytest.approx(age + answer, abs=1e-6)

    missed = int(value(status, 'missed measurements'))
    bench.measure(STEADY, last + 4.0)
    assert value(bench.status(), 'missed measurements') == str(missed + 3)
    bench.ros.set_parameters('controller', max_measurement_age=1.0)
    bench.status(lambda s: s.level == DiagnosticStatus.WARN and (
        'max_measurement_age allows 1 s' in s.message))
    # with stamps near the wall's, a rate limit would last as long on the way back as on the wall
    bench.ros.set_parameters('controller', observer_bandwidth=0.0, **{
        'coolant_temperature.rate_limit': 0.0})
    bench.settle(STEADY, last + 5.0)


def test_stamps_that_stand_still_and_a_temperature_outside_the_trained_range_are_reported(
        bench: Bench) -> None:
    for _ in range(2):
        bench.measure(STEADY, 2.0)
    bench.status(lambda s: s.level == DiagnosticStatus.WARN and 'does not advance' in s.message)
    bench.measure(STEADY, 3.0)
    bench.status(lambda s: s.level == DiagnosticStatus.OK)
    assert math.isfinite(bench.measure(54.5, 6.0).temperature)
    status = bench.status(lambda s: s.level == DiagnosticStatus.WARN and (
        'outside the trained range' in s.message))
    assert value(status, 'active law') == 'learned law'


def test_of_the_inputs_before_a_dead_time_only_the_last_is_known(bench: Bench) -> None:
    bench.ros.set_parameters('controller', **{'coolant_temperature.dead_time': 25.0})
    bench.measure(STEADY, 2.0)
    status = bench.status(lambda s: value(s, 'dead time [s]') == '25')
    assert value(status, 'effect of inputs before the start ends in [s]') == '24'
    assert value(status, 'dead time change') == 'dead time of coolant_temperature: 0 s -> 25 s'


def test_internals_carry_the_stamp_of_the_measurement(bench: Bench) -> None:
    bench.ros.set_parameters('controller', observer_bandwidth=0.1)
    internals = bench.ros.listen(JointState, topics.CONTROLLER_INTERNALS)
    predicted = bench.ros.listen(Temperature, reactor.PREDICTED_TEMPERATURE)
    bench.ros.meet('controller')
    last = measure_on(bench, 10, 2.0)
    bench.ros.wait_until(lambda: all(
        heard and seconds(heard[-1]) == last for heard in (internals, predicted)))
    # those of the measurement before may have been on their way
    for heard in (internals, predicted):
        assert [seconds(message) for message in heard[-10:]] == [2.0 + k for k in range(10)]
    # what the model expected of a temperature that falls
    assert predicted[-1].temperature == pytest.approx(STEADY - 0.18, abs=0.5)
    assert predicted[-1].temperature != STEADY - 0.02 * 9
    found = {name.split(' [')[0]: position for name, position in zip(
        internals[-1].name, internals[-1].position, strict=True)}
    assert found['estimated_temperature'] == pytest.approx(STEADY - 0.18, abs=0.5)
    assert found['level'] == 0.0
    assert 0.0 < found['gain'] < 1000.0


def test_a_plan_reports_its_active_limits(bench: Bench) -> None:
    plans = bench.ros.listen(JointTrajectory, topics.PREDICTED_TRAJECTORY)
    limits = bench.ros.listen(JointState, topics.ACTIVE_CONSTRAINTS)
    bench.ros.meet('controller')
    bench.ros.set_parameters('controller', **{
        'fallback_order': ['mpc', 'sdre'], 'recovery_time': 0.0,
        'coolant_temperature.rate_limit': 0.1})
    bench.measure(STEADY, 2.0)
    before = bench.measure(STEADY, 3.0).temperature
    # too cold, which takes a coolant that is warmer than it may get at once
    answer = bench.measure(STEADY - 1.5, 4.0)
    assert answer.temperature == pytest.approx(before + 0.1)
    bench.ros.wait_until(lambda: all(
        heard and seconds(heard[-1]) == 4.0 for heard in (plans, limits)))
    plan = plans[-1]
    assert list(plan.joint_names) == ['temperature [degC]', 'coolant_temperature [degC]']
    assert list(plan.points[0].positions) == pytest.approx([STEADY - 1.5, answer.temperature])
    assert plan.points[-1].positions[0] == pytest.approx(STEADY, abs=0.1)
    assert dict(zip(limits[-1].name, limits[-1].position, strict=True)) == {
        'at_range_coolant_temperature [-1 lower, 1 upper]': 0.0,
        'at_rate_coolant_temperature [-1 falling, 1 rising]': 1.0,
        'at_limit_temperature [-1 lower, 1 upper]': 0.0}
    # none of another law
    bench.ros.set_parameters('controller', fallback_order=['sdre', 'linear'])
    bench.measure(STEADY, 5.0)
    bench.ros.meet('controller')
    assert seconds(plans[-1]) == 4.0


def test_a_safe_coolant_outside_the_training_range_is_reported(
        bench: Bench, tmp_path: Path) -> None:
    bench.ros.wait_for_status(STATUS, lambda s: value(s, 'safe input') == 'within reach')
    model = load(model_path('reactor_nz4'))
    lower, upper = model.states.center - 1.5, model.states.center + 1.5
    narrow = tmp_path / 'narrow.safetensors'
    save(replace(model, states=replace(model.states, lower=lower, upper=upper)), narrow)
    # accepted nevertheless
    assert until_read(lambda: bench.ros.set_parameters_atomically(
        'controller', model=str(narrow))).successful
    words = 'under coolant_temperature.safe_value = 5 degC'
    status = bench.ros.wait_for_status(STATUS, lambda s: words in value(s, 'safe input'))
    assert 'leaves the trained range' in value(status, 'safe input')
    bench.ros.wait_until(lambda: words in bench.process.output())
    bench.ros.set_parameters('controller', **{'coolant_temperature.safe_value': 27.0})
    bench.ros.wait_for_status(STATUS, lambda s: value(s, 'safe input') == 'within reach')
    assert until_read(lambda: bench.ros.set_parameters_atomically(
        'controller', model='reactor_nz4')).successful


def test_two_controllers_report_each_other_while_both_run(
        ros: Harness, run_node: RunNode, monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside a best-effort thermometer, and a coolant that is promised and never told."""
    ros.node.create_publisher(Temperature, reactor.COOLANT_TEMPERATURE, topics.LATCHED_QOS)
    bench = Bench(ros, qos=QoSProfile(
        depth=10, reliability=ReliabilityPolicy.BEST_EFFORT), run_node=run_node)
    assert bench.commands[0].temperature > 25.0
    # only the first measurement waited for the coolant
    monkeypatch.setattr('koopman_ros.ros.signals._PATIENCE', 10.0 * TIMEOUT)
    for k in range(2, 12):
        bench.measure(STEADY - 1.0, float(k))
    # the temperature first measured is held
    assert bench.active == pytest.approx(STEADY)
    bench.status(lambda s: s.message.startswith('automatic, no set-point yet'))

    second = ros.start('controller', arguments=('-r', '__node:=controller_2'))
    ros.meet('controller_2')
    bench.measure(STEADY, 12.0)
    for name in ('controller', 'controller_2'):
        # names come a moment after their topics
        status = ros.wait_for_status(f'{name}: control', lambda s: (
            'stop all but one' in s.message and 'another node' not in s.message))
        assert status.level == DiagnosticStatus.WARN
        # a busy machine may also complain of the age of the last measurement
        assert status.message.startswith(
            '2 nodes command the coolant: /controller, /controller_2; stop all but one')
    assert '2 nodes command the coolant' in second.output()
    assert second.stop() == 0
    ros.wait_for_status(STATUS, lambda s: s.level == DiagnosticStatus.OK)


def test_a_measured_disturbance_that_fails_is_a_warning_and_the_loop_runs_on(
        ros: Harness, run_node: RunNode) -> None:
    recorded = ros.listen(String, topics.EVENT_LOG)
    bench = Bench(ros, {'model': 'reactor_feed', 'feed_temperature.sensor_max': 120.0,
                        'feed_temperature.timeout': 5.0, 'stuck_sensor_timeout': 0.0},
                  run_node=run_node)
    feed = ros.speak(Temperature, 'feed_temperature', to='controller')
    at = 1.0
    for celsius, words in (
            (None, 'no measurement of feed_temperature yet'), (78.0, ''),
            (math.nan, 'feed_temperature is nan'), (79.0, ''), (130.0, 'outside the range'),
            (79.5, ''), (None, 'no measurement of feed_temperature for more than 5 s')):
        for _ in range(8):
            at += 1.0
            if celsius is not None:
                feed.publish(temperature(celsius, at))
            bench.measure(STEADY, at)
        bench.status(lambda status, words=words: words in status.message and (
            status.level == (DiagnosticStatus.WARN if words else DiagnosticStatus.OK)))
    status = bench.status()
    assert value(status, 'active law') == 'learned law'
    assert float(value(status, 'feed_temperature [degC]')) == pytest.approx(79.5)
    reproduced(recorded)


def test_a_sender_of_manual_commands_that_has_gone_is_a_warning(bench: Bench) -> None:
    manual = bench.ros.speak(Temperature, reactor.MANUAL_COOLANT_SETPOINT, to='controller')
    assert bench.ros.set_bool('controller/set_automatic', False).success
    manual.publish(temperature(20.0))
    bench.ros.wait_until(lambda: bench.commands[-1].temperature == pytest.approx(20.0))
    bench.ros.wait_for_status('controller: requests', lambda s: s.level == DiagnosticStatus.OK)
    bench.ros.node.destroy_publisher(manual)
    bench.ros.wait_for_status('controller: requests', lambda s: (
        s.level == DiagnosticStatus.WARN and 'has gone' in s.message))
    assert bench.ros.set_bool('controller/set_automatic', True).success
    bench.ros.wait_for_status('controller: requests', lambda s: s.level == DiagnosticStatus.OK)


def test_of_two_clocks_one_may_have_died_and_diagnostics_have_their_time(
        ros: Harness, run_node: RunNode, monkeypatch: pytest.MonkeyPatch,
        capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(controller_status, '_PATIENCE', 0.5)
    clocks = [ros.node.create_publisher(Clock, '/clock', topics.CLOCK_QOS) for _ in range(2)]
    arrays = ros.listen(DiagnosticArray, '/diagnostics')
    run_node(ControllerNode, {'use_sim_time': True})
    seconds = itertools.count(1000)

    def said(task: str, words: str) -> bool:
        clocks[0].publish(Clock(clock=temperature(0.0, next(seconds)).header.stamp))
        status = ros.last_status(f'controller: {task}')
        return status is not None and status.level == DiagnosticStatus.WARN and (
            words in status.message)

    ros.wait_until(lambda: said('connections', '2 nodes publish the time: /bench, /bench'))
    assert '[WARN]' in next(line for line in capfd.readouterr().err.splitlines()
                            if '2 nodes publish the time' in line)
    ros.wait_until(lambda: said('connections', 'has died'))
    # no measurement that is old, as there was none
    ros.wait_until(lambda: said('measurements', 'no measurement was received for'))
    ros.wait_until(lambda: arrays and arrays[-1].header.stamp.sec >= 1000)
