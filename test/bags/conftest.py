# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Serialized messages of four types, made by ROS itself, and bags of them."""

from collections.abc import Callable, Iterator
import importlib
from pathlib import Path
from typing import Any
import warnings

import pytest

from koopman_ros.bags import BagWriter, message_definition
from support.bag_samples import messages, OFFERED_QOS, PERIOD_NS, ROUNDS, Sample, START_NS, TOPICS


@pytest.fixture(scope='session')
def samples() -> list[Sample]:
    serialization = importlib.import_module('rclpy.serialization')
    with warnings.catch_warnings():
        # The type support imports its generator, whose parser imports a deprecated module.
        warnings.simplefilter('ignore', DeprecationWarning)
        for message in messages(0, START_NS).values():
            serialization.serialize_message(message)
    found = []
    for index in range(ROUNDS):
        stamp_ns = START_NS + index * PERIOD_NS
        for offset, (topic, message) in enumerate(messages(index, stamp_ns).items()):
            found.append(Sample(
                topic=topic,
                message=message,
                data=serialization.serialize_message(message),
                log_time_ns=stamp_ns + 1_000_000 + offset,
                publish_time_ns=stamp_ns + offset,
            ))
    return found


@pytest.fixture
def write_bag(samples: list[Sample]) -> Callable[..., Path]:
    """Return a function that writes all samples to a path, with the writer's options."""

    def write(path: Path, **options: Any) -> Path:
        # A clock that moves 0.1 s a message gives chunks of a known number of messages.
        ticks: Iterator[float] = (0.1 * count for count in range(10**6))
        with BagWriter(path, **{'clock': lambda: next(ticks), **options}) as writer:
            for topic in dict.fromkeys(sample.topic for sample in samples):
                writer.add_topic(topic, message_definition(TOPICS[topic]), OFFERED_QOS[topic])
            for sample in samples:
                writer.write(
                    sample.topic, sample.data, sample.log_time_ns, sample.publish_time_ns)
        return path

    return write
