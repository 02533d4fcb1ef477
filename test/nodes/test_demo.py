# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The demo as a user runs it, and the closed loop behind it."""

import contextlib
import json
from pathlib import Path
import re
import signal
import subprocess
import sys

import pytest
import rclpy
from sensor_msgs.msg import Temperature

from koopman_ros.bags import summary
from koopman_ros.demo import first_act, second_act
from koopman_ros.ros import topics
from koopman_ros.testing import Harness, NodeProcess, reserved_output


def test_demo_leaves_bag_picture_and_summary(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, '-m', 'koopman_ros.demo', '--speed', '0', '--output', tmp_path],
        capture_output=True, text=True, timeout=240, check=False)
    assert (done.returncode, done.stderr) == (0, '')
    result = json.loads((tmp_path / 'summary.json').read_text())
    assert result['final_error_kelvin'] <= 0.01
    assert result['linear_final_error_kelvin'] > 1.0
    assert 60.0 < result['settling_time_seconds'] < 400.0
    assert result['measurements'] == result['commands'] == 601
    assert summary(tmp_path / 'closed_loop.mcap').message_count == result['bag_messages']
    assert (tmp_path / 'closed_loop.png').read_bytes().startswith(b'\x89PNG')
    assert 'final_error_kelvin' in done.stdout
    assert done.stdout.count('time [min]') >= 20


def test_demo_of_another_plant_is_measured_by_the_optimum(tmp_path: Path) -> None:
    """Of the pendulum from 60 degrees, whose angle and rate come in one message."""
    done = subprocess.run(
        [sys.executable, '-m', 'koopman_ros.demo', '--plant', 'pendulum', '--speed', '0',
         '--output', tmp_path], capture_output=True, text=True, timeout=240, check=False)
    assert (done.returncode, done.stderr) == (0, '')
    result = json.loads((tmp_path / 'summary.json').read_text())
    assert result['setpoint'] == {'angle': 0.0}
    assert result['final_error']['angle'] < 1e-3
    assert 0.5 < result['settling_time_seconds']['angle'] < 3.0
    assert 1.0 - 1e-6 < result['cost'] / result['optimal_cost'] < 1.02
    assert result['cost'] < result['linear_cost']
    assert result['measurements'] == result['commands'] == 301
    assert summary(tmp_path / 'closed_loop.mcap').message_count == result['bag_messages']
    assert (tmp_path / 'closed_loop.png').read_bytes().startswith(b'\x89PNG')
    assert done.stdout.count('angle set-point [rad]') >= 20


def test_demo_says_which_plants_it_knows(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert first_act.main(['--plant', 'volcano', '--output', str(tmp_path)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("demo: there is no demo of 'volcano': choose one of ")
    assert {'fed_reactor', 'pendulum', 'two_tanks'} <= set(line.split(' of ')[-1].split(', '))


def test_demo_says_in_one_line_why_it_cannot_run(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / 'taken').write_text('a file, not a folder')
    assert first_act.main(['--output', str(tmp_path / 'taken')]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith('demo: ')
    assert str(tmp_path / 'taken') in line


def test_demo_commands_nothing_in_a_domain_with_another_loop(
        ros: Harness, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str]) -> None:
    """In that of ROS_DOMAIN_ID, which it names."""
    domain = ros.environment['ROS_DOMAIN_ID']
    monkeypatch.setattr(NodeProcess, '__init__', None)  # starts nothing
    own = ros.node.create_subscription(
        Temperature, '/coolant_setpoint', lambda _: None, topics.LOOP_QOS)
    for demo, *more in ((first_act.main, '--panel'), (first_act.main,), (second_act.main,)):
        assert demo([*more, '--output', str(tmp_path / 'out')]) == 1
        said = capsys.readouterr()
        assert f'ROS domain {domain}\n' in said.out
        (line,) = said.err.splitlines()
        assert '/bench subscribes to coolant_setpoint' in line
        assert re.search(r'ROS_DOMAIN_ID=\d+ make demo', line)
    ros.node.destroy_subscription(own)
    other = rclpy.create_node('controller', context=ros.node.context)
    assert first_act.main(['--plant', 'pendulum', '--output', str(tmp_path / 'out')]) == 1
    assert 'a node /controller' in capsys.readouterr().err
    other.destroy_node()
    monkeypatch.setenv('ROS_DOMAIN_ID', 'mine')
    assert first_act.main(['--output', str(tmp_path / 'out')]) == 1
    assert "'mine'" in capsys.readouterr().err


@pytest.mark.parametrize('module', ['koopman_ros.demo', 'koopman_ros.demo.retrain'])
def test_demo_interrupted_while_it_loads_ends_without_a_word(tmp_path: Path, module: str) -> None:
    program = (
        'import os, runpy, signal, sys\n'
        'class Interrupted:\n'
        '    def find_spec(self, name, path=None, target=None):\n'
        '        if name == "matplotlib":\n'
        '            os.kill(os.getpid(), signal.SIGINT)\n'
        'sys.meta_path.insert(0, Interrupted())\n'
        f'runpy.run_module({module!r}, run_name="__main__", alter_sys=True)\n')
    done = subprocess.run([sys.executable, '-c', program, '--output', tmp_path],
                          capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (130, '', '')


def test_demo_interrupted_in_its_loop_keeps_what_it_recorded(tmp_path: Path) -> None:
    """Beside another run, so that it writes to demo-2."""
    wanted = tmp_path / 'demo'
    with reserved_output(wanted) as taken, subprocess.Popen(
            [sys.executable, '-u', '-m', 'koopman_ros.demo', '--speed', '0', '--output', wanted],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as demo:
        assert taken == wanted
        assert demo.stdout is not None
        assert demo.stdout.readline() == (
            f'another run writes to {wanted}: this one writes to {wanted}-2\n')
        assert any('time [min] 1.0' in said for said in demo.stdout)
        demo.send_signal(signal.SIGINT)
        # a second one while the first is handled
        demo.send_signal(signal.SIGTERM)
        assert demo.communicate()[1] == 'demo: interrupted; what was recorded is kept\n'
    assert demo.returncode == 130
    recorded = summary(tmp_path / 'demo-2' / 'closed_loop.mcap')
    assert recorded.complete
    assert recorded.counts['/temperature'] > 0
    # no process is left that has the folder among its arguments
    for path in Path('/proc').glob('[0-9]*/cmdline'):
        with contextlib.suppress(OSError):
            assert bytes(tmp_path) not in path.read_bytes()
    assert not wanted.exists()


def test_two_runs_write_to_two_folders(tmp_path: Path) -> None:
    (tmp_path / 'link').symlink_to(tmp_path)
    with (reserved_output(tmp_path / 'demo') as first,
          reserved_output(tmp_path / 'link' / 'demo') as second):
        assert first == tmp_path / 'demo'
        assert second == tmp_path / 'link' / 'demo-2'
    with reserved_output(tmp_path / 'demo') as again:
        assert again == first
