# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The trainer as a process: what it records, how it starts and stops, and how the bag ends."""

from pathlib import Path
import signal
import sys
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
import pytest
from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Temperature
from std_msgs.msg import String

from koopman_ros.bags import BagMessage, read_messages, summary
from koopman_ros.ros import topics
from koopman_ros.testing import Harness
from support.messages import temperature, TIMEOUT

BEST_EFFORT = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
TOPIC = '/temperature'


def recorded(bag: Path, topic: str = TOPIC) -> list[BagMessage]:
    """Return the messages of a topic, of a bag that was closed."""
    assert summary(bag).complete
    return list(read_messages(bag, [topic]))


def say(publisher: Publisher, count: int, first: int = 0) -> None:
    """Publish a burst of numbered temperatures and wait until the trainer has received it."""
    for k in range(first, first + count):
        publisher.publish(temperature(float(k), float(k)))
    assert publisher.wait_for_all_acked(Duration(seconds=TIMEOUT))


def values(messages: list[Any]) -> list[float]:
    return [entry.message.temperature for entry in messages]


@pytest.mark.parametrize(('number', 'name'), [
    (signal.SIGHUP, 'run'), (signal.SIGTERM, 'run.mcap')])
def test_signal_completes_the_bag_with_all_that_arrived(
        ros: Harness, tmp_path: Path, number: int, name: str) -> None:
    trainer = ros.start('trainer', {'output': tmp_path / name})
    received = ros.listen(Temperature, topics.TEMPERATURE, QoSProfile(depth=1000), raw=True)
    publisher = ros.speak(Temperature, topics.TEMPERATURE, to='trainer', subscribers=2)
    say(publisher, 900)
    ros.wait_until(lambda: len(received) == 900)
    assert trainer.stop(number) == 0
    messages = recorded(tmp_path / name)
    assert values(messages) == list(range(900))
    assert [entry.data for entry in messages] == received
    logged = [entry.log_time_ns for entry in messages]
    assert logged == sorted(logged)
    assert all(entry.publish_time_ns <= entry.log_time_ns for entry in messages)
    assert (tmp_path / 'run' / 'metadata.yaml').exists() == (name == 'run')


@pytest.fixture(scope='module')
def shared(shared_ros: Harness) -> Harness:
    """Start one trainer, which each test leaves without a recording."""
    shared_ros.start('trainer', {'record_at_start': False})
    return shared_ros


def record(ros: Harness, output: Path, qos: QoSProfile = topics.LOOP_QOS, subscribers: int = 1
           ) -> Publisher:
    """Start to record into a file; return a publisher that is recorded from now on."""
    (result,) = ros.set_parameters('trainer', output=str(output))
    assert result.successful, result.reason
    response = ros.set_bool('trainer/record', True)
    assert response.success, response.message
    return ros.speak(Temperature, topics.TEMPERATURE, qos, to='trainer', subscribers=subscribers)


def test_recording_stops_and_starts_by_service(shared: Harness, tmp_path: Path) -> None:
    ros, first, second = shared, tmp_path / 'first.mcap', tmp_path / 'second'
    status = ros.wait_for_status('trainer: recording', lambda _: True)
    assert status.message == 'not recording'
    response = ros.set_bool('trainer/record', False)
    assert (response.success, response.message) == (False, 'not recording')
    publisher = record(ros, first)
    response = ros.set_bool('trainer/record', True)
    assert (response.success, response.message) == (False, 'already recording')
    say(publisher, 900)
    response = ros.set_bool('trainer/record', False)
    assert response.success, response.message
    assert 'first.mcap' in response.message
    assert values(recorded(first)) == list(range(900))
    ros.wait_until(lambda: publisher.get_subscription_count() == 0)
    say(publisher, 10, first=900)
    ros.node.destroy_publisher(publisher)

    publisher = record(ros, second)
    say(publisher, 10, first=1000)
    assert ros.set_bool('trainer/record', False).success
    assert values(recorded(second)) == list(range(1000, 1010))
    ros.node.destroy_publisher(publisher)


