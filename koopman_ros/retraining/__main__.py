# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0


"""
The process that retrains: a task in JSON on the first line of its input, JSON lines on its output.

Each line holds either ``progress`` (share done) with ``text``, or at last ``summary`` and
``files``, or ``error``, or ``stopped``. It ends early on SIGINT, on SIGTERM, and when its input is
closed, so that it does not outlive whoever started it.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time

from koopman_ros.identification import Stopped
from koopman_ros.retraining import retrain, Task, write_report

_PERIOD = 0.2  # s between two lines of progress


def main() -> int:
    """Run the task; the exit code is 0 for an accepted lift, 2 for a refused one, 1 otherwise."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    # whoever controls the plant meanwhile comes first
    os.nice(10)
    line = sys.stdin.readline()
    threading.Thread(target=_wait_for_end_of_input, args=(stop,), daemon=True).start()
    last = -_PERIOD

    def tell(share: float, text: str) -> bool:
        nonlocal last
        if time.monotonic() - last >= _PERIOD:
            last = time.monotonic()
            _say(progress=round(share, 4), text=text)
        return stop.is_set()

    try:
        task = Task.from_json(line)
        outcome = retrain(task, tell)
    except BrokenPipeError:
        # whoever started it is gone
        return 1
    except Stopped:
        _say(stopped=True)
        return 1
    except (ValueError, TypeError, KeyError, OSError, MemoryError) as error:
        _say(error=' '.join(str(error).split()) or type(error).__name__)
        return 1
    warnings = list(outcome.verdict.warnings) if outcome.verdict else []
    try:
        files = [str(path) for path in write_report(outcome)]
    except OSError as error:
        # the lift is written already
        files = []
        warnings.append(f'the report could not be written: {error}')
    _say(summary={**outcome.summary(), 'warnings': warnings}, files=files)
    return 0 if outcome.accepted else 2


def _wait_for_end_of_input(stop: threading.Event) -> None:
    sys.stdin.read()
    stop.set()


def _say(**values: object) -> None:
    print(json.dumps(values), flush=True)


if __name__ == '__main__':
    sys.exit(main())
