# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The files of a training and of a replay: read with care, and shown as text and picture alone."""

import json
import os
from pathlib import Path
import struct
import zlib

import pytest

from koopman_ros.panel import learning
from koopman_ros.panel.learning import (
    Learning,
    read_bounded,
    read_comparison,
    read_picture,
    read_report,
    Report,
    report_base,
    report_state,
)

MARKUP = '<script>alert(1)</script>'
FIGURES = {
    'accepted': True, 'reasons': [], 'warnings': [MARKUP], 'model_file': 'new.safetensors',
    'measurements_read': 400, 'measurements_used': 398, 'condition': 12.34567,
    'heldout_error': {'temperature': 0.10234}, 'heldout_error_of_linear_model': {
        'temperature': None}, 'heldout_error_of_present_lift': None,
    'units': {'temperature': 'K'}, 'closed_loops_failed': 1, 'closed_loops': 128}
TOLD = {'accepted': 'True', 'measurements_read': '400', 'measurements_used': '398',
        'model_file': 'new.safetensors', 'done [%]': '100'}


def png(width: int = 2, height: int = 1) -> bytes:
    """Return a grey picture, as the format's own specification has it."""
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack('>I', len(data)) + kind + data + struct.pack(
            '>I', zlib.crc32(kind + data))

    return (b'\x89PNG\r\n\x1a\n' + chunk(b'IHDR', struct.pack('>IIBBBBB', width, height, 8, 0, 0,
                                                             0, 0))
            + chunk(b'IDAT', zlib.compress(b'\0\x80\x80')) + chunk(b'IEND', b''))


@pytest.fixture
def base(tmp_path: Path) -> Path:
    (tmp_path / 'new.json').write_text(json.dumps(FIGURES))
    (tmp_path / 'new.md').write_text(f'# Retraining {MARKUP}')
    (tmp_path / 'new.png').write_bytes(png())
    return tmp_path / 'new'


def test_a_report_is_read_with_its_figures_in_units(base: Path) -> None:
    found = read_report(base, TOLD)
    assert (found.problem, found.accepted, found.model_file) == ('', True, 'new.safetensors')
    assert found.lines == (f'Beware: {MARKUP}',)
    assert found.figures == {
        'error on held-out records': '0.1023 K', 'that of the best linear model': 'infinite K',
        'closed loops that failed': '1', 'closed loops that failed, of': '128',
        'condition number': '12.35', 'measurements used': '398', 'measurements used, of': '400'}
    assert found.text == f'# Retraining {MARKUP}'
    assert found.picture == png()


def test_a_report_of_another_training_is_not_shown_for_this_one(base: Path) -> None:
    found = read_report(base, {**TOLD, 'measurements_used': '399'})
    assert found == Report(
        f'the panel cannot read the report here: {base}.json is of another training')


@pytest.mark.parametrize('text', [
    '[]', '{', '[' * 100_000, '\xff', '{"bags": 1}', '{"bags": [{"recorded_model": []}]}'])
def test_figures_that_are_none_are_a_problem_and_no_more(tmp_path: Path, text: str) -> None:
    for name in ('new.json', 'summary.json'):
        (tmp_path / name).write_text(text, encoding='latin-1')
    assert text[:2] == '{"' or 'cannot read' in read_report(tmp_path / 'new').problem
    found = read_comparison(tmp_path, 'new', 1.0, 'one\n\ntwo: wrong\n')
    assert found.problem == 'the replay failed: one two: wrong'


def test_a_report_that_is_elsewhere(tmp_path: Path) -> None:
    found = read_report(tmp_path / 'new')
    assert found.problem.startswith(
        'the panel cannot read the report here, perhaps it is on another machine: ')


@pytest.mark.parametrize('data', [
    b'', png()[:-1], b'GIF89a' + png(), png(100_000, 100_000), png(0, 1),
    b'<svg xmlns="http://www.w3.org/2000/svg"/>'])
def test_what_is_no_whole_picture_of_bounded_size_is_none(tmp_path: Path, data: bytes) -> None:
    (tmp_path / 'a.png').write_bytes(data)
    assert read_picture(tmp_path / 'a.png') == b''


def test_pipes_folders_and_large_files_are_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / 'pipe')
    with pytest.raises(ValueError, match='no regular file'):
        read_bounded(tmp_path / 'pipe', 10)
    with pytest.raises((OSError, ValueError)):
        read_bounded(tmp_path, 10)
    (tmp_path / 'large').write_bytes(bytes(11))
    with pytest.raises(ValueError, match='has 11 bytes, at most 10 are read'):
        read_bounded(tmp_path / 'large', 10)
    assert read_picture(tmp_path / 'pipe') == b''


@pytest.mark.parametrize(('model', 'name'), [
    ('/a/new.safetensors', '/a/new'), ('/a/new.refused.safetensors', '/a/new'),
    ('reactor_nz4', None), ('', None)])
def test_files_lie_beside_the_model(model: str, name: str | None) -> None:
    assert report_base(model) == (None if name is None else Path(name))


def test_a_report_that_is_written_again_is_seen(base: Path) -> None:
    before = report_state(base)
    assert report_state(base) == before
    Path(f'{base}.md').unlink()
    assert report_state(base) != before


def test_pictures_go_by_what_they_are_of_and_by_nothing_else() -> None:
    own = Learning(report=Report(picture=b'one'))
    assert [own.picture(name) for name in ('training', 'comparison', '../x', '/etc/passwd')] == [
        b'one', b'', b'', b'']


def test_a_replay_tells_both_models_figures(tmp_path: Path) -> None:
    both = {'compared': 10, 'beyond_tolerance': 3, 'largest_difference': -1.23456,
            'largest_at_s': 7.0}
    (tmp_path / 'summary.json').write_text(json.dumps({'bags': [{
        'measurements': 12, 'reproduced': True, 'new_model': both,
        'recorded_model': {**both, 'beyond_tolerance': 0}}]}))
    (tmp_path / 'replay.png').write_bytes(png())
    found = read_comparison(tmp_path, 'new', 1.0, '')
    assert (found.problem, found.lines) == ('', ('the recorded commands are reproduced',))
    assert found.figures == {
        'measurements': '12', 'commands compared': '10', 'that differ by more': '3',
        'largest difference': '-1.235', 'at [s]': '7', 'acting model: commands that differ': '0'}
    assert found.picture == png()
    assert learning.MAX_PICTURE < 2 ** 25
