# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The player as a process: recorded inputs into a fresh controller, which answers as before."""

from collections.abc import Sequence
from pathlib import Path
import time
from typing import Any

import pytest
from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Temperature

from koopman_ros.bags import (
    BagWriter,
    INFINITE_NS,
    message_definition,
    QosProfile,
    read_messages,
    read_series,
    summary,
)
from koopman_ros.nodes import player
from koopman_ros.parameters.player import PlayerParameters
from koopman_ros.resources import config_directory
from koopman_ros.ros import topics
from koopman_ros.ros.codec import stamp_nanoseconds
from koopman_ros.testing import Harness
from koopman_ros.units import NANOSECONDS
from support.messages import temperature, TIMEOUT
from support.processes import complaint, run_here

SAMPLES = 61
TEMPERATURE = 'sensor_msgs/msg/Temperature'


def write_bag(path: Path, entries: Sequence[tuple[str, Temperature, float]],
              offered: Sequence[QosProfile] = ()) -> Path:
    """Write temperatures: (topic, message, seconds of receipt)."""
    with BagWriter(path) as writer:
        for topic, message, received in entries:
            writer.add_topic(topic, message_definition(TEMPERATURE), offered)
            writer.write(topic, serialize_message(message), round(received * NANOSECONDS))
    return path


def play(ros: Harness, bag: Path, *, arguments: tuple[str, ...] = (), **parameters: Any) -> str:
    """Play a bag to its end, which is a good one; return what the player said."""
    process = ros.start('player', {'bag': bag, **parameters}, arguments)
    assert ros.wait_for_end(process) == 0
    return process.output()


def stamps(messages: Sequence[Any]) -> list[int]:
    return [stamp_nanoseconds(message.header.stamp) for message in messages]


def test_lockstep_gives_bit_identical_commands(ros: Harness, recorded_loop: Path) -> None:
    recorded = read_series(recorded_loop, '/coolant_setpoint')
    commands = ros.listen(Temperature, topics.COOLANT_SETPOINT)
    ros.start('controller', {'observer_bandwidth': 0.0})
    ros.meet('controller')
    said = play(ros, recorded_loop, rate=0.0)
    ros.wait_until(lambda: len(commands) >= SAMPLES)
    assert stamps(commands) == recorded.stamp_ns.tolist()
    assert [command.temperature for command in commands] == recorded.values.tolist()
    # the coolant in force with each measurement, and one set-point
    inputs = {f'/{name}' for name in PlayerParameters().topics}
    counts = summary(recorded_loop).counts
    assert f'played {sum(counts[topic] for topic in inputs & set(counts))} messages' in said


