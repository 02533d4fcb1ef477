# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A case of the campaign: what is done to a running loop, and what is expected of it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
import time
from typing import Any

from koopman_ros.testing import HarnessError
from validation.faults.harness import FaultHarness, LOCKSTEP
from validation.faults.judge import Bounds, judge, Verdict
from validation.faults.trace import Trace

SETPOINT = 46.0  # degC; 5 K below the steady state that the reactor starts from
SETTLED = 240.0  # s of plant time from the start until the reactor stays there
LIMIT = 300.0  # s of wall time for a case, on a machine that is busy otherwise


@dataclass(frozen=True)
class Case:
    """A fault, and what the loop is to make of it."""

    name: str  #: by which it is called on the command line
    group: str  #: heading in the report
    does: str  #: what is done, for the report
    #: does it: waits, begins, puts the fault in, ends it. The runner has let the loop settle
    #: before, and lets it recover afterwards
    play: Callable[[FaultHarness], None]
    bounds: Bounds = field(default_factory=Bounds)  #: what the loop must keep to
    between: bool = False  #: whether messages are altered
    #: parameters on top of lock-step at full speed
    plant: Mapping[str, object] = field(default_factory=lambda: LOCKSTEP)
    controller: Mapping[str, object] = field(default_factory=dict)  #: parameters
    setpoint: float = SETPOINT  #: degC, requested at the start
    settle: float = SETTLED  #: plant time before the case is played, s
    afterwards: float = 360.0  #: plant time that the loop runs on after the fault, s


_OF_BOUNDS = frozenset(item.name for item in fields(Bounds))


def case(group: str, name: str, does: str, play: Callable[[FaultHarness], None], **details: Any
         ) -> Case:
    """Build a case; the details are fields of it, or of its bounds."""
    of_case = {key: value for key, value in details.items() if key not in _OF_BOUNDS}
    bounds = Bounds(**{key: details[key] for key in details if key in _OF_BOUNDS})
    return Case(name, group, does, play, bounds, **of_case)


@dataclass(frozen=True)
class Outcome:
    """What became of a case."""

    case: Case  #: the case
    trace: Trace  #: what happened
    #: what is held against it, and its figures; None where it could not be tried
    verdict: Verdict | None
    skipped: str  #: why it could not be tried here
    wall: float  #: what it took, s

    @property
    def survived(self) -> bool:
        """Whether it was tried and nothing is held against it."""
        return self.verdict is not None and self.verdict.survived


class SkipError(Exception):
    """A case cannot be tried on this machine; the message says why."""


def run(case: Case, folder: Path, check: Callable[[], None] = lambda: None) -> Outcome:
    """
    Run a case in a domain of its own and judge it.

    :param folder: for what the processes print.
    :param check: called all the time; may raise to end the case, whose processes end then, too.
    """
    started = time.monotonic()
    folder.mkdir(parents=True, exist_ok=True)
    skipped = ''
    loop = FaultHarness(folder, LIMIT, check, case.between)
    with loop:
        try:
            loop.start_loop(case.setpoint, case.plant, case.controller)
            loop.run_until(case.settle)
            case.play(loop)
            loop.run_for(case.afterwards)
            loop.expect(any('"command"' in text for _, text in loop.trace.records),
                        'the controller recorded no command')
        except HarnessError as error:
            loop.trace.complaints.append(str(error))
        except SkipError as reason:
            skipped = str(reason)
    verdict = None if skipped else judge(loop.trace, case.bounds)
    return Outcome(case, loop.trace, verdict, skipped, time.monotonic() - started)