def test_takes_the_next_name_beside_an_existing_recording(shared: Harness, tmp_path: Path
                                                          ) -> None:
    bag, second, third = (tmp_path / name for name in ('run', 'run_2', 'run_3'))
    bag.mkdir()
    (bag / 'run_0.mcap').write_text('precious')
    publisher = record(shared, bag)
    say(publisher, 5)
    assert shared.set_bool('trainer/record', False).message.endswith(str(second))
    response = shared.set_bool('trainer/record', True)
    assert response.success
    assert response.message == f'recording to {third}, because {bag} exists already'
    assert shared.set_bool('trainer/record', False).success
    assert values(recorded(second)) == list(range(5))
    assert summary(third).complete
    assert [path.read_text() for path in bag.iterdir()] == ['precious']
    warnings = [line for line in shared.printed().splitlines() if 'WARN' in line]
    assert [line.partition(': ')[2] for line in warnings] == [
        f'recording to {path}, because {bag} exists already' for path in (second, third)]
    shared.node.destroy_publisher(publisher)


def test_best_effort_publisher_is_recorded(shared: Harness, tmp_path: Path) -> None:
    bag = tmp_path / 'run.mcap'
    received = shared.listen(Temperature, topics.TEMPERATURE, BEST_EFFORT)
    publisher = record(shared, bag, BEST_EFFORT, subscribers=2)
    for k in range(20):
        publisher.publish(temperature(float(k)))
        shared.wait_until(lambda k=k: len(received) > k)
    # which is flushed twice a second
    shared.wait_until(lambda: summary(bag).counts.get(TOPIC, 0) >= 20)
    assert shared.set_bool('trainer/record', False).success
    assert values(recorded(bag)) == list(range(20))
    shared.node.destroy_publisher(publisher)


def test_topic_outside_the_loop_is_recorded_by_name_in_a_namespace(
        ros: Harness, tmp_path: Path) -> None:
    bag = tmp_path / 'run.mcap'
    trainer = ros.start('trainer', {'output': bag, 'topics': ['temperature', 'notes']},
                        ('-r', '__ns:=/unit_1'))
    publisher = ros.speak(Temperature, '/unit_1/temperature', to='/unit_1/trainer')
    say(publisher, 5)
    notes = ros.speak(String, '/unit_1/notes', to='/unit_1/trainer')
    said = [f'note {k}: 51.8 °C' for k in range(10)]
    for note in said:
        notes.publish(String(data=note))
    assert notes.wait_for_all_acked(Duration(seconds=TIMEOUT))
    assert trainer.stop() == 0
    assert values(recorded(bag, '/unit_1/temperature')) == list(range(5))
    messages = recorded(bag, '/unit_1/notes')
    assert [entry.message.data for entry in messages] == said
    assert {entry.type_name for entry in messages} == {'std_msgs/msg/String'}


def test_full_disk_stops_the_recording_but_not_the_node(ros: Harness, tmp_path: Path) -> None:
    bag = tmp_path / 'run.mcap'
    # no file of this process may grow beyond 60 kB
    program = ('import resource, sys\n'
               'from koopman_ros.nodes.trainer import main\n'
               'resource.setrlimit(resource.RLIMIT_FSIZE, (60000, 60000))\n'
               'sys.exit(main())\n')
    trainer = ros.start('trainer', {'output': bag}, command=(sys.executable, '-c', program))
    publisher = ros.speak(Temperature, topics.TEMPERATURE, to='trainer')
    say(publisher, 100)
    # which is flushed twice a second
    ros.wait_until(lambda: summary(bag).counts.get(TOPIC, 0) >= 100)
    say(publisher, 900, first=100)
    status = ros.wait_for_status(
        'trainer: recording', lambda s: s.level == DiagnosticStatus.ERROR)
    assert status.message.startswith(f'recording to {bag} stopped: ')
    kept = values(list(read_messages(bag, ['/temperature'], recover=True)))
    assert kept == list(range(len(kept)))
    assert len(kept) >= 100
    assert not summary(bag).complete

    (tmp_path / 'next').mkdir()
    ros.set_parameters('trainer', output=str(tmp_path / 'next' / 'run.mcap'))
    response = ros.set_bool('trainer/record', True)
    assert response.success, response.message
    assert trainer.stop() == 0
    assert 'Traceback' not in trainer.output()
