# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Retraining of many plants in one call, each with its own acceptance test, one plant a job."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
import contextlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from koopman_ros.execution import Backend, backend_of, SchedulerLost, Tell, WorkerLost
from koopman_ros.learning.identification import Stopped
from koopman_ros.learning.pipeline import retrain
from koopman_ros.learning.report import reported
from koopman_ros.learning.task import FIRST, TrainingTask

#: Exceptions of a training that the task, the bags or the machine cause.
EXPECTED = (ValueError, TypeError, KeyError, OSError, MemoryError, WorkerLost, SchedulerLost,
            ImportError)

# Called with the plant, the completed share of its retraining in [0, 1] and the current step,
# and with empty texts now and then while others work; True asks all to stop.
OnPlant = Callable[[str, float, str], bool]


@dataclass(frozen=True)
class TrainingOutcome:
    """How the retraining of one plant of a fleet ended."""

    summary: Mapping[str, Any] | None  #: as :meth:`Retrained.summary`, None where it failed
    files: tuple[str, ...] = ()  #: the report
    error: str = ''  #: why it failed, or empty
    stopped: bool = False  #: whether it was asked to end before it had ended

    @property
    def accepted(self) -> bool:
        """Whether there is a new lift that may be used."""
        return bool(self.summary and self.summary['accepted'])


def retrain_fleet(tasks: Mapping[str, TrainingTask], scheduler: str = '',
                  on_progress: OnPlant = lambda *_: False
                  ) -> Generator[tuple[str, TrainingOutcome]]:
    """
    Retrain plants side by side, and yield each with its outcome.

    Each is worked as a job of its own, as :func:`retrain` trains one here, and judged, written and
    reported in the same way; a failure of one is its outcome and does not touch the others. Those
    whose sibling is ``'first'`` begin from the lift of the first plant of their kind that is
    accepted: of the same signals, class and number of coordinates. They wait for that; where one
    is rejected or fails, the next one of the kind is learned from nothing.

    The outcomes come round by round, in each in the order of the plants. The lifts are the same
    wherever they are learned.

    :param tasks: by the names of the plants; their own `executor` counts for nothing.
    :param scheduler: where they are worked, see :func:`~koopman_ros.execution.backend_of`.
    :raises ValueError: for plants that would write the same file, none, or another `executor`
        than there is.
    :raises SchedulerLost: when a scheduler is not reached, or is lost; yielded outcomes stand.
    """
    _check(tasks)
    with backend_of(scheduler) as backend:
        yield from _rounds(backend, dict(tasks), on_progress)


def kind_of(task: TrainingTask) -> tuple[object, ...]:
    """Return the properties that lifts of siblings share."""
    return (task.model_class, task.coordinates, task.physical_model, task.unmeasured_states,
            *((state.name, state.unit) for state in task.states),
            *((one.name, one.unit) for one in task.inputs))


def _rounds(backend: Backend, waiting: dict[str, TrainingTask], on_progress: OnPlant
            ) -> Generator[tuple[str, TrainingOutcome]]:
    first: dict[tuple[object, ...], str] = {}  # the file of the first lift of a kind
    stopped = False

    def watch(name: str, told: tuple[float, str] | None) -> bool:
        nonlocal stopped
        stopped = on_progress(name, *(told or (0.0, ''))) or stopped
        return stopped

    while waiting and not stopped:
        now: dict[str, TrainingTask] = {}
        tried = set()
        for name, task in waiting.items():
            kind = kind_of(task)
            if task.warm_start_model != FIRST:
                now[name] = task
            elif kind in first:
                now[name] = replace(task, warm_start_model=first[kind])
            elif kind not in tried:
                tried.add(kind)
                now[name] = replace(task, warm_start_model='')
        with contextlib.closing(backend.run(_retrained, now, watch=watch, apart=True)) as found:
            for name, outcome in found:
                task = waiting.pop(name)
                one = outcome if isinstance(outcome, TrainingOutcome) else failed(outcome)
                if one.accepted and one.summary is not None:
                    first.setdefault(kind_of(task), str(one.summary['model_file']))
                yield name, one
    for name in waiting:
        yield name, TrainingOutcome(None, stopped=True)


def _retrained(_: None, task: TrainingTask, tell: Tell) -> TrainingOutcome:
    # serially, because the plants run in parallel
    return TrainingOutcome(*reported(retrain(
        replace(task, executor=''), lambda share, text: tell((share, text)))))


def failed(error: BaseException) -> TrainingOutcome:
    """Return the outcome of a training that raised an exception."""
    if isinstance(error, Stopped):
        return TrainingOutcome(None, stopped=True)
    return TrainingOutcome(None, error=_error_text(error))


def _error_text(error: BaseException) -> str:
    """Return the text of an error in a line; of an unexpected one with its class."""
    if isinstance(error, MemoryError):
        return 'out of memory: free memory, or train on fewer bags'
    said = ' '.join(str(error).split())
    expected = isinstance(error, EXPECTED)
    return said if said and expected else ': '.join(filter(None, [type(error).__name__, said]))


def _check(tasks: Mapping[str, TrainingTask]) -> None:
    if not tasks:
        raise ValueError('no plant to retrain: name at least one')
    by_file: dict[Path, str] = {}
    for name, task in tasks.items():
        file = Path(task.output).resolve()
        if (other := by_file.setdefault(file, name)) != name:
            raise ValueError(f'{other} and {name} would both write {task.output}: give each plant '
                             'its own output')
