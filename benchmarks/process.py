# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Measurements in processes of their own, with bounded processor time and memory."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import math
import multiprocessing
from multiprocessing.connection import Connection
import os
from pathlib import Path
import resource
import signal
import time
from typing import Any, TypeAlias

Tell: TypeAlias = Callable[[dict[str, Any]], None]


@dataclass(frozen=True)
class ProcessResult:
    """The messages of a job."""

    events: tuple[dict[str, Any], ...]  #: in their order
    failure: str  #: why it did not end by itself, or empty

    def find(self, key: str) -> Any:
        """Return the last value under a key, or None."""
        return next((event[key] for event in reversed(self.events) if key in event), None)


def processor_seconds(pid: int) -> float:
    """
    Return the processor time that a process has taken, in s, to the nanosecond.

    The columns of /proc count it in hundredths of a second, which is nothing of a short run.

    :raises OSError: where there is no such process.
    """
    # the clock that clock_getcpuclockid(3) names: CPUCLOCK_SCHED of this process
    return time.clock_gettime((~pid << 3) | 2)


def run(job: Callable[..., None], *arguments: Any, folder: Path, megabytes: float,
        children: bool = False, needed: Sequence[str] = ()) -> ProcessResult:
    """
    Run a job in a process; its messages stay when it is ended.

    :param job: takes a function that receives its results, and the arguments.
    :param folder: where it runs, as compilers leave files there.
    :param megabytes: the memory that it may take.
    :param children: whether it may start processes itself.
    :param needed: further modules that jobs import. All are imported once, by the
        process that the first job and those after it are forked from.
    """
    context = multiprocessing.get_context('forkserver')
    context.set_forkserver_preload([job.__module__, *needed])
    receiving, sending = context.Pipe(duplex=False)
    process = context.Process(target=_enter, args=(sending, folder, megabytes, job, arguments),
                              daemon=not children)
    process.start()
    sending.close()
    events: list[dict[str, Any]] = []
    try:
        while True:
            events.append(receiving.recv())
    except (EOFError, OSError):  # it has ended, or was ended within an event
        process.join()
    finally:
        process.kill()
        process.join()
    outcome = ProcessResult(tuple(events), '')
    failure = outcome.find('error') or ''
    if not failure and process.exitcode:
        failure = (outcome.find('too_long') if process.exitcode == -signal.SIGXCPU
                   else f'ended with status {process.exitcode}')
    return ProcessResult(outcome.events, failure)


def allow(tell: Tell, seconds: float, otherwise: str) -> None:
    """
    Let the system end this process when it takes more processor time from now on.

    :param otherwise: why it has ended then.
    """
    tell({'too_long': otherwise})
    resource.setrlimit(resource.RLIMIT_CPU, (
        math.ceil(time.process_time() + seconds), resource.RLIM_INFINITY))


def _enter(sending: Connection, folder: Path, megabytes: float, job: Callable[..., None],
           arguments: tuple[Any, ...]) -> None:
    # Ctrl-C is answered by the process that waits
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_DATA, (round(1e6 * megabytes),) * 2)
    os.chdir(folder)
    try:
        job(sending.send, *arguments)
    except MemoryError:
        sending.send({'error': f'needs more than {megabytes:.0f} MB of memory'})
    except RuntimeError as error:
        sending.send({'error': str(error)})
