# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""YAML that others wrote is read by one function, without aliases."""

from collections.abc import Callable
from pathlib import Path
import re
from typing import Any

import pytest

from koopman_ros import records
from koopman_ros.core.yaml_text import load_yaml
from koopman_ros.export import command_line as export
from koopman_ros.parameters.signal_topics import file_parameters
from koopman_ros.records.metadata import parse_offered_qos

# nine to the eighth parts, each written as an alias
BOMB = 'a0: &a0 [x, x, x, x, x, x, x, x, x]\n' + ''.join(
    f'a{k}: &a{k} [{", ".join([f"*a{k - 1}"] * 9)}]\n' for k in range(1, 9))
METADATA = 'rosbag2_bagfile_information:\n' + ''.join(
    f'  {line}\n' for line in [*BOMB.splitlines(), 'storage_identifier: *a8',
                               'relative_file_paths: [a.mcap]'])


def bag(folder: Path, text: str) -> None:
    (folder / 'metadata.yaml').write_text(text)
    records.summary(folder)


def parameters(folder: Path, text: str) -> None:
    (folder / 'loop.yaml').write_text(text)
    file_parameters(folder / 'loop.yaml', 'controller')


@pytest.mark.parametrize('read', [bag, parameters, lambda _, text: load_yaml(text)])
@pytest.mark.parametrize(('text', 'words'), [
    (METADATA, r'line \d.*alias'), (BOMB, 'alias'), ('a: [1, 2', 'YAML'),
    ('when: 2026-13-01 10:00:00', 'YAML'), ('[' * 100_000, 'YAML')])
def test_aliases_and_text_that_is_no_yaml_are_a_sentence(
        tmp_path: Path, read: Callable[[Path, str], Any], text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words) as error:
        read(tmp_path, text)
    assert len(str(error.value)) < 500


def test_a_parameter_file_of_aliases_is_not_exported(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for number, text in enumerate([BOMB, '- a list']):
        file = tmp_path / f'{number}.yaml'
        file.write_text(text)
        assert export.main(['reactor_nz4', '--sample_period', '1', '--parameters', str(file),
                            '--output', str(tmp_path / 'loop')]) == 1
        assert str(file) in capsys.readouterr().err


def test_offers_of_publishers_with_aliases_are_none() -> None:
    assert parse_offered_qos(BOMB + '- history: *a8\n') == ()


def test_no_other_module_reads_yaml() -> None:
    root = Path(records.__file__).parents[1]
    found = [path.name for path in root.rglob('*.py')
             if re.search(r'yaml\.(safe_load|load|full_load|unsafe_load)\b', path.read_text())]
    assert found == ['yaml_text.py']
