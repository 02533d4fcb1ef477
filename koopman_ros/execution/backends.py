# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""One interface for tasks in this process, in processes of joblib, or on a Dask cluster."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Mapping
from typing import Any, Self, TypeVar

Item = TypeVar('Item')
Found = TypeVar('Found')

# Reports the progress of a task; True requests its end with the result so far.
Notify = Callable[[Any], bool]
# Called with the name of a task and its progress, and with ('', None) every 0.1 s; True requests
# the end of all tasks.
Watch = Callable[[str, Any], bool]
# (shared value, item, tell) -> result
Task = Callable[[Any, Item, Notify], Found]

_ADDRESSES = ('tcp://', 'tls://')


class WorkerLost(RuntimeError):  # noqa: N818
    """Workers died repeatedly in the same task, or there is no worker."""


class SchedulerLost(RuntimeError):  # noqa: N818
    """The Dask scheduler does not answer."""


def never_stop(_: str, __: Any) -> bool:
    """Watch without requesting an end."""
    return False


class Backend(ABC):
    """Executor of tasks; a context manager that releases its workers."""

    @abstractmethod
    def run(self, function: Task[Item, Found], items: Mapping[str, Item], *, shared: Any = None,
            watch: Watch = never_stop) -> Generator[tuple[str, Found]]:
        """
        Yield the name and the result of each task, in the order of the items.

        Functions and items are pickled, also functions without a name in a module. Results do
        not depend on the backend. When `watch` requests the end, no further task begins, and the
        results of those that run are still yielded. A task whose worker died is repeated, at
        most twice.

        :param function: of the shared value, an item, and the progress callback.
        :param items: by the names of their tasks.
        :param shared: sent to each worker once.
        :raises WorkerLost: when the workers of a task died repeatedly.
        :raises SchedulerLost: when the scheduler does not answer any more.
        """

    def close(self) -> None:  # noqa: B027
        """Release the workers."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Serial(Backend):
    """Run one task after the other in this process."""

    def run(self, function: Task[Item, Found], items: Mapping[str, Item], *, shared: Any = None,
            watch: Watch = never_stop) -> Generator[tuple[str, Found]]:
        """Run tasks, see :meth:`Backend.run`."""
        ended = False

        def notifier(name: str) -> Notify:
            def notify(value: Any) -> bool:
                nonlocal ended
                ended = watch(name, value) or ended
                return ended

            return notify

        for name, item in items.items():
            try:
                found = function(shared, item, notifier(name))
            except Exception as error:
                error.add_note(f'in {name}')
                raise
            yield name, found
            if ended:
                return


def backend_of(text: str) -> Backend:
    """
    Return the backend of a parameter `executor`.

    ``''`` is this process, ``'process'`` a process of its own, ``'joblib:4'`` four processes,
    ``'joblib'`` one for each core, and ``'tcp://host:port'`` (or ``'tls://...'``) the workers of a
    Dask scheduler.

    :raises ValueError: for any other text.
    :raises SchedulerLost: when no scheduler answers at the address.
    :raises WorkerLost: when the scheduler has no worker.
    """
    if reason := executor_rejection(text):
        raise ValueError(reason)
    if not text:
        return Serial()
    # joblib and Dask are optional
    from koopman_ros.execution.pools import Cluster, Processes
    if text.startswith(_ADDRESSES):
        return Cluster(text)
    return Processes(1 if text == 'process' else int(text.partition(':')[2] or 0))


def executor_rejection(text: str) -> str:
    """Return why a text names no backend, or an empty text."""
    if text in ('', 'process', 'joblib') or text.startswith(_ADDRESSES):
        return ''
    kind, _, count = text.partition(':')
    if kind == 'joblib' and count.isascii() and count.isdigit() and int(count):
        return ''
    return (f'executor is {text!r}, must be empty (this process), process, joblib, joblib:N with '
            'N of at least 1, or the address of a Dask scheduler, e.g. tcp://127.0.0.1:8786')
