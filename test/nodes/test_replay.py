# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A controller recorded by a trainer, and replayed: offline to the bit, and with another model."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
import itertools
import json
import math
from pathlib import Path
import subprocess
import sys

import numpy as np
import pytest
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Temperature

from koopman_ros.bags import (
    BagMessage,
    BagWriter,
    in_log_order,
    message_definition,
    read_messages,
)
from koopman_ros.nodes import replay, topics
from koopman_ros.nodes.messages import NANOSECONDS
from koopman_ros.nodes.replay_parameters import ReplayParameters
from koopman_ros.nodes.replaying import steps
from koopman_ros.nodes.replaying.comparison import ReplayedBag
from koopman_ros.nodes.replaying.record import Names
from koopman_ros.nodes.replaying.report import about_beginning, reproduced, verdict
from koopman_ros.nodes.shipped import config_directory
from koopman_ros.testing import Harness, isolated_domain
from support.messages import seconds, temperature, value

STEADY = 51.8  # degC
# The rate limit is active through every step of the set-point, and the ramp takes some samples.
SETTINGS = {'coolant_rate_limit': 30.0, 'setpoint_ramp': 60.0}
# The law alone, which follows from a measurement and what is recorded of the rest.
PURE = {'observer_bandwidth': 0.0, 'transfer_time': 0.0}


class Operator:
    """
    A thermometer and an operator at a controller that a trainer records.

    :param ros: where both run.
    :param bag: where the trainer records.
    :param settings: of the controller.
    """

    def __init__(self, ros: Harness, bag: Path, settings: dict[str, float]) -> None:
        self.ros = ros
        self.time = 0.0
        ros.start('trainer', {'output': bag})
        ros.start('controller', settings)
        self.commands = ros.listen(Temperature, topics.COOLANT_SETPOINT)
        self.thermometer = ros.speak(
            Temperature, topics.TEMPERATURE, to='controller', subscribers=2)
        self.setpoint = ros.speak(Temperature, topics.SETPOINT, to='controller', subscribers=2)
        self.manual = ros.speak(
            Temperature, topics.MANUAL_COOLANT_SETPOINT, to='controller', subscribers=2)
        ros.meet('trainer')

    def measure(self, celsius: float, time: float | None = None) -> None:
        """Measure, a second after the last time or at a time, and wait for the command."""
        self.time = self.time + 1.0 if time is None else time
        answers = len(self.commands)
        self.thermometer.publish(temperature(celsius, self.time))
        self.ros.wait_until(lambda: len(self.commands) > answers)
        assert seconds(self.commands[-1]) == self.time

    def recorded(self, topic: str) -> int:
        """Return how many messages of a topic the trainer says it has recorded."""
        status = self.ros.wait_for_status('trainer: recording', lambda status: True)
        return int(value(status, f'messages on /{topic}'))


def run_a_day(operator: Operator) -> None:
    """Go through whatever an operator and a sensor may do."""
    while True:
        operator.measure(STEADY)
        if operator.recorded(topics.COOLANT_SETPOINT):
            break
        operator.ros.statuses.clear()
    for k in range(20):
        operator.measure(STEADY - 0.05 * k)
    operator.setpoint.publish(temperature(45.0))
    for k in range(15):
        operator.measure(STEADY - 0.3 * k)
    # refused, and one for later
    operator.setpoint.publish(temperature(200.0))
    operator.setpoint.publish(temperature(48.0, operator.time + 6.5))
    for k in range(12):
        operator.measure(47.3 - 0.1 * k)
    # a gap, a sensor that fails, stamps that repeat and come late, and a clock that is set back
    operator.measure(46.4, operator.time + 30.0)
    for celsius in (math.nan, -400.0, 46.3):
        operator.measure(celsius)
    now = operator.time
    for time in (now, now + 1.0, now + 0.5, now + 2.0, now + 2.0, now - 20.0, now - 19.0):
        operator.measure(46.2, time)
    for mode, celsius in ((False, 26.0), (True, 15.0), (False, 24.0)):
        operator.ros.set_bool('controller/set_automatic', mode)
        operator.manual.publish(temperature(celsius))
        for k in range(25):
            operator.measure(46.0 + 0.04 * k)
    operator.ros.set_bool('controller/set_automatic', True)
    # requests and measurements side by side, whose order only the controller knows
    for k in range(30):
        operator.setpoint.publish(temperature(44.0 + (k % 5)))
        operator.measure(46.0 - 0.03 * k)
    for k in range(240):
        if k in (30, 200):
            operator.setpoint.publish(temperature(46.0 + 0.01 * k))
        operator.measure(45.1 + math.sin(0.1 * k))


