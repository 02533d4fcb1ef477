# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A controller begins in numpy, goes on compiled, and its records say from when."""

import itertools

from std_msgs.msg import String

from koopman_ros.kernels import COMPILED, named
from koopman_ros.replay.records import NUMERICS
from koopman_ros.ros import topics
from koopman_ros.testing import Harness
from support.controller_bench import Bench, reproduced, STEADY


def test_compiled_step_takes_over_after_the_first_command_and_is_replayed(ros: Harness) -> None:
    # what is kept now, the controller need not wait for
    assert named(COMPILED)
    records = ros.listen(String, topics.CONTROLLER_EVENTS)
    bench = Bench(ros, {'compiled': True, 'disturbance_bandwidth': 0.0})
    later = itertools.count(2)

    def measure() -> bool:
        """Measure once more; tell whether the last answers were compiled."""
        bench.measure(STEADY - 0.1 * (next(later) % 7), float(next(later)))
        switched = [k for k, record in enumerate(records)
                    if f'"event":"{NUMERICS}"' in record.data]
        return bool(switched) and len(records) > switched[0] + 20

    ros.wait_until(measure)
    ros.wait_until(lambda: sum('"event":"measurement"' in record.data for record in records)
                   == bench.sent)
    written, commands = reproduced(records)
    assert [record.event for record in written].count(NUMERICS) == 1
    # the one that a new listener gets, or that of the start
    assert written[0].fields[NUMERICS] == 'numpy'
    assert commands == [message.temperature for message in bench.commands]
