# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A controller recorded by a trainer, and replayed: bit-identical, and with another model."""

from collections import Counter
from collections.abc import Callable, Iterable
import json
import math
from pathlib import Path
import shutil
import signal
import sys

from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np
import pytest
from sensor_msgs.msg import Temperature
from std_msgs.msg import String

from koopman_ros.core.paths import config_directory, model_path
from koopman_ros.core.units import to_kelvin
from koopman_ros.demo import reactor
from koopman_ros.event_log.records import EventRecord, parse, SNAPSHOT
from koopman_ros.event_log.report import ReplayedBag, reproduced, verdict
from koopman_ros.event_log.run import replayed_bag
from koopman_ros.event_log.sources import read_records
from koopman_ros.nodes import replay
from koopman_ros.parameters.controller import ReplayParameters
from koopman_ros.records import BagReadError
from koopman_ros.ros import topics
from koopman_ros.testing import Harness
from support.controller_bench import STEADY
from support.nodes import complaint, run_here, seconds, temperature, value
from support.recorded_runs import Recorded

COOLANT = 24.5  # degC, not what the law would command
# The rate limit is active through every step of the set-point, and the ramp takes some samples.
SETTINGS = {'coolant_temperature.rate_limit': 0.5, 'temperature.setpoint_ramp': 1.0,
            'measurement_timeout': 0.0}
RECORDS = f'/{topics.EVENT_LOG}'


class Operator:
    """A thermometer and an operator at a controller that a trainer records."""

    def __init__(self, ros: Harness, folder: Path) -> None:
        self.ros = ros
        self.time = 0.0
        self.answered: Counter[float] = Counter()  # commands by stamp
        self.model = folder / 'own.safetensors'
        ros.start('trainer', {'output': folder / 'day'})
        ros.node.create_subscription(
            Temperature, reactor.COOLANT_SETPOINT, self._on_command, topics.LOOP_QOS)
        coolant = ros.node.create_publisher(
            Temperature, reactor.COOLANT_TEMPERATURE, topics.LATCHED_QOS)
        coolant.publish(temperature(COOLANT, 1.0))
        self.controller = ros.start('controller', SETTINGS)
        self.thermometer, self.setpoint, self.manual = (
            ros.speak(Temperature, topic, to='controller', subscribers=2)
            for topic in (reactor.TEMPERATURE, reactor.SETPOINT, reactor.MANUAL_COOLANT_SETPOINT))
        ros.wait_until(lambda: coolant.get_subscription_count() >= 2)
        ros.meet('trainer')
        self.wait_for_records(1)

    def _on_command(self, message: Temperature) -> None:
        self.answered[seconds(message)] += 1

    def measure(self, celsius: float, time: float | None = None) -> None:
        """Measure, a second after the last time or at a time, and wait for the command."""
        self.time = self.time + 1.0 if time is None else time
        answers = self.answered[self.time]
        self.thermometer.publish(temperature(celsius, self.time))
        self.ros.wait_until(lambda: self.answered[self.time] > answers)

    def measure_on(self, count: int, celsius: float, step: float) -> None:
        for k in range(count):
            self.measure(celsius + step * k)

    def wait_for_records(self, count: int) -> None:
        """Wait until the trainer says that it has recorded so many, and all commands."""
        def recorded(status: DiagnosticStatus) -> bool:
            return int(value(status, f'messages on {RECORDS}')) >= count and int(value(
                status, 'messages on /coolant_setpoint')) >= self.answered.total()

        self.ros.wait_for_status('trainer: recording', recorded)

    def join(self) -> int:
        """Subscribe to the records, as another recorder would; return the snapshot's number."""
        heard = self.ros.listen(String, topics.EVENT_LOG)
        return self.ros.wait_until(lambda: next(
            (record.number for record in (parse(message.data) for message in heard)
             if record.event == SNAPSHOT), 0))

    def set(self, **parameters: object) -> bool:
        return self.ros.set_parameters_atomically('controller', **parameters).successful


