# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The fault campaign: its judge, its alterations, cases across real processes, its report."""

from collections import Counter
from dataclasses import replace
import json
import math

import numpy as np
import pytest
from studies.faults.cases.processes import second_controller

from koopman_ros.reasons import Code
from koopman_ros.replay.records import parse
from studies.faults import interceptor
from studies.faults.__main__ import main
from studies.faults.case import Case, Command, Status, Trace
from studies.faults.cases import CASES
from studies.faults.endurance import growth, run_endurance
from studies.faults.harness import run
from studies.faults.interceptor import Packet
from studies.faults.judge import judge, out_of_range, responses
from studies.faults.plants import QUADRUPLE_TANK
from studies.faults.report import write
from support.recorded_runs import Recorded, STEADY

# the type support's parser imports a module that Python deprecated
pytestmark = pytest.mark.filterwarnings('ignore::DeprecationWarning')

CASE = Case('test', 'test', '', lambda _: None, recovery=50.0,
            says=('^controller: control: .*frozen',))
SECONDS = 200
BEGIN, END = 50, 60
CONTROL, RECORDING = 'controller: control', 'trainer: recording'


def trace(temperature=lambda t: 46.0 + (1.0 if BEGIN <= t < END + 20 else 0.0),
          coolant=lambda t: 20.0 + 0.01 * t):
    """Return a trace that keeps to the bounds: 1 K off until 20 s after the fault."""
    return Trace(
        samples=[(float(t), (temperature(t),)) for t in range(SECONDS)],
        setpoints=[(0.0, (46.0,))], begin=float(BEGIN), end=float(END),
        statuses=[Status(55.0, CONTROL, 2, 'hold: the sensor is frozen', {}),
                  Status(70.0, CONTROL, 0, 'automatic', {})],
        commands=[Command(float(t), (coolant(t),), t) for t in range(SECONDS)])


def reasons(found, **bounds):
    return '; '.join(judge(found, replace(CASE, **bounds))['reasons'])


def test_figures_of_a_case_that_is_survived():
    verdict = judge(trace(), CASE)
    assert verdict == {
        'survived': True, 'reasons': [], 'unit': 'K', 'input_unit': 'K', 'worst_error': 1.0,
        'worst_step': 0.01, 'time_to_recover_s': 20.0, 'offset_at_the_end': 0.0}


def test_commands_that_do_not_follow_from_the_records_are_not_survived():
    controller = Recorded()
    for k in range(5):
        controller.measure(STEADY + 0.1 * k)
    found = trace()
    found.records = [(60.0, text) for text in controller.texts]
    assert not reasons(found)
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
    found = trace()
    for seconds, words in ((BEGIN, ''), (BEGIN - 1.0, 'no record gives the reason')):
        found.records = [(seconds, text) for text in controller.texts]
        assert reasons(found, code=Code.NOT_FINITE).startswith(words)
        assert bool(reasons(found, code=Code.NOT_FINITE)) is bool(words)


@pytest.mark.parametrize('celsius', [4.9, 32.1, math.nan, math.inf, -math.inf])
def test_command_out_of_range_is_not_survived(celsius):
    found = trace(coolant=lambda t: celsius if t == 100 else 20.0)
    assert f'coolant_temperature = {celsius:g} °C at 100 s is not within' in reasons(
        found)


def test_bump_of_the_command_is_not_survived():
    found = trace(coolant=lambda t: 20.0 if t < 100 else 25.0)
    assert reasons(found) == (
        'a command stepped by 5 K at 100 s, 1 K are allowed after 1 s')
    assert judge(found, CASE)['worst_step'] == 5.0
    # from what acts there is no bump
    found.applied[100] = {'coolant_temperature': 24.8}
    assert not reasons(found)
    assert judge(found, CASE)['worst_step'] == 0.2
    found.applied[100] = {'coolant_temperature': 22.0}
    assert 'a command stepped by 3 K at 100 s' in reasons(found)
    # after missed measurements, as the rate limit allows in the time that counts
    for missed, step, words in ((1, 2.0, ''), (1, 2.1, '2 K are allowed after 2 s'),
                                (2, 3.0, ''), (9, 3.1, '3 K are allowed after 10 s')):
        found = trace(coolant=lambda t, step=step: 20.0 if t < 100 else 20.0 + step)
        del found.commands[100 - missed:100]
        assert words in reasons(found)
        assert bool(reasons(found)) is bool(words)


