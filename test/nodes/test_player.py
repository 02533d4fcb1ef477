# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The bag of a closed loop, and the player: recorded inputs into a fresh controller."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
import re
import time
from typing import Any

from mcap.reader import make_reader
import pytest
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Qos, QosDurability, QosReliability
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Temperature
import yaml

from koopman_ros import records
from koopman_ros.core.message_fields import MessageField
from koopman_ros.core.paths import config_directory
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.demo import reactor
from koopman_ros.demo.loop import run_loop
from koopman_ros.event_log.run import replayed_bag
from koopman_ros.nodes import player
from koopman_ros.parameters.controller import ReplayParameters
from koopman_ros.parameters.player import player_table
from koopman_ros.parameters.trainer_table import preset_wiring
from koopman_ros.ros import topics
from koopman_ros.ros.time_conversion import stamp_message, stamp_nanoseconds
from koopman_ros.testing import Harness
from support.bag_samples import DEFAULT_QOS, TEMPERATURE
from support.nodes import complaint, run_here, temperature

SAMPLES = 61
SETPOINT = 42.0  # degC
TOPICS = {'/temperature', '/concentration', '/setpoint', '/active_setpoint', '/coolant_setpoint',
          '/coolant_temperature', '/predicted_temperature', '/controller_internals',
          '/event_log', '/diagnostics'}
LATCHED = {'/active_setpoint', '/coolant_temperature'}
# A minute of a loop with a step, a noisy two-state reactor and a slow coolant.
SCENARIO = reactor.scenario(
    reactor.MODEL, SETPOINT + 273.15, step_time=20.0, duration=60.0, speed=60.0,
    plant={'system': 'two_state', 'temperature.measurement_noise': 0.05, 'seed': 3,
           'coolant_temperature.delay': 1.0, 'coolant_temperature.lag': 2.0})


@pytest.fixture(scope='module')
def recorded_loop(tmp_path_factory: pytest.TempPathFactory) -> Path:
    bag = tmp_path_factory.mktemp('recorded') / 'loop.mcap'
    run_loop(SCENARIO, bag, bag.parent)
    return bag


def test_another_reader_finds_every_measurement_and_command(recorded_loop: Path) -> None:
    heard: dict[str, list[Any]] = {}
    with AnyReader([recorded_loop]) as reader:
        for connection, _, data in reader.messages():
            heard.setdefault(connection.topic, []).append(
                reader.deserialize(data, connection.msgtype))
    seconds = {topic: [message.header.stamp.sec for message in heard[topic]] for topic in (
        '/temperature', '/coolant_setpoint', '/coolant_temperature', '/concentration',
        '/active_setpoint')}
    whole = list(range(1, SAMPLES + 1))
    assert set(heard) == TOPICS
    assert seconds['/temperature'] == seconds['/coolant_setpoint'] == whole
    # of what keeps the last only, a recorder that is found late misses the first
    assert seconds['/coolant_temperature'][-50:] == whole[-50:]
    # and of what is no signal of its loop, it looks for publishers
    assert seconds['/concentration'] == whole[-len(seconds['/concentration']):]
    assert [m.temperature for m in heard['/setpoint']] == pytest.approx([SETPOINT])
    assert heard['/active_setpoint'][-1].temperature == pytest.approx(SETPOINT)
    assert seconds['/active_setpoint'] == [1, 21]
    assert {status.name for array in heard['/diagnostics'] for status in array.status} >= {
        'controller: control', 'trainer: recording'}
    for message in heard['/concentration']:
        assert list(message.name) == ['reactant_concentration [mol/L]']
        assert 0.5 < message.position[0] < 1.0


def test_replay_reproduces_every_command(recorded_loop: Path) -> None:
    found = replayed_bag(str(recorded_loop), ReplayParameters())
    assert found.check.identical == found.check.compared == SAMPLES
    assert found.found.lost == []


