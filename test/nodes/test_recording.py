# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What the trainer records, how it starts and stops, and how a bag ends: kills, full disks."""

from collections.abc import Callable, Iterator
import itertools
from pathlib import Path
import re
import shutil
import signal
import sys

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
import pytest
from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Temperature
from std_msgs.msg import Float64, String

from koopman_ros.core.units import NANOSECONDS as SECOND
from koopman_ros.demo import reactor
from koopman_ros.nodes import trainer
from koopman_ros.nodes.trainer import TrainerNode
from koopman_ros.records import BagMessage, read_messages, summary
from koopman_ros.ros import recorder, topics
from koopman_ros.ros.recording import free_name
from koopman_ros.ros.time_conversion import stamp_message
from koopman_ros.testing import Harness
from support.nodes import complaint, run_here, RunNode, temperature, TIMEOUT

BEST_EFFORT = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
TOPIC = '/temperature'
STATUS = 'trainer: recording'
ON_TOPIC = f'messages on {TOPIC}'


def recorded(bag: Path, topic: str = TOPIC) -> list[BagMessage]:
    assert summary(bag).complete
    return list(read_messages(bag, [topic]))


def values(messages: list[BagMessage]) -> list[float]:
    return [entry.message.temperature for entry in messages]


def say(publisher: Publisher, count: int, first: int = 0) -> None:
    """Publish a burst of numbered temperatures and wait until the trainer has received it."""
    for k in range(first, first + count):
        publisher.publish(temperature(float(k), float(k)))
    assert publisher.wait_for_all_acked(Duration(seconds=TIMEOUT))


def figures(ros: Harness, condition: Callable[[dict[str, str]], bool]) -> dict[str, str]:
    """Wait for figures of the recording's status, and return them."""
    def those(status: DiagnosticStatus) -> dict[str, str]:
        return {item.key: item.value for item in status.values}

    return those(ros.wait_for_status(
        STATUS, lambda status: 'messages' in those(status) and condition(those(status))))


def say_until(ros: Harness, publisher: Publisher, condition: Callable[[], object]) -> int:
    """Publish numbered temperatures at 200 Hz; return how many."""
    numbers = itertools.count()
    timer = ros.node.create_timer(
        0.005, lambda: publisher.publish(temperature(float(next(numbers)))))
    ros.wait_until(condition)
    ros.node.destroy_timer(timer)
    return next(numbers)


@pytest.mark.parametrize(('split', 'files'), [({}, 1), ({'max_bag_duration': 0.4}, 3)])
def test_kill_loses_no_more_than_the_last_second(
        ros: Harness, tmp_path: Path, split: dict[str, object], files: int) -> None:
    bag = tmp_path / 'run'
    process = ros.start('trainer', {'output': bag, 'compression': 'zstd', **split})
    publisher = ros.speak(Temperature, reactor.TEMPERATURE, to='trainer')

    def safe() -> int:
        """Return the messages two statuses ago: one a second, and two flushes, in one thread."""
        counts = [int(item.value) for status in ros.statuses if status.name == STATUS
                  for item in status.values if item.key == f'messages on {TOPIC}']
        return counts[-3] if len(counts) > 2 else 0

    sent = say_until(
        ros, publisher, lambda: safe() >= 150 and len(list(bag.glob('*.mcap'))) >= files)
    least = safe()
    assert process.stop(signal.SIGKILL) == -signal.SIGKILL
    found = values(list(read_messages(bag, [TOPIC], recover=True)))
    assert found == list(range(len(found)))
    assert least <= len(found) <= sent
    assert not summary(bag).complete


def test_signal_completes_the_bag_with_all_that_arrived(ros: Harness, tmp_path: Path) -> None:
    """In a namespace, with a topic outside the loop that is recorded by its name."""
    bag = tmp_path / 'run'
    process = ros.start('trainer', {'output': bag, 'topics': ['temperature', 'notes']},
                        ('-r', '__ns:=/unit_1'))
    received = ros.listen(Temperature, '/unit_1/temperature', QoSProfile(depth=1000), raw=True)
    publisher = ros.speak(
        Temperature, '/unit_1/temperature', to='/unit_1/trainer', subscribers=2)
    notes = ros.speak(String, '/unit_1/notes', to='/unit_1/trainer')
    said = [f'note {k}: 51.8 °C' for k in range(10)]
    for note in said:
        notes.publish(String(data=note))
    assert notes.wait_for_all_acked(Duration(seconds=TIMEOUT))
    say(publisher, 900)
    ros.wait_until(lambda: len(received) == 900)
    assert process.stop(signal.SIGTERM) == 0
    messages = recorded(bag, '/unit_1/temperature')
    assert values(messages) == list(range(900))
    assert [entry.data for entry in messages] == received
    logged = [entry.log_time_ns for entry in messages]
    assert logged == sorted(logged)
    assert all(entry.publish_time_ns <= entry.log_time_ns for entry in messages)
    messages = recorded(bag, '/unit_1/notes')
    assert [entry.message.data for entry in messages] == said
    assert {entry.type_name for entry in messages} == {'std_msgs/msg/String'}


