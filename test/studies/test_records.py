# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The study of measured records: its baselines on plants of their class, and its table."""

from dataclasses import replace
import json
from pathlib import Path
import warnings

import numpy as np
import pandas as pd
import pytest

from koopman_ros import learn_files
from studies.records import __main__ as study
from studies.records import table
from studies.records.baselines import BASELINES, chosen
from studies.records.sets import Frames, RecordSet, SETS
from support.quick_retraining import quick_retraining

PERIOD = 0.5


def run(seed: int, upper: float, count: int = 240) -> tuple[np.ndarray, np.ndarray]:
    """Return inputs and levels of two tanks in a row that empty linearly, the upper slowly."""
    pump = np.repeat(np.random.default_rng(seed).uniform(0.0, 10.0, count // 8), 8)
    above, level = 2.0, [2.0]
    for u in pump[:-1]:
        level.append(0.9 * level[-1] + 0.1 * above)
        above = upper * above + 0.5 * (1.0 - upper) * u
    return pump[:, None], np.array(level)[:, None]


@pytest.mark.parametrize(('name', 'options'), [
    ('ARX', {'order': (1, 2)}), ('N4SID', {'order': (2,)}),
    ('NARX', {'order': (2,), 'degree': (2,)}),
    ('EDMDc', {'delays': (2,), 'degree': (1,), 'ridge': (-6,)})])
def test_other_methods_are_exact_on_a_plant_of_their_class(
        name: str, options: dict[str, tuple[int, ...]]) -> None:
    baseline = replace(BASELINES[name], options=options)
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        pytest.importorskip(baseline.package)
        found, best = chosen(baseline, [run(0, 0.8)], init=20)
    u, y = run(1, 0.8)
    np.testing.assert_allclose(found(u, y[:20]), y, atol=1e-3)
    assert best.get('order', 2) == 2


def frames(_: Path) -> Frames:
    learn, test = (pd.DataFrame({
        'time [s]': PERIOD * np.arange(len(y)), 'pump [V]': u[:, 0], 'level [m]': y[:, 0]
        + 1e-3 * np.random.default_rng(2).standard_normal(len(y))}) for u, y in (
            run(0, 0.0), run(1, 0.0)))
    return [learn], test


def test_sets_at_hand_are_run_and_stand_in_the_table(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
        ) -> None:
    arx = replace(BASELINES['ARX'], options={'order': (1, 2)})
    for module in (study, table):
        monkeypatch.setattr(module, 'SETS', {
            'tanks': RecordSet(('level [m]',), ('pump [V]',), frames),
            'hair_dryer': SETS['hair_dryer']})
        monkeypatch.setattr(module, 'BASELINES', {'ARX': arx})
    program = learn_files.main
    monkeypatch.setattr(learn_files, 'main', lambda words: program(
        [*words, '--model_class', 'linear']))
    with quick_retraining(4, degrees=(1,)):
        assert study.main(['--records', str(tmp_path), '--output', str(tmp_path), '--seeds', '1',
                           '--scheduler', '', 'tanks', 'hair_dryer']) == 0
    printed = capsys.readouterr()
    assert 'hairdryer.csv' in printed.err
    found = json.loads((tmp_path / 'summary.json').read_text())
    assert found['tanks']['ARX']['fit']['level'][0] > 99.0
    assert found['tanks'][study.OWN]['fit']['level'][0] > 90.0
    assert '| `tanks`: level [m] |' in (tmp_path / 'report.md').read_text()
    assert (tmp_path / 'tanks' / 'seed_0.log').is_file()


def test_a_folder_that_is_not_there_is_a_sentence(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
        ) -> None:
    for module in (study, table):
        monkeypatch.setattr(module, 'SETS', {'hair_dryer': SETS['hair_dryer']})
    monkeypatch.setattr(study, 'PLANTS', 1)
    assert study.main(['--records', str(tmp_path / 'none'), '--output', str(tmp_path),
                       '--scheduler', '']) == 0
    assert '1 of 1' in (tmp_path / 'report.md').read_text()
    assert 'there is no folder' in capsys.readouterr().err


def test_an_interrupt_ends_the_whole_study(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
        ) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    for module in (study, table):
        monkeypatch.setattr(module, 'SETS', {
            'tanks': RecordSet(('level [m]',), ('pump [V]',), frames)})
    monkeypatch.setattr(study, 'by_baseline', interrupted)
    monkeypatch.setattr(study, 'learned', interrupted)
    monkeypatch.setattr(study, 'one_plant', interrupted)
    assert study.main(['--records', str(tmp_path), '--output', str(tmp_path), '--seeds', '1',
                       '--scheduler', '']) == 1
    assert capsys.readouterr().err.count('interrupted') == 1
    assert not json.loads((tmp_path / 'summary.json').read_text())['complete']