def record_a_day(folder: Path, settings: dict[str, float]) -> tuple[Path, int]:
    """Record it; return the bag and how many measurements there were."""
    with Harness(folder) as ros:
        operator = Operator(ros, folder / 'day', settings)
        run_a_day(operator)
        count = len(operator.commands)
        assert ros.set_bool('trainer/record', False).success
    return folder / 'day', count


@pytest.fixture(scope='module')
def day(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int]:
    return record_a_day(tmp_path_factory.mktemp('day'), SETTINGS)


@pytest.fixture(scope='module')
def pure_day(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int]:
    return record_a_day(tmp_path_factory.mktemp('pure_day'), SETTINGS | PURE)


def replayed(bag: Path, model: str = 'reactor_nz4', new_model: str = 'reactor_nz3',
             **settings: float) -> ReplayedBag:
    parameters = ReplayParameters(
        **{'model': model, 'new_model': new_model, **SETTINGS, **settings})
    return replay.replayed_bag(str(bag), Names(), parameters)


def test_every_recorded_command_is_reproduced_to_the_bit(day: tuple[Path, int]) -> None:
    bag, count = day
    found = replayed(bag)
    assert len(found.recorded) == count > 110
    # the first ones may have been given before the trainer knew of the controller
    assert found.check.compared >= count - 3
    assert found.check.identical == found.check.compared
    assert found.replayed.adopted == 0
    assert found.replayed.refused == 2
    assert found.record.unmatched_commands == 0


def test_the_run_was_not_an_easy_one(day: tuple[Path, int]) -> None:
    found = replayed(day[0])
    steps = abs(found.recorded[1:] - found.recorded[:-1])
    assert sum(steps > 0.49) > 20  # K; the rate limit at one sample a second
    modes = [operation.message for sample in found.replayed.samples
             for operation in sample.operations if not operation.topic]
    assert [mode.value for mode in modes] == [
        'manual', 'automatic', 'manual', 'automatic']
    assert all(sum(abs(found.recorded - asked) < 1e-9) > 1 for asked in (24.0, 26.0))
    assert len(set(found.setpoint)) > 9


@pytest.mark.parametrize(('wrong', 'words'), [
    ({'model': 'reactor_linear'}, 'another model'),
    ({'coolant_rate_limit': 31.0}, 'another limit'),
    ({'coolant_weight': 1.01}, 'another weight'),
])
def test_other_settings_are_found_out(day: tuple[Path, int], wrong: dict, words: str) -> None:
    found = replayed(day[0], **wrong)
    assert found.check.identical < found.check.compared, words
    assert found.check.worst is not None


def test_new_model_with_the_same_weights_commands_the_same(day: tuple[Path, int]) -> None:
    found = replayed(day[0], new_model='reactor_nz4')
    assert found.new is not None
    assert found.new.identical == found.new.compared == found.check.compared


def test_new_model_is_compared_where_it_would_have_acted_otherwise(day: tuple[Path, int]) -> None:
    found = replayed(day[0], new_model='reactor_linear')
    assert found.new is not None
    assert 10 < sum(found.new.beyond) < found.new.compared
    # in manual mode no model acts, once the coolant has arrived
    manual = abs(found.recorded - 26.0) < 1e-9
    assert sum(manual) > 10
    assert not any(found.new.beyond[manual][8:])


