# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Whether a case was survived, and by how much: from the trace alone, without ROS."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
import itertools
import math
import re

import numpy as np

from koopman_ros.nodes.replay import replay_records
from koopman_ros.parameters.controller import ControllerParameters
from koopman_ros.reasons import Code
from koopman_ros.replay.records import parse, RecordError
from validation.faults.trace import Trace

RUNAWAY = 60.0  # degC; the reactor's operating points end below 54 degC
_LAST = 30.0  # s at the end of a trace, in which an offset is looked for
RATE = ControllerParameters.coolant_rate_limit / 60.0  # K/s
LONGEST_GAP = 3.0  # s between two commands
BAND = 0.3  # K around the set-point that counts as back


@dataclass(frozen=True)
class Bounds:
    """What a case must keep to."""

    coolant_min: float = ControllerParameters.coolant_min  #: lowest command, degC
    coolant_max: float = ControllerParameters.coolant_max  #: highest command, degC
    #: between two commands, K; never less than the rate limit allows for the time between them,
    #: where a busy machine has missed measurements, of which :data:`LONGEST_GAP` counts
    largest_step: float = RATE
    #: plant time from the end of the fault within which the reactor must be back, s
    recovery: float = 300.0
    bump: float = math.inf  #: largest step from the fault on, K, where nothing calls for any
    #: distance from the set-point that counts as back, K; infinity where none is asked
    band: float = BAND
    offset: float = math.inf  #: largest distance from the set-point in the last seconds, K
    worst: float = math.inf  #: largest distance from the set-point from the fault on, K
    #: regular expressions that diagnostics (``<node>: <task>: <sentence>``) must have matched from
    #: the beginning of the fault on
    says: tuple[str, ...] = ()
    #: of reasons that the controller's records must have given since then
    codes: tuple[Code, ...] = ()
    allowed_errors: tuple[str, ...] = ()  #: statuses (``<node>: <task>``) that may end in ERROR


@dataclass(frozen=True)
class Verdict:
    """What became of a case."""

    reasons: tuple[str, ...]  #: why it was not survived, in sentences; empty when it was
    worst_error: float  #: largest |T - set-point| from the fault on, K; NaN when nothing was seen
    worst_step: float  #: largest step between two commands from the fault on, K
    #: plant time from the end of the fault until the temperature stays within the band, s;
    #: infinity when it never does
    recovery: float
    offset: float  #: largest |T - set-point| in the last seconds, K

    @property
    def survived(self) -> bool:
        """Whether nothing is held against it."""
        return not self.reasons


def judge(trace: Trace, bounds: Bounds) -> Verdict:
    """Judge the trace of a case."""
    reasons = [*trace.complaints]
    times, errors = trace.errors()
    since = times >= trace.begin
    worst = float(np.max(errors[since])) if np.any(since) else math.nan
    recovery = _recovery(trace, bounds.band)
    if math.isnan(worst):
        reasons.append('no temperature was measured after the fault began')
    elif not recovery <= bounds.recovery:
        taken = 'not back' if math.isinf(recovery) else f'back only after {recovery:.0f} s'
        reasons.append(f'{taken} within {bounds.band:g} K of the set-point; {bounds.recovery:g} s '
                       f'are allowed, and {errors[-1]:.2f} K are left')
    offset = float(np.max(errors[times >= times[-1] - _LAST])) if len(times) else math.nan
    if not offset <= bounds.offset:
        reasons.append(f'an offset of {offset:.3f} K is left, {bounds.offset:g} K are allowed')
    if worst > bounds.worst:
        reasons.append(f'the temperature was {worst:.2f} K from the set-point, {bounds.worst:g} K '
                       'are allowed')
    hottest = max((sample.celsius for sample in trace.samples), default=-math.inf)
    if not hottest < RUNAWAY:
        reasons.append(f'the reactor reached {hottest:.1f} degC, {RUNAWAY:g} degC is a runaway')
    reasons += _commands(trace, bounds)
    step = _worst_step(trace)
    if step > bounds.bump:
        reasons.append(f'the coolant command stepped by {step:.3f} K after the fault, '
                       f'{bounds.bump:g} K are allowed')
    reasons += _reports(trace, bounds)
    reasons += _replay(trace, bounds.codes)
    return Verdict(tuple(reasons), worst, step, recovery, offset)


