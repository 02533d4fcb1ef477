# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The commands, files and messages of docs/tutorials/own_plant.md."""

from dataclasses import replace
from pathlib import Path
import re
import shlex
import shutil
import sys
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from sensor_msgs.msg import Temperature
import yaml

from koopman_ros.model import load
from koopman_ros.nodes import controller, plant, trainer
from koopman_ros.records import summary
from koopman_ros.ros import topics
from koopman_ros.testing import Harness
from koopman_ros.testing.process import NodeProcess
from support.installation import Installation, ROOT, run, underlay
from support.nodes import run_here

OVEN = ROOT / 'examples' / 'oven'
PAGE = (ROOT / 'docs' / 'tutorials' / 'own_plant.md').read_text()
# node and arguments of each command on the page that takes a file, in the order there
RECORD, SIMULATE, TRAIN, CONTROL, RUN, *_ = (
    (node, tuple(shlex.split(text))) for node, text in re.findall(
        r'^ros2 run koopman_ros (\w+) --ros-args (--params-file .*)$', PAGE, re.MULTILINE))
ACCEPTED = r'the new model \(.+?\) is accepted: its error on held-out data is ([\d.]+) K, ' \
    r'that of the best linear model ([\d.]+) K; written to (\S+\.safetensors)\. On \d+ plants .*'


@pytest.fixture(scope='module')
def overlay(colcon: Installation, tmp_path_factory: pytest.TempPathFactory) -> Installation:
    """Build the oven's package in a workspace over that of this one."""
    folder = tmp_path_factory.mktemp('overlay')
    shutil.copytree(OVEN, folder / 'src' / 'oven')
    built = run(('bash', '-c', f'{colcon.before} && cd {folder} && exec {sys.executable} -m '
                 'colcon build --packages-select oven'))
    assert built.returncode == 0, built.stdout + built.stderr
    return replace(colcon, before=f'{underlay()} && . {folder}/install/setup.bash',
                   notes=folder / 'src' / 'oven' / 'notes')


@pytest.fixture(scope='module')
def folder(overlay: Installation) -> Path:
    """Return the folder of the package, in which the page's commands are given."""
    return overlay.notes.parent


def start(ros: Harness, overlay: Installation, command: tuple[str, tuple[str, ...]],
          *others: str) -> NodeProcess:
    """Run a command of the page, with further ROS arguments."""
    node, arguments = command
    return ros.start(node, {}, (*arguments, *others), overlay.command(
        str(overlay.executables / node)))


def train(ros: Harness, overlay: Installation, command: tuple[str, tuple[str, ...]],
          setting: str) -> Any:
    """Train as the page has it; return the errors of the lift and of the linear model, in K."""
    process = start(ros, overlay, command, '-p', setting)
    assert ros.wait_for_end(process) == 0, process.output()
    said = re.search(ACCEPTED, process.output())
    assert said, process.output()
    return float(said[1]), float(said[2])


@pytest.fixture(scope='module')
def recorded(overlay: Installation, folder: Path, tmp_path_factory: pytest.TempPathFactory
             ) -> Path:
    """Record the simulated oven under the experiment."""
    (service,) = re.findall(
        r"ros2 service call /(\S+) std_srvs/srv/SetBool '\{data: true\}'", PAGE)
    with Harness(tmp_path_factory.mktemp('record')) as ros:
        processes = [start(ros, overlay, RECORD), start(ros, overlay, SIMULATE)]
        assert ros.set_bool(service, True).success
        ros.wait_for_status('plant: simulation', lambda status: 'duration' in status.message)
        assert [process.stop() for process in processes] == [0, 0]
    return folder / 'run_1'


