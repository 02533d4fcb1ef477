# Copyright 2026 The koopman_ros Authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The process that retrains, as its parent sees it."""

from __future__ import annotations

from collections.abc import Iterator
import os
from pathlib import Path
import signal
import time

from koopman_ros.nodes import training_job
from koopman_ros.nodes.shipped import model_path
from koopman_ros.nodes.training_job import JobState, RetrainingJob
import pytest
from recorded_runs import driven, reactor, write_bag
from workbench import TIMEOUT


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_bag(tmp_path_factory.mktemp('bag') / 'run.mcap', driven(reactor(0.8), 6.0))


@pytest.fixture
def task(bag: Path, tmp_path: Path) -> dict[str, object]:
    return {'bags': [str(bag)], 'output': str(tmp_path / 'new.safetensors'),
            'model': str(model_path('reactor_nz4')), 'coordinates': 2, 'starts': 1}


def follow(job: RetrainingJob) -> Iterator[JobState]:
    """Yield the states of a job to its end."""
    deadline = time.monotonic() + TIMEOUT
    while not job.state.ended:
        assert time.monotonic() < deadline
        before = job.state
        if job.poll() != before:
            yield job.state


def until(job: RetrainingJob, word: str) -> None:
    """Wait for a step."""
    assert any(state.text.startswith(word) for state in follow(job))


def test_process_that_is_killed(task: dict[str, object], tmp_path: Path) -> None:
    job = RetrainingJob(task)
    until(job, 'estimating')
    os.kill(job._process.pid, signal.SIGKILL)
    *_, state = follow(job)
    assert state.text == ('the training process was killed by SIGKILL: see whether the memory '
                          'suffices, and train again')
    assert (state.ended, state.accepted, state.refused) == (True, False, False)
    assert 0.0 < state.share < 0.35
    job.close()
    assert list(tmp_path.iterdir()) == []


def test_process_that_is_terminated(task: dict[str, object], tmp_path: Path) -> None:
    job = RetrainingJob(task)
    until(job, 'estimating')
    os.kill(job._process.pid, signal.SIGTERM)
    *_, state = follow(job)
    assert state.text == 'cancelled, nothing was written'
    assert state.ended
    job.close()
    assert job._process.returncode == 1
    assert list(tmp_path.iterdir()) == []


def test_error_is_one_line(task: dict[str, object]) -> None:
    job = RetrainingJob({**task, 'nonsense': 1})
    *_, state = follow(job)
    assert state.text == ("training failed: Task.__init__() got an unexpected keyword argument "
                          "'nonsense'")
    job.close()
    assert job._process.returncode == 1


def test_process_that_breaks_down(monkeypatch: pytest.MonkeyPatch) -> None:
    # a library that prints, a line that is cut off, and an error that nobody expects
    program = ('import sys; sys.stdin.readline(); print("hello"); print(\'{"progress": 0.5, \'); '
               'print(\'{"progress": 0.25, "text": "learning"}\', flush=True); '
               'raise RuntimeError("the core melts")')
    monkeypatch.setattr(training_job, '_COMMAND', ('-c', program))
    job = RetrainingJob({})
    *_, state = follow(job)
    assert state == JobState(
        0.25, 'the training process ended with code 1: RuntimeError: the core melts', True)
    job.close()


def test_package_that_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training_job, '_COMMAND', ('-c', 'import no_such_torch'))
    job = RetrainingJob({})
    *_, state = follow(job)
    assert state.text == (
        'training needs a package that is not installed (ModuleNotFoundError: No module named '
        "'no_such_torch'): pip install 'koopman_ros[train]'")
    job.close()


def test_process_that_does_not_end_is_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    program = 'import signal, time; print(\'{"progress": 0.5, "text": "x"}\', flush=True); ' \
        'time.sleep(3600)'
    monkeypatch.setattr(training_job, '_COMMAND', ('-c', program))
    monkeypatch.setattr(training_job, '_PATIENCE', 0.2)
    job = RetrainingJob({})
    next(follow(job))
    job.close()
    assert job._process.returncode == -signal.SIGKILL
    assert job.poll().text == 'cancelled, nothing was written'