def _recovery(trace: Trace, band: float) -> float:
    times, errors = trace.errors()
    after = times >= trace.end
    times, out = times[after], errors[after] > band
    if not len(times) or out[-1]:
        return math.inf
    # back with the first sample after the last one that was outside
    return float(times[np.flatnonzero(out)[-1] + 1] - trace.end) if np.any(out) else 0.0


def out_of_range(trace: Trace, bounds: Bounds) -> list[str]:
    """Say which command is the first outside its range, if any is."""
    wrong = next((command for command in trace.commands if not
                  bounds.coolant_min <= command.celsius <= bounds.coolant_max), None)
    return [] if wrong is None else [
        f'the command {wrong.celsius:g} degC at {wrong.seconds:.0f} s is not within '
        f'{bounds.coolant_min:g} to {bounds.coolant_max:g} degC']


def _commands(trace: Trace, bounds: Bounds) -> list[str]:
    if not trace.commands:
        return ['the controller never commanded']
    reasons = out_of_range(trace, bounds)
    times, steps = trace.steps()
    gaps = np.diff(times, prepend=trace.commands[0].seconds)
    allowed = np.maximum(bounds.largest_step, RATE * np.minimum(gaps, LONGEST_GAP))
    # written so that NaN counts
    large = np.flatnonzero(~(steps <= allowed + 1e-6))
    if len(large):
        first = large[0]
        reasons.append(f'the coolant command stepped by {steps[first]:.2f} K at '
                       f'{times[first]:.0f} s, {allowed[first]:g} K are allowed after '
                       f'{gaps[first]:g} s')
    return reasons


def _worst_step(trace: Trace) -> float:
    times, steps = trace.steps()
    return float(np.max(steps[times >= trace.begin], initial=0.0))


def _reports(trace: Trace, bounds: Bounds) -> list[str]:
    reported = trace.reported()
    reasons = [f'diagnostics never said "{words}"' for words in bounds.says
               if not any(re.search(words, text) for text in reported)]
    last = {status.name: status for status in trace.statuses}
    return reasons + [
        f'at the end diagnostics still say ERROR: {name}: {status.message}'
        for name, status in sorted(last.items())
        if status.level >= 2 and name not in bounds.allowed_errors]


def _replay(trace: Trace, codes: Sequence[Code]) -> list[str]:
    """Say which reasons the records lack, and where commands do not follow from them."""
    try:
        records = [(seconds, parse(text)) for seconds, text in trace.records]
        found = replay_records(record for _, record in records)
    except RecordError as error:
        return [f'its records cannot be replayed: {error}']
    given = {code for seconds, record in records if seconds >= trace.begin
             for code in record.fields.get('reason', ())}
    reasons = [f'no record gives the reason {code.value}' for code in codes
               if code.value not in given]
    wrong = [sample.stamp_ns for sample in found.samples if sample.replayed is not None
             and sample.replayed.tobytes() != sample.recorded.tobytes()]
    if wrong:
        reasons.append(f'{len(wrong)} commands do not follow from the records, the first at stamp '
                       f'{wrong[0]} ns')
    return reasons + [f'records {lost.first} to {lost.last} are missing' for lost in found.lost]


@dataclass(frozen=True)
class Responses:
    """How the commands answer the measurements that reached the controller, by their stamps."""

    measurements: int  #: that reached it
    answered: int  #: of these, exactly once
    unanswered: int  #: of these, not at all
    repeated: int  #: answers beyond the first
    unasked: int  #: commands with a stamp that no measurement had
    out_of_order: int  #: answers that came before the answer to an earlier measurement

    @property
    def complete(self) -> bool:
        """Whether each measurement was answered once, in order."""
        return self.answered == self.measurements and not (
            self.repeated or self.unasked or self.out_of_order)


def responses(delivered: Sequence[int], answers: Sequence[int]) -> Responses:
    """
    Count commands by their stamps.

    :param delivered: stamps of the measurements as they reached the controller; one that came
        twice is to be answered twice.
    :param answers: stamps of the commands as they were published.
    """
    asked, given = Counter(delivered), Counter(answers)
    place: dict[int, int] = {}
    for number, stamp in enumerate(delivered):
        place.setdefault(stamp, number)
    order = [place[stamp] for stamp in answers if stamp in place]
    return Responses(
        measurements=len(delivered),
        answered=sum(count for stamp, count in asked.items() if given[stamp] == count),
        unanswered=(asked - given).total(),
        repeated=sum(count for stamp, count in (given - asked).items() if stamp in asked),
        unasked=sum(count for stamp, count in given.items() if stamp not in asked),
        out_of_order=sum(after < before for before, after in itertools.pairwise(order)))
