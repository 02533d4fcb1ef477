# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

import importlib
from pathlib import Path

import pytest

from koopman_ros.bags import message_definition, MessageDefinitionError

RULE = '=' * 80
HASH = 'RIHS01_' + '0' * 64


def _install(prefix: Path, type_name: str, text: str, *, description: str | None = None) -> None:
    package, name = type_name.split('/msg/')
    folder = prefix / 'share' / package / 'msg'
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f'{name}.msg').write_bytes(text.encode('utf-8'))
    if description is None:
        description = (
            f'{{"type_hashes": [{{"type_name": "{type_name}", "hash_string": "{HASH}"}}]}}')
    (folder / f'{name}.json').write_text(description, encoding='utf-8')


def test_dependencies_follow_depth_first_and_sorted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _install(tmp_path, 'a_msgs/msg/Top', 'b_msgs/Mid mid\nLeaf[] leaves\nuint8 X=1\n')
    _install(tmp_path, 'a_msgs/msg/Leaf', 'string<=4[<=2] names\n')
    _install(tmp_path, 'b_msgs/msg/Mid', '# Leaf is no field here\na_msgs/Leaf leaf\nLow low\n')
    _install(tmp_path, 'b_msgs/msg/Low', 'float64 x  # °C\n')
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path))
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
def test_definition_that_is_not_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, type_name: str, words: str
) -> None:
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path))
    _install(tmp_path, 'a_msgs/msg/Top', 'b_msgs/Gone gone\n')
    _install(tmp_path, 'a_msgs/msg/X', 'float64 x\n', description='{}')
    with pytest.raises(MessageDefinitionError, match=words.replace('{prefix}', str(tmp_path))):
        message_definition(type_name)


@pytest.mark.parametrize('type_name', [
    'builtin_interfaces/msg/Time',
    'diagnostic_msgs/msg/DiagnosticArray',
    'geometry_msgs/msg/PoseWithCovarianceStamped',
    'rosgraph_msgs/msg/Clock',
    'sensor_msgs/msg/JointState',
    'sensor_msgs/msg/PointCloud2',
    'sensor_msgs/msg/Temperature',
    'std_msgs/msg/Float64MultiArray',
])
def test_installed_hash_is_that_of_the_text(type_name: str) -> None:
    """Check text and hash against an independent implementation of REP-2016."""
    typesys = importlib.import_module('rosbags.typesys')
    try:
        definition = message_definition(type_name)
    except MessageDefinitionError as error:
        pytest.skip(str(error))
    store = typesys.get_typestore(typesys.Stores.EMPTY)
    store.register(typesys.get_types_from_msg(definition.text, type_name))
    assert store.hash_rihs01(type_name) == definition.type_hash
