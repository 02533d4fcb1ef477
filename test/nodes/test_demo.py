# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The demo as a user runs it, and the closed loop behind it."""

import contextlib
import json
from pathlib import Path
import re
import shutil
import signal
import subprocess
import sys
import threading

import pytest
import rclpy
from sensor_msgs.msg import Temperature

from koopman_ros.demo import disturbance_demo, line_demo, retraining_demo, setpoint_demo
from koopman_ros.demo.loop import running_loop, Scenario
from koopman_ros.demo.results import read_run
from koopman_ros.event_log.records import parse
from koopman_ros.event_log.run import replay_records
from koopman_ros.parameters.signal_topics import plant_defaults
from koopman_ros.records import read_messages, summary
from koopman_ros.ros import topics
from koopman_ros.testing import Harness, NodeProcess, reserved_output
from support.pictures import drawn_figures


@pytest.mark.parametrize(('plant', 'signal', 'final', 'settling', 'cost', 'measurements'), [
    # without observer: the linear law ends a kelvin off
    pytest.param('reactor', 'temperature', 0.01, (60.0, 200.0), 1.0001, 301, id='reactor'),
    # from 60 degrees; angle and rate come in one message
    pytest.param('pendulum', 'angle', 1e-3, (0.5, 3.0), 1.02, 301, id='pendulum')])
def test_demo_leaves_bag_picture_and_summary(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
        plant: str, signal: str, final: float, settling: tuple[float, float], cost: float,
        measurements: int) -> None:
    exports = plant == 'reactor' and shutil.which('cc') is not None
    if plant == 'reactor':
        monkeypatch.setattr(setpoint_demo, 'plant_defaults', lambda *of: plant_defaults(*of) | {
            'duration': 300.0})
    with drawn_figures() as figures:
        assert setpoint_demo.main(['--plant', plant, '--speed', '0', '--output', str(tmp_path),
                                   *['--export'] * exports]) == 0
    printed = capsys.readouterr().out
    result = json.loads((tmp_path / 'summary.json').read_text())
    assert result['final_error'][signal] < final
    assert plant == 'pendulum' or result['linear_final_error'][signal] > 1.0
    assert settling[0] < result['settling_time_seconds'][signal] < settling[1]
    # the rate limit of the reactor holds for the optimum, too
    assert 1.0 - 1e-6 < result['cost_by_optimum'] < cost
    assert result['cost_by_optimum'] == result['cost'] / result['optimal_cost']
    assert 1.03 < result['linear_cost_by_optimum'] == (
        result['linear_cost'] / result['optimal_cost'])
    words = figures['closed_loop.png'].axes[0].get_title()
    assert f'costs {result["cost_by_optimum"]:.3f} times the optimum' in words
    assert 'same limits' in words
    assert 'settles' in words
    assert ('K off' in words) == (plant == 'reactor')
    assert result['measurements'] == result['commands'] == measurements
    if exports:
        assert result['exported_difference']['coolant_temperature'] < 1e-9
    assert summary(tmp_path / 'closed_loop.mcap').message_count == result['bag_messages']
    assert (tmp_path / 'closed_loop.png').read_bytes().startswith(b'\x89PNG')
    assert f'{signal} set-point [' in printed
    assert len(re.findall(r'^ +[\d.]+ +', printed, re.MULTILINE)) >= 20


