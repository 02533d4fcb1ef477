# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Recording that goes wrong or goes on for long: kills, split bags, full disks, fast topics."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
import json
from pathlib import Path
import re
import shutil
import signal
import sys
import time

from diagnostic_msgs.msg import DiagnosticStatus
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader, NonSeekingReader
from mcap_ros2.decoder import DecoderFactory
import pytest
from rclpy.duration import Duration
from rosbags.highlevel import AnyReader
from sensor_msgs.msg import Temperature
import yaml

from koopman_ros.bags import read_messages, summary
from koopman_ros.nodes import trainer
from koopman_ros.parameters.trainer import TABLE, TrainerParameters
from koopman_ros.ros import topics
from koopman_ros.ros.recording import free_name
from koopman_ros.testing import Harness
from support.messages import temperature, TIMEOUT
from support.processes import complaint, run_here

TOPIC = '/temperature'
PUBLISHER = (Path(__file__).parents[2]
             / 'validation' / 'benchmarks' / 'recording' / 'publisher.py')
# (output, compression, moment of the kill [s after the first message]), in this order
KILLED = [
    ('file.mcap', 'none', 1.4), ('squeezed.mcap', 'zstd', 1.5), ('split', 'none', 1.75),
    ('squeezed_split', 'zstd', 2.1),
]


def values(bag: Path, *, recover: bool = False) -> list[int]:
    """Return the numbers in a bag, by our reader."""
    return [round(m.message.temperature) for m in read_messages(bag, [TOPIC], recover=recover)]


def values_by_mcap(bag: Path) -> list[int]:
    """Return the numbers in a bag by mcap, from files that need not be complete."""
    found = []
    for file in sorted(bag.glob('*.mcap')) if bag.is_dir() else [bag]:
        with file.open('rb') as stream:
            reader = NonSeekingReader(stream, decoder_factories=[DecoderFactory()])
            try:
                for entry in reader.iter_decoded_messages([TOPIC], log_time_order=False):
                    found.append(round(entry.decoded_message.temperature))
            except EndOfFile:
                pass
    return found


# Killed.


@dataclass(frozen=True)
class Killed:
    """A bag whose trainer was killed, and how many messages were older than a second."""

    bag: Path
    old: int
    sent: int


@pytest.fixture(scope='module')
def killed(shared_ros: Harness, tmp_path_factory: pytest.TempPathFactory) -> list[Killed]:
    """Kill trainers at several moments while messages stream."""
    ros = shared_ros
    folder = tmp_path_factory.mktemp('killed')
    processes = [ros.start('trainer', {
        'output': folder / output, 'compression': compression,
        **({} if output.endswith('.mcap') else {'max_bag_duration': 0.4})},
        ('-r', f'__node:=trainer_{k}')) for k, (output, compression, _) in enumerate(KILLED)]
    publisher = ros.speak(Temperature, topics.TEMPERATURE, to='trainer_0', subscribers=len(KILLED))
    for k in range(len(KILLED)):
        ros.meet(f'trainer_{k}')
    sent: list[float] = []

    def tick() -> None:
        publisher.publish(temperature(float(len(sent))))
        sent.append(time.monotonic())

    timer = ros.node.create_timer(0.005, tick)
    found = []
    for process, (output, _, moment) in zip(processes, KILLED, strict=True):
        ros.wait_until(lambda m=moment: sent and time.monotonic() > sent[0] + m)
        now = time.monotonic()
        assert process.stop(signal.SIGKILL) == -signal.SIGKILL
        # on a busy machine, where the trainer waits as long as we do
        stall = max(late - early for early, late in pairwise([*sent, now]))
        old = sum(at <= now - 1.0 - stall for at in sent)
        found.append(Killed(folder / output, old, len(sent)))
    timer.cancel()
    return found


def test_kill_loses_no_more_than_the_last_second(killed: list[Killed]) -> None:
    for case in killed:
        for found in (values(case.bag, recover=True), values_by_mcap(case.bag)):
            assert found == list(range(len(found)))
            assert case.old <= len(found) <= case.sent, case
            assert found
        assert not summary(case.bag).complete
        assert case.bag.suffix or len(list(case.bag.glob('*.mcap'))) >= 3


@pytest.mark.parametrize(('wanted', 'free'), [
    ('run', 'run_4'), ('run.mcap', 'run_2.mcap'), ('run_1.mcap', 'run_1_2.mcap'), ('new', 'new'),
    ('v1.0', 'v1.0_2')])
def test_free_name(tmp_path: Path, wanted: str, free: str) -> None:
    for name in ('run', 'run_2', 'v1.0'):
        (tmp_path / name).mkdir()
    (tmp_path / 'run_3').symlink_to('nowhere')
    for name in ('run.mcap', 'run_1.mcap'):
        (tmp_path / name).touch()
    assert free_name(tmp_path / wanted) == tmp_path / free


# Split.


@pytest.fixture(scope='module')
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Harness]:
    """Start a trainer that records only the temperature, away from those that were killed."""
    with Harness(tmp_path_factory.mktemp('running')) as ros:
        ros.start('trainer', {'topics': [TOPIC], 'record_at_start': False})
        yield ros


def record(ros: Harness, output: Path) -> None:
    """Start to record."""
    ros.set_parameters('trainer', output=str(output))
    response = ros.set_bool('trainer/record', True)
    assert response.success, response.message


