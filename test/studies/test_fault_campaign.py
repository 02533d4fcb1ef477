# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The fault campaign: its judge, its alterations, cases across real processes, its report."""

from dataclasses import replace
import json
import math
from pathlib import Path
from typing import Any

import pytest

from koopman_ros.core.status import StatusCode
from koopman_ros.event_log.records import parse
from studies.faults.__main__ import main
from studies.faults.case import Command, FaultCase, LoopTrace, SeenStatus
from studies.faults.cases import CASES, rejected_values
from studies.faults.endurance import run_endurance
from studies.faults.harness import FaultHarness, run
from studies.faults.judge import judge
from studies.faults.plants import FaultPlant, HEATED_LINE, QUADRUPLE_TANK, REACTOR, TWO_TANKS
from studies.faults.report import write
from support.recorded_runs import Recorded, STEADY

# the type support's parser imports a module that Python deprecated
pytestmark = pytest.mark.filterwarnings('ignore::DeprecationWarning')

CASE = FaultCase('test', 'test', '', lambda _: None, recovery=50.0,
                 says=('^controller: control: .*frozen',))
BEGIN, END = 50, 60
CONTROL, RECORDING = 'controller: control', 'trainer: recording'


def trace(temperature: Any = lambda t: 47.0 if BEGIN <= t < END + 20 else 46.0,
          coolant: Any = lambda t: 20.0 + 0.01 * t, **changes: Any) -> LoopTrace:
    """Return a trace that keeps to the bounds: 1 K off until 20 s after the fault."""
    return replace(LoopTrace(
        samples=[(float(t), (temperature(t),)) for t in range(200)],
        setpoints=[(0.0, (46.0,))], begin=float(BEGIN), end=float(END),
        statuses=[SeenStatus(55.0, CONTROL, 2, 'hold: the sensor is frozen', {}),
                  SeenStatus(70.0, CONTROL, 0, 'automatic', {})],
        commands=[Command(float(t), (coolant(t),), t) for t in range(200)]), **changes)


def reasons(found: LoopTrace, **bounds: Any) -> str:
    return '; '.join(judge(found, replace(CASE, **bounds))['reasons'])


def test_figures_of_a_survived_case() -> None:
    assert judge(trace(), CASE) == {
        'survived': True, 'reasons': [], 'unit': 'K', 'input_unit': 'K', 'worst_error': 1.0,
        'worst_step': 0.01, 'time_to_recover_s': 20.0, 'offset_at_the_end': 0.0}


@pytest.mark.parametrize(('found', 'bounds', 'words'), [
    (trace(), {'bump': 0.001}, 'stepped by 0.01 K after the fault'),
    (trace(), {'worst': 0.9}, '1 K from the set-point'),
    (trace(lambda t: 46.0 if t < BEGIN else 46.02), {'offset': 0.01}, 'offset of 0.02 K'),
    (trace(lambda t: 47.0 if BEGIN <= t < END + 51 else 46.0), {}, 'back only after 51 s'),
    (trace(lambda t: 46.0 if t < BEGIN else 46.4), {}, 'not back'),
    *((trace(coolant=lambda t, value=value: value if t == 100 else 20.0), {}, 'is not within')
      for value in (4.9, 32.1, math.nan, math.inf)),
    (trace(coolant=lambda t: 20.0 if t < 100 else 25.0), {}, 'stepped by 5 K at 100 s'),
    (trace(commands=[]), {}, 'never commanded'),
    (trace(end=math.inf), {}, 'not back'),
    (trace(begin=math.inf), {}, 'nothing was measured'),
    (trace(samples=[*trace().samples, (200.0, (61.0,)), (201.0, (46.0,))]), {}, 'lost from 60'),
    (trace(complaints=['ended with code -6']), {}, 'code -6'),
    # before the fault, or by another node
    (trace(statuses=[SeenStatus(10.0, CONTROL, 2, 'hold: the sensor is frozen', {}),
                     SeenStatus(56.0, 'plant: simulation', 0, 'frozen', {})]), {}, 'never said'),
    (trace(statuses=[*trace().statuses, SeenStatus(150.0, RECORDING, 2, 'the disk is full', {})]),
     {},
     'still say ERROR'),
    (trace(records=[(60.0, '{}')]), {}, 'cannot be replayed')])
