# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Retraining from a record that is longer than what is learned from."""

from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from koopman_ros.learning import retrain, TrainingTask
from koopman_ros.learning.record import read_record, reduced
from koopman_ros.plants import describe
from koopman_ros.records import loop_episodes, Record
from support.long_records import bags_of, drift_error, source, SYSTEM, task
from support.long_records import SAMPLES as LENGTH
from support.quick_retraining import page_of, quick_retraining

BAGS = 6
SAMPLES = BAGS * LENGTH


@pytest.fixture(scope='module', autouse=True)
def few_methods() -> Iterator[None]:
    """Estimate by a few methods alone, and try laws in a few loops."""
    with quick_retraining(16):
        yield


@pytest.fixture(scope='module')
def bags(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return bags_of(BAGS, tmp_path_factory.mktemp('bags'))


def small(bags: list[Path], output: Path) -> TrainingTask:
    return replace(task(bags, output), coordinates=2, starts=1, most_samples=3000)


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


def test_a_record_in_memory_is_reduced_to_the_same_segments(bags: list[Path]) -> None:
    one = source(bags[:1])
    episodes, account = loop_episodes(one.bags, one.states, one.inputs)
    record = Record(describe(SYSTEM), tuple(episodes), account, one.bags)
    streamed, found = read_record(one, 1000, 5), reduced(record, 1000, 5)
    assert found.reduction == streamed.reduction
    for own, other in zip(found.episodes, streamed.episodes, strict=True):
        assert np.array_equal(own.x, other.x)
