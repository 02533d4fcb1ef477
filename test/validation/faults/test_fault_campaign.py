# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Cases of the campaign across real processes, and what the campaign leaves behind."""

from dataclasses import replace
import json

import numpy as np
import pytest

from validation.faults.__main__ import main
from validation.faults.case import Case, Trace
from validation.faults.cases import CASES
from validation.faults.endurance import Endurance, Memory, run_endurance
from validation.faults.harness import Outcome, run
from validation.faults.judge import Responses, Verdict
from validation.faults.report import survived, write

# the type support's parser imports a module that Python deprecated
pytestmark = pytest.mark.filterwarnings('ignore::DeprecationWarning')


def test_faults_of_messages_models_and_processes_are_survived(tmp_path):
    """Of a case each, one after the other in one loop."""
    names = ('nan-short', 'model-garbage', 'controller-killed')

    def play(loop):
        for name in names:
            CASES[name].play(loop)
            loop.run_for(20.0)
        loop.trace.begin = nan.settle

    nan, garbage, killed = (CASES[name] for name in names)
    outcome = run(replace(nan, play=play, says=garbage.says, bump=killed.bump, plant=killed.plant,
                          afterwards=150.0), tmp_path)
    assert outcome.verdict is not None
    assert outcome.verdict.reasons == ()
    assert len(outcome.trace.samples) > 300
    assert len(list(tmp_path.glob('controller_*.log'))) == 2


def test_what_goes_wrong_is_held_against_the_case(tmp_path):
    """A process that dies, words that nobody reports, and a reactor that stays away."""
    def play(loop):
        with loop.fault():
            pass
        # where it does not come by on its way from 51.8 to 46 degC, however far it has come
        loop.request(53.0)
        loop.processes['controller'].process.kill()

    outcome = run(Case('test', 'doomed', '', play, settle=20.0, afterwards=60.0,
                       says=('nobody says this',)), tmp_path)
    assert not outcome.survived
    reasons = '; '.join(outcome.verdict.reasons)
    assert 'controller ended early, with code -9' in reasons
    assert 'controller_0 ended with code -9' in reasons
    assert 'not back within 0.3 K' in reasons
    assert 'diagnostics never said "nobody says this"' in reasons


def test_short_endurance_run_accounts_for_everything(tmp_path):
    found = run_endurance(tmp_path / 'soak', lambda: None, hours=0.05)
    assert found.reasons == ()
    assert found.answers.complete
    assert found.answers.measurements > 170
    assert found.recorded['/coolant_setpoint'] == found.recorded['/temperature'] == (
        found.answers.measurements)
    assert {'plant', 'controller', 'trainer'} >= set(found.memory)
    assert all(seen.megabytes[-1] > 20.0 for seen in found.memory.values())


def test_growth_is_that_of_a_warm_process():
    seconds = np.arange(0.0, 101.0)
    warming = Memory(seconds, np.where(seconds < 20.0, 50.0 + seconds, 70.0))
    assert warming.growth == pytest.approx(0.0, abs=1e-9)
    leaking = Memory(seconds, 50.0 + 0.1 * seconds)
    assert leaking.growth == pytest.approx(7.5)


GOOD = Outcome(CASES['nan-short'], Trace(notes=['a note']), Verdict((), 1.0, 0.5, 20.0, 0.0), '',
               2.0)
BAD = Outcome(CASES['bias'], Trace(), Verdict(('not back',), 9.0, 0.5, np.inf, 3.0), '', 2.0)
SKIPPED = Outcome(CASES['disk-full'], Trace(), None, 'no disk', 0.5)
ENDURED = Endurance((), 1.0, 9.0, Responses(3, 3, 0, 0, 0, 0), {'weights': 2},
                    {'plant': Memory(np.arange(9.0), np.full(9, 80.0))}, {'/temperature': 3},
                    52.0, 0.5)


def test_report_says_what_failed_and_why(tmp_path):
    write(tmp_path, [GOOD, BAD, SKIPPED], ENDURED)
    text = (tmp_path / 'report.md').read_text()
    assert '1 of 3 cases survived, 1 skipped' in text
    assert '- **bias**: not back' in text
    assert '| 9.00 | 0.50 | never | 3.000 | **failed** |' in text
    assert 'skipped: no disk' in text
    assert 'a note' in text
    assert '| plant | 80.0 | 80.0 | 0.00 |' in text
    summary = json.loads((tmp_path / 'summary.json').read_text())
    assert (summary['cases'], summary['survived'], summary['skipped']) == (3, 1, 1)
    assert summary['results']['bias']['time_to_recover_s'] is None
    assert summary['results']['nan-short']['worst_temperature_error_K'] == 1.0
    assert summary['soak']['survived']


def test_campaign_is_survived_when_nothing_failed():
    assert survived([GOOD, SKIPPED], ENDURED)
    assert not survived([GOOD, BAD], ENDURED)
    assert not survived([GOOD], replace(ENDURED, reasons=('it grew',)))


def test_command_line(capsys):
    assert len(CASES) >= 80
    assert all(case.does and case.group for case in CASES.values())
    assert main(['sensor', 'feed-warm', '--list']) == 0
    listed = capsys.readouterr().out
    assert 'nan-short' in listed
    assert 'feed-warm' in listed
    assert 'clock-back' not in listed
    with pytest.raises(SystemExit):
        main(['no-such-case'])
    assert 'there is no case no-such-case: --list shows them' in capsys.readouterr().err
