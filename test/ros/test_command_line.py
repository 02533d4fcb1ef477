# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The command line for topics, services and parameters, beside a running plant and controller."""

from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
import io
from pathlib import Path
import re
import shlex
import subprocess
import sys

import pytest
import yaml

from koopman_ros import __version__
from koopman_ros.ros import command_line
from koopman_ros.testing import Harness


@pytest.fixture(scope='module')
def harness(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Harness]:
    with Harness(tmp_path_factory.mktemp('command_line')) as harness:
        harness.start('controller')
        harness.start('plant', {'speed': 10.0})
        yield harness


def run(*words: str) -> tuple[int, str]:
    """Run a command in this process, in the domain of the harness."""
    said = io.StringIO()
    with redirect_stdout(said), redirect_stderr(said):
        code = command_line.main([*words])
    return code, said.getvalue()


def test_a_setpoint_is_published_and_received(harness: Harness) -> None:
    assert run('pub', '/setpoint', '{temperature: 45}', '--timeout', '60') == (0, '')
    harness.wait_until(lambda: yaml.safe_load(run(
        'echo', '/active_setpoint', '--count', '1', '--timeout', '60')[1].removesuffix(
        '---\n'))['temperature'] == 45.0)


@pytest.mark.usefixtures('harness')
def test_parameters_are_listed_read_and_set() -> None:
    def parameter(*words: str) -> tuple[int, str]:
        return run('param', '/controller', *words, '--timeout', '60')

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
    (('pub', '/bad topic', '{}'), "'/bad topic' is not a name of a topic"),
    (('echo', '/a//b'), "'/a//b' is not a name of a topic"),
    (('call', '/bad service'), 'is not a name of a service'),
    (('param', '/bad node'), "'/bad node' is not a name of a node"), (('param', ''), 'of a node'),
    *((('echo', '/none', '--timeout', seconds), '--timeout') for seconds in ('nan', 'inf', '-1')),
    (('echo', '/none', '--count', '-1'), '--count -1 must be at least 0'),
    (('pub', '/setpoint', '{header: {stamp: {sec: 99999999999}}}', '--timeout', '60'),
     'sec = 99999999999 must be an integer from -2147483648 to 2147483647'),
    (('pub', '/setpoint', '{header: {stamp: {nanosec: -1}}}', '--timeout', '60'),
     'from 0 to 4294967295'),
    (('pub', '/none', '{data: 1.5}', '--type', 'std_msgs/msg/UInt8'), 'from 0 to 255'),
    (('pub', '/none', '{data: [1, 300]}', '--type', 'std_msgs/msg/UInt8MultiArray'), 'data = 300'),
])
@pytest.mark.usefixtures('harness')
def test_a_failed_command_has_a_reason(words: tuple[str, ...], said: str) -> None:
    code, shown = run(*words)
    assert code == 1
    assert said in shown
    assert shown.startswith('koopman_ros: ')


def test_the_version_is_shown() -> None:
    assert subprocess.run(
        [sys.executable, '-m', 'koopman_ros.ros.command_line', '--version'], capture_output=True,
        text=True, check=True).stdout == f'{__version__}\n'


@pytest.mark.usefixtures('harness')
def test_commands_of_the_page_succeed() -> None:
    page = Path(__file__).parents[2] / 'docs' / 'how-to' / 'operate.md'
    commands = re.findall(r'^\.venv/bin/koopman_ros (.*)$', page.read_text(), re.MULTILINE)
    assert len(commands) == 4
    for command in commands:
        code, shown = run(*shlex.split(command), '--timeout', '60')
        assert code == 0, shown
