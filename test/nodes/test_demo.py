# Copyright 2026 The koopman_ros Authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The demo as a user runs it, and the closed loop behind it."""

from __future__ import annotations

import json
from pathlib import Path
import signal
import subprocess
import sys

from koopman_ros.bags import summary, temperature_series
from koopman_ros.demo.loop import LoopError, Row, run_loop, Scenario
import numpy as np
import pytest


def test_demo_leaves_bag_picture_and_summary(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, '-m', 'koopman_ros.demo', '--speed', '0', '--output', tmp_path],
        capture_output=True, text=True, timeout=120, check=False)
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


def test_demo_says_in_one_line_why_it_cannot_run(tmp_path: Path) -> None:
    (tmp_path / 'taken').write_text('a file, not a folder')
    done = subprocess.run(
        [sys.executable, '-m', 'koopman_ros.demo', '--output', tmp_path / 'taken'],
        capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith('demo: ')
    assert str(tmp_path / 'taken') in line


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_interrupted_demo_keeps_what_it_recorded(tmp_path: Path, number: int) -> None:
    with subprocess.Popen(
            [sys.executable, '-u', '-m', 'koopman_ros.demo', '--speed', '0', '--output', tmp_path],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as demo:
        assert demo.stdout is not None
        assert demo.stderr is not None
        assert any('time [min]' in line for line in demo.stdout)
        demo.send_signal(number)
        said = demo.stderr.read()
    assert demo.returncode == 130
    assert said == 'demo: interrupted; what was recorded is kept\n'
    assert summary(tmp_path / 'closed_loop.mcap').complete
    assert summary(tmp_path / 'closed_loop.mcap').counts['/temperature'] > 0


def test_loop_tells_which_process_failed(tmp_path: Path) -> None:
    with pytest.raises(LoopError, match=r'controller ended early: .*no_such_model'):
        run_loop(Scenario('no_such_model', 315.0), tmp_path / 'bag.mcap', tmp_path)


def test_two_runs_are_the_same_to_the_bit(tmp_path: Path) -> None:
    scenario = Scenario('reactor_nz4', 315.0, step_time=20.0, duration=120.0,
                        plant={'noise': 0.05, 'seed': 3})
    rows: list[Row] = []
    runs = []
    for name in ('first', 'second'):
        bag = tmp_path / f'{name}.mcap'
        run_loop(scenario, bag, tmp_path, rows.append)
        runs.append([temperature_series(bag, topic)
                     for topic in ('/temperature', '/coolant_setpoint')])
    for first, second in zip(*runs, strict=True):
        assert len(first.stamp_ns) == 121
        np.testing.assert_array_equal(first.stamp_ns, second.stamp_ns)
        np.testing.assert_array_equal(
            first.celsius.view(np.uint64), second.celsius.view(np.uint64))
        assert len(np.unique(first.celsius)) > 100
    seen = [(row.seconds, row.temperature, row.coolant) for row in rows]
    assert seen[:121] == seen[121:]