def test_a_missed_bound_is_a_reason(found: LoopTrace, bounds: dict[str, Any], words: str) -> None:
    assert words in reasons(found, **bounds)


def test_commands_must_follow_from_the_records_which_give_the_reason() -> None:
    controller = Recorded()
    for k in range(5):
        controller.measure(STEADY + 0.1 * k)
    controller.measure(math.nan)
    found = trace(records=[(60.0, text) for text in controller.texts])
    assert not reasons(found, code=StatusCode.NOT_FINITE)
    assert 'no record gives the reason' in reasons(found, code=StatusCode.FROZEN)
    altered = parse(controller.texts[3])
    altered.fields['command'][0] += 1e-12
    found.records[3] = 60.0, altered.text()
    assert 'do not follow' in reasons(found)
    del found.records[3]
    assert 'are missing' in reasons(found)


def test_faults_of_messages_models_and_processes_are_survived(tmp_path: Path) -> None:
    """One case of each, in turn in one loop."""
    nan, garbage, killed = (
        CASES[name] for name in ('nan-short', 'model-garbage', 'controller-killed'))

    def play(loop: FaultHarness) -> None:
        for case in (nan, garbage, killed):
            case.play(loop)
            loop.run_for(20.0)
        loop.trace.begin = nan.settle

    result, _ = run(replace(
        nan, play=play, says=garbage.says, bump=killed.bump, plant=killed.plant,
        afterwards=60.0, recovery=60.0), tmp_path)
    assert result['reasons'] == []


def test_short_endurance_run_accounts_for_everything(tmp_path: Path) -> None:
    found = run_endurance(tmp_path / 'soak', lambda: None, hours=0.03)
    assert found['reasons'] == []
    assert found['answers']['measurements'] > 100
    assert set(found['recorded'].values()) == {found['answers']['answered']}


@pytest.mark.parametrize('on', [REACTOR, TWO_TANKS, QUADRUPLE_TANK, HEATED_LINE])
def test_rejected_values_are_of_parameters_that_exist(on: FaultPlant) -> None:
    names = {name for change in rejected_values(on) for name in change}
    assert names <= set(on.table.rows)


def test_report_and_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good = {'plant': 'reactor', 'group': 'sensor', 'does': 'NaN', 'notes': ['a note'],
            'survived': True, 'reasons': [], 'worst_error': 1.0, 'worst_step': 0.5,
            'time_to_recover_s': 20.0, 'offset_at_the_end': 0.0, 'wall_seconds': 2.0}
    bad = {**good, 'survived': False, 'reasons': ['not back'], 'time_to_recover_s': math.inf}
    skipped = {'plant': 'two_tanks', 'group': 'processes', 'does': 'full', 'notes': [],
               'survived': False, 'skipped': 'no disk'}
    assert not write(tmp_path, {'nan-short': good, 'bias': bad, 'disk-full': skipped})
    text = (tmp_path / 'report.md').read_text()
    for words in ('1 of 3 cases survived, 1 skipped', '## two_tanks: processes',
                  '**bias**: not back', 'skipped: no disk', 'a note'):
        assert words in text
    assert json.loads((tmp_path / 'summary.json').read_text())['results']['bias'][
        'time_to_recover_s'] is None
    assert write(tmp_path, {'good': good, 'skipped': skipped})
    assert len(CASES) == 191
    assert main(['sensor', 'feed-warm', '--list']) == 0
    assert 'nan-short' in capsys.readouterr().out
    with pytest.raises(SystemExit):
        main(['no-such-case'])