def test_types_and_offers_are_those_of_ros(ros: Harness, recorded_loop: Path) -> None:
    with recorded_loop.open('rb') as stream:
        channels = make_reader(stream).get_summary().channels.values()
    stored = {channel.topic: channel.metadata for channel in channels}
    assert set(stored) == TOPICS
    wiring = preset_wiring('two_state')
    assert wiring is not None
    known = topics.expected_topics(wiring)
    for topic, metadata in stored.items():
        kind, _ = known.get(topic) or known[topic.removeprefix('/')]
        ros.node.create_publisher(kind, topic, 1)
        (info, *_) = ros.node.get_publishers_info_by_topic(topic)
        assert metadata['topic_type_hash'] == str(info.topic_type_hash)
        assert re.fullmatch('RIHS01_[0-9a-f]{64}', metadata['topic_type_hash'])
        durability = 'transient_local' if topic in LATCHED else 'volatile'
        profiles = yaml.safe_load(metadata['offered_qos_profiles'])
        assert {(profile['reliability'], profile['durability']) for profile in profiles} == {
            ('reliable', durability)}


LATCHED_QOS = DEFAULT_QOS._replace(durability=QosDurability.TRANSIENT_LOCAL, depth=1)
BEST_EFFORT_QOS = DEFAULT_QOS._replace(reliability=QosReliability.BEST_EFFORT)


def write_bag(path: Path, entries: Sequence[tuple[str, Temperature, float]],
              offered: Sequence[Qos] = ()) -> Path:
    """Write temperatures: (topic, message, seconds of receipt)."""
    with records.BagWriter(path) as writer:
        for topic, message, received in entries:
            writer.add_topic(
                topic, records.message_definition('sensor_msgs/msg/Temperature'), offered)
            writer.write(topic, serialize_message(message), round(received * NANOSECONDS))
    return path


def play(bag: Path, *arguments: str, **parameters: object) -> None:
    """Play a bag to its end, which is a good one, in this process."""
    given = [part for name, value in {'bag': bag, **parameters}.items()
             for part in ('-p', f'{name}:={value}')]
    assert player.main(['player', '--ros-args', *given, *arguments]) == 0


def test_lockstep_gives_bit_identical_commands(
        ros: Harness, recorded_loop: Path, capfd: pytest.CaptureFixture[str]) -> None:
    place = MessageField('/coolant_setpoint', TEMPERATURE, 'temperature', 'degC')
    recorded = records.read_series(recorded_loop, place)
    commands = ros.listen(Temperature, reactor.COOLANT_SETPOINT)
    ros.start('controller', {'observer_bandwidth': 0.0})
    ros.meet('controller')
    play(recorded_loop, rate=0.0)
    ros.wait_until(lambda: len(commands) >= SAMPLES)
    assert [stamp_nanoseconds(command.header.stamp) for command in commands] == (
        recorded.stamp_ns.tolist())
    assert [command.temperature for command in commands] == recorded.values.tolist()
    # the coolant in force with each measurement, and one set-point
    inputs = {f'/{name}' for name in player_table().snapshot({}).topics}
    counts = records.summary(recorded_loop).counts
    assert f'played {sum(counts[topic] for topic in inputs & set(counts))} messages' in (
        capfd.readouterr().err)


def test_messages_are_played_byte_for_byte_with_the_shipped_parameter_file(
        ros: Harness, recorded_loop: Path) -> None:
    heard = ros.listen(Temperature, 'played/temperature', raw=True)
    play(recorded_loop, '-r', '__ns:=/played', '--params-file',
         str(config_directory() / 'player.yaml'), '-p', f'bag:={recorded_loop}',
         '-p', 'rate:=10000.0', '-p', 'topics:=[temperature]')
    ros.wait_until(lambda: len(heard) >= SAMPLES)
    read = records.read_messages(recorded_loop, ['/temperature'])
    assert heard == [entry.data for entry in read]


def test_measurements_come_at_their_times(ros: Harness, tmp_path: Path) -> None:
    """A sample a second, ten times as fast."""
    bag = write_bag(tmp_path / 'slow.mcap', [
        ('/temperature', temperature(50.0 - 0.1 * k, float(k)), float(k)) for k in range(9)])
    sent_ns: list[int] = []

    def note(_: Temperature, info: Mapping[str, int]) -> None:
        sent_ns.append(info['source_timestamp'])

    ros.node.create_subscription(Temperature, reactor.TEMPERATURE, note, topics.LOOP_QOS)
    play(bag, rate=10.0)
    ros.wait_until(lambda: len(sent_ns) == 9)
    # the first one may come late on a busy machine, but none before its time
    assert sent_ns[-1] - sent_ns[0] > 0.5e9 * 8.0 / 10.0


