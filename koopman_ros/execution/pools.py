# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Backends by the executors of joblib (loky) and of Dask, both of `concurrent.futures`."""

from __future__ import annotations

from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Mapping
from concurrent.futures import Executor, FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
import contextlib
from functools import lru_cache, partial
import logging
import os
from pathlib import Path
import pickle
import queue
import signal
import tempfile
import time
from typing import Any
import uuid

import cloudpickle
from joblib.externals.loky import ProcessPoolExecutor

from koopman_ros.execution.backends import (
    Backend,
    Found,
    Item,
    never_stop,
    SchedulerLost,
    Task,
    Watch,
    WorkerLost,
)
from koopman_ros.process_entry import ONE_THREAD

PERIOD = 0.1  # s between two calls of a watch, and between two messages of a task
_PATIENCE = 5.0  # s from the request to end until a task is abandoned
_ATTEMPTS = 3  # times that a task is begun whose worker dies
_CONNECT = 10.0  # s for the first answer of a scheduler
_JOIN = 30.0  # s for its first worker
_STOP = 'stop'


# Sends the progress of a task by its number, None at its start, to the calling process; returns
# whether the task should end.
_Send = Callable[[int, Any], bool]
# that of the workers, the source of the call for them, and functions that return new messages and
# request the end of all tasks
_Messages = tuple[_Send, Any, Callable[[], list[tuple[int, Any]]], Callable[[], None]]


class _Pool(Backend):
    """Tasks on workers, whose executor and messages the subclasses provide."""

    def run(self, function: Task[Item, Found], items: Mapping[str, Item], *, shared: Any = None,
            watch: Watch = never_stop) -> Generator[tuple[str, Found]]:
        """Run tasks, see :meth:`Backend.run`."""
        names, ready, following = list(items), dict[int, Any](), 0
        with contextlib.closing(self._completed(
                cloudpickle.dumps((function, shared)), items, watch)) as completed:
            for number, found in completed:
                if isinstance(found, Exception):
                    found.add_note(f'in {names[number]}')
                    raise found
                ready[number] = found
                while following in ready:
                    yield names[following], ready.pop(following)
                    following += 1
        # after a request to end there are gaps
        for number in sorted(ready):
            yield names[number], ready[number]

    def _completed(self, call: bytes, items: Mapping[str, Any], watch: Watch
                   ) -> Generator[tuple[int, Any]]:
        """Yield number and result, or exception, of the tasks as they end."""
        names, values = list(items), list(map(cloudpickle.dumps, items.values()))
        open_, losses, abandoned = set(range(len(names))), Counter[int](), float('inf')
        with self._messages(call) as (send, source, received, stop):
            futures: dict[Future[Any], int] = {}
            try:
                while open_ and abandoned == float('inf'):
                    # tasks whose worker died before run alone, and last
                    batch = {n for n in open_ if not losses[n]} or {min(open_)}
                    futures = {self._workers().submit(_call, send, source, n, values[n]): n
                               for n in sorted(batch)}
                    lost, started = set[int](), set[int]()
                    while futures:
                        for future in wait(futures, PERIOD, FIRST_COMPLETED).done:
                            number = futures.pop(future)
                            found = self._outcome(future, names[number])
                            if isinstance(found, BrokenProcessPool):
                                lost.add(number)
                            elif not isinstance(found, _NotBegun):
                                open_.discard(number)
                                yield number, found
                        messages = received()
                        started |= {number for number, _ in messages}
                        requests = [watch(names[n], value) for n, value in messages
                                    if value is not None]
                        if any([*requests, watch('', None)]) and abandoned == float('inf'):
                            stop()
                            abandoned = time.monotonic() + _PATIENCE
                        if time.monotonic() > abandoned:
                            return
                    if lost:
                        self._abandon(futures)
                    for number in lost & started if lost & started else lost:
                        losses[number] += 1
                        if losses[number] == _ATTEMPTS:
                            open_.discard(number)
                            yield number, _worker_lost(names[number])
            finally:
                stop()
                if futures:
                    self._abandon(futures)

    @abstractmethod
    def _messages(self, call: bytes) -> contextlib.AbstractContextManager[_Messages]:
        """Open the channel of a run."""

    @abstractmethod
    def _workers(self) -> Executor:
        """Return the executor of the workers, started."""

    def _outcome(self, future: Future[Any], _: str) -> Any:
        return future.exception() or future.result()

    @abstractmethod
    def _abandon(self, futures: Iterable[Future[Any]]) -> None:
        """Give up tasks that do not end, and workers that died."""


