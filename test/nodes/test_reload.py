# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Another model in the running controller: nothing unanswered, no jump, reasons in words."""

from collections.abc import Callable
from dataclasses import dataclass, replace
import itertools
import math
import os
from pathlib import Path
import sys
from typing import BinaryIO

from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np
import pytest
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.task import Future
from sensor_msgs.msg import Temperature
from std_srvs.srv import Trigger

from koopman_ros.control import Controller, State
from koopman_ros.lifting import LiftedModel, load, save
from koopman_ros.parameters.controller import ControllerParameters
from koopman_ros.resources import model_path
from koopman_ros.ros import model_reload, topics
from koopman_ros.ros.codec import stamp_nanoseconds
from koopman_ros.testing import Harness
from koopman_ros.units import to_celsius, to_kelvin
from support.messages import seconds, temperature, value
from support.processes import opened

STATUS = 'controller: control'
STEADY = 51.8  # degC, near the plant's steady state
NAMES = ('reactor_nz3', 'reactor_nz4', 'reactor_linear')
PERIOD = 0.1  # s between the stamps of measurements
SETPOINTS = [(20.0 * k, 46.0 + math.sin(k)) for k in range(1, 150)]
# No limit acts, so that commands show which model gave them.
SETTINGS = {'setpoint_ramp': 3.0, 'observer_bandwidth': 1.0}
# Silence is told by the wall clock, and a busy machine may be silent where no test means it.
PATIENT = {'measurement_timeout': 0.0}
MOST_OPEN = 200  # measurements without a command; the middleware keeps a thousand


def shipped(name: str) -> LiftedModel:
    return load(model_path(name))


def put(content: bytes, path: Path) -> None:
    """Replace a file at once, as a program that saves a model does."""
    new = path.with_suffix('.new')
    new.write_bytes(content)
    os.replace(new, path)


class Bench:
    """
    Measures a reactor that swings, and changes the model of a running controller.

    :param ros: where the controller runs.
    """

    def __init__(self, ros: Harness) -> None:
        self.ros = ros
        self.sent: list[Temperature] = []
        self.commands = ros.listen(Temperature, topics.COOLANT_SETPOINT)
        self._reload = ros.node.create_client(Trigger, 'controller/reload_model')
        self._set = ros.node.create_client(SetParameters, 'controller/set_parameters')
        for client in (self._reload, self._set):
            ros.wait_until(client.service_is_ready)
        self._thermometer = ros.speak(Temperature, topics.TEMPERATURE, to='controller')

    def ask_to_reload(self) -> Future:
        """Ask the controller to read its model again."""
        return self._reload.call_async(Trigger.Request())

    def reload(self) -> tuple[bool, str]:
        """Let the controller read its model again; return what it answers."""
        future = self.ask_to_reload()
        self.ros.wait_until(future.done)
        return future.result().success, future.result().message

    def set(self, model: str | Path) -> tuple[bool, str]:
        """Set the model; return what the controller answers."""
        request = SetParameters.Request(
            parameters=[Parameter('model', value=str(model)).to_parameter_msg()])

        def change() -> SetParametersResult:
            future = self._set.call_async(request)
            self.ros.wait_until(future.done)
            return future.result().results[0]

        result = self.until_read(change)
        return result.successful, result.reason

    @staticmethod
    def until_read(change: Callable[[], SetParametersResult]) -> SetParametersResult:
        """Change a model, again if the machine is too busy to read it in the moment."""
        while 'still being read' in (result := change()).reason:
            pass
        return result

    def measure_at(self, hertz: float) -> None:
        """Measure from now on, as long as the controller keeps up."""
        def tick() -> None:
            if len(self.sent) - len(self.commands) < MOST_OPEN:
                self.measure()

        self._timer = self.ros.node.create_timer(1.0 / hertz, tick)

    def stop(self) -> None:
        """Measure no more, and wait until all is answered."""
        self._timer.cancel()
        self.wait_for_answers()

    def measure(self, celsius: float | None = None) -> None:
        """Measure once."""
        k = len(self.sent) + 1
        message = temperature(
            46.0 + math.sin(0.02 * k) if celsius is None else celsius, PERIOD * k)
        self.sent.append(message)
        self._thermometer.publish(message)

    def wait_for_answers(self) -> float:
        """Wait until every measurement is answered; return the last command."""
        self.ros.wait_until(lambda: len(self.commands) >= len(self.sent))
        return float(self.commands[-1].temperature)


