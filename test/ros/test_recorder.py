# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The order and the times in which what waited on several topics is recorded."""

from pathlib import Path
import time
from typing import Any

import pytest
from rclpy.duration import Duration
from sensor_msgs.msg import Temperature

from koopman_ros.bags import BagWriter, read_messages
from koopman_ros.ros import recorder, topics
from koopman_ros.ros.recorder import receipt_ns, Recorder
from koopman_ros.testing import Harness
from koopman_ros.units import NANOSECONDS
from support.messages import temperature, TIMEOUT

NAMES = (topics.TEMPERATURE, topics.SETPOINT, topics.COOLANT_SETPOINT)


def stamped_at_the_take(handle: Any, message_type: type) -> Any:
    """Take a message as rmw_cyclonedds does, which says that it was received just now."""
    taken = handle.take_message(message_type, True)
    return taken and (taken[0], {**taken[1], 'received_timestamp': time.time_ns()})


@pytest.mark.parametrize('at_the_take', [False, True])
def test_batch_is_recorded_in_the_order_of_sending(
        ros: Harness, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at_the_take: bool
        ) -> None:
    if at_the_take:
        monkeypatch.setattr(recorder, 'take_raw', stamped_at_the_take)
    publishers = [ros.node.create_publisher(Temperature, name, topics.LOOP_QOS) for name in NAMES]
    recording = Recorder(ros.node, BagWriter(tmp_path / 'run.mcap'), NAMES)
    ros.wait_until(lambda: all(p.get_subscription_count() for p in publishers))
    recording.take()
    sent = []
    for k in range(90):
        publisher = publishers[(k * k) % 7 % 3]
        publisher.publish(temperature(float(k)))
        # one after the other, for a middleware that tells when they arrived
        assert publisher.wait_for_all_acked(Duration(seconds=TIMEOUT))
        sent.append((publisher.topic_name, float(k)))
    before = time.time_ns()
    recording.take()
    recording.close()
    messages = list(read_messages(tmp_path / 'run.mcap'))
    assert [(m.topic, m.message.temperature) for m in messages] == sent
    logged = [m.log_time_ns for m in messages]
    assert logged == sorted(logged)
    # the times are not those at which the batch was taken
    assert logged[-1] < before
    assert all(m.publish_time_ns <= m.log_time_ns for m in messages)


@pytest.mark.parametrize(('received', 'source', 'found'), [
    (70, 60, 70),  # stamped on arrival
    (100, 60, 60),  # at the take
    (101, 60, 60),
    (0, 60, 60),  # not at all
    (101, 0, 101),
    (0, 0, 100),
    (101, 49.5, 49.5),  # on its way when nothing had come yet
    (101, 20, 50),  # by a sender whose clock is late
    (101, 900, 101),  # or early
    (40, 30, 40),
])
def test_time_of_receipt(received: float, source: float, found: float) -> None:
    info = {'received_timestamp': round(received * NANOSECONDS),
            'source_timestamp': round(source * NANOSECONDS)}
    assert receipt_ns(info, take_ns=100 * NANOSECONDS, empty_ns=50 * NANOSECONDS) == round(
        found * NANOSECONDS)
