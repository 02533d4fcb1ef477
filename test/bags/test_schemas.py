# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

from pathlib import Path

import pytest

from koopman_ros.bags import message_definition, MessageDefinitionError

RULE = '=' * 80
HASH = 'RIHS01_' + '0' * 64


@pytest.fixture(autouse=True)
def prefix(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have one prefix searched before the interpreter's own."""
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path))


def _install(prefix: Path, type_name: str, text: str, *, description: str | None = None) -> None:
    package, name = type_name.split('/msg/')
    folder = prefix / 'share' / package / 'msg'
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f'{name}.msg').write_bytes(text.encode('utf-8'))
    (folder / f'{name}.json').write_text(description or (
        f'{{"type_hashes": [{{"type_name": "{type_name}", "hash_string": "{HASH}"}}]}}'))


def test_dependencies_follow_depth_first_and_sorted(tmp_path: Path) -> None:
    _install(tmp_path, 'a_msgs/msg/Top', 'b_msgs/Mid mid\nLeaf[] leaves\nuint8 X=1\n')
    _install(tmp_path, 'a_msgs/msg/Leaf', 'string<=4[<=2] names\n')
    _install(tmp_path, 'b_msgs/msg/Mid', '# Leaf is no field here\na_msgs/Leaf leaf\nLow low\n')
    _install(tmp_path, 'b_msgs/msg/Low', 'float64 x  # °C\n')
    definition = message_definition('a_msgs/msg/Top')
    assert definition.type_hash == HASH
    assert definition.text == (
        'b_msgs/Mid mid\nLeaf[] leaves\nuint8 X=1\n'
        f'\n{RULE}\nMSG: a_msgs/Leaf\nstring<=4[<=2] names\n'
        f'\n{RULE}\nMSG: b_msgs/Mid\n# Leaf is no field here\na_msgs/Leaf leaf\nLow low\n'
        f'\n{RULE}\nMSG: b_msgs/Low\nfloat64 x  # °C\n')


def test_first_prefix_wins_and_line_ends_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _install(tmp_path / 'overlay', 'a_msgs/msg/X', 'float64 x\r\nfloat64 over\r\n')
    _install(tmp_path / 'underlay', 'a_msgs/msg/X', 'float64 under\n')
    _install(tmp_path / 'ros', 'builtin_interfaces/msg/Time', 'int32 other\n')
    monkeypatch.setenv('AMENT_PREFIX_PATH', f'{tmp_path / "overlay"}::{tmp_path / "underlay"}')
    assert message_definition('a_msgs/msg/X').text == 'float64 x\r\nfloat64 over\r\n'
    # the interpreter's own comes last
    installed = message_definition('builtin_interfaces/msg/Time').text
    assert 'int32 sec' in installed
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path / 'ros'))
    assert message_definition('builtin_interfaces/msg/Time').text == 'int32 other\n'
    monkeypatch.delenv('AMENT_PREFIX_PATH')
    assert message_definition('builtin_interfaces/msg/Time').text == installed


@pytest.mark.parametrize(('type_name', 'words'), [
    ('my_msgs/msg/Level', r"'my_msgs/msg/Level': no Level\.msg in {prefix}/share/my_msgs/msg, .*; "
     'install ros-jazzy-my-msgs'),
    ('a_msgs/msg/Top', r"'b_msgs/Gone': no Gone\.msg in"),
    ('a_msgs/msg/X', r'X\.json of a_msgs carries no hash'),
    ('sensor_msgs/Temperature', 'write sensor_msgs/msg/Temperature'),
    *((name, 'is not of the form package/msg/Name') for name in (
        'Temperature', 'sensor_msgs/srv/SetCameraInfo', '../../etc/msg/Passwd',
        'sensor_msgs/msg/', ''))])
def test_definition_that_is_not_there(tmp_path: Path, type_name: str, words: str) -> None:
    _install(tmp_path, 'a_msgs/msg/Top', 'b_msgs/Gone gone\n')
    _install(tmp_path, 'a_msgs/msg/X', 'float64 x\n', description='{}')
    with pytest.raises(MessageDefinitionError, match=words.replace('{prefix}', str(tmp_path))):
        message_definition(type_name)