@pytest.fixture(scope='module')
def shared_trainer(shared_ros: Harness) -> Harness:
    shared_ros.start('trainer', {'record_at_start': False})
    return shared_ros


@pytest.fixture
def shared(shared_trainer: Harness) -> Iterator[Harness]:
    """Yield the harness of a trainer that does not record, nor after the test."""
    yield shared_trainer
    shared_trainer.set_bool('trainer/record', False)


def record(ros: Harness, output: Path, qos: QoSProfile = topics.LOOP_QOS, subscribers: int = 1
           ) -> Publisher:
    """Start to record into a file; return a publisher that is recorded from now on."""
    # a subscription of the recording before is not taken for one of this
    ros.wait_until(lambda: '/trainer' not in map(
        topics.node_name, ros.node.get_subscriptions_info_by_topic(TOPIC)))
    (result,) = ros.set_parameters('trainer', output=str(output))
    assert result.successful, result.reason
    response = ros.set_bool('trainer/record', True)
    assert response.success, response.message
    return ros.speak(Temperature, reactor.TEMPERATURE, qos, to='trainer', subscribers=subscribers)


def test_recording_stops_and_starts_by_service(shared: Harness, tmp_path: Path) -> None:
    ros = shared
    assert ros.wait_for_status(STATUS, lambda _: True).message == 'not recording'
    for number, name in enumerate(('first.mcap', 'second')):
        response = ros.set_bool('trainer/record', False)
        assert (response.success, response.message) == (False, 'not recording')
        publisher = record(ros, tmp_path / name)
        response = ros.set_bool('trainer/record', True)
        assert (response.success, response.message) == (False, 'already recording')
        say(publisher, 900, first=1000 * number)
        response = ros.set_bool('trainer/record', False)
        assert response.success, response.message
        assert name in response.message
        ros.wait_until(lambda publisher=publisher: publisher.get_subscription_count() == 0)
        # which is in neither
        say(publisher, 10)
        ros.node.destroy_publisher(publisher)
        assert values(recorded(tmp_path / name)) == [1000 * number + k for k in range(900)]


def test_best_effort_publisher_is_recorded_under_the_next_free_name(
        shared: Harness, tmp_path: Path) -> None:
    bag, second = tmp_path / 'run', tmp_path / 'run_2'
    bag.mkdir()
    (bag / 'run_0.mcap').write_text('precious')
    received = shared.listen(Temperature, reactor.TEMPERATURE, BEST_EFFORT)
    publisher = record(shared, bag, BEST_EFFORT, subscribers=2)
    for k in range(20):
        publisher.publish(temperature(float(k)))
        shared.wait_until(lambda k=k: len(received) > k)
    # which is flushed twice a second
    shared.wait_until(lambda: summary(second).counts.get(TOPIC, 0) >= 20)
    assert shared.set_bool('trainer/record', False).message.endswith(str(second))
    assert values(recorded(second)) == list(range(20))
    shared.node.destroy_publisher(publisher)
    assert [path.read_text() for path in bag.iterdir()] == ['precious']
    assert f'recording to {second}, because {bag} already exists' in shared.printed()


def test_too_little_room_stops_the_recording_alone(shared: Harness, tmp_path: Path) -> None:
    ros, bag = shared, tmp_path / 'run'
    publisher = record(ros, bag)
    say(publisher, 900)
    (result,) = ros.set_parameters('trainer', min_free_disk=1e9)
    assert result.successful
    status = ros.wait_for_status(STATUS, lambda s: s.level == DiagnosticStatus.ERROR)
    assert 'less than min_free_disk = 1000000000 MB; free some space and call' in status.message
    assert values(recorded(bag)) == list(range(900))
    ros.node.destroy_publisher(publisher)

    rejected = ros.set_bool('trainer/record', True)
    assert not rejected.success
    assert 'less than min_free_disk = 1000000000 MB: free some space' in rejected.message
    ros.set_parameters('trainer', min_free_disk=0.0)
    again = ros.set_bool('trainer/record', True)
    assert again.success
    assert str(tmp_path / 'run_2') in again.message
    ros.wait_for_status(STATUS, lambda s: s.level == DiagnosticStatus.OK)
    assert ros.set_bool('trainer/record', False).success


