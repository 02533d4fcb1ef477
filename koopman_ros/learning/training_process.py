# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The process that retrains: a task in JSON on the first line of its input, JSON lines on its output.

Each line holds either ``progress`` (share done) with ``text``, or at last ``summary`` and
``files``, or ``error``, or ``stopped`` with the file of the best model so far. It ends early on
SIGINT, on SIGTERM, and when its input is closed, so that it does not outlive the process that
started it.
"""

import json
import os
import signal
import sys
import threading
import time

from koopman_ros.execution import SchedulerLost, WorkerLost
from koopman_ros.execution.training import outcome_text
from koopman_ros.learning import retrain, TrainingTask
from koopman_ros.learning.identification import Stopped
from koopman_ros.learning.report import reported

_PERIOD = 0.2  # s between two lines of progress
# exceptions of a training that the task, the bags or the machine cause
_EXPECTED = (ValueError, TypeError, KeyError, OSError, MemoryError, WorkerLost, SchedulerLost,
             ImportError)


def main() -> int:
    """Run the task; the exit code is 0 for an accepted lift, 2 for a rejected one, 1 otherwise."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    # the controller of the plant has priority
    os.nice(10)
    line = sys.stdin.readline()
    threading.Thread(target=_wait_for_end_of_input, args=(stop,), daemon=True).start()
    last = -_PERIOD

    def throttled(share: float, text: str) -> bool:
        nonlocal last
        if time.monotonic() - last >= _PERIOD:
            last = time.monotonic()
            _print(progress=round(share, 4), text=text)
        return stop.is_set()

    try:
        result = retrain(TrainingTask.of(json.loads(line)), throttled)
        if result.verdict == 'unfinished':
            _print(stopped=outcome_text(result.summary()))
            return 1
        summary, files = reported(result)
    except BrokenPipeError:
        # the process that started it is gone
        return 1
    except Stopped:
        _print(stopped='nothing was written')
        return 1
    except _EXPECTED as error:
        _print(error=_error_text(error))
        return 1
    _print(summary=summary, files=files)
    return 0 if summary['accepted'] else 2


def _error_text(error: BaseException) -> str:
    """Return the text of an error in a line."""
    if isinstance(error, MemoryError):
        return 'out of memory: free memory, or train on fewer bags'
    return ' '.join(str(error).split()) or type(error).__name__


def _wait_for_end_of_input(stop: threading.Event) -> None:
    sys.stdin.read()
    stop.set()


def _print(**values: object) -> None:
    print(json.dumps(values), flush=True)