@pytest.mark.parametrize(('temperature', 'bound', 'enough', 'words'), [
    (None, {'bump': 0.001}, {'bump': 0.02},
     'a command stepped by 0.01 K after the fault, 0.001 K are allowed'),
    (None, {'worst': 0.9}, {'worst': 1.1},
     'it was 1 K from the set-point, 0.9 K are allowed'),
    (lambda t: 46.0 if t < BEGIN else 46.02, {'offset': 0.01}, {},
     'an offset of 0.02 K is left, 0.01 K are allowed'),
    (lambda t: 47.0 if BEGIN <= t < END + 51 else 46.0, {}, {'recovery': 51.0},
     'back only after 51 s within 0.3 K of the set-point; 50 s are allowed, and 0 K are left'),
    (lambda t: 46.0 if t < BEGIN else 46.4, {}, {'band': 0.5},
     'not back within 0.3 K of the set-point; 50 s are allowed, and 0.4 K are left')])
def test_bounds_are_kept_to(temperature, bound, enough, words):
    found = trace() if temperature is None else trace(temperature)
    assert reasons(found, **bound) == words
    assert not reasons(found, **enough)


def test_error_and_recovery_are_those_of_the_set_point_of_their_time():
    found = trace(temperature=lambda t: 46.0 if t < 100 else 44.0)
    found.setpoints.append((100.0, (44.0,)))
    assert judge(found, CASE)['worst_error'] == 0.0
    # coming back is not being back
    found = trace(temperature=lambda t: 46.5 if BEGIN <= t < END or t == 150 else 46.0)
    assert judge(found, CASE)['time_to_recover_s'] == 91.0


@pytest.mark.parametrize(('change', 'words'), [
    ({'commands': []}, 'the controller never commanded'),
    ({'end': math.inf}, 'not back'),
    ({'begin': math.inf}, 'nothing was measured after the fault began'),
    ({'samples': [*trace().samples, (200.0, (61.0,)), (201.0, (46.0,))]},
     'it reached 61 °C, and is lost from 60 °C on'),
    ({'complaints': ['controller ended with code -6']}, 'controller ended with code -6'),
    # before the fault, or by another node
    ({'statuses': [Status(10.0, CONTROL, 2, 'hold: the sensor is frozen', {}),
                   Status(56.0, 'plant: simulation', 0, 'frozen', {})]},
     'diagnostics never said "^controller: control: .*frozen"'),
    ({'statuses': [*trace().statuses, Status(150.0, RECORDING, 2, 'the disk is full', {})]},
     f'at the end diagnostics still say ERROR: {RECORDING}: the disk is full')])
def test_what_else_is_not_survived(change, words):
    found = replace(trace(), **change)
    assert words in reasons(found)
    assert bool(reasons(found, allowed_errors=(RECORDING,))) is (RECORDING not in words)


@pytest.mark.parametrize(('delivered', 'answers', 'expected'), [
    ([1, 2, 3], [1, 2, 3], (3, 3, 0, 0, 0, 0)),
    # one that came twice is answered twice
    ([1, 2, 2, 3], [1, 2, 2, 3], (4, 4, 0, 0, 0, 0)),
    ([1, 2, 3], [1, 3], (3, 2, 1, 0, 0, 0)),
    ([1, 2, 3], [1, 2, 2, 3], (3, 2, 0, 1, 0, 0)),
    ([1, 2, 3], [1, 2, 3, 4], (3, 3, 0, 0, 1, 0)),
    ([1, 2, 3], [2, 1, 3], (3, 3, 0, 0, 0, 1))])
def test_responses_are_counted(delivered, answers, expected):
    assert tuple(responses(delivered, answers).values()) == expected


VALUES = [5, 6, 7, 8, 9, 10]
STAMPS = [k * 1_000_000_000 for k in VALUES]
SENT = [Packet(stamp, {'x': float(k)}) for stamp, k in zip(STAMPS, VALUES, strict=True)]


def arriving(alter, sent=SENT):
    return [packet for message in sent for packet in alter(message)]


@pytest.mark.parametrize(('alter', 'values', 'stamps'), [
    (interceptor.unchanged, VALUES, STAMPS),
    (interceptor.frozen(), [5] * 6, STAMPS),
    (interceptor.value(lambda seconds, shown: shown + 10.0 * seconds),
     [5, 16, 27, 38, 49, 60], STAMPS),
    (interceptor.lost(), [], []),
    (interceptor.lost(0.0), VALUES, STAMPS),
    (interceptor.twice, [5, 5, 6, 6, 7, 7, 8, 8, 9, 9, 10, 10], None),
    (interceptor.swapped(), [6, 5, 8, 7, 10, 9], None),
    (interceptor.delayed(2), [5, 6, 7, 8], STAMPS[:4]),
    (interceptor.stamped(lambda stamp_ns: stamp_ns + 7), VALUES, [k + 7 for k in STAMPS]),
    (interceptor.frozen('stamp_ns'), VALUES, STAMPS[:1] * 6)])
def test_what_arrives(alter, values, stamps):
    packets = arriving(alter)
    assert [packet.values['x'] for packet in packets] == values
    assert stamps in (None, [packet.stamp_ns for packet in packets])


