# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Recordings of a demo, whole and with messages that a busy machine has lost."""

from pathlib import Path

import numpy as np
import pytest

from koopman_ros.demo.results import read_run
from koopman_ros.parameters.trainer_table import preset_wiring
from koopman_ros.records import BagWriter, message_definition, read_messages
from support.recorded_runs import Run, write_bag

COUNT, COOLANT = 8, '/coolant_setpoint'


def without(bag: Path, lost: dict[str, tuple[int, ...]]) -> Path:
    """Return a copy of a bag without some messages of its topics."""
    copy, counts = bag.with_name('copy.mcap'), dict.fromkeys(('/temperature', COOLANT), 0)
    with BagWriter(copy) as writer:
        for topic in counts:
            writer.add_topic(topic, message_definition('sensor_msgs/msg/Temperature'))
        for entry in read_messages(bag, list(counts)):
            number = counts[entry.topic]
            counts[entry.topic] += 1
            if number not in lost.get(entry.topic, ()):
                writer.write(entry.topic, entry.data, entry.log_time_ns)
    return copy


@pytest.mark.parametrize(('lost', 'words'), [
    ({}, ''), ({COOLANT: (COUNT - 1,)}, ''),
    ({COOLANT: (COUNT - 2, COUNT - 1)}, f'lacks 1 of {COUNT} samples of coolant_temperature'),
    ({COOLANT: (2, 5)}, f'lacks 2 of {COUNT} samples of coolant_temperature'),
    ({'/temperature': (0,), COOLANT: (3,)},
     f'lacks 1 of {COUNT} samples of temperature, 1 of {COUNT} samples of coolant_temperature'),
    ({'/temperature': (4,), COOLANT: (4,)}, f'lacks 1 of {COUNT} samples of temperature')])
def test_samples_that_are_lost_are_named(tmp_path: Path, lost: dict[str, tuple[int, ...]],
                                         words: str) -> None:
    wiring = preset_wiring('reactor')
    assert wiring is not None
    bag = without(write_bag(tmp_path / 'whole.mcap', Run(
        np.full(COUNT, 320.0), np.full(COUNT, 300.0))), lost)
    if not words:
        run = read_run(wiring, bag)
        np.testing.assert_allclose(run.seconds, np.arange(COUNT))
        assert len(run.command_seconds) == COUNT - len(lost.get(COOLANT, ()))
        return
    with pytest.raises(ValueError, match=words) as caught:
        read_run(wiring, bag)
    assert 'run the demo again' in str(caught.value)
