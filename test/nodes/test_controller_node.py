# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The controller as a process: what it answers to measurements, set-points and operators."""

import itertools
import math

from diagnostic_msgs.msg import DiagnosticStatus
import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Temperature

from koopman_ros.ros import topics
from koopman_ros.testing import Harness
from support.controller_bench import Bench, STATUS, STEADY
from support.messages import seconds, temperature, value


@pytest.fixture(scope='module')
def shared_bench(shared_ros: Harness) -> Bench:
    return Bench(shared_ros)


@pytest.fixture
def bench(shared_bench: Bench) -> Bench:
    """Return a controller at its steady state, which acts by its law alone."""
    shared_bench.start_afresh()
    return shared_bench


def test_each_command_carries_the_stamp_of_its_measurement(bench: Bench) -> None:
    times = [2.0 + 0.125 * k for k in range(50)]
    for k, time in enumerate(times):
        bench.send(STEADY - 0.01 * k, time)
    # whatever else is still on its way would come before the answer to this
    bench.measure(STEADY, 60.0)
    assert [seconds(message) for message in bench.commands] == [1.0, *times, 60.0]


def test_setpoint_of_a_volatile_publisher_is_heard_and_the_active_one_latched(
        bench: Bench) -> None:
    """`ros2 topic pub` publishes reliable and volatile."""
    late = bench.ros.listen(Temperature, topics.ACTIVE_SETPOINT, topics.LATCHED_QOS)
    bench.ros.wait_until(lambda: late)
    assert late[0].temperature == pytest.approx(STEADY)
    setpoint = bench.ros.speak(Temperature, topics.SETPOINT, QoSProfile(
        depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.VOLATILE),
        to='controller')
    setpoint.publish(temperature(45.0))
    bench.measure_until_active(45.0, 2.0)
    assert bench.active_since(45.0) >= 2.0


@pytest.mark.parametrize(('asked', 'words'), [
    (80.0, 'set-point 80.00 degC is outside the trained range'),
    (math.nan, 'set-point nan degC is not finite'),
])
def test_bad_setpoint_is_refused_and_the_old_one_kept(bench: Bench, asked: float, words: str
                                                      ) -> None:
    bench.ask(45.0)
    bench.measure_until_active(45.0, 2.0)
    bench.ask(asked)
    status = bench.refusal()
    assert status.level == DiagnosticStatus.WARN
    assert words in status.message
    assert 'the old one is kept' in status.message
    # a change would be tracked and said with the first of these, before the next is answered
    bench.settle(STEADY, 100.0)
    assert bench.active == pytest.approx(45.0)


def test_scheduled_setpoint_takes_effect_at_its_stamp_until_one_for_now_ends_the_schedule(
        bench: Bench) -> None:
    bench.ask(46.0, time=8.0)
    bench.ask(47.0, time=4.0)
    bench.ask(49.0, time=11.0)
    for k in range(2, 10):
        bench.measure(STEADY, float(k))
    assert bench.active_since(47.0) == 4.0
    assert bench.active_since(46.0) == 8.0
    bench.ask(48.0)
    for k in range(10, 13):
        bench.measure(STEADY, float(k))
    assert bench.active_since(48.0) == 10.0
    assert bench.active == pytest.approx(48.0)


def test_measurement_out_of_order_repeats_the_command(bench: Bench) -> None:
    last = bench.measure(STEADY - 1.0, 3.0).temperature
    assert bench.measure(STEADY, 2.5).temperature == last
    status = bench.status(lambda s: int(value(s, 'late measurements')) >= 1)
    assert status.level == DiagnosticStatus.OK


def test_stamp_that_does_not_advance_is_reported(bench: Bench) -> None:
    for _ in range(2):
        bench.measure(STEADY, 2.0)
    status = bench.status(lambda s: 'does not advance' in s.message)
    assert status.level == DiagnosticStatus.WARN
    bench.measure(STEADY, 3.0)
    bench.status(lambda s: s.level == DiagnosticStatus.OK)


def test_temperature_outside_the_trained_range_is_reported(bench: Bench) -> None:
    assert math.isfinite(bench.measure(54.5, 2.0).temperature)
    status = bench.status(lambda s: s.level == DiagnosticStatus.WARN)
    assert 'outside the trained range' in status.message
    assert value(status, 'active law') == 'learned law'


def test_before_the_first_setpoint_the_temperature_is_held(ros: Harness) -> None:
    """That of a best-effort thermometer, here, which is heard by an override."""
    best_effort = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    override = 'qos_overrides./temperature.subscription.reliability:=best_effort'
    bench = Bench(ros, arguments=('-p', override), qos=best_effort)
    assert bench.active == pytest.approx(STEADY)
    bench.measure(STEADY - 1.0, 2.0)
    assert bench.active == pytest.approx(STEADY)
    bench.status(lambda s: s.message.startswith('automatic, no set-point yet'))