BOTH = Packet(7, {'x': 1.0, 'y': 2.0})


@pytest.mark.parametrize(('alter', 'arriving'), [
    # of one message where the stamp is the same
    (interceptor.value(lambda *_: 5.0), [BOTH._replace(values={'x': 1.0, 'y': 5.0})]),
    (interceptor.lost(), [Packet(7, {'x': 1.0})]),
    (interceptor.twice, [BOTH, Packet(7, {'y': 2.0})]),
    (interceptor.stamped(lambda stamp_ns: stamp_ns - 2),
     [Packet(7, {'x': 1.0}), Packet(5, {'y': 2.0})])])
def test_what_arrives_of_one_of_two_signals(alter, arriving):
    assert interceptor.part(alter, 'y')(BOTH) == arriving


def test_distances_and_steps_of_several_signals_are_the_largest():
    """Of tanks whose levels 3 and 4 have no set-point."""
    found = Trace(QUADRUPLE_TANK, samples=[(float(t), (0.15, 0.11, t, t)) for t in range(3)],
                  setpoints=[(0.0, (0.15, 0.1))],
                  commands=[Command(0.0, (3.0, 3.0), 0), Command(1.0, (3.1, 2.5), 1)])
    np.testing.assert_allclose(found.errors()[1], 0.01)
    np.testing.assert_allclose(found.steps()[1], 0.5)
    found.applied[1] = {'pump_1': 3.0, 'pump_2': 2.6}
    np.testing.assert_allclose(found.steps()[1], 0.1)
    found.commands.append(Command(2.0, (3.0, 10.5), 2))
    assert list(out_of_range(found)) == [
        'the command pump_2 = 10.5 V at 2 s is not within 0 to 10 V']


def test_a_share_is_lost_the_same_every_time_and_noise_has_its_deviation():
    many = [Packet(k, {'x': 40.0}) for k in range(4000)]
    lossy = arriving(interceptor.lost(0.3), many)
    assert len(lossy) == pytest.approx(2800, abs=150)
    assert arriving(interceptor.lost(0.3), many) == lossy
    noisy = arriving(interceptor.noise(2.0), many)
    assert [packet.stamp_ns for packet in noisy] == list(range(4000))
    shown = [packet.values['x'] for packet in noisy]
    assert np.mean(shown) == pytest.approx(40.0, abs=0.15)
    assert np.std(shown) == pytest.approx(2.0, rel=0.05)


def test_faults_of_messages_models_and_processes_are_survived(tmp_path):
    """Of a case each, one after the other in one loop."""
    names = ('nan-short', 'model-garbage', 'controller-killed')

    def play(loop):
        for name in names:
            CASES[name].play(loop)
            loop.run_for(20.0)
        loop.trace.begin = nan.settle

    nan, garbage, killed = (CASES[name] for name in names)
    result, trace = run(replace(
        nan, play=play, says=garbage.says, bump=killed.bump, plant=killed.plant,
        afterwards=60.0, recovery=60.0), tmp_path)
    assert result['reasons'] == []
    assert len(trace.samples) > 300
    assert len(list(tmp_path.glob('controller_*.log'))) == 2


def test_a_bad_signal_of_two_and_a_second_controller_are_survived(tmp_path):
    """On two levels and two pumps, each on a topic of its own."""
    case = CASES['two_tanks-nan-one']

    def play(loop):
        second_controller(loop, says=('^controller: control: 2 nodes command the pump_1',))
        loop.run_for(20.0)
        case.play(loop)

    result, found = run(replace(
        # as fast as it can, it would work on while the second one starts
        case, play=play, largest_step=math.inf, plant={**case.plant, 'speed': 20.0},
        settle=60.0, afterwards=60.0), tmp_path)
    assert result['reasons'] == []
    assert (result['plant'], result['unit'], result['input_unit']) == ('two_tanks', 'm', 'V')
    assert {len(states) for _, states in found.samples} == {2}
    assert {len(command.values) for command in found.commands} == {2}


def test_a_plant_that_runs_away_is_held_without_a_solver_and_without_its_sensor(tmp_path):
    """From the temperature alone; what was commanded is replayed without the solver, too."""
    case = replace(CASES['saddle-solver-missing'], play=CASES['saddle-lost'].play, between=True,
                   settle=15.0, afterwards=30.0, recovery=0.0, largest_step=2.0)
    result, found = run(case, tmp_path)
    assert result['reasons'] == []
    assert result['plant'] == 'saddle'
    assert {len(states) for _, states in found.samples} == {1}
    # with the solver the law would have planned
    assert judge(found, replace(case, missing=()))['reasons'] != []


