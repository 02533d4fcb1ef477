# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Retraining from a record that is longer than what is learned from."""

from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from koopman_ros.learning import retrain, TrainingTask
from koopman_ros.learning.identification import Stopped
from koopman_ros.learning.record import read_record, reduced
from koopman_ros.plants import describe
from koopman_ros.records import read, Record
from support.bag_samples import loop_episodes
from support.long_records import bags_of, drift_error, source, SYSTEM, task
from support.long_records import SAMPLES as LENGTH
from support.quick_retraining import page_of, quick_retraining

BAGS = 3
SAMPLES = BAGS * LENGTH


@pytest.fixture(scope='module', autouse=True)
def few_methods() -> Iterator[None]:
    """Estimate by a few methods alone, and try laws in a few loops."""
    with quick_retraining(4):
        yield


@pytest.fixture(scope='module')
def bags(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return bags_of(BAGS, tmp_path_factory.mktemp('bags'))


def small(bags: list[Path], output: Path) -> TrainingTask:
    return replace(task(bags, output), most_samples=3000)


def test_it_is_as_good_as_a_record_of_that_length(bags: list[Path], tmp_path: Path) -> None:
    told: list[tuple[float, str]] = []
    found = retrain(small(bags, tmp_path / 'long.safetensors'),
                    lambda share, text: told.append((share, text)) or False)
    assert found.accepted
    assert found.reduction is not None
    assert found.reduction.samples == found.account.measurements == SAMPLES
    assert found.reduction.used <= 3000
    # of rates up to 15 K/min
    assert drift_error(found.found.drift) < 0.02
    # a dozen segments of four minutes reach most of the range
    assert min(found.coverage.values()) > 0.6
    shares = [share for share, _ in told]
    assert shares == sorted(shares)
    # it is read twice, bag by bag
    assert sum(text == 'reading bags' for _, text in told) == 1 + 2 * BAGS
    assert found.summary()['reduction'] == asdict(found.reduction)
    assert found.reduction.text() in page_of(found)


def test_a_short_record_is_taken_whole(bags: list[Path]) -> None:
    found = read_record(source([*bags[:2], bags[0]]), 2 * LENGTH, 0)
    assert found.reduction is None
    assert [len(one) for one in found.episodes] == [LENGTH, LENGTH]
    # a bag that is named twice is read once, here and there
    twice = read_record(source([*bags[:2], bags[0]]), 2 * LENGTH - 1000, 0)
    assert twice.account.notes[0] == f'{bags[0]} is listed twice: read once'
    assert twice.account.used == 2 * LENGTH


def test_a_record_in_memory_is_reduced_to_the_same_segments(bags: list[Path]) -> None:
    one = source(bags[:1])
    episodes, account = loop_episodes(one.bags, one.states, one.inputs)
    record = Record(describe(SYSTEM), tuple(episodes), account, one.bags)
    streamed, found = read_record(one, 1000, 5), reduced(record, 1000, 5)
    assert found.reduction == streamed.reduction
    for own, other in zip(found.episodes, streamed.episodes, strict=True):
        assert np.array_equal(own.x, other.x)


def test_a_record_with_missing_values_is_reduced_without_averages() -> None:
    time = 0.1 * np.arange(4000)
    lab = np.where(np.arange(4000) % 20 == 0, np.cos(0.01 * time), np.nan)
    record = read({'time': time, 'level': np.sin(0.01 * time), 'lab': lab, 'pump': time},
                  ['level', 'lab'], 'pump')
    found = reduced(record, 1000, 0)
    assert found.reduction is not None
    assert (found.reduction.group, found.reduction.samples) == (1, 4000)
    assert found.reduction.used <= 1000
    every = np.concatenate([one.x for one in found.episodes])
    # the extremes are among them
    assert np.nanmax(every, axis=0) == pytest.approx(np.nanmax(record.episodes[0].x, axis=0))
    assert np.isnan(every[:, 1]).mean() == pytest.approx(0.95, abs=0.01)


def test_reading_can_be_stopped(bags: list[Path], tmp_path: Path) -> None:
    told: list[float] = []
    with pytest.raises(Stopped):
        retrain(small(bags, tmp_path / 'x.safetensors'),
                lambda share, _: told.append(share) or len(told) == 4)
    assert 0.0 < told[-1] < 0.05
    assert list(tmp_path.iterdir()) == []
