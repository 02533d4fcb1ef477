# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The judge of the fault campaign: whatever is wrong with a course, it sees."""

from __future__ import annotations

from dataclasses import replace
import math

import pytest

from koopman_ros.reasons import Code
from koopman_ros.replay.records import parse
from support.recorded_controller import Recorded, STEADY
from validation.faults.course import Command, Course, Said, Sample
from validation.faults.judge import Account, account, Bounds, judge

BOUNDS = Bounds(coolant_min=5.0, coolant_max=32.0, largest_step=1.0, recovery=50.0,
                says=('^controller: control: .*frozen',))
SECONDS = 200
BEGIN, END = 50, 60


def course(temperature=lambda t: 46.0 + (1.0 if BEGIN <= t < END + 20 else 0.0),
           coolant=lambda t: 20.0 + 0.01 * t):
    """Return a course that keeps to the bounds: 1 K off until 20 s after the fault."""
    said = [Said(55.0, 'controller: control', 2, 'hold: the sensor is frozen', {}),
            Said(70.0, 'controller: control', 0, 'automatic', {})]
    return Course(
        samples=[Sample(float(t), temperature(t)) for t in range(SECONDS)],
        setpoints=[(0.0, 46.0)], begin=float(BEGIN), end=float(END), said=said,
        commands=[Command(float(t), coolant(t), t) for t in range(SECONDS)])


def reasons(found):
    return '; '.join(judge(found, BOUNDS).reasons)


def test_figures_of_a_case_that_is_survived():
    verdict = judge(course(), BOUNDS)
    assert verdict.survived
    assert verdict.reasons == ()
    assert verdict.worst_error == pytest.approx(1.0)
    assert verdict.worst_step == pytest.approx(0.01)
    assert verdict.recovery == 20.0


def test_commands_that_do_not_follow_from_the_records_are_not_survived():
    controller = Recorded()
    for k in range(5):
        controller.measure(STEADY + 0.1 * k)
    found = course()
    found.records = [(60.0, text) for text in controller.texts]
    assert judge(found, BOUNDS).survived
    altered = parse(controller.texts[3])
    altered.fields['command'][0] += 1e-12
    found.records[3] = 60.0, altered.text()
    assert reasons(found).startswith('1 commands do not follow from the records, the first at')
    del found.records[3]
    assert reasons(found) == 'records 3 to 3 are missing'
    found.records = [(60.0, '{}')]
    assert 'its records cannot be replayed' in reasons(found)


def test_reason_is_looked_for_in_the_records_from_the_fault_on():
    controller = Recorded()
    controller.measure(STEADY)
    controller.measure(math.nan)
    bounds = replace(BOUNDS, codes=(Code.NOT_FINITE,))
    found = course()
    for seconds, words in ((BEGIN, ''), (BEGIN - 1.0, 'no record gives the reason')):
        found.records = [(seconds, text) for text in controller.texts]
        assert words in '; '.join(judge(found, bounds).reasons)
        assert judge(found, bounds).survived is not bool(words)


@pytest.mark.parametrize('celsius', [4.9, 32.1, math.nan, math.inf, -math.inf])
def test_command_out_of_range_is_not_survived(celsius):
    found = course(coolant=lambda t: celsius if t == 100 else 20.0)
    assert f'the command {celsius:g} degC at 100 s is not within 5 to 32 degC' in reasons(found)


def test_bump_of_the_command_is_not_survived():
    found = course(coolant=lambda t: 20.0 if t < 100 else 21.5)
    assert reasons(found) == (
        'the coolant command stepped by 1.50 K at 100 s, 1 K are allowed')
    assert judge(found, BOUNDS).worst_step == pytest.approx(1.5)


def test_command_from_what_is_in_force_is_no_bump():
    found = course(coolant=lambda t: 20.0 if t < 100 else 25.0)
    found.coolants[100] = 24.8
    assert judge(found, BOUNDS).survived
    assert judge(found, BOUNDS).worst_step == pytest.approx(0.2)
    found.coolants[100] = 22.0
    assert 'the coolant command stepped by 3.00 K at 100 s' in reasons(found)