def test_first_lift_is_accepted_and_brings_the_oven_to_its_set_point(
        overlay: Installation, folder: Path, recorded: Path, ros: Harness) -> None:
    assert summary(recorded).counts['/power_setpoint'] > 0
    lift, linear = train(ros, overlay, TRAIN, 'restarts:=1')
    # the noise of the sensor is 0.2 K
    assert lift < 0.25 < 1.0 < linear
    model = load(folder / 'oven.safetensors')
    assert (model.provenance.plant, model.n_z) == ('oven', 2)

    measured = ros.listen(Temperature, '/temperature')
    start(ros, overlay, CONTROL, '-p', 'controller:observer_bandwidth:=0.0')
    ros.meet('controller')
    # the law alone, without noise: what is left is the error of the lift
    start(ros, overlay, RUN, '-p', 'speed:=0.0', '-p', 'plant:temperature.measurement_noise:=0.0')
    ((topic, kind, content),) = re.findall(r"ros2 topic pub -w 1 --once (\S+) (\S+) '(.*)'", PAGE)
    asked = topics.message_class(kind)(**yaml.safe_load(content))
    ros.speak(type(asked), topic, to='controller').publish(asked)
    goal = asked.temperature

    def arrived() -> bool:
        last = np.array([message.temperature for message in measured[-50:]])
        return len(last) == 50 and abs(last[-1] - goal) < 2.0 and float(np.ptp(last)) < 0.01

    ros.wait_until(arrived, lambda: f'{[message.temperature for message in measured[-5:]]}')
    # derived by hand: the tangent at 290 degC, in the middle of the range, would end 33 K lower
    assert measured[-1].temperature == pytest.approx(goal, abs=1.0)


QUICK = {'autostart': 'true', 'system': 'oven'}
SIGNALS = {'states_measured': '["temperature [K]"]', 'inputs_commanded': '["power [W]"]'}
BAD = """
from koopman_ros.plants import two_state_example
class Empty: pass
class Failing:
    def system(self): return 1.0 / 0.0
"""


@pytest.mark.parametrize(('program', 'given', 'words'), [
    (plant, {'system': 'ovn'}, ("plant 'ovn': choose one of", 'workspace sourced')),
    (plant, {'system': 'no_oven:Oven'},
     ('cannot be loaded (ModuleNotFoundError', 'check the name')),
    (plant, {'system': 'bad_oven:Empty'}, ('must be a ControlAffineSystem', 'method system')),
    (plant, {'system': 'bad_oven:Failing'}, ('cannot be constructed', 'correct the class')),
    (trainer, {}, ('the measured signals and inputs of the system', "like ['level [m]']")),
    (trainer, {**SIGNALS, 'states_measured': '["temperature [Kelvin]"]'},
     ("there is no unit 'Kelvin'", 'use e.g. K')),
    (controller, {**SIGNALS, 'model': 'reactor_nz4'},
     ('has states temperature [K] and inputs power [W]', 'choose a model of that system',
      '-p "system:=\'\'"')),
    # as the shell hands it over
    (controller, {'model': 'reactor_nz4', 'system': ''},
     ("parse parameter override rule: '-p system:='", '-p "system:=\'\'"')),
])
def test_a_start_with_wrong_arguments_gives_the_reason(
        program: ModuleType, given: dict[str, str], words: tuple[str, ...], tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / 'bad_oven.py').write_text(BAD)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    assert run_here(program, **{**QUICK, **given}) == 1
    said = capfd.readouterr().err
    for word in words:
        assert word in said
    assert 'Traceback' not in said


def test_the_page_names_the_files_and_quotes_the_output() -> None:
    sources = {path.suffix: [p.read_text() for p in OVEN.glob(f'*{path.suffix}')]
               for path in OVEN.iterdir() if path.suffix}
    for kind, suffix in (('yaml', '.yaml'), ('python', '.py')):
        blocks = re.findall(rf'```{kind}\n(.*?)```', PAGE, re.DOTALL)
        assert blocks
        for block in blocks:
            assert any(block in source for source in sources[suffix]), block
    (shown,) = re.findall(r'```text\n(the new model.*)\n```', PAGE)
    assert re.fullmatch(ACCEPTED, shown)
