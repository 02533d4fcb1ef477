# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The trainer trains: as a task of its own, on request beside a running loop, to its end."""

import json
from pathlib import Path
import re
import sys

from diagnostic_msgs.msg import DiagnosticStatus
import pytest

from koopman_ros.demo.reactor import constant
from koopman_ros.model import load
from koopman_ros.nodes import trainer
from koopman_ros.records import summary
from koopman_ros.testing import Harness
from support.nodes import children, complaint, ended, run_here, value
from support.quick_retraining import QUICK_TRAINER
from support.recorded_runs import driven, reactor, write_bag

STATUS = 'trainer: training'
QUICK = {'model_class': 'identity lift', 'lifted_dimension': 2, 'restarts': 1}


def test_trains_from_a_bag_with_a_bar_on_the_terminal(ros: Harness, tmp_path: Path) -> None:
    """Six minutes of a reactor whose jacket has fouled."""
    bag = write_bag(tmp_path / 'run.mcap', driven(reactor(0.8), 6.0))
    # a terminal of its own, whose output goes to the log
    program = ('import pty, os, sys; '
               'sys.exit(os.waitstatus_to_exitcode(pty.spawn(sys.argv[1:])))')
    process = ros.start('trainer', {
        **QUICK, 'task': 'train', 'bags': [bag], 'model_output': tmp_path / 'new.safetensors'},
        command=(sys.executable, '-c', program, sys.executable, '-c', QUICK_TRAINER))
    assert ros.wait_for_end(process) == 0, process.output()
    printed = process.output()
    shares = [int(share) for share in re.findall(r'\|[#-]{30}\| +(\d+) %', printed)]
    # a quick machine shows few of the steps
    assert shares == sorted(shares)
    assert shares[-1] == 100
    assert re.search(r'the new model \(.+\) is accepted: .* 0\.\d+ K, that of the current model '
                     rf'\d\.\d+ K; written to {tmp_path}/new\.safetensors', printed)
    assert {'new.json', 'new.md', 'new.safetensors'} == {
        path.name for path in tmp_path.glob('new.*') if 'alternative' not in path.name}
    assert load(tmp_path / 'new.safetensors').n_z == 2
    # no bag is recorded meanwhile
    assert not list(tmp_path.glob('koopman_ros_*'))


@pytest.mark.parametrize('name', ['best', 'neural drift'])
def test_class_is_passed_on_and_each_that_was_learned_is_shown(
        monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], name: str) -> None:
    """The process rejects with the class that its task names."""
    learned = {
        'linear': {'chosen': True, 'rejection': '', 'limit': '', 'seconds': 0.04,
                   'heldout_rx': 0.02, 'heldout_error': {'temperature': 0.5}, 'closed_loops': 128,
                   'closed_loops_failed': 1},
        'free lift': {'chosen': False, 'rejection': 'it has lost a state', 'limit': '',
                      'seconds': 2.0}}
    end = {'accepted': False, 'model_class': 'linear', 'model_file': '',
           'units': {'temperature': 'K'}, 'classes': learned}
    monkeypatch.setattr('koopman_ros.execution.training.TrainingJob.command', lambda *_: (
        sys.executable, '-c', 'import json; task = json.loads(input()); print(json.dumps('
        f'{{"summary": {{**json.loads({json.dumps(end)!r}), "reasons": [task["model_class"]]}}}}))'
    ))
    assert run_here(trainer, task='train', bags='[run]', model_class=name) == 2
    said = capfd.readouterr().err
    assert re.search(rf'\[WARN\].*the new model \(.+\) is rejected: {name}\n', said)
    assert ('linear: chosen: drift rx 2.0e-02, roll-out 0.5 K, controller fails in 1 of 128 '
            'simulated closed loops, 0.0 s\n') in said
    assert 'free lift: 2.0 s; rejected: it has lost a state\n' in said


@pytest.mark.parametrize(('given', 'words'), [
    ({'bags': '[run]', 'model_class': 'lift'}, "model_class = 'lift' must be one of linear, "),
    ({}, 'no bag to train from')])
