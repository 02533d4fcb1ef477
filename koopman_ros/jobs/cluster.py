# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Work on the workers of a Dask cluster, through its scheduler."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
import contextlib
import logging
import pickle
import queue
import sys
import threading
import time
from types import TracebackType
from typing import Any, Self
import uuid
import warnings

import cloudpickle
import distributed
from distributed import Client, Future
from distributed.scheduler import KilledWorker

from koopman_ros.jobs.backends import (
    ATTEMPTS,
    Found,
    Item,
    Kept,
    never,
    noted,
    PATIENCE,
    PERIOD,
    SchedulerLost,
    SILENCE,
    Task,
    Tell,
    Watch,
    WorkerLost,
)

_CONNECT = 10.0  # s for the first answer of a scheduler
_JOIN = 30.0  # s for its first worker, which may just be starting
_LOST = (distributed.client.FutureCancelledError, distributed.CancelledError,
         distributed.comm.CommClosedError)


class Cluster:
    """
    The workers of a Dask scheduler.

    A worker that says nothing for `silence` is taken off the cluster, and what it did is begun
    anew on another one. Where the scheduler is lost, so are the workers, and the work with them.

    :param address: of the scheduler, like ``'tcp://127.0.0.1:8786'``.
    :param silence: seconds, also without any worker after which the work is lost; longer than a
        task may hold a worker's interpreter.
    :raises SchedulerLost: when nothing answers there.
    :raises WorkerLost: when no worker has joined.
    """

    def __init__(self, address: str, silence: float = SILENCE) -> None:
        self._address, self._silence = address, silence
        # what it says of a lost scheduler, with all that led to it, is raised here in a sentence
        logging.getLogger('distributed.client').setLevel(logging.CRITICAL)
        try:
            self._client = Client(address, timeout=_CONNECT, set_as_default=False)
        except (OSError, TimeoutError) as error:
            raise SchedulerLost(
                f'no scheduler answers at {address} within {_CONNECT:g} s: start `dask scheduler` '
                'there, and `dask worker` with its address') from error
        self._looked, self._seen = time.monotonic(), time.monotonic()
        try:
            self.wait_for_workers(1)
        except WorkerLost:
            self.close()
            raise

    def wait_for_workers(self, count: int) -> None:
        """Wait until so many have joined; WorkerLost when they do not."""
        try:
            self._client.wait_for_workers(count, timeout=_JOIN)
        except TimeoutError:
            raise self._deserted(_JOIN) from None

    def run(self, function: Task[Item, Found], items: Mapping[str, Item], *, shared: Any = None,
            watch: Watch = never, apart: bool = False) -> Generator[tuple[str, Found]]:
        """Run tasks, as :meth:`~koopman_ros.jobs.backends.Backend.run`."""
        token = uuid.uuid4().hex
        news: queue.SimpleQueue[tuple[str, Any]] = queue.SimpleQueue()
        futures: dict[str, Future] = {}
        left_behind = float('inf')  # when those that were asked to end are
        with self._failing():
            self._client.subscribe_topic(token, lambda event: news.put(event[1]))
        try:
            # not scattered: that would be lost with the worker that has it
            place = self.submit(_Shared, _packed((function, shared)), key=f'shared-{token}')
            futures = {name: self.submit(_do, place, name, _packed(item), token,
                                         key=f'{name}-{token}') for name, item in items.items()}
            for name, future in futures.items():
                while not future.done() and time.monotonic() < left_behind:
                    self._wait([future])
                    asked = [watch(*news.get()) for _ in range(news.qsize())]
                    if left_behind == float('inf') and any([*asked, watch('', None)]):
                        left_behind = time.monotonic() + PATIENCE
                        self._ask_to_end(token)
                if future.done() and not isinstance(
                        found := self._result(name, future, apart), _NotBegun):
                    yield name, found
        finally:
            self._leave(token, list(futures.values()))

    def keep(self, load: Callable[[Item], Any], items: Mapping[str, Item]) -> Kept:
        """Load on the workers, as :meth:`~koopman_ros.jobs.backends.Backend.keep`."""
        return _KeptOnCluster(self, load, items)

    def close(self) -> None:
        """Leave the cluster; what this client had there is released."""
        self._client.close(timeout=PATIENCE)

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 traceback: TracebackType | None) -> None:
        """Close it."""
        self.close()

    def submit(self, function: Callable[..., Any], *arguments: Any, key: str) -> Future:
        """Send a task."""
        with self._failing(), warnings.catch_warnings():
            # of a large graph: what all tasks share goes to the scheduler once
            warnings.simplefilter('ignore', UserWarning)
            return self._client.submit(function, *arguments, key=key, pure=False)

    def each(self, function: Callable[..., Any], given: Mapping[str, Future], key: str,
             **arguments: Any) -> list[Any]:
        """Send a task for each of some futures, and return what they find, in their order."""
        # all of them in one message there and one back
        with self._failing():
            futures = self._client.map(function, given.values(), pure=False, **arguments,
                                       key=[f'{name}-{key}' for name in given])
        while missing := [future for future in futures if not future.done()]:
            self._wait(missing, 'ALL_COMPLETED')
        for name, future in zip(given, futures, strict=True):
            if future.status == 'error':
                self._result(name, future)
        with self._failing():
            found: list[Any] = self._client.gather(futures)
        return found

    def _leave(self, token: str, futures: Sequence[Future]) -> None:
        """Ask for nothing any longer, and let those that are under way end."""
        with contextlib.suppress(OSError, ValueError, RuntimeError, *_LOST):
            self._client.unsubscribe_topic(token)
            if under_way := [future for future in futures if not future.done()]:
                self._ask_to_end(token)
                self._client.cancel(under_way)

    def _ask_to_end(self, token: str) -> None:
        """Tell the workers; one that is frozen should not keep us."""
        def tell() -> None:
            with contextlib.suppress(OSError, ValueError, RuntimeError, *_LOST):
                self._client.run(_stop, token, on_error='ignore')

        threading.Thread(target=tell, daemon=True).start()

    def _result(self, name: str, future: Future, apart: bool = False) -> Any:
        """Return what a task that is done has found; raise, or return, what it has raised."""
        with self._failing():
            error = future.exception() if future.status == 'error' else None
            if error is None:
                return self._client.gather(future)
        if isinstance(error, KilledWorker):
            error = WorkerLost(
                f'{name}: {ATTEMPTS} workers that ran it were killed or fell silent, one after '
                'the other: see whether the memory suffices for it, and run it again')
        else:
            noted(error, name)
        if apart:
            return error
        raise error from None

    def _wait(self, futures: Sequence[Future], until: str = 'FIRST_COMPLETED') -> None:
        """Wait a little, and look after the workers now and then."""
        with self._failing():
            with contextlib.suppress(TimeoutError), self._client.as_current():
                distributed.wait(futures, timeout=PERIOD, return_when=until)
            if self._client.status != 'running':
                raise self._gone()
            if time.monotonic() - self._looked > self._silence / 4.0:
                self._look()

    def _look(self) -> None:
        """Take workers that are silent off the cluster, and notice when there is none left."""
        silence = self._silence

        # within, so that the scheduler is sent its code and need not have this package
        async def drop_silent(dask_scheduler: Any = None) -> int:
            now = time.time()
            for worker in list(dask_scheduler.workers.values()):
                if now - worker.last_seen > silence:
                    await dask_scheduler.remove_worker(
                        worker.address, stimulus_id=f'silent-{now}', close=False)
            return len(dask_scheduler.workers)

        self._looked = time.monotonic()
        if self._client.run_on_scheduler(drop_silent):
            self._seen = time.monotonic()
        elif time.monotonic() - self._seen > silence:
            raise self._deserted(silence)

    @contextlib.contextmanager
    def _failing(self) -> Generator[None]:
        """Say in our words that the scheduler is lost."""
        try:
            yield
        except (*_LOST, OSError):
            raise self._gone() from None

    def _gone(self) -> SchedulerLost:
        return SchedulerLost(f'the scheduler at {self._address} is lost, and the work with it: '
                             'start it and its workers again, and repeat the work')

    def _deserted(self, seconds: float) -> WorkerLost:
        return WorkerLost(f'the scheduler at {self._address} has had no worker for {seconds:g} s: '
                          f'start one, `dask worker {self._address}`')