def test_clock_shows_the_stamp_of_each_measurement(ros: Harness, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / 'bag.mcap', [
        ('/temperature', temperature(50.0, 100.0), 1.0),
        # a request for later does not move the time
        ('/setpoint', temperature(45.0, 900.0), 1.1),
        ('/temperature', temperature(50.0, 101.0), 1.2),
        ('/temperature', temperature(50.0, 20.0), 1.3)])
    ticks = ros.listen(Clock, topics.CLOCK, topics.CLOCK_QOS)
    heard = ros.listen(Temperature, reactor.TEMPERATURE)
    ros.listen(Temperature, reactor.SETPOINT)
    play(bag, clock='true')
    ros.wait_until(lambda: len(heard) >= 3 and ticks and ticks[-1].clock.sec == 20)
    # single ticks may be lost, and the first ones before the bench is known
    assert [tick.clock.sec for tick in ticks] in (
        [100, 101, 20], [101, 20], [100, 20], [20])


def test_order_is_that_of_receipt_and_the_offset_leaves_out_the_beginning(
        ros: Harness, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / 'bag.mcap', [
        ('/temperature', temperature(float(k), float(k)), received)
        for k, received in [(0, 10.0), (3, 10.8), (1, 10.4), (2, 10.6), (4, 1.0)]])
    heard = ros.listen(Temperature, reactor.TEMPERATURE)
    play(bag, rate=100.0)
    # the recorder's clock was set back by more than it can have fallen behind: a later part
    ros.wait_until(lambda: len(heard) >= 5)
    assert [message.temperature for message in heard] == [0.0, 1.0, 2.0, 3.0, 4.0]
    heard.clear()
    play(bag, rate=100.0, start_offset=9.5)
    ros.wait_until(lambda: len(heard) >= 2)
    assert [message.temperature for message in heard] == [2.0, 3.0]


@pytest.mark.parametrize(('offered', 'reliable', 'latched'), [
    ((), True, False),
    ((BEST_EFFORT_QOS,), False, False),
    ((LATCHED_QOS,), True, True),
    ((BEST_EFFORT_QOS, DEFAULT_QOS), True, False)])
def test_offer_is_that_of_the_recorded_publishers(
        offered: tuple[Qos, ...], reliable: bool, latched: bool) -> None:
    profile = player.recorded_offer(offered)
    assert (profile.reliability is ReliabilityPolicy.RELIABLE) is reliable
    assert (profile.durability is DurabilityPolicy.TRANSIENT_LOCAL) is latched


def test_bag_in_a_namespace_is_played_into_another_controller(
        ros: Harness, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / 'bag.mcap', [
        ('/unit_1/temperature', temperature(51.0 - k, 1.0 + k), float(k)) for k in range(5)])
    commands = ros.listen(Temperature, '/unit_2/coolant_setpoint')
    ros.start('controller', arguments=('-r', '__ns:=/unit_2'))
    ros.meet('unit_2/controller')
    play(bag, '-r', '/unit_1/temperature:=/unit_2/temperature', rate=0.0,
         topics="['/unit_1/temperature']", measurement="['/unit_1/temperature']",
         answer='/unit_2/coolant_setpoint')
    ros.wait_until(lambda: len(commands) >= 5)


@pytest.mark.parametrize(('shape', 'values', 'stamps'), [
    ({}, [45.0, 40.0, 41.0], [None, None, None]),
    ({'setpoint_ramps': True, 'ramp_period': 10.0}, [45.0, 42.5, 40.0, 40.5, 41.0], 5 * [None]),
    ({'setpoint_lead': 60.0}, [45.0, 40.0, 41.0], [0.0, 20.0, 40.0])])
def test_setpoints_of_a_csv_are_steps_or_ramps_at_once_or_ahead(
        ros: Harness, tmp_path: Path, shape: dict[str, Any], values: list[float],
        stamps: list[float | None]) -> None:
    # the unit is that of the column; a cell may be empty
    (tmp_path / 'day.csv').write_text(
        'time [min],temperature [K],note\n0,318.15,\n0.3333333333333333,313.15,\n0.5,,x\n'
        '0.6666666666666666,314.15,\n')
    heard = ros.listen(Temperature, reactor.SETPOINT)
    began = time.time()
    play(tmp_path / 'day.csv', rate=200.0, **shape)
    ros.wait_until(lambda: len(heard) >= len(values))
    assert [message.temperature for message in heard] == pytest.approx(values)
    found = [stamp_nanoseconds(message.header.stamp) / NANOSECONDS for message in heard]
    if stamps[0] is None:
        assert found == [0.0] * len(stamps)
    else:
        assert began <= found[0] <= time.time()
        assert [at - found[0] for at in found] == pytest.approx(stamps, abs=1e-6)


