# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The process that retrains, as its parent sees it."""

from __future__ import annotations

from collections.abc import Iterator
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

import pytest

from koopman_ros.jobs import training
from koopman_ros.jobs.training import JobState, RetrainingJob
from koopman_ros.resources import model_path
from support.messages import TIMEOUT
from support.recorded_runs import driven, reactor, write_bag


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
        else:
            # or the process that is waited for would have one core less
            time.sleep(0.01)


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
    assert 0.0 < state.share < 1.0
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
    monkeypatch.setattr(training, '_command', lambda: (sys.executable, '-c', program))
    job = RetrainingJob({})
    *_, state = follow(job)
    assert state == JobState(
        0.25, 'the training process ended with code 1: RuntimeError: the core melts', True)
    job.close()


def test_package_that_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    program = 'import no_such_torch'
    monkeypatch.setattr(training, '_command', lambda: (sys.executable, '-c', program))
    job = RetrainingJob({})
    *_, state = follow(job)
    assert state.text == (
        'training needs a package that is not installed (ModuleNotFoundError: No module named '
        "'no_such_torch'): pip install 'koopman_ros[train]'")
    job.close()


@pytest.mark.parametrize('word', ['starting', 'estimating'])
def test_process_ends_with_its_parent_that_is_killed(
        task: dict[str, object], tmp_path: Path, word: str) -> None:
    program = (
        'import sys, time\n'
        'from koopman_ros.jobs.training import RetrainingJob\n'
        f'job = RetrainingJob({task!r})\n'
        f'while not job.poll().text.startswith({word!r}):\n'
        '    time.sleep(0.01)\n'
        'print(job._process.pid, flush=True)\n'
        'time.sleep(60)\n')
    with subprocess.Popen(
            [sys.executable, '-c', program], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        parent.kill()
    deadline = time.monotonic() + 1.0
    while _running(child):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert list(tmp_path.iterdir()) == []


def _running(pid: int) -> bool:
    try:
        state = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[0]
    except FileNotFoundError:
        return False
    # one that nobody waits for stays as a zombie where the first process of a container sleeps
    return state != 'Z'


def test_process_that_does_not_end_is_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    program = 'import signal, time; print(\'{"progress": 0.5, "text": "x"}\', flush=True); ' \
        'time.sleep(3600)'
    monkeypatch.setattr(training, '_command', lambda: (sys.executable, '-c', program))
    monkeypatch.setattr(training, '_PATIENCE', 0.2)
    job = RetrainingJob({})
    next(follow(job))
    job.close()
    assert job._process.returncode == -signal.SIGKILL
    assert job.poll().text == 'cancelled, nothing was written'