def run_a_day(operator: Operator) -> None:
    """Go through whatever an operator and a sensor may do."""
    operator.measure_on(8, STEADY, -0.05)
    operator.setpoint.publish(temperature(45.0))
    operator.measure_on(12, STEADY, -0.3)
    # rejected, and one for later
    operator.setpoint.publish(temperature(200.0))
    operator.setpoint.publish(temperature(48.0, operator.time + 6.5))
    operator.measure_on(10, 47.3, -0.1)
    operator.join()
    # a gap, a sensor that fails, stamps that repeat and come late, and a clock that is set back
    operator.measure(46.4, operator.time + 30.0)
    for celsius in (math.nan, -400.0, 80.0, 46.3):
        operator.measure(celsius)
    now = operator.time
    for time in (now, now + 1.0, now + 0.5, now + 2.0, now + 2.0, now - 20.0, now - 19.0):
        operator.measure(46.2, time)
    for mode, celsius in ((False, 26.0), (True, 15.0), (False, 24.0)):
        operator.ros.set_bool('controller/set_automatic', mode)
        operator.manual.publish(temperature(celsius))
        operator.measure_on(4, 46.0, 0.04)
    operator.ros.set_bool('controller/set_automatic', True)
    # requests and measurements side by side, whose order only the controller knows
    for k in range(12):
        operator.setpoint.publish(temperature(44.0 + (k % 5)))
        operator.measure(46.0 - 0.03 * k)
    operator.join()


def tune_and_swap(operator: Operator) -> None:
    """Change parameters and models, also to what is rejected, and go on a little each time."""
    shutil.copy(model_path('reactor_nz3'), operator.model)
    for change, taken in (
            ({'coolant_temperature.weight': 0.3}, True),
            ({'coolant_temperature.weight': -1.0}, False),
            ({'fallback_order': ['none', 'linear']}, False),
            ({'fallback_order': ['mpc', 'sdre', 'linear'], 'mpc.temperature.max': 46.2}, True),
            ({'setpoint_filter_time': 15.0, 'observer_bandwidth': 0.05}, True),
            ({'model': str(operator.model), 'coolant_temperature.weight': 0.5}, True),
            ({'model': 'none'}, False)):
        assert operator.set(**change) is taken
        operator.measure_on(3, 46.0, -0.05)
    for content in (model_path('reactor_nz3').read_bytes(), b'',
                    model_path('reactor_nz4').read_bytes()):
        operator.model.write_bytes(content)
        assert operator.ros.trigger('controller/reload_model').success is bool(content)
        operator.measure_on(3, 45.8, 0.05)


