# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Whether a case was survived, and by how much: from the trace alone, without ROS."""

from collections import Counter
from collections.abc import Iterator, Sequence
import contextlib
import itertools
import math
import re
import sys
from typing import Any

import numpy as np

from koopman_ros.event_log.records import parse, RecordError
from koopman_ros.event_log.run import replay_records
from studies.faults.case import FaultCase, LoopTrace

LONGEST_GAP = 3.0  # samples between two commands, for which a larger step is allowed
_PLANNER = 'koopman_ros.control.mpc.planner'
_LAST = 30.0  # s at the end of a trace, in which an offset is looked for


def judge(trace: LoopTrace, case: FaultCase) -> dict[str, Any]:
    """
    Judge the trace of a case.

    :return: `reasons` why it was not survived, in sentences; largest distance of a controlled
        state from its set-point and step between two commands from the fault on; plant time from
        its end until all stay within the band (infinity for never); largest distance in the last
        seconds.
    """
    unit, input_unit = case.on.unit, case.on.input_unit
    times, errors = trace.errors()
    stepped, steps = trace.steps()
    offset = float(np.max(errors[times >= times[-1] - _LAST])) if len(times) else math.nan
    since = errors[times >= trace.begin]
    worst = float(np.max(since)) if len(since) else math.nan
    step = float(np.max(steps[stepped >= trace.begin], initial=0.0))
    recovery = _recovery(trace, case.band)
    reasons = [*trace.complaints]
    if math.isnan(worst):
        reasons.append('nothing was measured after the fault began')
    elif not recovery <= case.recovery:
        taken = 'not back' if math.isinf(recovery) else f'back only after {recovery:.0f} s'
        reasons.append(f'{taken} within {case.band:g} {unit} of the set-point; '
                       f'{case.recovery:g} s are allowed, and {errors[-1]:.3g} {unit} are left')
    if not offset <= case.offset:
        reasons.append(f'an offset of {offset:.3g} {unit} is left, {case.offset:g} {unit} are '
                       'allowed')
    if worst > case.worst:
        reasons.append(f'it was {worst:.3g} {unit} from the set-point, {case.worst:g} {unit} are '
                       'allowed')
    reasons += [*out_of_range(trace), *_too_large_steps(trace, case)]
    if step > case.bump:
        reasons.append(f'a command stepped by {step:.3g} {input_unit} after the fault, '
                       f'{case.bump:g} {input_unit} are allowed')
    reasons += [*_reports(trace, case), *_records(trace, case)]
    return {'survived': not reasons, 'reasons': reasons,
            'unit': unit, 'input_unit': input_unit,
            'worst_error': round(worst, 6), 'worst_step': round(step, 6),
            'time_to_recover_s': round(recovery, 6), 'offset_at_the_end': round(offset, 6)}


def _recovery(trace: LoopTrace, band: float) -> float:
    times, errors = trace.errors()
    after = times >= trace.end
    times, out = times[after], errors[after] > band
    if not len(times) or out[-1]:
        return math.inf
    # back with the first sample after the last one that was outside
    return float(times[np.flatnonzero(out)[-1] + 1] - trace.end) if np.any(out) else 0.0


def out_of_range(trace: LoopTrace) -> Iterator[str]:
    """Say whether the plant was lost, and which command is the first outside its range."""
    on = trace.on
    unit, input_unit = on.shown_units
    highest = max((value for _, states in trace.samples for name, value in zip(
        on.states, states, strict=True) if name in on.controlled), default=-math.inf)
    if not highest < on.highest:
        yield f'it reached {highest:g} {unit}, and is lost from {on.highest:g} {unit} on'
    for command in trace.commands:
        for value, name in zip(command.values, on.inputs, strict=True):
            low, high = on.range(name)
            if not low <= value <= high:
                yield (f'the command {name} = {value:g} {input_unit} at {command.seconds:.0f} s '
                       f'is not within {low:g} to {high:g} {input_unit}')
                return


