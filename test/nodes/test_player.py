# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The player as a process: recorded inputs into a fresh controller, which answers as before."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
import time
from typing import Any

from mcap.writer import CompressionType, IndexType, Writer
import pytest
from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Temperature

from koopman_ros.bags import (
    BagReadError,
    BagWriter,
    INFINITE_NS,
    loop_episodes,
    message_definition,
    QosProfile,
    read_messages,
    read_series,
)
from koopman_ros.demo.loop import run_loop, Scenario
from koopman_ros.nodes import player, replay
from koopman_ros.resources import config_directory
from koopman_ros.ros import topics
from koopman_ros.ros.codec import stamp_nanoseconds
from koopman_ros.testing import Harness, isolated_domain, NodeProcess
from koopman_ros.units import NANOSECONDS
from support.messages import temperature, TIMEOUT

SAMPLES = 61
SCENARIO = Scenario('reactor_nz4', 315.15, step_time=20.0, duration=SAMPLES - 1.0,
                    plant={'noise': 0.05, 'seed': 5})
TEMPERATURE = 'sensor_msgs/msg/Temperature'


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record a minute of a closed loop with a step of the set-point."""
    folder = tmp_path_factory.mktemp('recorded')
    run_loop(SCENARIO, folder / 'loop.mcap', folder)
    return folder / 'loop.mcap'


def write_bag(path: Path, entries: Sequence[tuple[str, Temperature, float]],
              offered: Sequence[QosProfile] = ()) -> Path:
    """Write temperatures: (topic, message, seconds of receipt)."""
    with BagWriter(path) as writer:
        for topic, message, received in entries:
            writer.add_topic(topic, message_definition(TEMPERATURE), offered)
            writer.write(topic, serialize_message(message), round(received * NANOSECONDS))
    return path


def play(ros: Harness, bag: Path, *, arguments: tuple[str, ...] = (), **parameters: Any
         ) -> NodeProcess:
    return ros.start('player', {'bag': bag, **parameters}, arguments)


def refusal(ros: Harness, process: NodeProcess) -> str:
    """Wait until the player gives up; return the one line that it says."""
    assert ros.wait_for_end(process) == 1
    lines = [line for line in process.output().splitlines() if line.startswith('player: ')]
    assert len(lines) == 1
    assert 'Traceback' not in process.output()
    return lines[0]


def stamps(messages: Sequence[Any]) -> list[int]:
    return [stamp_nanoseconds(message.header.stamp) for message in messages]


def test_lockstep_gives_the_recorded_commands_to_the_bit(ros: Harness, bag: Path) -> None:
    recorded = read_series(bag, '/coolant_setpoint')
    commands = ros.listen(Temperature, topics.COOLANT_SETPOINT)
    ros.start('controller', {'observer_bandwidth': 0.0})
    ros.meet('controller')
    process = play(ros, bag, rate=0.0)
    assert ros.wait_for_end(process) == 0
    ros.wait_until(lambda: len(commands) >= SAMPLES)
    assert stamps(commands) == recorded.stamp_ns.tolist()
    assert [command.temperature for command in commands] == recorded.values.tolist()
    # the coolant in force with each measurement, and one set-point
    assert f'played {2 * SAMPLES + 1} messages' in process.output()


def test_lockstep_waits_for_requests_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch
                                           ) -> None:
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
    with isolated_domain() as environment, NodeProcess(
            'controller', {}, tmp_path / 'controller.log', environment):
        assert player.main(['player', '--ros-args', '-p', f'bag:={bag}', '-p', 'rate:=0.0']) == 0
    # and at the start, until the subscribers have found each topic, and at the end
    assert waits[:-3] == ['/coolant_temperature', '/setpoint', '/setpoint']
    assert sorted(waits[-3:]) == ['/coolant_temperature', '/setpoint', '/temperature']


def test_messages_are_played_byte_for_byte(ros: Harness, bag: Path) -> None:
    heard = ros.listen(Temperature, 'played/temperature', raw=True)
    process = play(ros, bag, rate=10000.0, topics=['temperature'],
                   arguments=('-r', '__ns:=/played'))
    assert ros.wait_for_end(process) == 0
    ros.wait_until(lambda: len(heard) >= SAMPLES)
    assert heard == [entry.data for entry in read_messages(bag, ['/temperature'])]


def test_live_answers_come_within_a_sample(ros: Harness, bag: Path, tmp_path: Path) -> None:
    """A minute of one sample a second in four."""
    rate = 15.0
    slow = write_bag(tmp_path / 'slow.mcap', [
        (entry.topic, temperature(entry.message.temperature, stamp / NANOSECONDS),
         stamp / NANOSECONDS)
        for entry in read_messages(bag, ['/temperature'])
        for stamp in [stamp_nanoseconds(entry.message.header.stamp)]])
    commands = ros.listen(Temperature, topics.COOLANT_SETPOINT)
    arrived: dict[str, dict[int, float]] = {'measured': {}, 'commanded': {}}
    for topic, name in ((topics.TEMPERATURE, 'measured'), (topics.COOLANT_SETPOINT, 'commanded')):
        ros.node.create_subscription(
            Temperature, topic, lambda message, name=name: arrived[name].setdefault(
                stamp_nanoseconds(message.header.stamp), time.monotonic()), topics.LOOP_QOS)
    ros.start('controller')
    ros.meet('controller')
    process = play(ros, slow, rate=rate, wait_for_subscribers=2)
    # three subscriptions, which need not hear of the last one in this order
    ros.wait_until(lambda: min(len(commands), *map(len, arrived.values())) >= SAMPLES)
    assert ros.wait_for_end(process) == 0
    times = list(arrived['measured'].values())
    # the first one may come late on a busy machine, but none before its time
    assert times[-1] - times[0] > 0.75 * (SAMPLES - 1.0) / rate
    in_time = [arrived['commanded'][stamp] < after
               for stamp, after in zip(arrived['measured'], times[1:], strict=False)]
    assert sum(in_time) > SAMPLES // 2
    # the controller holds the temperature first measured: there is no request in this bag
    assert stamps(commands) == list(arrived['measured'])


def test_shipped_parameter_file_fits(ros: Harness, bag: Path) -> None:
    heard = ros.listen(Temperature, topics.SETPOINT)
    file = config_directory() / 'player.yaml'
    process = ros.start('player', arguments=(
        '--params-file', str(file), '-p', f'bag:={bag}', '-p', 'topics:=[setpoint]'))
    assert ros.wait_for_end(process) == 0
    ros.wait_until(lambda: heard)


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
    process = play(ros, bag, clock=True)
    ros.wait_until(lambda: len(heard) >= 3 and ticks and ticks[-1].clock.sec == 20)
    assert ros.wait_for_end(process) == 0
    # single ticks may be lost, and the first ones before the bench is known
    assert [tick.clock.sec for tick in ticks] in (
        [100, 101, 20], [101, 20], [100, 20], [20])


def test_order_is_that_of_receipt_and_the_offset_leaves_out_the_beginning(
        ros: Harness, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / 'bag.mcap', [
        ('/temperature', temperature(float(k), float(k)), received)
        for k, received in [(0, 10.0), (3, 10.8), (1, 10.4), (2, 10.6), (4, 1.0)]])
    heard = ros.listen(Temperature, topics.TEMPERATURE)
    process = play(ros, bag, rate=100.0)
    assert ros.wait_for_end(process) == 0
    # the recorder's clock was set back by more than it can have fallen behind: a later part
    ros.wait_until(lambda: len(heard) >= 5)
    assert [message.temperature for message in heard] == [0.0, 1.0, 2.0, 3.0, 4.0]
    heard.clear()
    process = play(ros, bag, rate=100.0, start_offset=9.5)
    assert ros.wait_for_end(process) == 0
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
    process = play(
        ros, bag, rate=0.0, topics=['/unit_1/temperature'], measurement='/unit_1/temperature',
        answer='/unit_2/coolant_setpoint',
        arguments=('-r', '/unit_1/temperature:=/unit_2/temperature'))
    assert ros.wait_for_end(process) == 0
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
        ros: Harness, tmp_path: Path, parameters: dict[str, Any], words: str) -> None:
    bag = write_bag(tmp_path / 'bag.mcap', [('/temperature', temperature(50.0, 1.0), 1.0)])
    process = ros.start('player', {'bag': bag, **parameters})
    assert words in refusal(ros, process)


@pytest.fixture(scope='module')
def hostile(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return bags of some kilobytes that would take minutes, or all the memory there is."""
    folder = tmp_path_factory.mktemp('hostile')
    with (folder / 'records.mcap').open('wb') as stream:
        writer = Writer(stream, chunk_size=2**26, compression=CompressionType.ZSTD,
                        index_types=IndexType.NONE)
        writer.start('ros2')
        channels = [
            writer.register_channel(topic, 'cdr', writer.register_schema(
                kind, 'ros2msg', message_definition(kind).text.encode()))
            for topic, kind in (('/temperature', TEMPERATURE), ('/coolant_setpoint', TEMPERATURE),
                                ('/controller_events', 'std_msgs/msg/String'))]
        for k in range(120_000):
            writer.add_message(channels[k % 3], 1, b'', 1)
        writer.finish()
    (laughs := folder / 'laughs').mkdir()
    (laughs / 'metadata.yaml').write_text('\n'.join(['a0: &a0 [ha]', *(
        f'a{k}: &a{k} [{", ".join([f"*a{k - 1}"] * 10)}]' for k in range(1, 30))]))
    return {'records': folder / 'records.mcap', 'laughs': laughs}