def rewrite(path: Path, *parts: Iterable[BagMessage]) -> Path:
    """Write parts of bags one after the other, an hour of receipt apart."""
    with BagWriter(path) as writer:
        for number, part in enumerate(parts):
            for entry in part:
                writer.add_topic(entry.topic, message_definition(entry.type_name))
                writer.write(entry.topic, entry.data,
                             entry.log_time_ns + number * 3600 * NANOSECONDS)
    return path


def from_measurement(bag: Path, number: int) -> Iterator[BagMessage]:
    """Yield what a recorder would have heard that came before this measurement."""
    entries = list(in_log_order(read_messages(bag)))
    place = [k for k, entry in enumerate(entries) if entry.topic == '/temperature'][number]
    # whoever joins late is told the set-point that is tracked
    yield [entry for entry in entries[:place] if entry.topic == '/active_setpoint'][-1]
    yield from entries[place:]


# the one before the last comes after the clock was set back, the last in automatic mode again
@pytest.mark.parametrize('number', [10, 30, 58, 145])
def test_bag_that_begins_in_the_middle_of_a_run_of_the_law_alone(
        pure_day: tuple[Path, int], tmp_path: Path, number: int) -> None:
    bag, count = pure_day
    found = replayed(rewrite(tmp_path / 'late.mcap', from_measurement(bag, number)), **PURE)
    assert found.record.began_before
    assert len(found.recorded) == count - number
    # the first command, or the second if that one was missed, follows from what is not recorded,
    # and one more may, such as the usual interval before a gap
    assert found.check.compared >= count - number - 3
    assert found.check.identical >= found.check.compared - 1
    assert not np.any(found.check.beyond)


@pytest.mark.parametrize('number', [10, 30, 58, 145])
def test_bag_that_begins_in_the_middle_of_a_run_agrees_after_three_minutes(
        day: tuple[Path, int], tmp_path: Path, number: int) -> None:
    """What the controller remembered of the disturbance then is not in the bag."""
    bag, count = day
    found = replayed(rewrite(tmp_path / 'late.mcap', from_measurement(bag, number)))
    assert found.record.began_before
    assert found.replayed.given_seconds == 180.0
    assert found.check.compared >= count - number - 185
    difference = np.abs(found.check.difference)
    assert np.nanmax(difference) < 0.05
    assert np.nanmax(difference[-20:]) < 0.005
    assert 'the commands of the first 180 s are taken over' in about_beginning(found)


def test_bag_of_the_middle_that_is_too_short_to_be_compared_says_so(
        day: tuple[Path, int], tmp_path: Path) -> None:
    bag, count = day
    found = replayed(rewrite(tmp_path / 'late.mcap', from_measurement(bag, count - 50)))
    assert found.check.compared == 0
    assert verdict(found) == (
        'nothing is compared: the bag is too short, the commands of the first 180 s are not '
        'compared because the run had begun before it')
    assert not reproduced(found)


@pytest.mark.parametrize(('number', 'settings', 'code', 'words'), [
    (50, [], 3, 'replay: too short, or without commands: not every bag has commands to compare'),
    (0, ['-p', 'coolant_weight:=2.0'], 1, 'replay: not all recorded commands are reproduced'),
])
def test_too_short_has_an_exit_code_of_its_own(
        day: tuple[Path, int], tmp_path: Path, capfd: pytest.CaptureFixture[str], number: int,
        settings: list[str], code: int, words: str) -> None:
    bag, count = day
    short = rewrite(tmp_path / 'late.mcap', from_measurement(bag, count - 50))
    bags = f'[{short}]' if number else f'[{bag}, {short}]'
    given = [part for name, value in SETTINGS.items() for part in ('-p', f'{name}:={value}')]
    with isolated_domain():
        assert replay.main(['replay', '--ros-args', *given, *settings, '-p', f'bags:={bags}',
                            '-p', f'output:={tmp_path}']) == code
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith(words)
    assert ('not those of the recording' in (tmp_path / 'report.md').read_text()) == (code == 1)


