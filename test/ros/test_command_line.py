# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The command line for topics, services and parameters, beside a running plant and controller."""

from collections.abc import Iterator
import os
from pathlib import Path
import re
import shlex
import subprocess
import sys

import pytest
import yaml

from koopman_ros import __version__
from koopman_ros.testing import Harness

PATIENCE = 60.0  # s, on a busy machine


@pytest.fixture(scope='module')
def harness(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Harness]:
    with Harness(tmp_path_factory.mktemp('command_line')) as harness:
        harness.start('controller')
        harness.start('plant', {'speed': 10.0})
        yield harness


def run(harness: Harness, *words: str) -> tuple[int, str]:
    done = subprocess.run(
        [sys.executable, '-m', 'koopman_ros.ros.command_line', *words],
        env={**os.environ, **harness.environment}, capture_output=True, text=True,
        timeout=2.0 * PATIENCE, check=False)
    return done.returncode, done.stdout + done.stderr


def test_a_set_point_is_published_and_heard(harness: Harness) -> None:
    assert run(harness, 'pub', '/setpoint', '{temperature: 45}', '--timeout', '60') == (0, '')
    harness.wait_until(lambda: yaml.safe_load(run(
        harness, 'echo', '/active_setpoint', '--count', '1', '--timeout', '60')[1].removesuffix(
        '---\n'))['temperature'] == 45.0)


def test_a_service_is_called(harness: Harness) -> None:
    code, shown = run(harness, 'call', '/controller/set_automatic', '{data: true}',
                      '--timeout', '60')
    assert (code, yaml.safe_load(shown)['success']) == (0, True)


def test_parameters_are_listed_read_and_set(harness: Harness) -> None:
    def parameter(*words: str) -> tuple[int, str]:
        return run(harness, 'param', '/controller', *words, '--timeout', '60')

    name = 'coolant_temperature.weight'
    assert parameter(name, '3') == (0, '')
    assert parameter(name) == (0, '3.0\n')
    assert f'{name}: 3.0\n' in parameter()[1]
    code, shown = parameter(name, '-3')
    assert code == 1
    assert 'must be in' in shown
    assert parameter(name) == (0, '3.0\n')


@pytest.mark.parametrize(('words', 'said'), [
    (('pub', '/setpoint', '{temprature: 45}', '--timeout', '60'), 'the fields are header'),
    (('pub', '/setpoint', '[', '--timeout', '60'), 'is not a valid Temperature'),
    (('pub', '/none', '{}', '--timeout', '0.5'), 'no node uses /none'),
    (('pub', '/none', '{}', '--type', 'std_msgs/msg/Float64', '--timeout', '0.5'),
     'no node subscribes'),
    (('pub', '/none', '{}', '--type', 'std_msgs/msg/None'), 'is not installed'),
    (('echo', '/none', '--type', 'std_msgs/msg/Float64', '--timeout', '0.5'), 'no message on'),
    (('call', '/none', '--timeout', '0.5'), 'no service /none'),
    (('param', '/none', '--timeout', '0.5'), 'no node /none'),
    (('param', '/controller', 'none', '--timeout', '60'), 'has no parameter none'),
])
def test_what_cannot_be_done_has_a_reason(harness: Harness, words: tuple[str, ...], said: str
                                          ) -> None:
    code, shown = run(harness, *words)
    assert code == 1
    assert said in shown
    assert shown.startswith('koopman_ros: ')


def test_the_version_is_shown(harness: Harness) -> None:
    assert run(harness, '--version') == (0, f'{__version__}\n')


def test_commands_of_the_page_succeed(harness: Harness) -> None:
    page = Path(__file__).parents[2] / 'docs' / 'how-to' / 'operate.md'
    commands = re.findall(r'^\.venv/bin/koopman_ros (.*)$', page.read_text(), re.MULTILINE)
    assert len(commands) == 4
    for command in commands:
        code, shown = run(harness, *shlex.split(command), '--timeout', '60')
        assert code == 0, shown
