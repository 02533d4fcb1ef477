# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Parameter files of nodes in a namespace, or under another name."""

from pathlib import Path

import pytest

from koopman_ros.core.paths import config_directory
from koopman_ros.ros.parameter_files import ignored_sections
from koopman_ros.testing import Harness

OPERATORS = '{}:\n  ros__parameters: {{pump_1.max: 3.0}}\n'


def test_limits_of_an_operator_hold_in_every_namespace(ros: Harness, tmp_path: Path) -> None:
    shipped = (config_directory() / 'plants' / 'two_tanks.yaml').read_text()
    file = tmp_path / 'loop.yaml'
    file.write_text(shipped.replace('max: 12.0', 'max: 3.0'))
    for number, namespace in enumerate(('/', '/east')):
        ros.start('controller', arguments=(
            '--params-file', str(file), '-r', f'__ns:={namespace}'))
        node = f'{namespace.rstrip("/")}/controller'
        assert ros.get_parameters(node, 'pump_1.max', 'pump_2.max') == [3.0, 3.0]
        assert 'ignored' not in ros.processes[number].output()


def test_a_section_that_is_not_read_is_a_warning(ros: Harness, tmp_path: Path) -> None:
    (tmp_path / 'own.yaml').write_text(
        '/**:\n  ros__parameters: {system: two_tanks}\n' + OPERATORS.format('controller'))
    process = ros.start('controller', arguments=(
        '--params-file', str(tmp_path / 'own.yaml'), '-r', '__ns:=/east',
        '-p', 'controller:pump_2.max:=4.0'))
    assert ros.get_parameters('/east/controller', 'pump_1.max', 'pump_2.max') == [12.0, 12.0]
    for source in ('own.yaml', '-p controller:pump_2.max:=4.0'):
        ros.wait_until(lambda source=source: any(
            'WARN' in line and source in line and '"/**/controller:"' in line
            for line in process.output().splitlines()), source)


@pytest.mark.parametrize(('section', 'name', 'ignored'), [
    ('controller', '/controller', False), ('/controller', '/controller', False),
    ('/**/controller', '/controller', False), ('/**/controller', '/east/controller', False),
    ('/**', '/east/tank', False), ('/east/controller', '/east/controller', False),
    ('/**/tank', '/east/tank', False), ('trainer', '/east/controller', False),
    # of another node
    ('/west/controller', '/east/controller', False),
    ('controller', '/east/controller', True), ('/controller', '/east/controller', True),
    ('controller', '/tank', True), ('/**/controller', '/east/tank', True),
    ('tank', '/east/tank', True)])
def test_sections_that_ros_does_not_read(
        tmp_path: Path, section: str, name: str, ignored: bool) -> None:
    (tmp_path / 'own.yaml').write_text(OPERATORS.format(section))
    for given in (['--params-file', str(tmp_path / 'own.yaml')],
                  ['-p', f'{section}:pump_1.max:=3.0'], ['--param', f'{section}:pump_1.max:=3.0']):
        found = ignored_sections(['node', '--ros-args', *given], 'controller', name)
        assert bool(found) == ignored
        if found:
            assert f'"/**/{name.rpartition("/")[2]}:"' in found[0]


def test_a_parameter_without_a_section_is_not_ignored() -> None:
    assert ignored_sections(['node', '--ros-args', '-p', 'controller:=1', '-p', 'model:=a:b'],
                            'controller', '/east/controller') == []