class _Shared:
    """What all tasks of a work share, unpacked once on each worker."""

    def __init__(self, packed: bytes) -> None:
        self.function, self.value = pickle.loads(packed)


def _packed(value: Any) -> bytes:
    """Pickle, so that Dask does not look into it for futures."""
    data: bytes = cloudpickle.dumps(value)
    return data


class _NotBegun:
    """What a task finds that was asked to end before it began."""


_stopped: set[str] = set()  # tokens of works that were asked to end, on a worker


def _stop(token: str) -> None:
    _stopped.add(token)


def _do(shared: _Shared, name: str, item: bytes, token: str) -> Any:
    """Run a task on a worker."""
    if token in _stopped:
        return _NotBegun()
    return shared.function(shared.value, pickle.loads(item), _telling(name, token))


def _telling(name: str, token: str) -> Tell:
    worker = distributed.get_worker()
    last = -PERIOD

    def tell(value: Any) -> bool:
        nonlocal last
        if time.monotonic() - last >= PERIOD:
            last = time.monotonic()
            worker.log_event(token, (name, value))
        return token in _stopped

    return tell


class _Resident:
    """
    What a worker has loaded.

    Dask may want it on another worker: what goes there is how it is loaded.
    """

    def __init__(self, origin: bytes) -> None:
        self._origin = origin
        load, item = pickle.loads(origin)
        self.value = load(item)

    def __reduce__(self) -> tuple[type[_Resident], tuple[bytes]]:
        return _Resident, (self._origin,)

    def __sizeof__(self) -> int:
        # by which Dask decides where it is cheap to work
        return getattr(self.value, 'nbytes', sys.getsizeof(self.value))


class _KeptOnCluster:
    """Items that workers have loaded."""

    def __init__(self, cluster: Cluster, load: Callable[[Any], Any], items: Mapping[str, Any]
                 ) -> None:
        self._cluster, self._token, self._count = cluster, uuid.uuid4().hex, 0
        self._loaded = {
            name: cluster.submit(_Resident, _packed((load, item)), key=f'{name}-{self._token}')
            for name, item in items.items()}

    def run(self, function: Callable[[Any, Any], Found], argument: Any) -> list[Found]:
        self._count += 1
        return self._cluster.each(_on_resident, self._loaded, f'{self._token}-{self._count}',
                                  call=_packed((function, argument)))

    def close(self) -> None:
        # Dask lets go of what nobody asks for
        self._loaded.clear()


def _on_resident(resident: _Resident, call: bytes) -> Any:
    function, argument = pickle.loads(call)
    return function(resident.value, argument)