def fall_silent(operator: Operator) -> None:
    """Leave the controller without measurements, until it holds, and until it is safe."""
    for hold_timeout in (60.0, 0.5):
        assert operator.set(measurement_timeout=0.3, hold_timeout=hold_timeout)
        count = operator.answered.total()
        operator.ros.wait_until(lambda count=count: operator.answered.total() >= count + 3)
        assert operator.set(measurement_timeout=0.0)
        operator.time += 10.0
        operator.measure_on(5, 46.0, -0.02)


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record a day of a controller, which is started again in the evening."""
    folder = tmp_path_factory.mktemp('day')
    with Harness(folder) as ros:
        operator = Operator(ros, folder)
        run_a_day(operator)
        tune_and_swap(operator)
        fall_silent(operator)
        # what is on its way to the trainer is lost with its sender: one record to spare, which
        # stands for the first, where that came before the trainer had found the controller
        operator.join()
        count = operator.join()
        operator.wait_for_records(count)
        operator.controller.send(signal.SIGINT)
        assert ros.wait_for_end(operator.controller) == 0
        ros.start('controller', SETTINGS | {'model': 'reactor_nz3'})
        ros.wait_until(lambda: operator.thermometer.get_subscription_count() >= 2)
        ros.meet('controller')
        runs = ros.listen(String, topics.EVENT_LOG)
        ros.wait_until(lambda: len({parse(message.data).run for message in runs}) == 1)
        # each who joins is sent a record, which the trainer has once it has found the controller
        ros.wait_until(lambda: operator.join() and int(value(
            ros.last_status('trainer: recording'), f'messages on {RECORDS}')) > count + 1)
        operator.measure_on(5, 46.0, -0.05)
        ros.wait_until(lambda: sum(
            parse(message.data).event == 'measurement' for message in runs) == 5)
        operator.wait_for_records(count)
        assert ros.set_bool('trainer/record', False).success
    operator.model.unlink()
    return folder / 'day'


def replayed(bag: Path, **parameters: object) -> ReplayedBag:
    return replayed_bag(str(bag), ReplayParameters(**parameters), given=parameters)


def test_every_recorded_command_of_a_day_that_was_not_easy_is_reproduced(bag: Path) -> None:
    found, written = replayed(bag), list(read_records(bag, RECORDS))
    assert found.check.identical == found.check.compared == len(found.recorded) > 80
    assert (found.found.runs, found.found.lost) == (2, [])
    assert found.complete
    assert verdict(found) == (
        f'all {len(found.recorded)} recorded commands are reproduced exactly')

    events = Counter(record.event for record in written)
    # the manual command in automatic mode is rejected
    assert {name: events[name] for name in ('setpoint', 'mode', 'manual_command', 'model')} == {
        'setpoint': 15, 'mode': 4, 'manual_command': 3, 'model': 2}
    assert found.found.rejected == 2
    # on a busy machine there may be more
    assert events['silence'] >= 6
    # that of a controller may come before the trainer has found it
    assert events['initialisation'] <= 2
    assert events['parameters'] >= 7
    assert events[SNAPSHOT] >= 3
    assert {record.fields['result'] for record in written if record.event == 'measurement'} == {
        'accepted', 'rejected', 'repeated', 'late'}
    assert {record.fields['level'] for record in written if 'level' in record.fields} >= {
        'mpc', 'sdre', 'hold', 'safe'}
    assert found.found.models == ['reactor_nz4', str(bag.parent / 'own.safetensors'),
                                  'reactor_nz3']
    steps = np.abs(np.diff(found.recorded[:, 0]))
    assert sum(steps > 0.49) > 10  # K; the rate limit at one sample a second


def test_bag_that_was_cut_off_is_reproduced_as_far_as_it_is_whole(
        bag: Path, tmp_path: Path) -> None:
    (file,) = bag.glob('*.mcap')
    part = tmp_path / 'part.mcap'
    part.write_bytes(file.read_bytes()[:int(0.7 * file.stat().st_size)])
    with pytest.raises(BagReadError, match='not closed by its recorder'):
        replayed(part)
    found = replayed(part, recover=True)
    assert found.check.identical == found.check.compared > 20
    assert not found.complete


def write_run(path: Path, change: Callable[[list[EventRecord]], Iterable[EventRecord]] = list,
              model: str = 'reactor_nz4', prefix: str = '') -> Path:
    """Write a bag of twenty measurements, with a snapshot in the middle of the records."""
    controller = Recorded(model)
    for k in range(20):
        if k == 10:
            controller.snapshot()
        controller.measure(to_kelvin(46.0) - 0.1 * k)
    return controller.save(path, change, prefix)


def altered(whole: list[EventRecord]) -> list[EventRecord]:
    record = next(record for record in whole if 'command' in record.fields)
    record.fields['command'][0] += 1.0
    return whole


@pytest.mark.parametrize(('change', 'code', 'words'), [
    (altered, 1, 'replay: not all recorded commands are reproduced within 0.1: '),
    (lambda whole: whole[-5:], 3, 'replay: nothing to compare in a bag'),
    (lambda whole: whole[:1], 3, 'replay: nothing to compare in a bag'),
    (lambda whole: [*whole[:9], *whole[:9]], 1, 'or follows record 8'),
    (lambda whole: [], 1, 'has no records of a controller'),
])
def test_records_that_are_not_reproduced_end_with_their_code_and_one_line(
        tmp_path: Path, capfd: pytest.CaptureFixture[str],
        change: Callable[[list[EventRecord]], list[EventRecord]], code: int, words: str) -> None:
    path = write_run(tmp_path / 'part.mcap', change)
    assert run_here(replay, bags=f'[{path}]', output=tmp_path) == code
    line = complaint(capfd)
    assert line.startswith('replay: ')
    assert words in line


def test_run_without_its_start_and_with_a_lost_record_is_reproduced_from_the_snapshot_on(
        tmp_path: Path) -> None:
    path = write_run(tmp_path / 'part.mcap', lambda whole: [*whole[5:8], *whole[9:]])
    found = replayed(path)
    (lost,) = found.found.lost
    assert lost.first == lost.last == 8
    assert found.check.identical == found.check.compared == 10
    assert len(found.recorded) == 15
    assert found.found.begins_late == found.found.runs == 1
    assert reproduced(found)
    assert run_here(replay, bags=f'[{path}]', output=tmp_path) == 0
    assert 'Records 8 to 8 of run a are missing' in (tmp_path / 'report.md').read_text()


def test_a_replay_reports_differences_of_a_new_tuning_and_none_in_several_bags_of_the_same(
        tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = write_run(tmp_path / 'run.mcap')
    for file, tuning, bags, pictures in (
            ('controller.yaml', ('-p', 'coolant_temperature.weight:=5.0'), [path], {'replay.png'}),
            ('replay.yaml', (), [path, path], {'replay_1.png', 'replay_2.png'})):
        output = tmp_path / file
        assert run_here(
            replay, '--params-file', str(config_directory() / file), *tuning,
            '-p', f'bags:=[{", ".join(map(str, bags))}]', '-p', 'new_model:=reactor_nz4',
            '-p', f'output:={output}') == 0
        assert 'commands are reproduced' in capfd.readouterr().out
        found = json.loads((output / 'summary.json').read_text())['bags']
        assert len(found) == len(bags)
        report = (output / 'report.md').read_text()
        for figures in found:
            assert figures['recorded_model']['identical'] == figures['recorded_model']['compared']
            new = figures['new_model']
            assert (new['beyond_tolerance'] > 0) is bool(tuning)
            assert not tuning or (
                f'{new["beyond_tolerance"]} of {new["compared"]} commands differ' in report)
        assert 'not a closed loop' in report
        assert {path.name for path in output.iterdir()} == {
            'report.md', 'summary.json', *pictures}
        assert all((output / name).read_bytes().startswith(b'\x89PNG') for name in pictures)


@pytest.mark.parametrize(('arguments', 'words'), [
    (('-p', 'bags:=[none.mcap]'), "bag 'none.mcap' does not exist"),
    (('-p', "bags:=['']"), "bags = [''] must contain"),
    (('-p', 'new_model:=none'), 'none.safetensors'),
    (('-r', '__ns:=/unit_1'), 'no records of a controller on'),
    (('-r', 'event_log:=coolant_setpoint'),
     'is sensor_msgs/msg/Temperature and not std_msgs'),
    *((('-p', 'new_model:=reactor_nz4', '-p', given), words) for given, words in (
        ('coolant_temperature.min:=40.0', 'coolant_temperature.min = 40.0 degC must be below'),
        ('coolant_temperature.min:=40',
         'coolant_temperature.min = 40 must be a double, e.g. 1.0'))),
    (('-p', 'output:=/dev/null/out'), 'Not a directory'),
])
def test_a_bag_that_cannot_be_replayed_is_rejected_in_one_line(
        tmp_path: Path, capfd: pytest.CaptureFixture[str], arguments: tuple[str, ...],
        words: str) -> None:
    bag = write_run(tmp_path / 'run.mcap')
    assert run_here(replay, *arguments, bags=f'[{bag}]', output=tmp_path) == 1
    line = complaint(capfd)
    assert line.startswith('replay: ')
    assert words in line


def test_controller_in_a_namespace_is_replayed_by_its_own_records(tmp_path: Path) -> None:
    bag = write_run(tmp_path / 'run.mcap', model='reactor_nz3', prefix='/unit_1')
    assert run_here(replay, '-r', '__ns:=/unit_1', bags=f'[{bag}]', output=tmp_path) == 0
    (figures,) = json.loads((tmp_path / 'summary.json').read_text())['bags']
    assert figures['recorded_model']['identical'] == figures['measurements'] == 20


def test_missing_matplotlib_is_reported_in_one_line(
        monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.delitem(sys.modules, 'koopman_ros.event_log.figure', raising=False)
    monkeypatch.setitem(sys.modules, 'matplotlib', None)
    assert run_here(replay, bags='[run.mcap]') == 1
    assert complaint(capfd).startswith(
        'replay: the plot needs matplotlib, which is not installed: pip install')
