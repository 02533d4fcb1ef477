# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Where long work runs: in this process, in processes of its own, on a Dask cluster; one way."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from types import TracebackType
from typing import Any, Protocol, Self, TypeVar

Item = TypeVar('Item')
Found = TypeVar('Found')
Loaded = TypeVar('Loaded')

# Given to a task, which calls it with where it stands; True asks it to end with what it has.
Tell = Callable[[Any], bool]
# Called with the name of a task and what it told, and with ('', None) now and then while others
# work; True asks all tasks to end.
Watch = Callable[[str, Any], bool]
# (what all tasks share, the task's own, tell) to what it finds
Task = Callable[[Any, Item, Tell], Found]

#: s between two calls of a watch while others work, and between two messages of a task.
PERIOD = 0.1
#: s from the request to end until a task is left behind.
PATIENCE = 5.0
#: s without a sign of life after which a worker counts as lost.
SILENCE = 30.0
#: Times that a task is begun anew whose worker was lost.
ATTEMPTS = 3
_ADDRESSES = ('tcp://', 'tls://')


class WorkerLost(RuntimeError):  # noqa: N818
    """Workers were lost with what they did, and no other one could do it."""


class SchedulerLost(RuntimeError):  # noqa: N818
    """There is no scheduler at an address, or no longer."""


def never(_: str, __: Any) -> bool:
    """Watch without asking anything to end."""
    return False


class Kept(Protocol):
    """What was loaded where it is used, and stays there until it is closed."""

    def run(self, function: Callable[[Any, Any], Found], argument: Any) -> list[Found]:
        """Return function(loaded, argument) of all that was loaded, in the order of the items."""
        ...

    def close(self) -> None:
        """Let it go."""
        ...


class Backend(Protocol):
    """
    A place where tasks run; to be closed, as a context manager does.

    Functions and items go to the place by pickle (functions by value where they have no name in a
    module). An exception of a task is raised here with a note that names the task. What a worker
    that died had begun is begun anew, at most three times. Tasks know nothing of where they run:
    the same function of the same items finds the same, to the bit on equal machines with equally
    many threads of numpy and torch.
    """

    def run(self, function: Task[Item, Found], items: Mapping[str, Item], *, shared: Any = None,
            watch: Watch = never, apart: bool = False) -> Generator[tuple[str, Found]]:
        """
        Yield the name of each task and what it found, in the order of the items.

        When `watch` asks to end, no further task is begun; those under way are asked to end, and
        what they have by then still comes. A generator that is closed early, or left by an
        exception, leaves no task at work that could be ended by force.

        :param function: of what is shared, an item, and what the task tells its progress with.
        :param items: by the names of their tasks.
        :param shared: goes to each worker once.
        :param apart: whether a task that fails leaves the others alone: its exception is then
            what it found, also where its workers died time and again.
        :raises WorkerLost: when the workers of a task died time and again.
        :raises SchedulerLost: when a scheduler is not reached any longer.
        """
        ...

    def keep(self, load: Callable[[Item], Any], items: Mapping[str, Item]) -> Kept:
        """
        Let workers load each item; what they load does not leave them.

        A worker that is lost loses what it has loaded, and another one loads it again.
        """
        ...

    def close(self) -> None:
        """End what was started for it."""
        ...

    def __enter__(self) -> Self:
        """Return itself."""
        ...

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 traceback: TracebackType | None) -> None:
        """Close it."""
        ...


class Here:
    """One task after the other, in this process."""

    def run(self, function: Task[Item, Found], items: Mapping[str, Item], *, shared: Any = None,
            watch: Watch = never, apart: bool = False) -> Generator[tuple[str, Found]]:
        """Run tasks, as :meth:`Backend.run`."""
        ended = False

        def telling(name: str) -> Tell:
            def tell(value: Any) -> bool:
                nonlocal ended
                ended = watch(name, value) or ended
                return ended

            return tell

        for name, item in items.items():
            found: Any
            try:
                found = function(shared, item, telling(name))
            except Exception as error:
                noted(error, name)
                if not apart:
                    raise
                found = error
            yield name, found
            if ended:
                return

    def keep(self, load: Callable[[Item], Any], items: Mapping[str, Item]) -> Kept:
        """Load here, as :meth:`Backend.keep`."""
        return _KeptHere(load, items)

    def close(self) -> None:
        """Nothing was started."""

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 traceback: TracebackType | None) -> None:
        """Close it."""
        self.close()


class _KeptHere:
    def __init__(self, load: Callable[[Item], Any], items: Mapping[str, Item]) -> None:
        self._loaded: dict[str, Any] = {}
        for name, item in items.items():
            try:
                self._loaded[name] = load(item)
            except Exception as error:
                noted(error, name)
                raise

    def run(self, function: Callable[[Any, Any], Found], argument: Any) -> list[Found]:
        found = []
        for name, loaded in self._loaded.items():
            try:
                found.append(function(loaded, argument))
            except Exception as error:
                noted(error, name)
                raise
        return found

    def close(self) -> None:
        self._loaded.clear()


def noted(error: BaseException, name: str) -> None:
    """Add to an exception of which task it is."""
    error.add_note(f'in {name}')


def backend_of(text: str) -> Backend:
    """
    Return the backend that a parameter or an option names.

    ``''`` is this process, ``'process'`` a process of its own, ``'joblib:4'`` so many processes
    of joblib's, ``'joblib'`` one for each core, and ``'tcp://host:port'`` (or ``'tls://...'``) the
    workers of the scheduler of a Dask cluster.

    :raises ValueError: for anything else.
    :raises SchedulerLost: when nothing answers at the address, or there is no worker.
    """
    if reason := scheduler_refusal(text):
        raise ValueError(reason)
    # in here: what is not asked for need not be installed
    if text.startswith(_ADDRESSES):
        from koopman_ros.jobs.cluster import Cluster
        return Cluster(text)
    if text:
        from koopman_ros.jobs.processes import cores, Processes
        return Processes(1 if text == 'process' else int(text.partition(':')[2] or cores()))
    return Here()


def scheduler_refusal(text: str) -> str:
    """Return why a text names no backend, or an empty text."""
    if text in ('', 'process', 'joblib') or text.startswith(_ADDRESSES):
        return ''
    kind, _, count = text.partition(':')
    if kind == 'joblib' and count.isascii() and count.isdigit() and int(count):
        return ''
    return (f'scheduler is {text!r}, must be empty for this process, process, joblib, joblib:N '
            'with N processes of at least 1, or the address of a Dask scheduler, like '
            'tcp://127.0.0.1:8786')
