# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The files of a training and of a replay, and the words for a model."""

from collections.abc import Mapping
from dataclasses import replace
from datetime import datetime
import json
import os
from pathlib import Path
import struct
import threading
import zlib

import pytest

from koopman_ros.core.paths import model_path
from koopman_ros.model import load
from koopman_ros.panel.files import read_bounded
from koopman_ros.panel.learning_watch import LearningWatch
from koopman_ros.panel.model_card import model_card, status_card, training_card, training_ranges
from koopman_ros.panel.training_report import (
    read_comparison,
    read_report,
)
from koopman_ros.parameters.panel import panel_signals, panel_table
from koopman_ros.parameters.signal_topics import SignalTopics

MARKUP = '<script>alert(1)</script>'
FIGURES = {
    'accepted': True, 'reasons': [], 'warnings': [MARKUP], 'model_file': 'new.safetensors',
    'measurements_read': 400, 'measurements_used': 398}
TRAINED = {'accepted': 'True', 'measurements_read': '400', 'measurements_used': '398',
           'model_file': 'new.safetensors', 'done [%]': '100'}


def png() -> bytes:
    """Return a grey picture by the specification of the format."""
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack('>I', len(data)) + kind + data + struct.pack(
            '>I', zlib.crc32(kind + data))

    return (b'\x89PNG\r\n\x1a\n' + chunk(b'IHDR', struct.pack('>IIBBBBB', 2, 1, 8, 0, 0, 0, 0))
            + chunk(b'IDAT', zlib.compress(b'\0\x80\x80')) + chunk(b'IEND', b''))


@pytest.fixture
def base(tmp_path: Path) -> Path:
    (tmp_path / 'new.json').write_text(json.dumps(FIGURES))
    (tmp_path / 'new.md').write_text(f'# Retraining {MARKUP}')
    (tmp_path / 'new.png').write_bytes(png())
    return tmp_path / 'new'


def test_a_report_has_verdict_text_and_picture(base: Path) -> None:
    found = read_report(base, TRAINED)
    assert (found.problem, found.accepted, found.model_file) == ('', True, 'new.safetensors')
    assert found.lines == (f'Warning: {MARKUP}',)
    assert found.text == f'# Retraining {MARKUP}'
    assert found.picture == png()


@pytest.mark.parametrize(('trained', 'exists', 'word'), [
    ({**TRAINED, 'measurements_used': '399'}, True, 'another training'),
    (TRAINED, False, 'another machine')])
def test_a_report_of_another_training_or_machine_is_a_problem(
        base: Path, trained: dict[str, str], exists: bool, word: str) -> None:
    if not exists:
        Path(f'{base}.json').unlink()
    found = read_report(base, trained)
    assert word in found.problem
    assert (found.accepted, found.text, found.picture) == (False, '', b'')


def test_pipes_folders_and_large_files_are_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / 'pipe')
    (tmp_path / 'large').write_bytes(bytes(11))
    for name, words in (('pipe', 'not a regular file'), ('.', 'not a regular file'),
                        ('large', 'more than 10 bytes')):
        with pytest.raises(ValueError, match=words):
            read_bounded(tmp_path / name, 10)


def test_a_comparison_counts_the_commands_that_differ(tmp_path: Path) -> None:
    (tmp_path / 'summary.json').write_text(json.dumps({'bags': [{
        'reproduced': True, 'new_model': {'compared': 10, 'beyond_tolerance': 3}}]}))
    (tmp_path / 'replay.png').write_bytes(png())
    found = read_comparison(tmp_path, 'new', 1.0, '')
    assert (found.problem, found.picture) == ('', png())
    assert '3 of 10' in found.lines[1]


class SlowDisk(LearningWatch):
    """A watch whose files are on a disk that does not answer until it is released."""

    def __init__(self) -> None:
        given = {'system': 'reactor'}
        values = {name: row.default for name, row in panel_table(None, given).rows.items()}
        settings = panel_table(None, given).snapshot(values)
        super().__init__('reactor', SignalTopics(
            panel_signals(None, given), settings.states, settings.inputs), '/', str)
        self.released, self.reads = threading.Event(), 0

    def _follow(self, base: Path, trained: Mapping[str, str]) -> None:
        self.reads += 1
        self.released.wait(10.0)
        super()._follow(base, trained)

    def wait(self) -> None:
        """Wait for the thread that reads."""
        assert self._reader is not None
        self._reader.join()


def test_a_disk_that_does_not_answer_does_not_stop_the_panel(base: Path) -> None:
    watch = SlowDisk()
    for _ in range(3):
        watch.training({**TRAINED, 'model_file': f'{base}.safetensors'}, '')
        assert watch.learning.report is None
    watch.released.set()
    watch.wait()
    assert watch.learning.report is not None
    assert watch.reads == 1
    watch.complete()


def test_a_report_is_followed(base: Path) -> None:
    watch = SlowDisk()
    watch.released.set()
    assert 'train one' in watch.compare('reactor_nz4').text
    trained = {**TRAINED, 'model_file': f'{base}.safetensors'}
    for number, (model, accepted) in enumerate(((trained['model_file'], True), ('other', False))):
        Path(f'{base}.json').write_text(json.dumps({**FIGURES, 'model_file': model}))
        os.utime(f'{base}.json', (2e9 + number, 2e9 + number))
        watch.training(trained, '')
        watch.wait()
        assert watch.learning.report
        assert watch.learning.report.accepted is accepted
        # a trainer that has started again does not know it
        assert watch.learning.new_model({}) == ((model, False) if accepted else ('', True))
        assert watch.learning.new_model({**trained, 'accepted': 'False'})[1]
        assert 'record first' in watch.compare('reactor_nz4').text
    assert 'another training' in watch.learning.report.problem
    watch.complete()


def test_a_model_is_described_in_words() -> None:
    model = load(model_path('two_tanks'))
    found = model_card(model)
    assert found['Model class'] == 'free lift, n_z = 2'
    assert found['Learned from'] == 'two tanks'
    assert {'Condition number', 'Held-out roll-out error (RMS), level 1 [m]'} <= set(found)
    assert not any('_' in name for name in found)
    said = 'On 30 plants'
    model = replace(model, provenance=replace(model.provenance, closed_loops=said))
    assert model_card(model)['Closed loops'] == said
    assert training_ranges(model)['level_1'] == (model.states.lower[0], model.states.upper[0])
    assert training_card({
        'accepted': 'False', 'done [%]': '100', 'heldout_rw': '1e-4', 'units: level_1': 'm',
        'heldout_error: level_1': '0.01', 'model_class': 'linear', 'class linear': 'chosen'}) == {
        'Held-out error, level 1 [m]': '0.01', 'Model class': 'linear', 'Class linear': 'chosen'}
    written = '2026-11-25T20:55:08.000+05:45'
    assert status_card({
        'model': 'x', 'model file time': written, 'law': 'none',
        'distance outside training box [half-ranges]': '0.5', 'gain norm': 'nan',
        'pump_1 and pump_2 outside training box [half-ranges]': '0'}) == {
        'File written': f'{datetime.fromisoformat(written).astimezone():%Y-%m-%d %H:%M:%S}',
        'State outside the training range [half-ranges]': '0.5',
        'Pump 1 and pump 2 outside the training range [half-ranges]': '0'}