def test_messages_that_find_the_queue_full_are_counted_as_missed(
        ros: Harness, tmp_path: Path, run_node: RunNode) -> None:
    bag = tmp_path / 'run.mcap'
    node = run_node(TrainerNode, {'output': bag})
    publisher = ros.speak(Temperature, reactor.TEMPERATURE, to='trainer')
    say(publisher, 1)
    found = figures(ros, lambda found: found[ON_TOPIC] == '1')
    assert found['missed messages'] == '0'
    # the node, which runs in this thread, takes none of them meanwhile
    say(publisher, recorder.QUEUE_DEPTH + 118, first=1)
    status = ros.wait_for_status(STATUS, lambda status: status.level == DiagnosticStatus.WARN)
    assert f'missed 118 messages on {TOPIC}' in status.message
    figures(ros, lambda found: found['missed messages'] == '118')
    node.complete()
    assert values(recorded(bag)) == [0.0, *range(119, recorder.QUEUE_DEPTH + 119)]


def test_messages_that_the_middleware_loses_are_counted_as_missed(
        ros: Harness, tmp_path: Path) -> None:
    """Of two publishers, whose numbers do not say which of them sent a message."""
    bag = tmp_path / 'run.mcap'
    process = ros.start('trainer', {'output': bag})
    publishers = [ros.speak(Temperature, reactor.TEMPERATURE, BEST_EFFORT, to='trainer')
                  for _ in range(2)]
    for publisher in publishers:
        publisher.publish(temperature(0.0))
    figures(ros, lambda found: found[ON_TOPIC] == '2')
    process.send(signal.SIGSTOP)
    long = temperature(1.0)
    long.header.frame_id = 'sensor' * 1000
    for _ in range(3000):
        for publisher in publishers:
            publisher.publish(long)
    process.send(signal.SIGCONT)
    # after what waited in the buffers of the network
    ros.meet('trainer')
    for publisher in publishers:
        publisher.publish(temperature(2.0))
    found = figures(
        ros, lambda found: int(found[ON_TOPIC]) + int(found['missed messages']) == 6004)
    assert int(found['missed messages']) > 0


def test_publishers_that_take_turns_are_not_counted_as_missed(
        ros: Harness, tmp_path: Path, run_node: RunNode) -> None:
    node = run_node(TrainerNode, {'output': tmp_path / 'run.mcap'})
    first = ros.speak(Temperature, reactor.TEMPERATURE, to='trainer')
    say(first, 5)
    figures(ros, lambda found: found[ON_TOPIC] == '5')
    second = ros.speak(Temperature, reactor.TEMPERATURE, to='trainer')
    for _ in range(10):
        say(second, 7)
        say(first, 1)
    figures(ros, lambda found: found[ON_TOPIC] == '85')
    ros.node.destroy_publisher(first)
    say(second, 5)
    found = figures(ros, lambda found: found[ON_TOPIC] == '90')
    assert found['missed messages'] == '0'
    node.complete()


def test_bag_that_vanished_is_no_success(shared: Harness, tmp_path: Path) -> None:
    bag = tmp_path / 'run'
    shared.node.destroy_publisher(record(shared, bag))
    shutil.rmtree(bag)
    response = shared.set_bool('trainer/record', False)
    assert not response.success
    assert response.message.startswith(f'{bag} is not complete: ')
    status = shared.wait_for_status(STATUS, lambda s: s.level == DiagnosticStatus.ERROR)
    assert status.message == response.message