def test_what_goes_wrong_is_held_against_the_case(tmp_path):
    """A process that dies, words that nobody reports, and a reactor that stays away."""
    def play(loop):
        with loop.fault():
            pass
        # where it does not come by on its way from 51.8 to 46 degC, however far it has come
        loop.request(53.0)
        loop.processes['controller'].process.kill()

    result, _ = run(Case('test', 'doomed', '', play, settle=20.0, afterwards=60.0,
                       says=('nobody says this',)), tmp_path)
    assert not result['survived']
    reasons = '; '.join(result['reasons'])
    assert 'controller ended early, with code -9' in reasons
    assert 'controller_0 ended with code -9' in reasons
    assert 'not back within 0.3 K' in reasons
    assert 'diagnostics never said "nobody says this"' in reasons


def test_short_endurance_run_accounts_for_everything(tmp_path):
    found = run_endurance(tmp_path / 'soak', lambda: None, hours=0.03)
    assert found['reasons'] == []
    assert found['answers']['measurements'] > 100
    assert set(found['recorded'].values()) == {found['answers']['answered']}
    assert set(found['recorded']) == {'/coolant_setpoint', '/temperature'}
    assert {'plant', 'controller', 'trainer'} >= set(found['memory_MB'])
    assert all(seen['last'] > 20.0 for seen in found['memory_MB'].values())


def test_growth_is_that_of_a_warm_process():
    seconds = np.arange(0.0, 101.0)
    assert growth(seconds, np.where(seconds < 20.0, 50.0 + seconds, 70.0)) == pytest.approx(
        0.0, abs=1e-9)
    assert growth(seconds, 50.0 + 0.1 * seconds) == pytest.approx(7.5)


GOOD = {'plant': 'reactor', 'group': 'sensor', 'does': 'NaN', 'notes': ['a note'],
        'survived': True, 'reasons': [], 'worst_error': 1.0, 'worst_step': 0.5,
        'time_to_recover_s': 20.0, 'offset_at_the_end': 0.0, 'wall_seconds': 2.0}
BAD = {**GOOD, 'survived': False, 'reasons': ['not back'], 'worst_error': 9.0,
       'time_to_recover_s': math.inf, 'offset_at_the_end': 3.0}
SKIPPED = {'plant': 'two_tanks', 'group': 'processes', 'does': 'full', 'notes': [],
           'survived': False, 'skipped': 'no disk'}
ENDURED = {
    'survived': True, 'reasons': [], 'hours': 1.0, 'wall_seconds': 9.0,
    'answers': {'measurements': 3}, 'events': {'weights': 2}, 'recorded': {'/temperature': 3},
    'hottest_degC': 52.0, 'mean_error_K': 0.5,
    'memory_MB': {'plant': {'first': 80.0, 'last': 80.1, 'growth_when_warm': 0.02}}}


def test_report_says_what_failed_and_why(tmp_path):
    assert not write(tmp_path, {'nan-short': GOOD, 'bias': BAD, 'disk-full': SKIPPED}, {
        'soak': ENDURED})
    text = (tmp_path / 'report.md').read_text()
    assert '1 of 3 cases survived, 1 skipped: reactor 1 of 2, two_tanks 0 of 1.' in text
    assert '## two_tanks: processes' in text
    assert '- **bias**: not back' in text
    assert '| 9 | 0.50 | never | 3 | **failed** |' in text
    assert 'skipped: no disk' in text
    assert 'a note' in text
    assert '| plant | 80.0 | 80.1 | 0.02 |' in text
    summary = json.loads((tmp_path / 'summary.json').read_text())
    assert (summary['cases'], summary['survived'], summary['skipped']) == (3, 1, 1)
    assert summary['results']['bias']['time_to_recover_s'] is None
    assert summary['results']['nan-short']['worst_error'] == 1.0
    assert summary['soak']['survived']
    assert write(tmp_path, {'good': GOOD, 'skipped': SKIPPED}, {'soak': ENDURED})
    assert not write(tmp_path, {'good': GOOD}, {
        'soak': ENDURED, 'soak-saddle': {**ENDURED, 'survived': False}})


def test_command_line(capsys):
    counts = Counter(case.on.name for case in CASES.values())
    assert (counts['reactor'], counts['saddle']) == (93, 15)
    assert min(counts['two_tanks'], counts['quadruple_tank']) >= 15
    assert all(name.startswith(case.on.name) for name, case in CASES.items()
               if case.on.name != 'reactor')
    assert all(case.does and case.group for case in CASES.values())
    assert main(['sensor', 'feed-warm', '--list']) == 0
    listed = capsys.readouterr().out
    assert 'nan-short' in listed
    assert 'feed-warm' in listed
    assert 'clock-back' not in listed
    with pytest.raises(SystemExit):
        main(['no-such-case'])
    assert 'there is no case no-such-case: --list shows them' in capsys.readouterr().err
