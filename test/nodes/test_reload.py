# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Another model in the running controller: nothing unanswered, no jump, reasons in words."""

from dataclasses import replace
import itertools
import math
import os
from pathlib import Path
import re
import sys
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np
import pytest
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.task import Future
from sensor_msgs.msg import Temperature
from std_msgs.msg import String
from std_srvs.srv import Trigger

from koopman_ros.core.paths import model_path
from koopman_ros.core.units import NANOSECONDS, to_celsius, ZERO_CELSIUS
from koopman_ros.demo import reactor
from koopman_ros.event_log.records import MODEL, PARAMETERS
from koopman_ros.model import load, save
from koopman_ros.nodes.controller import ControllerNode
from koopman_ros.plants import Process
from koopman_ros.ros import model_reload, topics
from koopman_ros.testing import Harness
from support.closed_loops import REACTOR
from support.controller_bench import PATIENT, reproduced, STATUS, STEADY
from support.nodes import change, opened, RunNode, temperature, until_read, value

NAMES = ('reactor_nz3', 'reactor_nz4', 'reactor_linear')
SETPOINTS = [(20.0 * k, 46.0 + math.sin(k)) for k in range(1, 150)]
SETTINGS = {'temperature.setpoint_ramp': 0.05, 'observer_bandwidth': 0.0166666666667}


def put(content: bytes, path: Path) -> None:
    """Replace a file at once, as a program that saves a model does."""
    new = path.with_suffix('.new')
    new.write_bytes(content)
    os.replace(new, path)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    put(model_path('reactor_nz4').read_bytes(), file := tmp_path / 'model.safetensors')
    return file


class Bench:
    """Measures a reactor that swings, and changes the model of a running controller."""

    def __init__(self, ros: Harness) -> None:
        self.ros = ros
        self.sent: list[Temperature] = []
        self.period = 0.1  # s between measurements
        self.commands = ros.listen(Temperature, reactor.COOLANT_SETPOINT)
        self._reload = ros.node.create_client(Trigger, 'controller/reload_model')
        self._set = ros.node.create_client(SetParameters, 'controller/set_parameters')
        for client in (self._reload, self._set):
            ros.wait_until(client.service_is_ready)
        self._thermometer = ros.speak(Temperature, reactor.TEMPERATURE, to='controller')

    def ask_to_reload(self) -> Future:
        return self._reload.call_async(Trigger.Request())

    def _wait_for(self, future: Future) -> Any:
        self.ros.wait_until(future.done)
        return future.result()

    def reload(self) -> tuple[bool, str]:
        response = self._wait_for(self.ask_to_reload())
        return response.success, response.message

    def set(self, model: str | Path) -> tuple[bool, str]:
        request = SetParameters.Request(
            parameters=[Parameter('model', value=str(model)).to_parameter_msg()])
        result = until_read(
            lambda: self._wait_for(self._set.call_async(request)).results[0])
        return result.successful, result.reason

    def measure(self, celsius: float | None = None) -> None:
        k = len(self.sent) + 1
        message = temperature(
            46.0 + math.sin(0.02 * k) if celsius is None else celsius, self.period * k)
        self.sent.append(message)
        self._thermometer.publish(message)

    def wait_for_answers(self) -> float:
        self.ros.wait_until(lambda: len(self.commands) >= len(self.sent))
        return float(self.commands[-1].temperature)