def test_bump_where_nothing_calls_for_a_step_is_not_survived():
    assert judge(course(), replace(BOUNDS, bump=0.02)).survived
    assert judge(course(), replace(BOUNDS, bump=0.001)).reasons == (
        'the coolant command stepped by 0.010 K after the fault, 0.001 K are allowed',)


def test_silent_controller_is_not_survived():
    assert reasons(replace(course(), commands=[])) == 'the controller never commanded'


def test_late_recovery_is_not_survived():
    found = course(temperature=lambda t: 47.0 if BEGIN <= t < END + 51 else 46.0)
    assert reasons(found).startswith('back only after 51 s within 0.3 K of the set-point; 50 s')
    assert judge(found, BOUNDS).recovery == 51.0


def test_coming_back_is_not_being_back():
    found = course(temperature=lambda t: 46.5 if BEGIN <= t < END or t == 150 else 46.0)
    assert judge(found, BOUNDS).recovery == 91.0


def test_reactor_that_stays_away_is_not_survived():
    found = course(temperature=lambda t: 46.0 if t < BEGIN else 46.4)
    assert reasons(found).startswith('not back within 0.3 K')
    assert judge(found, BOUNDS).recovery == math.inf
    assert judge(found, replace(BOUNDS, band=0.5)).survived


def test_offset_that_is_left_is_not_survived_where_none_may_be():
    found = course(temperature=lambda t: 46.0 if t < BEGIN else 46.02)
    assert judge(found, BOUNDS).survived
    assert judge(found, replace(BOUNDS, offset=0.01)).reasons == (
        'an offset of 0.020 K is left, 0.01 K are allowed',)


def test_error_is_bounded_where_a_case_says_so():
    assert judge(course(), replace(BOUNDS, worst=1.1)).survived
    assert judge(course(), replace(BOUNDS, worst=0.9)).reasons == (
        'the temperature was 1.00 K from the set-point, 0.9 K are allowed',)


def test_error_is_that_from_the_set_point_of_its_time():
    found = course(temperature=lambda t: 46.0 if t < 100 else 44.0)
    found.setpoints.append((100.0, 44.0))
    assert judge(found, BOUNDS).worst_error == 0.0


def test_fault_that_never_ended_is_not_survived():
    assert 'not back' in reasons(replace(course(), end=math.inf))
    assert 'no temperature was measured after the fault began' in reasons(
        replace(course(), begin=math.inf))


def test_runaway_is_not_survived():
    found = course(temperature=lambda t: 61.0 if t == 55 else 46.0)
    assert reasons(found) == 'the reactor reached 61.0 degC, 60 degC is a runaway'


def test_silent_diagnostics_are_not_survived():
    found = course()
    # said before the fault, or by another, is not said
    found.said[0] = found.said[0]._replace(seconds=10.0)
    found.said.append(Said(56.0, 'plant: simulation', 0, 'frozen', {}))
    assert reasons(found) == 'diagnostics never said "^controller: control: .*frozen"'


def test_lasting_error_is_not_survived_unless_excused():
    found = course()
    found.said.append(Said(150.0, 'trainer: recording', 2, 'the disk is full', {}))
    assert reasons(found) == (
        'at the end diagnostics still say ERROR: trainer: recording: the disk is full')
    assert judge(found, replace(BOUNDS, excused=('trainer: recording',))).survived


def test_complaints_of_the_case_count():
    found = course()
    found.complaints.append('controller ended with code -6')
    assert reasons(found) == 'controller ended with code -6'


def test_account_of_answers():
    assert account([1, 2, 3], [1, 2, 3]) == Account(3, 3, 0, 0, 0, 0)
    assert account([1, 2, 3], [1, 2, 3]).complete
    # one that came twice is answered twice
    assert account([1, 2, 2, 3], [1, 2, 2, 3]).complete


@pytest.mark.parametrize(('answers', 'expected'), [
    ([1, 3], Account(3, 2, 1, 0, 0, 0)),
    ([1, 2, 2, 3], Account(3, 2, 0, 1, 0, 0)),
    ([1, 2, 3, 4], Account(3, 3, 0, 0, 1, 0)),
    ([2, 1, 3], Account(3, 3, 0, 0, 0, 1))])
def test_account_finds_what_is_amiss(answers, expected):
    found = account([1, 2, 3], answers)
    assert found == expected
    assert not found.complete
