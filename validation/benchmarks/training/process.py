# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Processes that are given a bounded time and memory."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
import json
import multiprocessing
from multiprocessing import forkserver
from multiprocessing.context import ForkServerProcess
import os
from pathlib import Path
import signal
import tempfile
import time
from typing import Any

from validation.benchmarks.options import ONE_THREAD

_POLL = 0.05   # s
_START = 30.0  # s for imports and data
# A solver looks at its own limit between two steps, and a step may be long; besides, its iterates
# are judged in the same process.
_GRACE = 10.0  # s
_SLACK = 2.0
# Limits are on processor time, and this many times as much is allowed on the wall.
_CROWDED = 4.0
_PAGE = os.sysconf('SC_PAGE_SIZE') / 2 ** 20  # MB
_TICK = 1.0 / os.sysconf('SC_CLK_TCK')  # s
# Imported once; every process is forked from the one that has them.
_PRELOAD = ['validation.benchmarks.training.part', 'validation.benchmarks.training.worker',
            'casadi', 'torch._dynamo']


@dataclass(frozen=True)
class Outcome:
    """What a process has noted."""

    events: tuple[dict[str, Any], ...]  #: in their order
    failure: str  #: why it did not end by itself, or empty

    def find(self, key: str) -> Any:
        """Return the first value under a key, or None."""
        return next((event[key] for event in self.events if key in event), None)


def run(job: dict[str, Any], *, build_limit: float, limit: float, megabytes: float) -> Outcome:
    """
    Run one job of :mod:`validation.benchmarks.training.worker` on one thread.

    :param job: what to do.
    :param build_limit: processor time until the first event, beside what it takes to start, s.
    :param limit: processor time from then on, s.
    :param megabytes: resident memory at which it is ended.
    """
    lifetime = _CROWDED * (_START + build_limit + _SLACK * limit + _GRACE) + _GRACE
    context = multiprocessing.get_context('forkserver')
    context.set_forkserver_preload(_PRELOAD)
    with _environment(ONE_THREAD):
        forkserver.ensure_running()
    with tempfile.TemporaryDirectory(prefix='koopman_bench_') as folder:
        events, output = Path(folder, 'events'), Path(folder, 'output')
        events.touch()
        process = context.Process(target=_enter, args=(job, folder, int(lifetime)))
        process.start()
        try:
            failure = _watch(process, events, build_limit, limit, megabytes)
        finally:
            process.kill()
            process.join()
        noted = _read(events)
        if not failure and process.exitcode:
            last = output.read_text().strip().rpartition('\n')[2]
            failure = last or f'ended with status {process.exitcode}'
    error = next((event['error'] for event in noted if 'error' in event), '')
    return Outcome(noted, failure or error)


def _enter(job: dict[str, Any], folder: str, lifetime: int) -> None:
    """Begin a job in its process."""
    from validation.benchmarks.training import worker

    # Ctrl-C is answered by the process that waits; where that was killed, the alarm ends this one
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.alarm(lifetime)
    # compilers leave files where they run
    os.chdir(folder)
    with open('output', 'wb') as stream:
        os.dup2(stream.fileno(), 1)
        os.dup2(stream.fileno(), 2)
    worker.main(job, Path('events').absolute())


@contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    """Set variables for a while."""
    before = dict(os.environ)
    os.environ.update(values)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


def _watch(process: ForkServerProcess, events: Path, build_limit: float, limit: float,
           megabytes: float) -> str:
    """Wait for the end; return why it has to be ended, or nothing."""
    start, spent, allowed, building = time.monotonic(), 0.0, _START + build_limit, True
    while process.is_alive():
        now = _spent(process.pid or 0)
        if building and events.stat().st_size:
            start, spent, allowed, building = (
                time.monotonic(), now, _SLACK * limit + _GRACE, False)
        if now - spent > allowed or time.monotonic() - start > _CROWDED * allowed:
            return (f'not built after {build_limit:g} s' if building
                    else f'stopped after {limit:g} s')
        if _resident(process.pid or 0) > megabytes:
            return f'needs more than {megabytes:.0f} MB of memory'
        process.join(_POLL)
    return ''


def _resident(pid: int) -> float:
    """Return the memory of a process in MB, 0 where the system does not tell."""
    try:
        return float(Path(f'/proc/{pid}/statm').read_text().split()[1]) * _PAGE
    except (OSError, IndexError):
        return 0.0


def _spent(pid: int) -> float:
    """Return the processor time of a process and its children in s, 0 where nobody tells."""
    try:
        fields = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
        return sum(int(field) for field in fields[11:15]) * _TICK
    except (OSError, ValueError):
        return 0.0


def _read(events: Path) -> tuple[dict[str, Any], ...]:
    # a line may be half written when the process is killed
    lines = events.read_text().split('\n')[:-1]
    return tuple(json.loads(line) for line in lines)