def test_reloads_under_load_leave_no_trace(ros: Harness, file: Path) -> None:
    """Each command is the very one that the models give in turn, and none of them jumps."""
    contents = {name: model_path(name).read_bytes() for name in NAMES}
    whole = contents['reactor_nz4']
    bad = itertools.cycle((b'', b'garbage' * 1000, whole[:len(whole) // 2], whole[:-1]))
    ros.start('controller', {'model': file, **SETTINGS, **PATIENT})
    records = ros.listen(String, topics.EVENT_LOG)
    bench = Bench(ros)
    setpoint = ros.speak(Temperature, reactor.SETPOINT, to='controller')
    # with the snapshot for who listens
    ros.wait_until(lambda: records)
    for at, celsius in SETPOINTS:
        setpoint.publish(temperature(celsius, at))
    ros.meet('controller')

    def tick() -> None:
        # the middleware keeps a thousand
        if len(bench.sent) - len(bench.commands) < 200:
            bench.measure()

    timer = ros.node.create_timer(1.0 / 100.0, tick)
    for k, name in enumerate(itertools.islice(itertools.cycle(NAMES), 12)):
        if k % 3 == 0:
            put(next(bad), file)
            for done, reason in (bench.reload(), bench.set(file)):
                assert not done
                assert reason.startswith(f'the current model is kept: {file}')
        put(contents[name], file)
        done, reason = bench.reload() if k % 2 else bench.set(file)
        assert done, reason
    status = ros.wait_for_status(STATUS, lambda s: value(s, 'model reloads') == '12')
    assert status.level != DiagnosticStatus.ERROR
    # a busy machine measures less often, and the set-point moves once in 200 measurements
    ros.wait_until(lambda: len(bench.sent) > 320)
    timer.cancel()
    bench.wait_for_answers()
    assert [message.header.stamp for message in bench.commands] == [
        message.header.stamp for message in bench.sent]
    commands = [message.temperature for message in bench.commands]
    ros.wait_until(lambda: sum('"event":"measurement"' in message.data for message in records)
                   >= len(bench.sent))
    written, recorded = reproduced(records)
    assert recorded == commands
    assert sum(record.event in (MODEL, PARAMETERS) for record in written) == 12
    assert np.max(np.abs(np.diff(commands))) < 0.03
    assert np.ptp(commands) > 0.1


SHIPPED = load(model_path('reactor_nz4'))


def test_rejected_model_leaves_the_old_one_in_force_until_the_operator_forces_it(
        ros: Harness, tmp_path: Path, run_node: RunNode) -> None:
    run_node(ControllerNode, PATIENT)
    bench, file = Bench(ros), tmp_path / 'rejected.safetensors'

    def measure() -> float:
        bench.measure(STEADY)
        return bench.wait_for_answers()

    def change(**parameters: object) -> SetParametersResult:
        return until_read(lambda: ros.set_parameters_atomically('controller', **parameters))

    save(replace(SHIPPED, provenance=replace(
        SHIPPED.provenance, accepted=False, reasons=('too large an error',))), file)
    measure()
    assert bench.set('reactor_nz3')[0]
    before = measure()
    done, reason = bench.set(file)
    assert not done
    assert reason.startswith('the current model is kept: ')
    assert 'load_rejected_model' in reason
    status = ros.wait_for_status(STATUS, lambda s: s.message == reason)
    assert status.level == DiagnosticStatus.WARN
    assert value(status, 'model') == 'reactor_nz3'
    assert ros.get_parameters('controller', 'model') == ['reactor_nz3']
    assert measure() == pytest.approx(before, abs=1e-9)

    assert bench.reload() == (
        True, 'model reactor_nz3: identity lift, n_z = 3, trained for temperature 31.85 to '
        '53.85 degC; acceptance: not tested')
    status = ros.wait_for_status(STATUS, lambda s: s.level == DiagnosticStatus.OK)
    assert value(status, 'model rejected') == 'none'

    assert change(load_rejected_model=True, model=str(file)).successful
    done, about = bench.reload()
    assert done
    assert 'too large an error' in about
    status = ros.wait_for_status(STATUS, lambda s: 'was rejected' in s.message)
    assert (status.level, 'too large an error' in status.message) == (DiagnosticStatus.WARN, True)
    assert value(status, 'model acceptance') == 'rejected (too large an error)'
    assert change(load_rejected_model=False).successful
    assert 'load_rejected_model' in bench.reload()[1]
    assert ros.get_parameters('controller', 'model') == [str(file)]

    # a model and the bound that it needs are changed together
    assert 'the gain exceeds its bound' in change(model='reactor_linear', max_gain=1e-3).reason
    assert change(model='reactor_linear', max_gain=500.0).successful
    assert ros.get_parameters('controller', 'model', 'max_gain') == ['reactor_linear', 500.0]


def test_a_model_that_predicts_recent_measurements_much_worse_is_rejected(
        ros: Harness, file: Path, run_node: RunNode) -> None:
    """It takes over neither by parameter nor by service, unless the operator insists."""
    run_node(ControllerNode, {'model': file, 'bumpless_transfer_time': 0.0, **PATIENT})
    bench = Bench(ros)
    bench.period = 5.0
    setpoint = ros.speak(Temperature, reactor.SETPOINT, to='controller')
    plant = Process(REACTOR, 0, REACTOR.nominal_state, REACTOR.nominal_input)

    def track(celsius: float, samples: int = 40) -> None:
        nonlocal plant
        setpoint.publish(temperature(celsius, 0.0))
        ros.meet('controller')
        for _ in range(samples):
            bench.measure(to_celsius(float(plant.x[0])))
            plant = plant.commanded(np.array(
                [bench.wait_for_answers() + ZERO_CELSIUS]), plant.time_ns)
            plant = plant.until(plant.time_ns + 5 * NANOSECONDS)
        assert to_celsius(float(plant.x[0])) == pytest.approx(celsius, abs=0.1)

    bench.measure(to_celsius(float(plant.x[0])))
    bench.wait_for_answers()
    # nothing is known yet, and what is as good is taken over
    assert bench.reload()[0]
    track(45.0)
    track(48.0)
    assert bench.set('reactor_nz3')[0]
    status = ros.wait_for_status(STATUS, lambda s: value(s, 'model') == 'reactor_nz3')
    assert re.fullmatch(r'predicts temperature of the last 400 s with an error of 0\.00\d+ K, '
                        r'the previous model with 0\.00\d+ K', value(status, 'model check'))
    assert bench.set(file)[0]

    save(replace(SHIPPED, B=-SHIPPED.B), file)
    why = (r'the current model is kept: the model predicts temperature of the last 400 s with an '
           r'error of (\S+) K, the current one with (\S+) K, at most (\S+) K are allowed: train '
           r'it again with more data, or set model_check_factor = 0 to load it anyway')
    for done, reason in (bench.reload(), bench.set(f'{file.parent}/./{file.name}')):
        assert not done
        found = re.fullmatch(why, reason)
        assert found, reason
        wrong, present, allowed = map(float, found.groups())
        # the response of the plant, turned round, and less than a hundredth of it
        assert wrong > 0.5 > 0.01 > present
        assert present < allowed < wrong
    ros.wait_for_status(STATUS, lambda s: s.message == reason)
    track(44.0)
    assert until_read(lambda: ros.set_parameters_atomically(
        'controller', model=f'{file.parent}/./{file.name}', model_check_factor=0.0)).successful
    assert bench.reload()[0]


# Disks that do not answer. A file with a pipe beside it is read when somebody has written to that:
# a system call that waits in a thread, as one on such a disk does.

SLOW_DISK = """
import os, sys
from koopman_ros.nodes import controller
from koopman_ros.ros import model_reload
read = model_reload.load_suitable
def slowly(name, *others, **options):
    if os.path.exists(name + '.disk'):
        open(name + '.disk', 'rb').read()
    return read(name, *others, **options)
model_reload.load_suitable = slowly
"""


def start_controller(ros: Harness, file: Path, changes: str = '') -> Bench:
    """Start a controller whose model is not slow yet."""
    ros.start('controller', {'model': file}, command=(
        sys.executable, '-c', f'{SLOW_DISK}{changes}\nsys.exit(controller.main())'))
    return Bench(ros)


def disk(file: Path) -> Path:
    return Path(f'{file}.disk')


def test_the_loop_continues_while_a_slow_disk_is_read(ros: Harness, file: Path) -> None:
    bench = start_controller(ros, file)
    dead = file.with_name('dead.safetensors')
    for path in (file, dead):
        os.mkfifo(disk(path))
    put(model_path('reactor_nz3').read_bytes(), file)
    reloaded = bench.ask_to_reload()
    # closing it lets the reader go on
    slow = opened(ros, disk(file))
    assert ros.set_parameters('controller', model=str(dead))[0].reason.startswith(
        f'the current model is kept: {dead} is still being read')
    for _ in range(50):
        bench.measure()
    ros.wait_until(lambda: len(bench.commands) == 50)
    assert not reloaded.done()
    slow.close()
    ros.wait_until(reloaded.done)
    assert reloaded.result().success
    assert 'n_z = 3' in reloaded.result().message

    # a node that is taken down while a file is read goes on when it is configured again
    bench.ask_to_reload()
    with opened(ros, disk(file)):
        for transition in ('deactivate', 'cleanup'):
            assert change(ros, 'controller', transition)
    for transition in ('configure', 'activate'):
        assert change(ros, 'controller', transition)
    ros.meet('controller')
    bench.measure()
    ros.wait_until(lambda: len(bench.commands) == 51)

    # one that is changed during a slow reload stays
    reloaded = bench.ask_to_reload()
    slow = opened(ros, disk(file))
    assert bench.set('reactor_linear')[0]
    slow.close()
    ros.wait_until(reloaded.done)
    assert not reloaded.result().success
    assert 'reactor_linear became the current model' in reloaded.result().message
    ros.wait_for_status(STATUS, lambda s: value(s, 'model') == 'reactor_linear')
    # the other is still being read when the process is told to end
    assert ros.processes[0].stop() == 0
    assert 'Traceback' not in ros.printed()


def test_a_slow_trial_serves_the_next_attempt_unless_the_file_has_changed(
        ros: Harness, file: Path, run_node: RunNode, monkeypatch: pytest.MonkeyPatch,
        capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(model_reload, '_SHORT_WAIT', 0.0)
    run_node(ControllerNode, {'model': file})
    bench = Bench(ros)

    def accepted(name: str) -> bool:
        return ros.set_parameters('controller', model=name)[0].successful

    bench.measure()
    assert not accepted('reactor_nz3')
    ros.wait_until(lambda: accepted('reactor_nz3'))
    # the result for a file that has been replaced since is not used
    assert not accepted(str(file))
    put(model_path('reactor_linear').read_bytes(), file)
    ros.wait_until(lambda: accepted(str(file)))
    ros.wait_until(lambda: f'model {file}: linear' in capfd.readouterr().err)


def test_dead_disk_does_not_pile_up_readers(ros: Harness, file: Path) -> None:
    # impatient, or this would last
    bench = start_controller(ros, file, 'model_reload._LONG_WAIT = 0.02')
    others = [file.with_name(f'{k}.safetensors') for k in range(8)]
    for path in (file, *others):
        os.mkfifo(disk(path))
    assert bench.reload() == (
        False, f'the current model is kept: {file} was not read within 0.02 s: check its disk')
    assert bench.reload() == (
        False, f'the current model is kept: {file} is still being read: check its disk, or try '
        'again')
    request = SetParameters.Request(parameters=[
        Parameter('model', value=str(path)).to_parameter_msg() for path in others])
    results = ros.call(SetParameters, 'controller/set_parameters', request).results
    assert ['8 model files are still being read' in result.reason for result in results] == [
        False] * 7 + [True]
