# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Bags with random damage: they give a result or one clear sentence, and never what was not recorded.

`BAG_MUTANTS=5000 pytest test/bags/test_fuzz.py` tries that many of each kind instead of a few.
"""

from collections.abc import Callable
import os
from pathlib import Path
import random
import resource
import shutil

import pytest

from koopman_ros.bags import (
    BagMessage,
    BagReadError,
    BagSummary,
    read_messages,
    read_series,
    summary,
)
from support.bag_samples import mutate, Sample, Specimen, specimens, TOPICS

MUTANTS = int(os.environ.get('BAG_MUTANTS', '40'))
ROUNDS = 8
KINDS = ['none', 'zstd', 'lz4', 'directory', 'files compressed by rosbag2',
         'messages compressed by rosbag2', 'without checksums', 'without chunks']
# What a process may grow by however many bytes a damaged length declares [KiB].
MEMORY = 200 * 1024


@pytest.fixture(scope='module')
def few(samples: list[Sample]) -> list[Sample]:
    return samples[:ROUNDS * len(TOPICS)]


@pytest.fixture(scope='module')
def whole(tmp_path_factory: pytest.TempPathFactory, few: list[Sample]) -> dict[str, Specimen]:
    return specimens(tmp_path_factory.mktemp('specimens'), few)


def _write(path: Path, files: dict[str, bytes]) -> Path:
    shutil.rmtree(path, ignore_errors=True)
    path.mkdir(parents=True)
    for name, content in files.items():
        (path / (name or 'run.mcap')).write_bytes(content)
    return path / 'run.mcap' if '' in files else path


def _content(messages: list[BagMessage]) -> list[tuple[str, bytes, int, int]]:
    return [(m.topic, m.data, m.log_time_ns, m.publish_time_ns) for m in messages]


def _attempt(read: Callable[[], object]) -> object:
    """Return what was read, or None for an error of one line."""
    try:
        return read()
    except BagReadError as error:
        sentence = str(error)
    assert sentence
    assert sentence.splitlines() == [sentence]
    return None


def _check(path: Path, sent: list[tuple[str, bytes, int, int]], guarded: bool) -> None:
    strict = _attempt(lambda: _content(list(read_messages(path))))
    recovered = _attempt(lambda: _content(list(read_messages(path, recover=True))))
    if guarded:
        assert strict is None or strict == sent
        assert recovered is None or set(recovered) <= set(sent)
        content = _attempt(lambda: summary(path))
        assert (not isinstance(content, BagSummary) or not content.complete
                or content.message_count == len(sent))
    _attempt(lambda: summary(path))
    for recover in (False, True):
        _attempt(lambda recover=recover: read_series(
            path, '/temperature', recover=recover))


@pytest.mark.parametrize('kind', KINDS)
def test_whole_bag_is_read(
    tmp_path: Path, whole: dict[str, Specimen], few: list[Sample], kind: str
) -> None:
    sent = [(s.topic, s.data, s.log_time_ns, s.publish_time_ns) for s in few]
    path = _write(tmp_path / 'bag', whole[kind].files)
    for recover in (False, True):
        assert _content(list(read_messages(path, recover=recover))) == sent
    content = summary(path)
    assert (content.counts, content.types) == (dict.fromkeys(TOPICS, ROUNDS), TOPICS)
    assert content.complete
    assert len(read_series(path, '/temperature').values) == ROUNDS


@pytest.mark.parametrize('kind', KINDS)
def test_damaged_bag_is_read_or_refused_in_one_line(
    tmp_path: Path, whole: dict[str, Specimen], few: list[Sample],
    capsys: pytest.CaptureFixture[str], kind: str
) -> None:
    sent = [(s.topic, s.data, s.log_time_ns, s.publish_time_ns) for s in few]
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for seed in range(MUTANTS):
        dice = random.Random(seed)
        files = dict(whole[kind].files)
        victim = dice.choice(sorted(files))
        files[victim] = mutate(dice, files[victim])
        if len(files) > 1 and dice.random() < 0.1:
            del files[dice.choice(sorted(files))]
        path = _write(tmp_path / 'bag', files)
        try:
            _check(path, sent, whole[kind].guarded)
        except Exception as error:
            raise AssertionError(f'{kind}: the mutant of seed {seed}') from error
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < MEMORY
    assert capsys.readouterr() == ('', '')
