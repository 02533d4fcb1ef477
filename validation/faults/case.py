# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A case of the campaign: what is done to a running loop, and what is expected of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
import math
from pathlib import Path
import time

from koopman_ros.parameters.controller import ControllerParameters
from koopman_ros.reasons import Code
from koopman_ros.testing import HarnessError
from validation.faults.course import Course
from validation.faults.judge import BAND, Bounds, judge, Verdict
from validation.faults.rig import LOCKSTEP, Rig

SETPOINT = 46.0  # degC; 5 K below the steady state that the reactor starts from
SETTLED = 240.0  # s of plant time from the start until the reactor stays there


@dataclass(frozen=True)
class Case:
    """
    A fault, and what the loop is to make of it.

    :param name: by which it is called on the command line.
    :param group: heading in the report.
    :param does: what is done, for the report.
    :param play: does it: waits, begins, puts the fault in, ends it. The runner has let the loop
        settle before, and lets it recover afterwards.
    :param between: whether messages are altered.
    :param plant: parameters on top of lock-step at full speed.
    :param controller: parameters.
    :param says: regular expressions that diagnostics must match, see :class:`Bounds`.
    :param codes: of reasons that must be in the controller's records, see there.
    :param excused: statuses that may end in ERROR.
    :param recovery: plant time to be back in, s.
    :param band: what counts as back, K.
    :param offset: largest one that may be left at the end, K.
    :param worst: largest distance from the set-point, K.
    :param largest_step: of the coolant between two commands, K; by default what the rate limit
        allows between two samples. After a gap it allows twice that.
    :param bump: the same from the fault on, where nothing calls for any.
    :param setpoint: degC, asked for at the start.
    :param settle: plant time before the case is played, s.
    :param afterwards: plant time that the loop runs on after the fault, s.
    :param limit: wall time, s.
    """

    name: str
    group: str
    does: str
    play: Callable[[Rig], None]
    between: bool = False
    plant: Mapping[str, object] = field(default_factory=lambda: LOCKSTEP)
    controller: Mapping[str, object] = field(default_factory=dict)
    says: tuple[str, ...] = ()
    codes: tuple[Code, ...] = ()
    excused: tuple[str, ...] = ()
    recovery: float = 300.0
    band: float = BAND
    offset: float = math.inf
    worst: float = math.inf
    largest_step: float = 1.0
    bump: float = math.inf
    setpoint: float = SETPOINT
    settle: float = SETTLED
    afterwards: float = 360.0
    limit: float = 40.0

    def bounds(self) -> Bounds:
        """Return what the course is judged by."""
        usual = ControllerParameters()
        return Bounds(
            coolant_min=usual.coolant_min, coolant_max=usual.coolant_max,
            largest_step=self.largest_step, bump=self.bump, recovery=self.recovery,
            band=self.band, offset=self.offset,
            worst=self.worst, says=self.says, codes=self.codes, excused=self.excused)


@dataclass(frozen=True)
class Outcome:
    """
    What became of a case.

    :param case: the case.
    :param course: what happened.
    :param verdict: what is held against it, and its figures; None where it could not be tried.
    :param skipped: why it could not be tried here.
    :param wall: what it took, s.
    """

    case: Case
    course: Course
    verdict: Verdict | None
    skipped: str
    wall: float

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
    rig = Rig(folder, case.limit, check, case.between)
    with rig:
        try:
            rig.start_loop(case.setpoint, case.plant, case.controller)
            rig.run_until(case.settle)
            case.play(rig)
            rig.run_for(case.afterwards)
            rig.expect(any('"command"' in text for _, text in rig.course.records),
                       'the controller recorded no command')
        except HarnessError as error:
            rig.course.complaints.append(str(error))
        except SkipError as reason:
            skipped = str(reason)
    verdict = None if skipped else judge(rig.course, case.bounds())
    return Outcome(case, rig.course, verdict, skipped, time.monotonic() - started)