def test_requests_and_measurements_of_one_time(day: tuple[Path, int], tmp_path: Path) -> None:
    """A thousand requests that explain nothing are not tried out for each measurement."""
    names = Names()
    asked = [replace(entry, log_time_ns=NANOSECONDS, message=None, data=serialize_message(
        temperature(44.0 + 0.001 * k))) for k, entry in enumerate(itertools.islice(
            itertools.cycle(read_messages(day[0], [names.setpoint])), 400))]
    told = [replace(entry, log_time_ns=NANOSECONDS + k // 400)
            for topic in (names.temperature, names.command, names.active)
            for k, entry in enumerate(read_messages(day[0], [topic]))]
    attempts: list[int] = []
    with pytest.MonkeyPatch.context() as patch:
        ask = steps.ask_setpoint
        patch.setattr(steps, 'ask_setpoint',
                      lambda *values: attempts.append(1) or ask(*values))
        replayed(rewrite(tmp_path / 'one.mcap', [*asked, *told]))
    inputs = len(asked) + len(told)
    assert len(attempts) < steps._TRIALS + (steps._TRIALS_EACH + 2) * inputs


def test_setpoints_that_were_not_recorded_follow_from_what_was_tracked(
        day: tuple[Path, int], tmp_path: Path) -> None:
    bag, _ = day
    entries = (entry for entry in read_messages(bag) if entry.topic != '/setpoint')
    found = replayed(rewrite(tmp_path / 'part.mcap', entries))
    assert found.replayed.adopted > 20
    assert found.check.identical == found.check.compared


def test_controller_that_was_started_again(day: tuple[Path, int], tmp_path: Path) -> None:
    bag, count = day
    found = replayed(rewrite(tmp_path / 'two.mcap', read_messages(bag), read_messages(bag)))
    assert len(found.recorded) == 2 * count
    assert found.check.identical == found.check.compared >= 2 * (count - 3)


def test_missing_diagnostics_are_told_by_commands_that_differ(
        day: tuple[Path, int], tmp_path: Path) -> None:
    """The operator's changes of mode are recorded there alone."""
    bag, _ = day
    entries = (entry for entry in read_messages(bag) if entry.topic != '/diagnostics')
    found = replayed(rewrite(tmp_path / 'part.mcap', entries))
    assert found.check.identical < found.check.compared
    assert not found.record.models


def test_word_of_a_mode_that_comes_after_the_request_it_allows(
        day: tuple[Path, int], tmp_path: Path) -> None:
    """The recorder hears of the mode from one node, and of the request from another."""
    bag, _ = day
    late = (replace(entry, log_time_ns=entry.log_time_ns + NANOSECONDS // 20)
            if entry.topic == '/diagnostics' else entry for entry in read_messages(bag))
    found = replayed(rewrite(tmp_path / 'late.mcap', late))
    assert found.check.identical == found.check.compared
    assert found.replayed.refused == 2


def test_changes_of_the_setpoint_that_a_busy_recorder_missed_do_no_harm(
        day: tuple[Path, int], tmp_path: Path) -> None:
    """Their topic keeps the last one alone; requests are recorded late, too."""
    bag, _ = day
    changes = itertools.count()
    kept = (replace(entry, log_time_ns=entry.log_time_ns + (
                NANOSECONDS // 50 if entry.topic == '/setpoint' else 0))
            for entry in read_messages(bag)
            if entry.topic != '/active_setpoint' or next(changes) % 3)
    found = replayed(rewrite(tmp_path / 'part.mcap', kept))
    assert found.check.identical == found.check.compared


def test_lost_messages_leave_the_rest_comparable(day: tuple[Path, int], tmp_path: Path) -> None:
    bag, _ = day
    whole = replayed(bag)
    commands = itertools.count()
    entries = (entry for entry in read_messages(bag)
               if entry.topic != '/coolant_setpoint' or next(commands) not in (5, 6, 7, 30))
    found = replayed(rewrite(tmp_path / 'part.mcap', entries))
    assert found.check.identical == found.check.compared == whole.check.compared - 4
    assert found.unanswered == whole.unanswered + 4


def test_report_tells_where_the_new_model_differs(day: tuple[Path, int], tmp_path: Path) -> None:
    settings = [part for name, given in SETTINGS.items() for part in ('-p', f'{name}:={given}')]
    with isolated_domain():
        ended = subprocess.run(
            [sys.executable, '-m', 'koopman_ros.nodes.replay', '--ros-args', '--params-file',
             str(config_directory() / 'controller.yaml'), *settings, '-p', f'bags:=[{day[0]}]',
             '-p', 'new_model:=reactor_linear', '-p', 'output:=out'],
            cwd=tmp_path, capture_output=True, text=True, timeout=240, check=False)
    assert (ended.returncode, ended.stderr) == (0, '')
    assert 'reproduced to the bit' in ended.stdout
    summary = json.loads((tmp_path / 'out' / 'summary.json').read_text())
    (bag,) = summary['bags']
    assert summary['reproduced']
    assert bag['recorded_model']['identical'] == bag['recorded_model']['compared']
    new = bag['new_model']
    assert abs(new['largest_difference_K']) > 0.5
    report = (tmp_path / 'out' / 'report.md').read_text()
    assert f'{new["beyond_tolerance"]} of {new["compared"]} commands differ' in report
    assert 'not a closed loop' in report
    assert (tmp_path / 'out' / 'replay.png').read_bytes().startswith(b'\x89PNG')


def test_several_bags_and_the_shipped_parameter_file(
        day: tuple[Path, int], tmp_path: Path) -> None:
    settings = [part for name, given in SETTINGS.items() for part in ('-p', f'{name}:={given}')]
    with isolated_domain():
        code = replay.main([
            'replay', '--ros-args', '--params-file', str(config_directory() / 'replay.yaml'),
            *settings, '-p', f'bags:=[{day[0]}, {day[0]}]', '-p', f'output:={tmp_path}'])
    assert code == 0
    assert {path.name for path in tmp_path.iterdir()} == {
        'report.md', 'summary.json', 'replay_1.png', 'replay_2.png'}
    assert len(json.loads((tmp_path / 'summary.json').read_text())['bags']) == 2


@pytest.mark.parametrize(('arguments', 'words'), [
    (('-p', 'bags:=[none.mcap]'), "bag 'none.mcap' does not exist"),
    (('-p', "bags:=['']"), "bags = [''] must hold at least one path"),
    (('-p', 'new_model:=none'), 'none.safetensors'),
    (('-r', '__ns:=/unit_1'), "no message on '/unit_1/temperature', it has /active_setpoint"),
    (('-r', 'setpoint:=diagnostics', '-r', '/diagnostics:=none'), 'not laid out as sensor_msgs'),
    (('-p', 'coolant_min:=40.0'), 'coolant_min = 40.0 degC must be below'),
    (('-p', 'tolerance:=-1.0'), 'tolerance = -1.0 K must be in [0, 100] K'),
    (('-p', 'output:=/dev/null/out'), 'Not a directory'),
    (('-p', 'coolant_weight:=2.0'), 'not all recorded commands are reproduced within 0.1 K'),
])
def test_what_cannot_be_replayed_is_refused_in_one_line(
        day: tuple[Path, int], tmp_path: Path, capfd: pytest.CaptureFixture[str],
        arguments: tuple[str, ...], words: str) -> None:
    with isolated_domain():
        code = replay.main(['replay', '--ros-args', '-p', f'bags:=[{day[0]}]', '-p',
                            f'output:={tmp_path}', *arguments])
    assert code == 1
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith('replay: ')
    assert words in line


def test_missing_matplotlib_is_told_in_one_line(
        day: tuple[Path, int], monkeypatch: pytest.MonkeyPatch,
        capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.delitem(sys.modules, 'koopman_ros.nodes.replaying.figure', raising=False)
    monkeypatch.setitem(sys.modules, 'matplotlib', None)
    with isolated_domain():
        assert replay.main(['replay', '--ros-args', '-p', f'bags:=[{day[0]}]']) == 1
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith('replay: the picture needs matplotlib, which is missing: pip install')