def test_task_that_cannot_start(
        capfd: pytest.CaptureFixture[str], given: dict[str, str], words: str) -> None:
    assert run_here(trainer, task='train', **given) == 1
    assert words in complaint(capfd)


def test_no_orphan_and_no_file_when_the_trainer_ends(ros: Harness, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / 'run.mcap', driven(reactor(), 6.0))
    process = ros.start('trainer', {
        **QUICK, 'task': 'train', 'bags': [bag], 'model_output': tmp_path / 'new.safetensors'})
    # the first words say that the process is there
    (child,) = ros.wait_until(lambda: children(process.process.pid))
    assert process.stop() == 1
    ros.wait_until(lambda: ended(child))
    assert not list(tmp_path.glob('new*'))
    assert 'training: cancelled; nothing was written' in process.output()
    assert 'Traceback' not in process.output()


def test_training_runs_while_the_loop_runs(ros: Harness, tmp_path: Path) -> None:
    # no quicker: what is recorded while the machine is busy is what there is to train from
    ros.start('plant', {
        'lockstep': True, 'speed': 30.0, 'lockstep_subscribers': 2,
        'temperature.measurement_noise': 0.1,
        'constants.heat_transfer_coefficient': 0.8 * constant('heat_transfer_coefficient')})
    process = ros.start('trainer', {
        'output': tmp_path / 'run.mcap', 'model_output': tmp_path / 'new.safetensors',
        'model_class': 'linear',
        # which none meets
        'acceptance_margin': 0.99,
        'experiment_length': 600.0, 'coolant_temperature.experiment_min': 4.0,
        'min_free_disk': 0.0}, command=(sys.executable, '-c', QUICK_TRAINER))
    ros.meet('plant')
    assert ros.set_bool('trainer/experiment', True).success

    def wait_for_measurements(count: int) -> None:
        ros.wait_for_status('trainer: recording', lambda status: len(status.values) > 1 and int(
            value(status, 'messages on /temperature')) > count)

    # the bag is still being recorded; with fewer the training could fail before it is cancelled
    wait_for_measurements(250)
    response = ros.trigger('trainer/train')
    assert (response.success, response.message) == (True, f'training from {tmp_path}/run.mcap')
    response = ros.trigger('trainer/train')
    assert (response.success, response.message) == (False, 'already training')
    (child,) = children(process.process.pid)
    response = ros.trigger('trainer/cancel_training')
    assert (response.success, response.message) == (True, 'the training is being cancelled')
    ros.wait_for_status(STATUS, lambda status: status.level == DiagnosticStatus.OK
                        and status.message == 'cancelled; nothing was written')
    ros.wait_until(lambda: re.search(
        r'\[INFO\].*: cancelled; nothing was written', process.output()))
    assert ended(child)
    response = ros.trigger('trainer/cancel_training')
    assert (response.success, response.message) == (False, 'not training')
    assert not list(tmp_path.glob('new*'))

    assert ros.trigger('trainer/train').success
    status = ros.wait_for_status(STATUS, lambda status: status.message.startswith('the new model'))
    figures = json.loads((tmp_path / 'new.json').read_text())
    assert value(status, 'done [%]') == '100'
    noise = figures['noise']['temperature']
    assert float(value(status, 'noise: temperature')) == pytest.approx(noise)
    assert noise == pytest.approx(0.1, rel=0.2)
    assert figures['measurements_used'] > 250
    assert 'was not closed or is damaged' in (tmp_path / 'new.md').read_text()
    # the benchmark's 2.092 1/min are of 5e4 J/(min K)
    gain = 60.0 * figures['input_gain']['temperature']['coolant_temperature']
    assert gain == pytest.approx(0.8 * 2.0921, rel=0.15)
    assert (status.level, figures['accepted']) == (DiagnosticStatus.WARN, False)
    assert re.match(r'the new model \(.+\) is rejected: ', status.message)
    assert not (tmp_path / 'new.safetensors').exists()

    # the recording was the task, and it is complete
    assert process.stop() == 0
    assert 'Traceback' not in process.output()
    bag = summary(tmp_path / 'run.mcap')
    assert bag.complete
    assert bag.counts['/temperature'] > figures['measurements_read']