def test_split_bag_reads_as_one(running: Harness, tmp_path: Path) -> None:
    ros, bag = running, tmp_path / 'run'
    ros.set_parameters('trainer', output=str(bag), max_bag_size=0.01)
    record(ros, bag)
    publisher = ros.speak(Temperature, topics.TEMPERATURE, to='trainer')
    sent: list[int] = []

    def tick() -> None:
        publisher.publish(temperature(float(len(sent))))
        sent.append(len(sent))

    timer = ros.node.create_timer(0.005, tick)
    ros.wait_until(lambda: len(list(bag.glob('*.mcap'))) >= 3)
    timer.cancel()
    assert publisher.wait_for_all_acked(Duration(seconds=TIMEOUT))
    assert ros.set_bool('trainer/record', False).success
    ros.set_parameters('trainer', max_bag_size=0.0)
    assert values(bag) == sent
    assert summary(bag).complete
    files = sorted(bag.glob('*.mcap'))
    information = yaml.safe_load((bag / 'metadata.yaml').read_text())[
        'rosbag2_bagfile_information']
    assert information['relative_file_paths'] == [file.name for file in files]
    assert sum(file['message_count'] for file in information['files']) == len(sent)
    with AnyReader([bag]) as reader:
        assert [reader.deserialize(data, connection.msgtype).temperature
                for connection, _, data in reader.messages()] == sent
    heard = 0
    for file in files:
        with file.open('rb') as stream:
            heard += sum(1 for _ in make_reader(stream, validate_crcs=True).iter_messages())
    assert heard == len(sent)


def test_single_file_is_not_split() -> None:
    for limit in ({'max_bag_size': 1.0}, {'max_bag_duration': 60.0}):
        assert TABLE.check(TrainerParameters(output='run.mcap', **limit)) == (
            "output = 'run.mcap' is one file, which max_bag_size and max_bag_duration cannot "
            'split: give the name of a folder, without .mcap')
        assert not TABLE.check(TrainerParameters(output='run', **limit))
        assert not TABLE.check(TrainerParameters(output='', **limit))


# Full disk.


def test_does_not_start_on_a_disk_with_too_little_room(
        tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    bag = tmp_path / 'deep' / 'run'
    assert run_here(trainer, output=bag, min_free_disk=1e9) == 1
    assert re.fullmatch(
        rf'trainer: cannot start: cannot record: \d+ MB are free on the disk of {tmp_path}, below '
        r'min_free_disk = 1000000000 MB: free some space, or choose another disk',
        complaint(capfd))
    assert not bag.parent.exists()


def test_too_little_room_stops_the_recording_but_not_the_node(running: Harness, tmp_path: Path
                                                              ) -> None:
    ros, bag = running, tmp_path / 'run'
    record(ros, bag)
    publisher = ros.speak(Temperature, topics.TEMPERATURE, to='trainer')
    for k in range(900):
        publisher.publish(temperature(float(k)))
    assert publisher.wait_for_all_acked(Duration(seconds=TIMEOUT))
    (result,) = ros.set_parameters('trainer', min_free_disk=1e9)
    assert result.successful
    status = ros.wait_for_status('trainer: recording', lambda s: s.level == DiagnosticStatus.ERROR)
    assert status.message.startswith(f'recording to {bag} stopped: ')
    assert 'below min_free_disk = 1000000000 MB; free some space and call' in status.message
    assert values(bag) == list(range(900))
    assert summary(bag).complete

    refused = ros.set_bool('trainer/record', True)
    assert not refused.success
    assert 'below min_free_disk = 1000000000 MB: free some space' in refused.message
    ros.set_parameters('trainer', min_free_disk=0.0)
    again = ros.set_bool('trainer/record', True)
    assert again.success
    assert str(tmp_path / 'run_2') in again.message
    ros.wait_for_status('trainer: recording', lambda s: s.level == DiagnosticStatus.OK)
    assert ros.set_bool('trainer/record', False).success


def test_bag_that_vanished_is_no_success(running: Harness, tmp_path: Path) -> None:
    ros, bag = running, tmp_path / 'run'
    record(ros, bag)
    shutil.rmtree(bag)
    response = ros.set_bool('trainer/record', False)
    assert not response.success
    assert response.message.startswith(f'{bag} is not complete: ')
    status = ros.wait_for_status('trainer: recording', lambda s: s.level == DiagnosticStatus.ERROR)
    assert status.message == response.message


# Fast.


def test_loses_nothing_at_1_khz(ros: Harness, tmp_path: Path) -> None:
    bag = tmp_path / 'run'
    process = ros.start('trainer', {'output': bag, 'max_bag_duration': 1.0})
    publisher = ros.start('publisher', command=(
        sys.executable, str(PUBLISHER), '--rate', '1000', '--count', '2000'))
    assert ros.wait_for_end(publisher) == 0
    sent = json.loads(publisher.output().splitlines()[-1])
    assert sent['sent'] == 2000
    assert process.stop() == 0
    messages = list(read_messages(bag, [TOPIC]))
    assert [m.message.header.stamp.nanosec for m in messages] == list(range(2000))
    logged = [m.log_time_ns for m in messages]
    assert logged == sorted(logged)
    # the times are those of receipt, not those at which the recorder took a batch: they differ as
    # often as those of sending do, whatever else the machine does
    sent_at = {m.publish_time_ns // 1_000_000 for m in messages}
    assert len({at // 1_000_000 for at in logged}) > len(sent_at) / 2
    assert len(sent_at) > 200
