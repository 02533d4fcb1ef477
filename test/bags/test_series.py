# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from koopman_ros.bags import BagReadError, BagWriter, message_definition, temperature_series
from support.bag_samples import PERIOD_NS, ROUNDS, START_NS

WriteBag = Callable[..., Path]


def test_arrays_of_a_temperature_topic(tmp_path: Path, write_bag: WriteBag) -> None:
    series = temperature_series(write_bag(tmp_path / 'run'), '/temperature')
    index = np.arange(ROUNDS)
    np.testing.assert_array_equal(series.stamp_ns, START_NS + PERIOD_NS * index)
    assert series.stamp_ns.dtype == np.int64
    np.testing.assert_array_equal(series.stamp_s, series.stamp_ns / 1e9)
    np.testing.assert_array_equal(series.celsius, 51.95 + 0.1 * index)
    np.testing.assert_array_equal(series.variance, np.full(ROUNDS, 0.04))


def test_origin_is_subtracted_before_rounding(tmp_path: Path, write_bag: WriteBag) -> None:
    series = temperature_series(
        write_bag(tmp_path / 'run'), '/temperature', origin_ns=START_NS - 1)
    expected = (PERIOD_NS * np.arange(ROUNDS) + 1) / 1e9
    np.testing.assert_array_equal(series.stamp_s, expected)


def test_topic_without_messages_gives_empty_arrays(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'run.mcap') as writer:
        writer.add_topic('/t', message_definition('sensor_msgs/msg/Temperature'))
    series = temperature_series(writer.path, '/t')
    assert series.stamp_s.shape == series.celsius.shape == series.variance.shape == (0,)
    assert series.stamp_ns.dtype == np.int64


def test_unknown_topic_lists_the_known_ones(tmp_path: Path, write_bag: WriteBag) -> None:
    with pytest.raises(BagReadError, match=(
            "has no topic '/temp': choose one of /clock, /diagnostics, /joint_states, "
            '/temperature')):
        temperature_series(write_bag(tmp_path / 'run'), '/temp')


def test_topic_of_another_type(tmp_path: Path, write_bag: WriteBag) -> None:
    with pytest.raises(BagReadError, match=(
            r"'/joint_states' .* is sensor_msgs/msg/JointState, not sensor_msgs/msg/Temp")):
        temperature_series(write_bag(tmp_path / 'run'), '/joint_states')


def test_cut_bag_needs_recover(tmp_path: Path, write_bag: WriteBag) -> None:
    path = write_bag(tmp_path / 'run.mcap')
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(BagReadError, match='is cut short'):
        temperature_series(path, '/temperature')
    assert len(temperature_series(path, '/temperature', recover=True).celsius) == ROUNDS
