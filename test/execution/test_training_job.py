# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The process that retrains, as its parent sees it."""

from collections.abc import Iterator
from dataclasses import asdict
import os
from pathlib import Path
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest

from koopman_ros.core.paths import model_path
from koopman_ros.execution import job as job_module
from koopman_ros.execution import training
from koopman_ros.execution.training import JobState, TrainingJob
from koopman_ros.model import load
from support.nodes import TIMEOUT, wait_until_ended
from support.quick_retraining import QUICK_CHILD
from support.recorded_runs import driven, INPUTS, reactor, STATES, write_bag


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_bag(tmp_path_factory.mktemp('bag') / 'run.mcap', driven(reactor(0.8), 6.0))


@pytest.fixture
def task(bag: Path, tmp_path: Path) -> dict[str, object]:
    return {'bags': [str(bag)], 'output': str(tmp_path / 'new.safetensors'),
            'model': str(model_path('reactor_nz4')), 'coordinates': 2, 'starts': 1,
            'states': list(map(asdict, STATES)), 'inputs': list(map(asdict, INPUTS))}


def follow(job: TrainingJob) -> Iterator[JobState]:
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


@pytest.mark.parametrize(('begun', 'number', 'code', 'words'), [
    (False, signal.SIGKILL, -signal.SIGKILL,
     'the training process was killed by SIGKILL: check the free memory, and train again'),
    (True, signal.SIGTERM, 1, 'cancelled; nothing was written')])
def test_process_that_gets_a_signal(
        task: dict[str, object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, begun: bool,
        number: int, code: int, words: str) -> None:
    # its libraries may take their time to end on a busy machine
    monkeypatch.setattr(job_module, '_PATIENCE', TIMEOUT)
    job = TrainingJob(task)
    if begun:
        # whichever of its steps is seen first
        assert not next(follow(job)).ended
    os.kill(job.process.pid, number)
    *_, state = follow(job)
    assert (state.text, state.ended) == (words, True)
    assert (state.accepted, state.rejected) == (False, False)
    assert state.share < 1.0
    job.close()
    assert job.process.returncode == code
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize('by_signal', [False, True])
def test_a_cancelled_training_keeps_the_best_class_so_far(
        task: dict[str, object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
        by_signal: bool) -> None:
    monkeypatch.setattr(job_module, '_PATIENCE', TIMEOUT)
    monkeypatch.setattr(
        TrainingJob, 'command', lambda *_: (sys.executable, '-c', QUICK_CHILD))
    job = TrainingJob({**task, 'model_class': 'best', 'dead_time': {'coolant_temperature': 0.0}})
    for state in follow(job):
        if state.text.startswith('learning: neural drift'):
            break
    if by_signal:
        os.kill(job.process.pid, signal.SIGTERM)
    else:
        job.cancel()
    *_, last = follow(job)
    job.close()
    assert (last.cancelled, last.accepted, last.rejected) == (True, False, False)
    file = tmp_path / 'new.unfinished.safetensors'
    assert f'kept as {file}' in last.text
    assert 'classes not tried: neural drift, identity lift, free lift' in last.text
    assert load(file).provenance.accepted is False
    assert file.with_suffix('.md').exists()


@pytest.mark.parametrize(('program', 'share', 'words'), [
    # a library that prints, a line that is cut off, and an error that nobody expects
    ('import sys; sys.stdin.readline(); print("hello"); print(\'{"progress": 0.5, \'); '
     'print(\'{"progress": 0.25, "text": "learning"}\', flush=True); '
     'raise RuntimeError("the core melts")', 0.25, 'code 1: RuntimeError: the core melts'),
    ('import no_such_torch', 0.0, "No module named 'no_such_torch'): pip install torch"),
    ('import os, signal; os.kill(os.getpid(), signal.SIGXCPU)', 0.0, 'day of processor'),
    # before it has read its task
    ('raise SystemExit("no time")', 0.0, 'code 1: no time')])
def test_process_that_breaks_down(
        monkeypatch: pytest.MonkeyPatch, program: str, share: float, words: str) -> None:
    monkeypatch.setattr(TrainingJob, 'command', lambda *_: (sys.executable, '-c', program))
    # more than a pipe holds
    job = TrainingJob({'output': 'x' * 1_000_000})
    *_, last = follow(job)
    assert (last.share, last.ended) == (share, True)
    assert words in last.text
    job.close()


def test_process_ends_with_its_parent_that_is_killed(
        task: dict[str, object], tmp_path: Path) -> None:
    program = (
        'import sys, time\n'
        'from koopman_ros.execution.training import TrainingJob\n'
        f'job = TrainingJob({task!r})\n'
        'while job.poll().text == "starting":\n'
        '    time.sleep(0.01)\n'
        'print(job.process.pid, flush=True)\n'
        'time.sleep(600)\n')
    with subprocess.Popen(
            [sys.executable, '-c', program], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        parent.kill()
    wait_until_ended(child)
    assert list(tmp_path.iterdir()) == []


def test_process_that_does_not_end_is_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(TrainingJob, 'command', lambda *_: (
        'sh', '-c', 'echo \'{"progress": 0.5, "text": "x"}\'; exec sleep 3600'))
    monkeypatch.setattr(job_module, '_PATIENCE', 0.2)
    job = TrainingJob({})
    next(follow(job))
    job.close()
    assert job.process.returncode == -signal.SIGKILL
    assert job.poll().cancelled


def test_figures_are_reported_for_each_signal() -> None:
    assert training.scalars({
        'accepted': True, 'reasons': ['no'], 'noise': {'low': 0.5, 'high': None},
        'input_gain': {'low': {'pump': 2.0}}}) == {
            'accepted': True, 'noise: low': 0.5, 'input_gain: low: pump': 2.0}
    summary = {'accepted': True, 'model_class': 'free lift', 'model_file': 'new',
               'units': {'low': 'm', 'high': 'Pa'}, 'heldout_error': {'low': 0.25, 'high': 3.0},
               'heldout_error_of_current_model': {'low': 1.0, 'high': 3.0}}
    words = training.outcome_text(summary)
    assert '0.25 m in low, 3 Pa in high, that' in words
    assert '1 m in low, 3 Pa in high' in words
    summary['heldout_error_of_current_model']['low'] = None
    assert 'infinite (diverges)' in training.outcome_text(summary)
    said = {**summary, 'closed_loop_statement': 'On 30 plants'}
    assert training.outcome_text(said).endswith('written to new. On 30 plants')


def test_a_line_of_progress_says_about_how_long_the_rest_takes(
        monkeypatch: pytest.MonkeyPatch) -> None:
    now, lines = [0.0], list[str]()
    monkeypatch.setattr(training, 'time', SimpleNamespace(monotonic=lambda: now[0]))
    progress = training.TrainingProgress(lines.append)
    for seconds, share in ((2.0, 0.1), (20.0, 0.25), (60.0, 0.2)):
        now[0] = seconds
        progress.show(JobState(share, 'learning'))
    assert len(lines) == 2
    assert '25 %: about 60 s left, learning' in lines[0]
    assert 'about 4 min left' in lines[1]