def test_a_measured_step_of_the_feed_peaks_at_a_third_of_an_unmeasured_one_or_less(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, seconds in (('_STEP_TIME', 10.0), ('_AFTER', 60.0)):
        monkeypatch.setattr(disturbance_demo, name, seconds)
    assert disturbance_demo.main(['--speed', '0', '--output', str(tmp_path)]) == 0
    result = json.loads((tmp_path / 'summary.json').read_text())
    assert result['peak_unmeasured_kelvin'] == pytest.approx(0.91, abs=0.1)
    assert result['peak_ratio'] < 1.0 / 3.0
    assert result['peak_measured_kelvin'] < 0.25
    assert (tmp_path / 'disturbance.png').read_bytes().startswith(b'\x89PNG')
    # the records of the loop give its commands again
    replayed = replay_records(
        parse(entry.message.data) for entry in read_messages(
            tmp_path / 'measured.mcap', [f'/{topics.EVENT_LOG}']))
    assert len(replayed.samples) > 60
    assert all(one.recorded == one.replayed for one in replayed.samples)


def test_a_loop_with_dead_time_reaches_the_optimal_cost_and_beats_pi_control(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, number in (('STEPS', ((20.0, 333.15), (250.0, 321.15))), ('FEED_TIME', 480.0),
                         ('_DURATION', 680.0)):
        monkeypatch.setattr(line_demo, name, number)
    assert setpoint_demo.main(
        ['--plant', 'heated_line', '--speed', '0', '--output', str(tmp_path)]) == 0
    result = json.loads((tmp_path / 'summary.json').read_text())
    learned, pi, smith = (result[name] for name in ('learned', 'pi', 'smith_predictor'))
    assert 0.98 < learned['cost_by_optimum'] < 1.03
    assert min(pi['cost_by_optimum'], smith['cost_by_optimum']) > 1.1
    assert max(learned['overshoot_up'], learned['overshoot_down']) < 0.2
    assert learned['feed_peak'] < 1.1 * result['optimum']['feed_peak']
    assert (tmp_path / 'closed_loop.png').read_bytes().startswith(b'\x89PNG')


def test_a_recording_holds_what_the_operator_saw_of_a_loop_whose_trainer_fell_behind(
        tmp_path: Path) -> None:
    bag = tmp_path / 'loop.mcap'
    scenario = Scenario({'temperature': 330.0}, duration=0.0)
    with running_loop(scenario, tmp_path / 'logs', {'output': bag}) as operator:
        trainer = next(one for one in operator.harness.processes if one.name == 'trainer')
        operator.run_until(20.0)
        trainer.process.send_signal(signal.SIGSTOP)
        operator.run_until(400.0)
        resumed = threading.Timer(1.0, trainer.process.send_signal, [signal.SIGCONT])
        resumed.start()
        operator.wait_for_recording()
        resumed.join()
    assert read_run(scenario.wiring, bag).command_seconds[-1] >= 400.0


def test_a_demo_that_cannot_run_gives_the_reason_in_one_line(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / 'taken').write_text('a file, not a folder')
    for options, words in ((['--output', str(tmp_path / 'taken')], str(tmp_path / 'taken')),
                           (['--plant', 'volcano', '--output', str(tmp_path)],
                            "no demo for the plant 'volcano': choose one of fed_reactor,"),
                           (['--plant', 'pendulum', '--export', '--output', str(tmp_path)],
                            'the law mpc cannot be exported')):
        assert setpoint_demo.main(options) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith('demo: ')
        assert words in line


def test_demo_commands_nothing_in_a_domain_with_another_loop(
        ros: Harness, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str]) -> None:
    """In that of ROS_DOMAIN_ID, which it names."""
    domain = ros.environment['ROS_DOMAIN_ID']
    monkeypatch.setattr(NodeProcess, '__init__', None)  # starts nothing
    own = ros.node.create_subscription(
        Temperature, '/coolant_setpoint', lambda _: None, topics.LOOP_QOS)
    for demo, *more in ((setpoint_demo.main, '--panel'), (setpoint_demo.main,),
                        (retraining_demo.main,)):
        assert demo([*more, '--output', str(tmp_path / 'out')]) == 1
        said = capsys.readouterr()
        assert f'ROS domain {domain}\n' in said.out
        (line,) = said.err.splitlines()
        assert '/bench subscribes to coolant_setpoint' in line
        assert re.search(r'ROS_DOMAIN_ID=\d+ make demo', line)
    ros.node.destroy_subscription(own)
    other = rclpy.create_node('controller', context=ros.node.context)
    assert setpoint_demo.main(['--plant', 'pendulum', '--output', str(tmp_path / 'out')]) == 1
    assert 'a node /controller' in capsys.readouterr().err
    other.destroy_node()
    monkeypatch.setenv('ROS_DOMAIN_ID', 'mine')
    assert setpoint_demo.main(['--output', str(tmp_path / 'out')]) == 1
    assert "'mine'" in capsys.readouterr().err


@pytest.mark.parametrize('which', [[], ['retrain']])
def test_demo_interrupted_while_it_loads_ends_without_a_word(
        tmp_path: Path, which: list[str]) -> None:
    program = (
        'import os, runpy, signal, sys\n'
        'class Interrupted:\n'
        '    def find_spec(self, name, path=None, target=None):\n'
        '        if name == "matplotlib":\n'
        '            os.kill(os.getpid(), signal.SIGINT)\n'
        'sys.meta_path.insert(0, Interrupted())\n'
        'runpy.run_module("koopman_ros.demo", run_name="__main__", alter_sys=True)\n')
    done = subprocess.run([sys.executable, '-c', program, *which, '--output', tmp_path],
                          capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (130, '', '')


def test_an_interrupted_demo_keeps_its_recording(tmp_path: Path) -> None:
    """Beside another run, so that it writes to demo-2."""
    wanted = tmp_path / 'demo'
    with reserved_output(wanted) as taken, subprocess.Popen(
            [sys.executable, '-u', '-m', 'koopman_ros.demo', '--speed', '0', '--output', wanted],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as demo:
        assert taken == wanted
        assert demo.stdout is not None
        assert demo.stdout.readline() == (
            f'another run is writing to {wanted}: writing to {wanted}-2\n')
        assert any(said.lstrip().startswith('1.0 ') for said in demo.stdout)
        demo.send_signal(signal.SIGINT)
        # a second one while the first is handled
        demo.send_signal(signal.SIGTERM)
        assert demo.communicate()[1] == 'demo: interrupted; the recording is kept\n'
    assert demo.returncode == 130
    recorded = summary(tmp_path / 'demo-2' / 'closed_loop.mcap')
    assert recorded.complete
    assert recorded.counts['/temperature'] > 0
    # no process is left that has the folder among its arguments
    for path in Path('/proc').glob('[0-9]*/cmdline'):
        with contextlib.suppress(OSError):
            assert bytes(tmp_path) not in path.read_bytes()
    assert not wanted.exists()