def _too_large_steps(trace: LoopTrace, case: FaultCase) -> Iterator[str]:
    if not trace.commands:
        yield 'the controller never commanded'
        return
    times, steps = trace.steps()
    gaps = np.diff(times, prepend=trace.commands[0].seconds)
    period, rate, unit = case.on.period, case.on.rate, case.on.input_unit
    allowed = np.maximum(case.largest_step,
                         rate * np.clip(gaps, period, LONGEST_GAP * period))
    # written so that NaN counts
    for first in np.flatnonzero(~(steps <= allowed + 1e-6))[:1]:
        yield (f'a command stepped by {steps[first]:.3g} {unit} at {times[first]:.0f} s, '
               f'{allowed[first]:g} {unit} are allowed after {gaps[first]:g} s')


def _reports(trace: LoopTrace, case: FaultCase) -> Iterator[str]:
    reported = trace.reported()
    for words in case.says:
        if not any(re.search(words, text) for text in reported):
            yield f'diagnostics never said "{words}"'
    for name, status in sorted({status.name: status for status in trace.statuses}.items()):
        if status.level >= 2 and name not in case.allowed_errors:
            yield f'at the end diagnostics still say ERROR: {name}: {status.message}'


def _records(trace: LoopTrace, case: FaultCase) -> Iterator[str]:
    """Say which reason the records lack, and where commands do not follow from them."""
    try:
        records = [(seconds, parse(text)) for seconds, text in trace.records]
        # as the controller was; a module that found the packages before would find them again
        missing = (*case.missing, _PLANNER) if case.missing else ()
        with _without(missing):
            found = replay_records(record for _, record in records)
    except RecordError as error:
        yield f'its records cannot be replayed: {error}'
        return
    if case.code is not None and not any(
            case.code.value in record.fields.get('reason', ()) for seconds, record in records
            if seconds >= trace.begin):
        yield f'no record gives the reason {case.code.value}'
    wrong = [sample.stamp_ns for sample in found.samples if sample.replayed is not None
             and sample.replayed.tobytes() != sample.recorded.tobytes()]
    if wrong:
        yield (f'{len(wrong)} commands do not follow from the records, the first at stamp '
               f'{wrong[0]} ns')
    for lost in found.lost:
        yield f'records {lost.first} to {lost.last} are missing'


@contextlib.contextmanager
def _without(modules: Sequence[str]) -> Iterator[None]:
    """Let some modules be missing, and keep all others that are imported meanwhile."""
    before = {name: sys.modules.get(name) for name in modules}
    sys.modules.update(dict.fromkeys(modules))  # type: ignore[arg-type]
    try:
        yield
    finally:
        for name, module in before.items():
            del sys.modules[name]
            if module is not None:
                sys.modules[name] = module


def responses(delivered: Sequence[int], answers: Sequence[int]) -> dict[str, int]:
    """
    Count how commands answer the measurements that reached the controller.

    :param delivered: stamps of the measurements as they reached the controller; one that came
        twice is to be answered twice.
    :param answers: stamps of the commands as they were published.
    :return: `measurements` that reached it; `answered`, of these, as often as they came;
        `unanswered`; `repeated` answers beyond those; `unasked`, whose stamp no measurement had;
        `out_of_order`, before the answer to an earlier measurement.
    """
    asked, given = Counter(delivered), Counter(answers)
    place = {stamp: number for number, stamp in reversed([*enumerate(delivered)])}
    order = [place[stamp] for stamp in answers if stamp in place]
    return {
        'measurements': len(delivered),
        'answered': sum(count for stamp, count in asked.items() if given[stamp] == count),
        'unanswered': (asked - given).total(),
        'repeated': sum(count for stamp, count in (given - asked).items() if stamp in asked),
        'unasked': sum(count for stamp, count in given.items() if stamp not in asked),
        'out_of_order': sum(after < before for before, after in itertools.pairwise(order))}