def test_long_frame_id_is_cut_and_reported(bench: Bench) -> None:
    message = temperature(STEADY, 2.0)
    message.header.frame_id = 'x' * 100_000
    bench.thermometer.publish(message)
    command = bench.ros.wait_until(
        lambda: next((m for m in bench.commands if seconds(m) == 2.0), None))
    assert command.header.frame_id == 'x' * 256
    status = bench.ros.wait_for_status(STATUS, lambda s: 'frame_id' in s.message)
    assert status.level == DiagnosticStatus.WARN
    assert 'has 100000 characters, of which 256 are passed on' in status.message
    assert bench.measure(STEADY, 3.0).header.frame_id == ''
    bench.ros.wait_for_status(STATUS, lambda s: s.level == DiagnosticStatus.OK)


def test_odd_stamps_are_answered_with_themselves(bench: Bench) -> None:
    message = temperature(STEADY)
    message.header.stamp.sec, message.header.stamp.nanosec = 2, 1_500_000_000
    bench.thermometer.publish(message)
    command = bench.ros.wait_until(
        lambda: next((m for m in bench.commands if seconds(m) == 3.5), None))
    assert command.header.stamp == message.header.stamp
    for time in (-2.0 ** 31, -5.25, -4.25):
        assert math.isfinite(bench.measure(STEADY, time).temperature)


def test_manual_mode_commands_what_the_operator_asks(bench: Bench) -> None:
    held = bench.measure(STEADY, 2.0).temperature
    response = bench.ros.set_bool('controller/set_automatic', False)
    assert (response.success, response.message) == (True, 'manual mode')
    assert bench.measure(STEADY + 1.0, 3.0).temperature == held

    manual = bench.ros.speak(Temperature, topics.MANUAL_COOLANT_SETPOINT, to='controller')
    manual.publish(temperature(20.0))
    time = bench.measure_until(lambda command: command.temperature == pytest.approx(20.0), 4.0)
    status = bench.status(lambda s: s.message.startswith('manual'))
    assert value(status, 'law') == 'none'

    assert bench.ros.set_bool('controller/set_automatic', True).message == 'automatic mode'
    time, command = bench.settle(STEADY, time + 1.0)
    assert command == pytest.approx(held, abs=1e-6)
    assert bench.settle(STEADY + 1.0, time + 1.0)[1] < held - 0.3


def test_manual_command_is_refused_in_automatic_mode(bench: Bench) -> None:
    manual = bench.ros.speak(Temperature, topics.MANUAL_COOLANT_SETPOINT, to='controller')
    held = bench.settle(STEADY, 2.0)[1]
    manual.publish(temperature(20.0))
    status = bench.status(lambda s: 'switch to manual mode' in s.message)
    assert status.level == DiagnosticStatus.WARN
    assert bench.measure(STEADY, 1000.0).temperature == pytest.approx(held, abs=1e-6)


def test_manual_command_stays_within_the_limits(bench: Bench) -> None:
    bench.ros.set_parameters('controller', coolant_max=28.0)
    bench.ros.set_bool('controller/set_automatic', False)
    manual = bench.ros.speak(Temperature, topics.MANUAL_COOLANT_SETPOINT, to='controller')
    for wild in (90.0, math.nan):
        manual.publish(temperature(wild))
    bench.status(lambda s: 'manual coolant_temperature nan degC is not finite' in s.message)
    assert bench.measure(STEADY, 1000.0).temperature == pytest.approx(28.0)


def test_limits_change_while_the_loop_runs(bench: Bench) -> None:
    held = bench.measure(STEADY, 2.0).temperature
    assert held > 25.0
    bench.ros.set_parameters('controller', coolant_rate_limit=6.0)
    assert bench.measure(STEADY + 3.0, 3.0).temperature == pytest.approx(held - 0.1)
    bench.ros.set_parameters('controller', coolant_rate_limit=60.0, coolant_max=24.0)
    commands = [bench.measure(STEADY, float(time)).temperature for time in range(4, 10)]
    # at the rate limit of 1 K/s
    assert max(before - now for before, now in itertools.pairwise(commands)) == pytest.approx(1.0)
    assert commands[-1] == pytest.approx(24.0)


def test_setpoint_ramp_changes_while_the_loop_runs(bench: Bench) -> None:
    bench.ros.set_parameters('controller', setpoint_ramp=6.0)
    bench.ask(STEADY - 10.0)
    for k in range(2, 13):
        bench.measure(STEADY, float(k))
    # 0.1 K/s since the measurement at 1 s
    assert bench.active_since(STEADY - 1.1) == 12.0


def test_weights_change_while_the_loop_runs(bench: Bench) -> None:
    """A dear coolant moves less."""
    hot = STEADY + 1.0
    time, held = bench.settle(STEADY, 2.0)
    time, before = bench.settle(hot, time + 1.0)
    bench.ros.set_parameters('controller', coolant_weight=100.0)
    time, dear = bench.settle(hot, time + 1.0)
    bench.ros.set_parameters('controller', temperature_weight=10000.0)
    time, eager = bench.settle(hot, time + 1.0)
    assert eager < before < dear < held