class Processes(_Pool):
    """
    Processes of joblib's loky, of one thread each, started for the first tasks.

    :param count: of processes; 0 for one on each core.
    """

    def __init__(self, count: int) -> None:
        self._count = count or len(os.sched_getaffinity(0))
        self._executor: ProcessPoolExecutor | None = None

    def close(self) -> None:
        """End the processes."""
        if self._executor is not None:
            # loky's own thread fails with a KeyError where it still finds the number of a queued
            # task, whose entry it has just dropped
            with contextlib.suppress(queue.Empty):
                while True:
                    self._executor._work_ids.get_nowait()
            self._executor.shutdown(kill_workers=True)
            self._executor = None

    def _workers(self) -> Executor:
        if self._executor is None:
            # the process that waits answers an interrupt of the terminal
            self._executor = ProcessPoolExecutor(
                self._count, timeout=None, env={**ONE_THREAD, **os.environ},
                initializer=signal.signal, initargs=(signal.SIGINT, signal.SIG_IGN))
        return self._executor

    def _abandon(self, _: object) -> None:
        self.close()

    @contextlib.contextmanager
    def _messages(self, call: bytes) -> Generator[_Messages]:
        with tempfile.TemporaryDirectory(prefix='koopman_ros_') as name:
            folder, seen = Path(name), dict[str, bytes]()
            source = folder / 'call'
            source.write_bytes(call)

            def received() -> list[tuple[int, Any]]:
                messages = {path.name: path.read_bytes() for path in folder.iterdir()
                            if path.name.isdigit()}
                new = [(int(key), pickle.loads(data)) for key, data in messages.items()
                       if seen.get(key) != data]
                seen.update(messages)
                return new

            yield partial(_to_folder, folder), source, received, (folder / _STOP).touch


def _to_folder(folder: Path, number: int, value: Any) -> bool:
    # a rename, so that no half is read
    draft = folder / f'{number}.draft'
    draft.write_bytes(pickle.dumps(value))
    draft.replace(folder / str(number))
    return (folder / _STOP).exists()


class Cluster(_Pool):
    """
    Workers of a Dask scheduler, which repeats the tasks of workers that died.

    :param address: of the scheduler, like ``'tcp://127.0.0.1:8786'``.
    :raises SchedulerLost: when nothing answers there.
    :raises WorkerLost: when no worker has joined.
    """

    def __init__(self, address: str) -> None:
        import distributed
        self._address = address
        # a lost scheduler is raised here
        logging.getLogger('distributed.client').setLevel(logging.CRITICAL)
        try:
            self._client = distributed.Client(address, timeout=_CONNECT, set_as_default=False)
        except (OSError, TimeoutError) as error:
            raise SchedulerLost(
                f'no scheduler answers at {address} within {_CONNECT:g} s: start `dask scheduler` '
                'there, and `dask worker` with its address') from error
        try:
            self._client.wait_for_workers(1, timeout=_JOIN)
        except TimeoutError:
            self.close()
            raise WorkerLost(f'the scheduler at {address} has no worker: start one, `dask worker '
                             f'{address}`') from None
        self._executor: Executor = self._client.get_executor(pure=False)

    def close(self) -> None:
        """Leave the cluster."""
        self._client.close(timeout=_PATIENCE)

    def _workers(self) -> Executor:
        return self._executor

    def _outcome(self, future: Future[Any], name: str) -> Any:
        from distributed.scheduler import KilledWorker
        if future.cancelled():
            raise self._lost()
        error = future.exception()
        return _worker_lost(name) if isinstance(error, KilledWorker) else error or future.result()

    def _abandon(self, futures: Iterable[Future[Any]]) -> None:
        for future in futures:
            future.cancel()

    def _lost(self) -> SchedulerLost:
        return SchedulerLost(f'lost the connection to the scheduler at {self._address}: restart '
                             'it and its workers, and try again')

    @contextlib.contextmanager
    def _messages(self, call: bytes) -> Generator[_Messages]:
        import distributed
        from distributed.client import ClosedClientError
        token, messages = uuid.uuid4().hex, queue.SimpleQueue[tuple[int, Any]]()
        event = distributed.Event(token, client=self._client)

        def received() -> list[tuple[int, Any]]:
            if self._client.status != 'running':
                raise self._lost()
            return [messages.get() for _ in range(messages.qsize())]

        def stop() -> None:
            with contextlib.suppress(OSError, RuntimeError, ClosedClientError):
                event.set()

        self._client.subscribe_topic(token, lambda message: messages.put(message[1]))
        try:
            # not scattered: that would be lost with the worker that has it
            source = self._client.submit(bytes, call, pure=False)
            yield partial(_to_topic, token), source, received, stop
        finally:
            # a client that lost its scheduler is closed at any moment
            with contextlib.suppress(OSError, ValueError, RuntimeError, ClosedClientError):
                self._client.unsubscribe_topic(token)


def _to_topic(token: str, number: int, value: Any) -> bool:
    import distributed
    distributed.get_worker().log_event(token, (number, value))
    stopped: bool = distributed.Event(token).is_set()
    return stopped


class _NotBegun:
    """Result of a task that should end before it began."""


@lru_cache(maxsize=1)
def _unpacked(source: Path | bytes) -> Any:
    return pickle.loads(source.read_bytes() if isinstance(source, Path) else source)


def _call(send: _Send, source: Path | bytes, number: int, item: bytes) -> Any:
    """Run a task on a worker, which reports its progress at most once a period."""
    if send(number, None):
        return _NotBegun()
    function, shared = _unpacked(source)
    last = -PERIOD

    def notify(value: Any) -> bool:
        nonlocal last
        if time.monotonic() - last < PERIOD:
            return False
        last = time.monotonic()
        return send(number, value)

    return function(shared, pickle.loads(item), notify)


def _worker_lost(name: str) -> WorkerLost:
    return WorkerLost(f'{name}: {_ATTEMPTS} workers that ran it died, one after the other: check '
                      'whether they have enough memory, and run it again')