@pytest.mark.parametrize(('name', 'words'), [
    ('records', 'grows to more records than bytes, which no recording does: fetch it again'),
    ('laughs', 'aliases are not read in the metadata of a bag'),
])
def test_bags_beyond_reason_are_refused_by_all_who_read_bags(
        hostile: dict[str, Path], tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str,
        words: str) -> None:
    with pytest.raises(BagReadError, match=words):
        loop_episodes([hostile[name]], '/temperature', '/coolant_setpoint')
    with isolated_domain():
        for program, arguments in (
                (player, [f'bag:={hostile[name]}', 'wait_for_subscribers:=0', 'rate:=10000.0']),
                (replay, [f'bags:=[{hostile[name]}]', f'output:={tmp_path}'])):
            given = [part for argument in arguments for part in ('-p', argument)]
            assert program.main(['program', '--ros-args', *given]) == 1
            (line,) = [line for line in capfd.readouterr().err.splitlines()
                       if line.startswith(('player: ', 'replay: '))]
            assert words in line


def test_damage_on_the_way_is_told_in_one_line(ros: Harness, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / 'bag.mcap', [
        ('/temperature', temperature(50.0, float(k)), float(k)) for k in range(100)])
    content = bytearray(bag.read_bytes())
    content[len(content) // 3] ^= 1
    bag.write_bytes(content)
    process = ros.start('player', {'bag': bag, 'rate': 1000.0, 'wait_for_subscribers': 0})
    assert 'is damaged' in refusal(ros, process)


def test_signal_ends_it(ros: Harness, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / 'bag.mcap', [
        ('/temperature', temperature(50.0, float(k)), 3600.0 * k) for k in range(2)])
    heard = ros.listen(Temperature, topics.TEMPERATURE)
    process = play(ros, bag)
    ros.wait_until(lambda: heard)
    before = time.monotonic()
    assert process.stop() == 0
    assert time.monotonic() - before < TIMEOUT / 3.0
