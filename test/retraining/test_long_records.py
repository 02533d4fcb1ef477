# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Retraining from a record that is longer than what is learned from."""

from collections.abc import Iterator
from dataclasses import replace
import json
from pathlib import Path
import pickle

import numpy as np
import pytest

from koopman_ros.bags import loop_episodes
from koopman_ros.identification import Stopped
from koopman_ros.identification.regression import weak_form
from koopman_ros.jobs.backends import backend_of, Here
from koopman_ros.plant_data import cut
from koopman_ros.retraining import retrain, Task, write_report
from koopman_ros.retraining.known import known
from koopman_ros.retraining.record import read_record, Source
from koopman_ros.retraining.shards import identify_bags
from support.quick_retraining import quick_retraining
from validation.benchmarks.retraining import Case, cases, drift_error, task_of, write_bags

SLOW = cases()['reactor at 1 Hz']
# ten bags of 10000 samples
CASE = replace(SLOW, bag=10_000)
SAMPLES = 100_000


@pytest.fixture(scope='module', autouse=True)
def few_methods() -> Iterator[None]:
    """Estimate by a few methods alone, and try laws in a few loops."""
    with quick_retraining(16):
        yield


@pytest.fixture(scope='module')
def bags(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return write_bags(CASE, SAMPLES, tmp_path_factory.mktemp('bags'))


def small(bags: list[Path], output: Path, case: Case = CASE) -> Task:
    return replace(task_of(case, bags, output), coordinates=2, starts=1, most_samples=3000)


def test_it_is_as_good_as_a_record_of_that_length(bags: list[Path], tmp_path: Path) -> None:
    told: list[tuple[float, str]] = []
    found = retrain(small(bags, tmp_path / 'long.safetensors'),
                    lambda share, text: told.append((share, text)) or False)
    assert found.accepted
    assert found.reduction is not None
    assert found.reduction.samples == found.account.measurements == SAMPLES
    assert found.reduction.used <= 3000
    # of rates up to 15 K/min
    assert drift_error(CASE, found.found.drift)[0] < 0.02
    # a dozen segments of four minutes reach most of the range
    assert min(found.coverage.values()) > 0.6
    shares = [share for share, _ in told]
    assert shares == sorted(shares)
    # it is read twice, bag by bag
    assert sum(text == 'reading bags' for _, text in told) == 1 + 2 * 10
    files = write_report(found)
    assert json.loads(files[0].read_text())['reduction'] == {
        'samples': SAMPLES, 'group': 1, 'segments': found.reduction.segments,
        'chosen': found.reduction.chosen, 'used': found.reduction.used}
    assert found.reduction.text() in files[1].read_text()


def source(bags: list[Path]) -> Source:
    task = task_of(CASE, bags, Path('none.safetensors'))
    return Source(task.bags, task.states, task.inputs, 0, None)


def test_the_same_is_read_whoever_reads(bags: list[Path]) -> None:
    few, told = source(bags[:4]), []
    one = read_record(few, 3000, 7)
    with backend_of('process') as elsewhere:
        other = read_record(few, 3000, 7, tick=told.append, backend=elsewhere)
    assert min(told) == 0
    assert one.reduction == other.reduction
    assert one.account == other.account
    for a, b in zip(one.episodes, other.episodes, strict=True):
        np.testing.assert_array_equal(a.x, b.x)
    another = read_record(few, 3000, 8).episodes
    assert [part.x[0, 0] for part in another] != [part.x[0, 0] for part in one.episodes]


def test_a_short_record_is_taken_whole(bags: list[Path]) -> None:
    found = read_record(source([*bags[:2], bags[0]]), 20_000, 0)
    assert found.reduction is None
    assert [len(one) for one in found.episodes] == [10_000, 10_000]
    # a bag that is named twice is read once, here and there
    twice = read_record(source([*bags[:2], bags[0]]), 15_000, 0)
    assert twice.account.notes[0] == f'{bags[0]} is named twice: read once'
    assert twice.account.used == 20_000


def test_reading_can_be_stopped(bags: list[Path], tmp_path: Path) -> None:
    told: list[float] = []
    with pytest.raises(Stopped):
        retrain(small(bags, tmp_path / 'x.safetensors'),
                lambda share, _: told.append(share) or len(told) == 4)
    assert 0.0 < told[-1] < 0.05
    assert list(tmp_path.iterdir()) == []


def test_a_drift_of_bags_that_stay_with_their_workers(bags: list[Path]) -> None:
    """Fitted to triangles of each bag as to all equations, and no samples come back."""
    few = source(bags[:3])
    plant = known(task_of(CASE, bags, Path('none.safetensors')), None)[0]
    sizes: list[int] = []

    class Weighed(Here):
        def keep(self, load, items):
            kept = super().keep(load, items)
            original = kept.run

            def run(function, argument):
                found = original(function, argument)
                sizes.append(max(len(pickle.dumps(one)) for one in found))
                return found

            kept.run = run
            return kept

    here = identify_bags(plant, few, Weighed(), degrees=(1, 2, 3))
    with backend_of('process') as elsewhere:
        there = identify_bags(plant, few, elsewhere, degrees=(1, 2, 3))
    assert there.drift.coefficients.tobytes() == here.drift.coefficients.tobytes()
    assert there.drift.B.tobytes() == here.drift.B.tobytes()
    assert here.samples == 3 * 10_000
    assert [shard.name for shard in here.shards] == list(map(str, bags[:3]))
    assert max(sizes) < 2000
    episodes = cut(loop_episodes(few.bags, few.states, few.inputs)[0], 240)
    whole = weak_form(episodes, here.drift.box, here.drift.degree, None, 40)
    assert here.drift.coefficients == pytest.approx(whole.coefficients, rel=1e-8)
    assert pytest.approx(whole.B, rel=1e-8) == here.drift.B
    assert max(drift_error(CASE, here.drift)) < 0.05
    part = here.shards[0].read(*here.shards[0].arguments)
    assert part.dxdt == pytest.approx(here.drift.rate(part.x, part.u))