def test_forty_reloads_under_load_leave_no_trace(ros: Harness, tmp_path: Path) -> None:
    """Each command is the very one that the models give in turn, and none of them jumps."""
    file = tmp_path / 'model.safetensors'
    contents = {name: model_path(name).read_bytes() for name in NAMES}
    whole = contents['reactor_nz4']
    bad = itertools.cycle((b'', b'garbage' * 1000, whole[:len(whole) // 2], whole[:-1]))
    put(contents['reactor_nz4'], file)
    ros.start('controller', {'model': file, **SETTINGS, **PATIENT})
    bench = Bench(ros)
    setpoint = ros.speak(Temperature, topics.SETPOINT, to='controller')
    for at, celsius in SETPOINTS:
        setpoint.publish(temperature(celsius, at))
    ros.meet('controller')

    bench.measure_at(400.0)
    names = list(itertools.islice(itertools.cycle(NAMES), 40))
    for k, name in enumerate(names):
        if k % 10 == 0:
            put(next(bad), file)
            for done, reason in (bench.reload(), bench.set(file)):
                assert not done
                assert reason.startswith(f'the old model is kept: {file}')
        put(contents[name], file)
        done, reason = bench.reload() if k % 2 else bench.set(file)
        assert done, reason
    status = ros.wait_for_status(STATUS, lambda s: value(s, 'model reloads') == '40')
    # a busy machine measures less often, and the set-point moves once in 200 measurements
    ros.wait_until(lambda: len(bench.sent) > 1000)
    bench.stop()

    assert [message.header.stamp for message in bench.commands] == [
        message.header.stamp for message in bench.sent]
    jumps = jumps_of(bench, names)
    # the last ones may have come after the last measurement
    assert len(jumps) > 20
    assert max(jumps) < 0.01
    swing = np.ptp([message.temperature for message in bench.commands])
    assert swing > 0.2
    assert status.level != DiagnosticStatus.ERROR


def jumps_of(bench: Bench, names: list[str]) -> list[float]:
    """
    Follow the commands bit for bit, from state to state and from model to model.

    :param names: of the models in the order in which they were loaded.
    :return: by how much the command to the next measurement differed from what the model before
        would have commanded, in K, wherever one took another's place.
    """
    settings = ControllerParameters(**SETTINGS).settings()
    controllers = {name: Controller(shipped(name), settings) for name in NAMES}
    controller, state = controllers['reactor_nz4'], State()
    for at, celsius in SETPOINTS:
        state, refused = controller.request_setpoint(
            state, np.array([to_kelvin(celsius)]), round(at * 1e9))
        assert not refused
    left, jumps = list(names), []
    for measured, command in zip(bench.sent, bench.commands, strict=True):
        x = np.array([to_kelvin(measured.temperature)])
        stamp_ns = stamp_nanoseconds(measured.header.stamp)
        after, kept, _ = controller.step(state, x, stamp_ns)
        u = kept
        while to_celsius(float(u[0])) != command.temperature:
            assert left, (seconds(measured), command.temperature)
            predecessor, controller = controller, controllers[left.pop(0)]
            state = controller.hand_over(predecessor, state)
            after, u, _ = controller.step(state, x, stamp_ns)
        if u is not kept:
            jumps.append(abs(float(u[0] - kept[0])))
        state = after
    return jumps


# Models that are refused.


def edited(**changes: object) -> LiftedModel:
    return replace(shipped('reactor_nz4'), **changes)


def with_states(**changes: object) -> LiftedModel:
    return edited(states=replace(shipped('reactor_nz4').states, **changes))


BAD_MODELS = {
    'other unit': (lambda: with_states(units=('degC',)), "has states in ('degC',)"),
    'nominal point outside its range': (
        lambda: with_states(center=np.array([400.0])),
        'trained for a temperature of 305 to 327 K around 400 K, which cannot be'),
    'below absolute zero': (
        lambda: with_states(lower=np.array([-5.0])), 'which cannot be: train the model again'),
    'range without the set-point': (
        lambda: with_states(upper=np.array([324.8])),
        f'set-point {STEADY:.2f} degC is outside the trained range 31.85 degC to 51.65 degC'),
    'input without effect': (
        lambda: edited(A=-shipped('reactor_nz4').A, B=np.zeros((1, 1))),
        f'tried at {STEADY:.2f} degC with the set-point {STEADY:.2f} degC the model fails (no '
        'feedback gain: the Hamiltonian has no stable subspace of full size'),
    'coolant in place of the temperature': (
        lambda: with_states(names=('coolant_temperature',)),
        "has 'coolant_temperature' as state and 'coolant_temperature' as input"),
    'gain beyond its bound': (
        lambda: edited(A=1e6 * np.abs(shipped('reactor_nz4').A)), 'the model fails'),
    'numbers that overflow': (
        lambda: edited(A=1e300 * shipped('reactor_nz4').A), 'the model fails'),
}


@pytest.fixture(scope='module')
def running(shared_ros: Harness) -> Bench:
    """Return a controller that tracks the first measurement."""
    shared_ros.start('controller', PATIENT)
    bench = Bench(shared_ros)
    bench.measure(STEADY)
    bench.wait_for_answers()
    return bench


@pytest.mark.parametrize('name', BAD_MODELS)
def test_unsuitable_model_is_refused_with_the_reason(
        running: Bench, tmp_path: Path, name: str) -> None:
    def measure() -> float:
        running.measure(STEADY)
        return running.wait_for_answers()

    ros = running.ros
    build, words = BAD_MODELS[name]
    save(build(), tmp_path / 'bad.safetensors')
    assert running.set('reactor_nz3')[0]
    before = measure()
    done, reason = running.set(tmp_path / 'bad.safetensors')
    assert not done
    assert reason.startswith('the old model is kept: ')
    assert words in reason
    status = ros.wait_for_status(STATUS, lambda s: s.message == reason)
    assert status.level == DiagnosticStatus.WARN
    assert value(status, 'model') == 'reactor_nz3'
    assert ros.get_parameters('controller', 'model') == ['reactor_nz3']
    assert measure() == pytest.approx(before, abs=1e-9)

    assert running.reload() == (
        True, 'model reactor_nz3: n_z = 3, trained for 31.85 degC to 53.85 degC')
    status = ros.wait_for_status(STATUS, lambda s: s.level == DiagnosticStatus.OK)
    assert value(status, 'model refused') == 'none'


def test_model_changes_with_the_weights_that_it_needs(running: Bench) -> None:
    def change(gain: float) -> SetParametersResult:
        return running.ros.set_parameters_atomically(
            'controller', model='reactor_linear', max_gain=gain)

    assert 'the gain exceeds its bound' in running.until_read(lambda: change(1e-3)).reason
    result = running.until_read(lambda: change(500.0))
    assert result.successful, result.reason
    assert running.ros.get_parameters('controller', 'model', 'max_gain') == [
        'reactor_linear', 500.0]


# What is no regular file.


def test_pipes_and_devices_are_refused_at_once_and_a_good_model_is_taken_after_them(
        running: Bench, tmp_path: Path) -> None:
    """Eight pipes that nobody writes to once kept all readers busy for ever."""
    pipes = [tmp_path / f'{k}.safetensors' for k in range(9)]
    for pipe in pipes:
        os.mkfifo(pipe)
    endless = tmp_path / 'endless.safetensors'
    endless.symlink_to('/dev/zero')
    for path, kind in ((endless, 'a device'), (Path('/dev/random'), 'a device'),
                       (tmp_path, 'a folder'), *((pipe, 'a named pipe') for pipe in pipes)):
        done, reason = running.set(path)
        assert not done
        assert reason == (f'the old model is kept: cannot read the model file {path}: it is '
                          f'{kind}, not a regular file')
    done, reason = running.set('reactor_nz4')
    assert done, reason


# Disks that do not answer. A file with a pipe beside it is read when somebody has written to that:
# a system call that waits in a thread, as one on such a disk does.

SLOW_DISK = """
import os, sys
from koopman_ros.nodes import controller
from koopman_ros.ros import model_reload
read = model_reload.load_suitable
def slowly(name):
    if os.path.exists(name + '.disk'):
        open(name + '.disk', 'rb').read()
    return read(name)
model_reload.load_suitable = slowly
"""


@dataclass
class SlowDisk:
    """Model files that are on a disk which does not answer until it is told to."""

    ros: Harness  #: where the controller runs
    folder: Path  #: for the files

    def start_controller(self, changes: str = '') -> Path:
        """Start a controller whose model, not slow yet, is returned."""
        file = self.folder / 'model.safetensors'
        put(model_path('reactor_nz4').read_bytes(), file)
        self.ros.start('controller', {'model': file}, command=(
            sys.executable, '-c', f'{SLOW_DISK}{changes}\nsys.exit(controller.main())'))
        return file

    def hang(self, file: Path) -> None:
        """Let a file wait from now on."""
        os.mkfifo(f'{file}.disk')

    def wait_for_reader(self, file: Path) -> BinaryIO:
        """Wait until a file is read; closing what is returned lets the reader go on."""
        return opened(self.ros, Path(f'{file}.disk'))


@pytest.fixture
def disk(ros: Harness, tmp_path: Path) -> SlowDisk:
    return SlowDisk(ros, tmp_path)


def test_loop_goes_on_while_a_slow_disk_is_read(ros: Harness, disk: SlowDisk) -> None:
    file = disk.start_controller()
    dead = file.with_name('dead.safetensors')
    bench = Bench(ros)
    for path in (file, dead):
        disk.hang(path)
    put(model_path('reactor_nz3').read_bytes(), file)
    reloaded = bench.ask_to_reload()
    slow = disk.wait_for_reader(file)
    (result,) = ros.set_parameters('controller', model=str(dead))
    assert result.reason.startswith(f'the old model is kept: {dead} is still being read')
    for _ in range(50):
        bench.measure()
    ros.wait_until(lambda: len(bench.commands) == 50)
    assert not reloaded.done()

    slow.close()
    ros.wait_until(reloaded.done)
    assert reloaded.result().success
    assert 'n_z = 3' in reloaded.result().message
    # the other is still being read when the process is told to end
    assert ros.processes[0].stop() == 0
    assert 'Traceback' not in ros.printed()


def test_model_changed_during_a_slow_reload_stays(ros: Harness, disk: SlowDisk) -> None:
    file = disk.start_controller()
    bench = Bench(ros)
    disk.hang(file)
    reloaded = bench.ask_to_reload()
    slow = disk.wait_for_reader(file)
    assert bench.set('reactor_linear')[0]
    slow.close()
    ros.wait_until(reloaded.done)
    assert not reloaded.result().success
    assert 'the model was changed to reactor_linear' in reloaded.result().message
    ros.wait_for_status(STATUS, lambda s: value(s, 'model') == 'reactor_linear')


def test_dead_disk_does_not_pile_up_readers_and_a_healthy_one_is_read(
        ros: Harness, disk: SlowDisk) -> None:
    # impatient, or this would last; the folder stands for a disk
    file = disk.start_controller(f"""
model_reload._LONG_WAIT = 0.02
model_reload._mount_of = lambda path: '/dead' if path.startswith('{disk.folder}/') else '/'
""")
    bench = Bench(ros)
    others = [file.with_name(f'{k}.safetensors') for k in range(8)]
    for path in (file, *others):
        disk.hang(path)
    assert bench.reload() == (
        False, f'the old model is kept: {file} was not read within 0.02 s: check its disk')
    assert bench.reload() == (
        False, f'the old model is kept: {file} is still being read: check its disk, or try again')
    request = SetParameters.Request(parameters=[
        Parameter('model', value=str(path)).to_parameter_msg() for path in others])
    results = ros.call(SetParameters, 'controller/set_parameters', request).results
    assert ['8 model files of the file system /dead' in result.reason for result in results] == [
        False] * 7 + [True]
    done, reason = bench.set('reactor_nz3')
    assert done, reason


@pytest.mark.parametrize(('path', 'mount'), [
    ('/mnt/a b/model', '/mnt/a b'), ('/mnt/a', '/mnt'), ('/mnt', '/mnt'), ('/mntx/a', '/'),
    ('/proc/1/x', '/proc')])
def test_file_system_of_a_path_is_found_without_asking_it(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch, path: str, mount: str) -> None:
    mounts = tmp_path / 'mountinfo'
    mounts.write_text(''.join(
        f'{k} 1 0:{k} / {name} rw - ext4 none rw\n'
        for k, name in enumerate(('/', '/proc', '/mnt', '/mnt/a\\040b'))))
    monkeypatch.setattr(model_reload, '_MOUNTS', mounts)
    assert model_reload._mount_of(path) == mount
    mounts.unlink()
    assert model_reload._mount_of(path) == '/'
