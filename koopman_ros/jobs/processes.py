# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Work in processes of its own on this machine, which joblib starts."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
import contextlib
import math
import os
from pathlib import Path
import pickle
import signal
import tempfile
import time
from types import TracebackType
from typing import Any, Self
import uuid

import cloudpickle
from joblib.externals.loky import ProcessPoolExecutor

from koopman_ros.jobs.backends import (
    ATTEMPTS,
    Found,
    Item,
    Kept,
    never,
    noted,
    PATIENCE,
    PERIOD,
    SILENCE,
    Task,
    Tell,
    Watch,
    WorkerLost,
)
from koopman_ros.startup import ONE_THREAD

_STOP, _SHARED = 'stop', 'shared'


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0))


class Processes:
    """
    So many processes, started when they are needed first, each with one thread.

    One that is stopped (by SIGSTOP, a debugger, or a container that is paused) for `silence` is
    ended, and what it did begun anew in another one.

    :param count: at least 1.
    :param silence: seconds.
    """

    def __init__(self, count: int, silence: float = SILENCE) -> None:
        self._workers = [_Worker(silence) for _ in range(count)]

    def run(self, function: Task[Item, Found], items: Mapping[str, Item], *, shared: Any = None,
            watch: Watch = never, apart: bool = False) -> Generator[tuple[str, Found]]:
        """Run tasks, as :meth:`~koopman_ros.jobs.backends.Backend.run`."""
        with tempfile.TemporaryDirectory(prefix='koopman_ros_') as name:
            folder = Path(name)
            (folder / _SHARED).write_bytes(cloudpickle.dumps((function, shared)))
            course = _Course(self._workers, items, folder, watch, apart)
            try:
                for name in items:
                    while course.awaits(name):
                        course.go_on()
                    if name in course.found:
                        yield name, course.found.pop(name)
            finally:
                course.abandon()

    def keep(self, load: Callable[[Item], Any], items: Mapping[str, Item]) -> Kept:
        """Load in the processes, as :meth:`~koopman_ros.jobs.backends.Backend.keep`."""
        return _KeptInProcesses(self._workers, load, items)

    def close(self) -> None:
        """End the processes."""
        for worker in self._workers:
            worker.end()

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 traceback: TracebackType | None) -> None:
        """Close it."""
        self.close()


class _Worker:
    """One process, begun anew after it was lost."""

    def __init__(self, silence: float) -> None:
        self._executor: ProcessPoolExecutor | None = None
        self._pid: Future[int]
        self._silence, self._stopped_since = silence, math.inf

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        if self._executor is None:
            # its workers would end when they are idle
            self._executor = ProcessPoolExecutor(
                1, timeout=None, initializer=_begin, env={**ONE_THREAD, **os.environ})
            self._pid = self._executor.submit(os.getpid)
        future: Future[Any] = self._executor.submit(function, *arguments)
        return future

    def look(self) -> None:
        """End the process when it has been stopped for too long."""
        if self._executor is None or not self._pid.done() or self._pid.exception():
            return
        pid, now = self._pid.result(), time.monotonic()
        if not _is_stopped(pid):
            self._stopped_since = math.inf
            return
        self._stopped_since = min(now, self._stopped_since)
        if now - self._stopped_since >= self._silence:
            self._stopped_since = math.inf
            # whoever waits for it finds it lost
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    @property
    def started(self) -> bool:
        return self._executor is not None

    def end(self) -> None:
        if self._executor is not None:
            # not `shutdown(kill_workers=True)`: a task that was given to it just before makes
            # that fail in a thread of its own; so, it finds its process lost
            with contextlib.suppress(BrokenProcessPool, ProcessLookupError):
                os.kill(self._pid.result(), signal.SIGKILL)
            self._executor.shutdown()
            self._executor = None


def _is_stopped(pid: int) -> bool:
    """Return whether a process is stopped, by a signal or a debugger."""
    try:
        # its name, in brackets, may hold anything
        state = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[0]
    except OSError:
        return False
    return state in 'Tt'