def test_setpoints_of_a_csv_are_due_in_the_time_of_a_simulation(
        ros: Harness, tmp_path: Path) -> None:
    (tmp_path / 'day.csv').write_text('time [s],temperature [degC]\n0,45\n3600,40\n')
    heard = ros.listen(Temperature, reactor.SETPOINT)
    clock = ros.node.create_publisher(Clock, topics.CLOCK, topics.CLOCK_QOS)
    process = ros.start('player', {
        'bag': tmp_path / 'day.csv', 'use_sim_time': True, 'setpoint_lead': 60.0})

    def received(seconds: float, count: int) -> bool:
        clock.publish(Clock(clock=stamp_message(round(seconds * NANOSECONDS))))
        return len(heard) == count

    ros.wait_until(partial(received, 100.0, 1))
    ros.wait_until(partial(received, 3640.0, 2))
    assert ros.wait_for_end(process) == 0
    assert [(message.header.stamp.sec, message.temperature) for message in heard] == [
        (100, 45.0), (3700, 40.0)]


@pytest.mark.parametrize(('parameters', 'words'), [
    ({'bag': 'day.csv', 'rate': 0.0}, 'lock-step, which a .csv of set-points cannot'),
    ({'bag': 'day.csv'}, 'day.csv has no column temperature: name the columns time [s] and'),
    ({'bag': 'day.csv', 'system': 'none', 'topics': ['setpoint']},
     "system = 'none' has no set-points"),
    ({'bag': 'none.mcap'}, "cannot start: bag 'none.mcap' does not exist"),
    ({'topics': ['pressure']}, 'no message on /pressure: choose from /temperature'),
    # of another plant, which needs no topics of measurements and commands in recorded time
    ({'system': 'none', 'topics': ['temperature'], 'wait_timeout': 0.1},
     '/temperature found no subscriber or publisher within 0.1 s'),
    ({'system': 'none', 'topics': ['temperature'], 'rate': 0.0}, 'set measurement and answer'),
    ({'system': 'none', 'topics': ['temperature'], 'clock': True}, 'set measurement'),
    ({'system': 'none'}, "topics = ['']"),
    ({'measurement': ['temperature', '']},
     "topics = ['temperature', ''] must contain at least one name and no empty one"),
    ({'rate': -1.0}, 'rate = -1.0 must be 0, or in [1e-06, 10000]'),
    ({'wait_timeout': 0.1}, '/temperature found no subscriber or publisher within 0.1 s'),
    ({'wait_for_subscribers': 0, 'rate': 0.0, 'answer_timeout': 0.1},
     'no command for the measurement at 1.000 s within 0.1 s: check that the controller'),
    ({'bag': 'damaged.mcap', 'rate': 1000.0, 'wait_for_subscribers': 0}, 'is damaged'),
])
def test_a_bag_that_cannot_be_played_is_rejected_in_one_line(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str],
        parameters: dict[str, Any], words: str) -> None:
    monkeypatch.chdir(tmp_path)
    bag = write_bag(tmp_path / 'bag.mcap', [
        ('/temperature', temperature(50.0, float(k)), float(k)) for k in range(1, 101)])
    content = bytearray(bag.read_bytes())
    content[len(content) // 3] ^= 1
    Path('damaged.mcap').write_bytes(content)
    Path('day.csv').write_text('time [s],pressure [Pa]\n0,1.0\n')
    assert run_here(player, **{'bag': 'bag.mcap', **parameters}) == 1
    assert words in complaint(capfd)


def test_signal_ends_it(ros: Harness, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / 'bag.mcap', [
        ('/temperature', temperature(50.0, float(k)), 3600.0 * k) for k in range(2)])
    heard = ros.listen(Temperature, reactor.TEMPERATURE)
    process = ros.start('player', {'bag': bag})
    ros.wait_until(lambda: heard)
    # a process that waits for its next message, an hour later, is aborted
    assert process.stop() == 0