def test_lockstep_waits_for_requests_alone(
        ros: Harness, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """To wait until a message is received takes 0.1 s with some middlewares."""
    bag = write_bag(tmp_path / 'bag.mcap', [
        (topic, temperature(celsius, stamp), float(k)) for k in range(1, 21)
        for topic, celsius, stamp in [
            ('/coolant_temperature', 22.0, float(k)), ('/temperature', 50.0 + 0.1 * k, float(k)),
            *([('/setpoint', 49.0, 0.0)] if k in (5, 6) else [])]],
        [QosProfile(durability='transient_local', depth=1)])
    waits: list[str] = []
    wait = Publisher.wait_for_all_acked

    def counted(publisher: Publisher, timeout: Duration) -> bool:
        waits.append(publisher.topic_name)
        return wait(publisher, timeout)

    monkeypatch.setattr(Publisher, 'wait_for_all_acked', counted)
    ros.start('controller')
    assert player.main(['player', '--ros-args', '-p', f'bag:={bag}', '-p', 'rate:=0.0']) == 0
    # and at the start, until the subscribers have found each topic, and at the end
    assert waits[:-3] == ['/coolant_temperature', '/setpoint', '/setpoint']
    assert sorted(waits[-3:]) == ['/coolant_temperature', '/setpoint', '/temperature']


def test_messages_are_played_byte_for_byte_with_the_shipped_parameter_file(
        ros: Harness, recorded_loop: Path) -> None:
    heard = ros.listen(Temperature, 'played/temperature', raw=True)
    play(ros, recorded_loop, arguments=(
        '-r', '__ns:=/played', '--params-file', str(config_directory() / 'player.yaml'),
        '-p', f'bag:={recorded_loop}', '-p', 'rate:=10000.0', '-p', 'topics:=[temperature]'))
    ros.wait_until(lambda: len(heard) >= SAMPLES)
    assert heard == [entry.data for entry in read_messages(recorded_loop, ['/temperature'])]


def test_live_answers_come_within_a_sample(ros: Harness, tmp_path: Path) -> None:
    """A sample a second, four times as fast."""
    rate, count = 4.0, 11
    bag = write_bag(tmp_path / 'slow.mcap', [
        ('/temperature', temperature(50.0 - 0.1 * k, float(k)), float(k)) for k in range(count)])
    commands = ros.listen(Temperature, topics.COOLANT_SETPOINT)
    arrived: dict[str, dict[int, float]] = {topics.TEMPERATURE: {}, topics.COOLANT_SETPOINT: {}}
    for topic, times in arrived.items():
        ros.node.create_subscription(
            Temperature, topic, lambda message, times=times: times.setdefault(
                stamp_nanoseconds(message.header.stamp), time.monotonic()), topics.LOOP_QOS)
    ros.start('controller')
    ros.meet('controller')
    process = ros.start('player', {'bag': bag, 'rate': rate, 'wait_for_subscribers': 2})
    # three subscriptions, which need not hear of the last one in this order
    ros.wait_until(lambda: min(len(commands), *map(len, arrived.values())) >= count)
    assert ros.wait_for_end(process) == 0
    measured, commanded = arrived.values()
    times = list(measured.values())
    # the first one may come late on a busy machine, but none before its time
    assert times[-1] - times[0] > 0.75 * (count - 1.0) / rate
    in_time = [commanded[stamp] < after for stamp, after in zip(measured, times[1:], strict=False)]
    assert sum(in_time) > count // 2
    # the controller holds the temperature first measured: there is no request in this bag
    assert stamps(commands) == list(measured)


def test_clock_shows_the_stamp_of_each_measurement_before_it(ros: Harness, tmp_path: Path
                                                             ) -> None:
    bag = write_bag(tmp_path / 'bag.mcap', [
        ('/temperature', temperature(50.0, 100.0), 1.0),
        # a request for later does not move the time
        ('/setpoint', temperature(45.0, 900.0), 1.1),
        ('/temperature', temperature(50.0, 101.0), 1.2),
        ('/temperature', temperature(50.0, 20.0), 1.3)])
    ticks = ros.listen(Clock, topics.CLOCK, topics.CLOCK_QOS)
    heard = ros.listen(Temperature, topics.TEMPERATURE)
    ros.listen(Temperature, topics.SETPOINT)
    play(ros, bag, clock=True)
    ros.wait_until(lambda: len(heard) >= 3 and ticks and ticks[-1].clock.sec == 20)
    # single ticks may be lost, and the first ones before the bench is known
    assert [tick.clock.sec for tick in ticks] in (
        [100, 101, 20], [101, 20], [100, 20], [20])


def test_order_is_that_of_receipt_and_the_offset_leaves_out_the_beginning(
        ros: Harness, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / 'bag.mcap', [
        ('/temperature', temperature(float(k), float(k)), received)
        for k, received in [(0, 10.0), (3, 10.8), (1, 10.4), (2, 10.6), (4, 1.0)]])
    heard = ros.listen(Temperature, topics.TEMPERATURE)
    play(ros, bag, rate=100.0)
    # the recorder's clock was set back by more than it can have fallen behind: a later part
    ros.wait_until(lambda: len(heard) >= 5)
    assert [message.temperature for message in heard] == [0.0, 1.0, 2.0, 3.0, 4.0]
    heard.clear()
    play(ros, bag, rate=100.0, start_offset=9.5)
    ros.wait_until(lambda: len(heard) >= 2)
    assert [message.temperature for message in heard] == [2.0, 3.0]


@pytest.mark.parametrize(('offered', 'reliability', 'durability'), [
    ((), ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE),
    ((QosProfile(reliability='best_effort'),),
     ReliabilityPolicy.BEST_EFFORT, DurabilityPolicy.VOLATILE),
    ((QosProfile(durability='transient_local', depth=1),),
     ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL),
    ((QosProfile(reliability='best_effort'), QosProfile(deadline_ns=INFINITE_NS)),
     ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE),
])
def test_offer_is_that_of_the_recorded_publishers(
        offered: tuple[QosProfile, ...], reliability: ReliabilityPolicy,
        durability: DurabilityPolicy) -> None:
    profile = player.recorded_offer(offered)
    assert (profile.reliability, profile.durability) == (reliability, durability)


def test_bag_in_a_namespace_is_played_into_another_controller(
        ros: Harness, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / 'bag.mcap', [
        ('/unit_1/temperature', temperature(51.0 - k, 1.0 + k), float(k)) for k in range(5)])
    commands = ros.listen(Temperature, '/unit_2/coolant_setpoint')
    ros.start('controller', arguments=('-r', '__ns:=/unit_2'))
    ros.meet('unit_2/controller')
    play(
        ros, bag, rate=0.0, topics=['/unit_1/temperature'], measurement='/unit_1/temperature',
        answer='/unit_2/coolant_setpoint',
        arguments=('-r', '/unit_1/temperature:=/unit_2/temperature'))
    ros.wait_until(lambda: len(commands) >= 5)


@pytest.mark.parametrize(('parameters', 'words'), [
    ({'bag': 'none.mcap'}, "cannot start: bag 'none.mcap' does not exist"),
    ({'topics': ['pressure']}, 'no message on /pressure: choose topics among /temperature'),
    ({'topics': ['a b']}, 'cannot start: topics: Invalid topic name'),
    ({'rate': -1.0}, 'rate = -1.0 must be 0, or in [1e-06, 10000]'),
    ({'wait_timeout': 0.1}, '/temperature found no counterpart within 0.1 s: start the'),
    ({'wait_for_subscribers': 0, 'rate': 0.0, 'answer_timeout': 0.1},
     'no command for the measurement at 1.000 s within 0.1 s: is the controller alive?'),
])
def test_what_cannot_be_played_is_refused_in_one_line(
        tmp_path: Path, capfd: pytest.CaptureFixture[str], parameters: dict[str, Any], words: str
        ) -> None:
    write_bag(tmp_path / 'bag.mcap', [('/temperature', temperature(50.0, 1.0), 1.0)])
    assert run_here(player, **{'bag': tmp_path / 'bag.mcap', **parameters}) == 1
    assert words in complaint(capfd)


def test_damage_on_the_way_is_told_in_one_line(
        tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    bag = write_bag(tmp_path / 'bag.mcap', [
        ('/temperature', temperature(50.0, float(k)), float(k)) for k in range(100)])
    content = bytearray(bag.read_bytes())
    content[len(content) // 3] ^= 1
    bag.write_bytes(content)
    assert run_here(player, bag=bag, rate=1000.0, wait_for_subscribers=0) == 1
    assert 'is damaged' in complaint(capfd)


def test_signal_ends_it(ros: Harness, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / 'bag.mcap', [
        ('/temperature', temperature(50.0, float(k)), 3600.0 * k) for k in range(2)])
    heard = ros.listen(Temperature, topics.TEMPERATURE)
    process = ros.start('player', {'bag': bag})
    ros.wait_until(lambda: heard)
    before = time.monotonic()
    assert process.stop() == 0
    assert time.monotonic() - before < TIMEOUT / 3.0