class _Course:
    """Tasks on their way: what waits, what runs where, and what was found."""

    def __init__(self, workers: list[_Worker], items: Mapping[str, Any], folder: Path,
                 watch: Watch, apart: bool) -> None:
        self._items, self._folder, self._watch, self._apart = items, folder, watch, apart
        self._numbers = {name: number for number, name in enumerate(items)}
        self._waiting = deque(items)
        self._idle = list(workers)
        self._running: dict[Future[Any], tuple[str, _Worker]] = {}
        self._lost: dict[str, int] = {}
        self._told: dict[str, bytes] = {}
        self._left_behind = float('inf')  # when those that were asked to end are
        self.found: dict[str, Any] = {}

    def awaits(self, name: str) -> bool:
        """Return whether what a task finds may still come."""
        return name in self._waiting or any(name == one for one, _ in self._running.values())

    def go_on(self) -> None:
        """Begin what can be begun, and wait a little."""
        while self._waiting and self._idle:
            name, worker = self._waiting.popleft(), self._idle.pop()
            future = worker.submit(_do, self._folder, self._numbers[name], self._items[name])
            self._running[future] = name, worker
        for _, worker in self._running.values():
            worker.look()
        for future in wait(self._running, PERIOD, FIRST_COMPLETED).done:
            name, worker = self._running.pop(future)
            self._idle.append(worker)
            self._take(name, worker, future)
        if self._left_behind < float('inf'):
            if time.monotonic() > self._left_behind:
                self.abandon()
        elif any([self._watch(name, value) for name, value in self._news()]
                 or [self._watch('', None)]):
            (self._folder / _STOP).touch()
            self._waiting.clear()
            self._left_behind = time.monotonic() + PATIENCE

    def abandon(self) -> None:
        """End by force what is at work."""
        for _, worker in self._running.values():
            worker.end()
            self._idle.append(worker)
        self._running.clear()
        self._waiting.clear()

    def _take(self, name: str, worker: _Worker, future: Future[Any]) -> None:
        try:
            self.found[name] = future.result()
        except BrokenProcessPool:
            worker.end()
            self._lost[name] = self._lost.get(name, 0) + 1
            if self._lost[name] == ATTEMPTS:
                if not self._apart:
                    raise lost(name) from None
                self.found[name] = lost(name)
            elif self._left_behind == float('inf'):
                self._waiting.appendleft(name)
        except Exception as error:
            noted(error, name)
            if not self._apart:
                raise
            self.found[name] = error

    def _news(self) -> list[tuple[str, Any]]:
        """Return what tasks have told since."""
        news = []
        for name in [name for name, _ in self._running.values()]:
            with contextlib.suppress(FileNotFoundError):
                said = (self._folder / str(self._numbers[name])).read_bytes()
                if said != self._told.get(name):
                    self._told[name] = said
                    news.append((name, pickle.loads(said)))
        return news


def lost(name: str) -> WorkerLost:
    """Return the error for a task whose workers died one after the other."""
    return WorkerLost(
        f'{name}: {ATTEMPTS} workers that ran it were killed, one after the other: see whether '
        'the memory suffices for it, and run it again')


def _begin() -> None:
    # an interrupt of the terminal reaches the whole group: the process that waits answers it and
    # ends its workers, which between two tasks would only print where they were
    signal.signal(signal.SIGINT, signal.SIG_IGN)


_known: tuple[Path, Any] | None = None  # the function and what is shared, by its folder


def _do(folder: Path, number: int, item: Any) -> Any:
    """Run a task in the process."""
    global _known
    if _known is None or _known[0] != folder:
        _known = folder, pickle.loads((folder / _SHARED).read_bytes())
    function, shared = _known[1]
    return function(shared, item, _telling(folder, str(number)))


def _telling(folder: Path, number: str) -> Tell:
    """Return what writes where a task stands into a file, and looks for the request to end."""
    last = -PERIOD

    def tell(value: Any) -> bool:
        nonlocal last
        if time.monotonic() - last >= PERIOD:
            last = time.monotonic()
            # under a name of its own first: half of it must not be read
            draft = folder / f'{number}.draft'
            draft.write_bytes(pickle.dumps(value))
            draft.replace(folder / number)
        return (folder / _STOP).exists()

    return tell


class _KeptInProcesses:
    """Items that the processes have loaded, each always the same ones."""

    def __init__(self, workers: list[_Worker], load: Callable[[Any], Any],
                 items: Mapping[str, Any]) -> None:
        self._places = {name: workers[number % len(workers)]
                        for number, name in enumerate(items)}
        self._token = uuid.uuid4().hex
        self._load, self._items = load, items
        self.run(_nothing, None)

    def run(self, function: Callable[[Any, Any], Found], argument: Any) -> list[Found]:
        found: dict[str, Found] = {}
        attempts = 0
        while missing := [name for name in self._items if name not in found]:
            if attempts == ATTEMPTS:
                raise lost(missing[0])
            attempts += 1
            futures = {name: self._places[name].submit(
                _on_kept, self._token, name, self._load, self._items[name], function, argument)
                for name in missing}
            for name, future in futures.items():
                while not wait([future], PERIOD).done:
                    for worker in dict.fromkeys(self._places.values()):
                        worker.look()
                try:
                    found[name] = future.result()
                except BrokenProcessPool:
                    self._places[name].end()
                except Exception as error:
                    noted(error, name)
                    raise
        return [found[name] for name in self._items]

    def close(self) -> None:
        for worker in dict.fromkeys(self._places.values()):
            with contextlib.suppress(BrokenProcessPool):
                if worker.started:
                    worker.submit(_forget, self._token).result()


_kept: dict[str, dict[str, Any]] = {}  # by token and name, in the process that has loaded it


def _on_kept(token: str, name: str, load: Callable[[Any], Any], item: Any,
             function: Callable[[Any, Any], Found], argument: Any) -> Found:
    known = _kept.setdefault(token, {})
    if name not in known:
        known[name] = load(item)
    return function(known[name], argument)


def _nothing(_: Any, __: Any) -> None:
    """Only load."""


def _forget(token: str) -> None:
    _kept.pop(token, None)
