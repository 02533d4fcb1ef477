# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The process that retrains: a task in JSON on the first line of its input, JSON lines on its output.

Each line holds either ``progress`` (share done) with ``text``, or at last ``summary`` and
``files``, or ``error``, or ``stopped``. It ends early on SIGINT, on SIGTERM, and when its input is
closed, so that it does not outlive the process that started it.
"""

import json
import os
import signal
import sys
import threading
import time

from koopman_ros.identification import Stopped
from koopman_ros.jobs.backends import SchedulerLost, WorkerLost
from koopman_ros.retraining import retrain, Task, write_report

_PERIOD = 0.2  # s between two lines of progress


def main() -> int:
    """Run the task; the exit code is 0 for an accepted lift, 2 for a refused one, 1 otherwise."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    # the controller of the plant has priority
    os.nice(10)
    line = sys.stdin.readline()
    threading.Thread(target=_wait_for_end_of_input, args=(stop,), daemon=True).start()
    last = -_PERIOD

    def on_progress(share: float, text: str) -> bool:
        nonlocal last
        if time.monotonic() - last >= _PERIOD:
            last = time.monotonic()
            _print(progress=round(share, 4), text=text)
        return stop.is_set()

    try:
        task = Task.from_json(line)
        retrained = retrain(task, on_progress)
    except BrokenPipeError:
        # the process that started it is gone
        return 1
    except Stopped:
        _print(stopped=True)
        return 1
    except (ValueError, TypeError, KeyError, OSError, MemoryError, WorkerLost,
            SchedulerLost, ImportError) as error:
        _print(error=' '.join(str(error).split()) or type(error).__name__)
        return 1
    warnings = list(retrained.decision.warnings) if retrained.decision else []
    try:
        files = [str(path) for path in write_report(retrained)]
    except OSError as error:
        # the lift is written already
        files = []
        warnings.append(f'the report could not be written: {error}')
    _print(summary={**retrained.summary(), 'warnings': warnings}, files=files)
    return 0 if retrained.accepted else 2


def _wait_for_end_of_input(stop: threading.Event) -> None:
    sys.stdin.read()
    stop.set()


def _print(**values: object) -> None:
    print(json.dumps(values), flush=True)


if __name__ == '__main__':
    sys.exit(main())
