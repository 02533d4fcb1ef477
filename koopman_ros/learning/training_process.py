# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The process that retrains: a task in JSON on the first line of its input, JSON lines on its output.

Each line holds either ``progress`` (share done) with ``text``, or at last ``summary`` and
``files``, or ``error``, or ``stopped``. The task of a fleet has ``plants``, a task each by name,
and ``executor``; then these last lines come for each ``plant``, and after all ``ended``. It ends
early on SIGINT, on SIGTERM, and when its input is closed, so that it does not outlive the process
that started it.
"""

from collections.abc import Mapping
import json
import os
import signal
import sys
import threading
import time
from typing import Any

from koopman_ros.learning import retrain, retrain_fleet, TrainingOutcome, TrainingTask
from koopman_ros.learning.fleet import EXPECTED, failed
from koopman_ros.learning.identification import Stopped
from koopman_ros.learning.pipeline import OnProgress
from koopman_ros.learning.report import reported

_PERIOD = 0.2  # s between two lines of progress


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

    def now_and_then(share: float, text: str) -> bool:
        nonlocal last
        if time.monotonic() - last >= _PERIOD:
            last = time.monotonic()
            _print(progress=round(share, 4), text=text)
        return stop.is_set()

    try:
        values = json.loads(line)
        if 'plants' in values:
            return _fleet(values, now_and_then)
        outcome = TrainingOutcome(*reported(retrain(TrainingTask.of(values), now_and_then)))
    except BrokenPipeError:
        # the process that started it is gone
        return 1
    except (Stopped, *EXPECTED) as error:
        outcome = failed(error)
    return _print_outcome(outcome)


def _fleet(values: Mapping[str, Any], now_and_then: OnProgress) -> int:
    """Retrain many plants; the exit code is that of the worst of them."""
    tasks = {name: TrainingTask.of(fields) for name, fields in values['plants'].items()}
    shares = dict.fromkeys(tasks, 0.0)

    def on_progress(name: str, share: float, text: str) -> bool:
        if name:
            shares[name] = share
        return now_and_then(sum(shares.values()) / len(shares), f'{name}: {text}' if name else '')

    codes = []
    for name, outcome in retrain_fleet(tasks, values.get('executor', ''), on_progress):
        shares[name] = 1.0
        codes.append(_print_outcome(outcome, plant=name))
    _print(ended=True)
    # a failure says more than a rejection
    return 1 if 1 in codes else max(codes)


def _print_outcome(outcome: TrainingOutcome, **of_plant: str) -> int:
    """Print the last line of a training, and return its exit code."""
    if outcome.summary is None:
        _print(**of_plant, **({'stopped': True} if outcome.stopped else {'error': outcome.error}))
        return 1
    _print(**of_plant, summary=outcome.summary, files=outcome.files)
    return 0 if outcome.accepted else 2


def _wait_for_end_of_input(stop: threading.Event) -> None:
    sys.stdin.read()
    stop.set()


def _print(**values: object) -> None:
    print(json.dumps(values), flush=True)