def test_full_disk_stops_the_recording_but_not_the_node(ros: Harness, tmp_path: Path) -> None:
    bag = tmp_path / 'run.mcap'
    # no file of this process may grow beyond 60 kB
    program = ('import resource, sys\n'
               'from koopman_ros.nodes.trainer import main\n'
               'resource.setrlimit(resource.RLIMIT_FSIZE, (60000, 60000))\n'
               'sys.exit(main())\n')
    process = ros.start('trainer', {'output': bag}, command=(sys.executable, '-c', program))
    publisher = ros.speak(Temperature, reactor.TEMPERATURE, to='trainer')
    say(publisher, 100)
    # which is flushed twice a second
    ros.wait_until(lambda: summary(bag).counts.get(TOPIC, 0) >= 100)
    say(publisher, 900, first=100)
    status = ros.wait_for_status(STATUS, lambda s: s.level == DiagnosticStatus.ERROR)
    assert status.message.startswith(f'recording to {bag} stopped: ')
    kept = values(list(read_messages(bag, [TOPIC], recover=True)))
    assert kept == list(range(len(kept)))
    assert len(kept) >= 100
    assert not summary(bag).complete

    (tmp_path / 'next').mkdir()
    ros.set_parameters('trainer', output=str(tmp_path / 'next' / 'run.mcap'))
    response = ros.set_bool('trainer/record', True)
    assert response.success, response.message
    assert process.stop() == 0
    assert 'Traceback' not in process.output()


def test_does_not_start_on_a_disk_with_too_little_room(
        tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    bag = tmp_path / 'deep' / 'run'
    assert run_here(trainer, output=bag, min_free_disk=1e9) == 1
    assert re.search(rf'\d+ MB are free on the disk of {tmp_path}, less than', complaint(capfd))
    assert not bag.parent.exists()


def test_free_name(tmp_path: Path) -> None:
    for name in ('run', 'run_2', 'v1.0'):
        (tmp_path / name).mkdir()
    (tmp_path / 'run_3').symlink_to('nowhere')
    for name in ('run.mcap', 'run_1.mcap'):
        (tmp_path / name).touch()
    free = {'run': 'run_4', 'run.mcap': 'run_2.mcap', 'run_1.mcap': 'run_1_2.mcap', 'new': 'new',
            'v1.0': 'v1.0_2'}
    assert {wanted: free_name(tmp_path / wanted).name for wanted in free} == free


UNSTAMPED = {f'{name}.{key}': value for name in ('temperature', 'coolant_temperature')
             for key, value in (('type', 'std_msgs/msg/Float64'), ('unit', 'degC'))}


def test_messages_are_logged_by_the_time_of_the_node(
        ros: Harness, tmp_path: Path, run_node: RunNode) -> None:
    """As `ros2 bag record --use-sim-time`, 20 times as fast as the clock on the wall."""
    bag = tmp_path / 'run.mcap'
    node = run_node(TrainerNode, {'output': bag, 'use_sim_time': True, **UNSTAMPED})
    values = ros.speak(Float64, reactor.TEMPERATURE, to='trainer')
    # two subscriptions: that of the recording, and that of the node's own clock
    ticks = ros.speak(Clock, topics.CLOCK, to='trainer', subscribers=2)
    values.publish(Float64(data=-1.0))
    ros.wait_for_status(STATUS, lambda status: status.level == DiagnosticStatus.WARN
                        and 'before the first /clock' in status.message)
    for k in range(40):
        # a simulation that is started again, and a time that cannot be
        ticks.publish(Clock(clock=stamp_message((50 + k if k < 30 else k - 29) * SECOND)))
        if k == 10:
            ticks.publish(Clock(clock=Time(sec=-1)))
        values.publish(Float64(data=float(k)))
        assert values.wait_for_all_acked(Duration(seconds=TIMEOUT))
    ros.wait_for_status(STATUS, lambda status: status.level == DiagnosticStatus.OK and {
        'messages on /temperature': '40'}.items() <= {
            one.key: one.value for one in status.values}.items())
    node.complete()
    found = recorded(bag)
    assert [entry.message.data for entry in found] == list(range(40))
    assert [entry.log_time_ns for entry in found] == [
        (50 + k if k < 30 else k - 29) * SECOND for k in range(40)]


def test_the_clock_is_recorded_with_unstamped_messages_logged_by_wall_time(
        ros: Harness, tmp_path: Path, run_node: RunNode) -> None:
    bag = tmp_path / 'run.mcap'
    node = run_node(TrainerNode, {'output': bag, **UNSTAMPED})
    ros.speak(Float64, reactor.TEMPERATURE, to='trainer')
    ticks = ros.speak(Clock, topics.CLOCK, to='trainer')
    ros.wait_for_status(STATUS, lambda status: status.level == DiagnosticStatus.WARN
                        and 'use_sim_time set to true' in status.message)
    ticks.publish(Clock(clock=stamp_message(SECOND)))
    ros.wait_for_status(STATUS, lambda status: {
        'messages on /clock': '1'}.items() <= {
            one.key: one.value for one in status.values}.items())
    node.complete()
    assert summary(bag).counts['/clock'] == 1
