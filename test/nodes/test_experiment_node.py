# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The identification experiment across processes: steps on a plant, rejections, ways back."""

from itertools import pairwise
import math
from pathlib import Path
import signal

from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np
import pytest
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Temperature

from koopman_ros.control.experiment import advance, begin, ExperimentPhase
from koopman_ros.core.paths import model_path
from koopman_ros.core.units import to_celsius, to_kelvin
from koopman_ros.demo import reactor
from koopman_ros.model import load
from koopman_ros.parameters.plant import PlantTable
from koopman_ros.parameters.signal_topics import Signals
from koopman_ros.parameters.trainer_table import trainer_table
from koopman_ros.records import read_messages
from koopman_ros.ros import topics
from koopman_ros.ros.time_conversion import stamp_nanoseconds
from koopman_ros.testing import Harness
from support.nodes import seconds, temperature, value

STATUS = 'trainer: experiment'
SERVICE = 'trainer/experiment'
TRAINER, JACKET = 'unit_1/trainer', '/unit_1/jacket'
TABLE = trainer_table(load(model_path(reactor.MODEL)))
SIGNALS = Signals({'temperature': 'K'}, {'coolant_temperature': 'K'}, ('temperature',))
SAFE = round(to_celsius(float(TABLE.snapshot({}).safe_value[0])), 9)
PRESENT = PlantTable().system(PlantTable().snapshot({})).nominal_input[0]  # K
IDLE = {'record_at_start': False}
LOST = 'the trainer has released the inputs'


class Bench:
    """A trainer in a namespace with a best-effort thermometer and a coolant of another name."""

    def __init__(self, ros: Harness) -> None:
        self.ros = ros
        self.commands = ros.listen(Temperature, JACKET)
        ros.start('trainer', IDLE, ('-r', '__ns:=/unit_1', '-r', 'coolant_setpoint:=jacket'))
        self.thermometer = self.publisher(ReliabilityPolicy.BEST_EFFORT)
        self.time = 0.0
        ros.meet(TRAINER)

    def publisher(self, reliability: ReliabilityPolicy) -> Publisher:
        # rclpy raises where a publisher is destroyed while one of its events is waiting
        return self.ros.node.create_publisher(
            Temperature, '/unit_1/temperature', QoSProfile(depth=10, reliability=reliability),
            event_callbacks=PublisherEventCallbacks(use_default_callbacks=False))

    def ask(self, begin: bool) -> tuple[bool, str]:
        response = self.ros.set_bool(f'unit_1/{SERVICE}', begin)
        return response.success, response.message

    def set(self, **parameters: object) -> None:
        for result in self.ros.set_parameters(TRAINER, **parameters):
            assert result.successful, result.reason

    def start(self, celsius: float = 45.0) -> tuple[bool, str]:
        """Start an experiment, measuring all the while; return what the service answers."""
        timer = self.ros.node.create_timer(0.02, lambda: self.measure(celsius))
        answer = self.ask(True)
        self.ros.node.destroy_timer(timer)
        return answer

    def measure(self, celsius: float = 45.0) -> None:
        self.time += 1.0
        self.thermometer.publish(temperature(celsius, self.time))

    def answer(self, celsius: float = 45.0) -> float:
        self.measure(celsius)
        self.ros.wait_until(lambda: self.commands and seconds(self.commands[-1]) == self.time)
        return float(self.commands[-1].temperature)

    def status(self, words: str) -> DiagnosticStatus:
        return self.ros.wait_for_status(f'unit_1/{STATUS}', lambda s: words in s.message)


def start_with_plant(ros: Harness, subscribers: int = 2, **trainer: object) -> list[Temperature]:
    """Start both, and an experiment that both know of; return the measurements to come."""
    measured = ros.listen(Temperature, reactor.TEMPERATURE)
    ros.start('trainer', {**IDLE, **trainer})
    ros.start('plant', {'lockstep': True, 'speed': 150.0, 'lockstep_subscribers': subscribers})
    ros.meet('plant')
    response = ros.set_bool(SERVICE, True)
    assert response.success, response.message
    assert response.message == 'started on /coolant_setpoint'
    return measured


def test_steps_drive_the_plant_as_planned(ros: Harness) -> None:
    commands = ros.listen(Temperature, reactor.COOLANT_SETPOINT)
    given = {'experiment_length': 150.0, 'experiment_seed': 5, 'experiment_min_hold_time': 8.0,
             'experiment_max_hold_time': 30.0}
    measured = start_with_plant(ros, **given)
    status = ros.wait_for_status(STATUS, lambda s: s.message.startswith('finished'))
    assert status.level == DiagnosticStatus.OK
    assert status.message.startswith('finished; coolant to 18.85 degC')
    ros.wait_until(lambda: len(commands) > 180)

    plan = TABLE.snapshot(given).experiment(SIGNALS)
    # the first ones may have been given before the bench was known
    heard = {seconds(message): message for message in commands}
    assert all(late - early == 1.0 for early, late in pairwise(heard))
    assert np.ptp([message.temperature for message in commands]) > 12.0
    assert commands[-1].temperature == pytest.approx(SAFE, abs=1e-12)
    # from the present input of the plant, before the first command
    progress = begin(plan, stamp_nanoseconds(measured[0].header.stamp), np.array([PRESENT]))
    for message in measured:
        progress = advance(plan, progress, np.array([to_kelvin(message.temperature)]),
                           stamp_nanoseconds(message.header.stamp))
        if command := heard.pop(seconds(message), None):
            assert command.header == message.header
            assert command.temperature == to_celsius(float(progress.command[0]))
    # a command may be heard before its measurement
    assert len(heard) <= 1
    assert progress.phase is ExperimentPhase.FINISHED


@pytest.fixture(scope='module')
def shared_bench(shared_ros: Harness) -> Bench:
    return Bench(shared_ros)


def test_an_obstacle_prevents_the_start_of_an_experiment(shared_bench: Bench) -> None:
    bench, ros = shared_bench, shared_bench.ros
    for celsius, words in (
            (60.0, 'the temperature 60.00 degC is outside the bounds of the experiment, 31.85 '
             'degC to 53.85 degC'), (math.nan, 'is nan, not finite: check the sensor')):
        started, said = bench.start(celsius)
        assert not started
        assert said.startswith('rejected: ')
        assert words in said
        assert bench.status(words).level == DiagnosticStatus.WARN
        assert bench.commands == []
        ros.wait_until(lambda: ros.node.count_publishers(JACKET) == 0)

    bench.set(experiment_timeout=0.3)
    assert bench.ask(True)[1] == (
        'rejected: no newer measurement for more than 0.3 s: check sensor and plant')
    # a busy machine may be as slow
    bench.set(experiment_timeout=10.0, experiment_signal='manual')
    assert 'start the controller and switch it to manual mode' in bench.start()[1]


def test_service_ends_the_steps_and_then_lets_go(shared_bench: Bench) -> None:
    bench, ros = shared_bench, shared_bench.ros
    assert bench.ask(False)[1] == 'no experiment is running'
    assert bench.start() == (True, 'started on /unit_1/jacket')
    assert not bench.ask(True)[0]
    for _ in range(20):
        bench.answer()
    assert bench.answer() != pytest.approx(SAFE, abs=0.5)
    assert value(bench.status('running'), 'topic') == JACKET

    assert bench.ask(False)[1].startswith('ended: coolant to 18.85 degC')
    bench.status('ended; coolant to 18.85 degC')
    for _ in range(20):
        bench.answer()
    assert bench.answer() == pytest.approx(SAFE)
    assert bench.ask(False)[1] == LOST
    ros.wait_until(lambda: ros.node.count_publishers(JACKET) == 0)
    ros.wait_for_status(f'unit_1/{STATUS}', lambda s: s.message == 'ended')


def test_silent_sensor_brings_the_safe_coolant(shared_bench: Bench) -> None:
    bench, ros = shared_bench, shared_bench.ros
    bench.set(experiment_timeout=0.5, **{'coolant_temperature.experiment_rate_limit': 10.0})
    # which a busy machine may miss
    ros.wait_until(lambda: bench.start()[0])
    for _ in range(5):
        bench.answer()
    status = bench.status('no newer measurement for more than 0.5 s')
    assert status.level == DiagnosticStatus.ERROR
    ros.wait_until(lambda: bench.commands[-1].temperature == pytest.approx(SAFE, abs=1e-9))
    heard = len(bench.commands)
    ros.wait_until(lambda: len(bench.commands) > heard + 2)
    # a sensor that comes back is answered, with the same
    assert bench.answer() == pytest.approx(SAFE, abs=1e-9)
    assert bench.ask(False)[1] == LOST


def test_thermometer_of_another_reliability_takes_over(ros: Harness) -> None:
    """The subscription follows the publishers during an experiment, too."""
    bench = Bench(ros)
    bench.set(experiment_timeout=30.0)

    def replace(reliability: ReliabilityPolicy) -> None:
        ros.node.destroy_publisher(bench.thermometer)
        bench.thermometer = bench.publisher(reliability)

    replace(ReliabilityPolicy.RELIABLE)
    assert bench.start()[0]
    replace(ReliabilityPolicy.BEST_EFFORT)
    before = len(bench.commands)
    timer = ros.node.create_timer(0.05, bench.measure)
    ros.wait_until(lambda: len(bench.commands) > before + 3)
    ros.node.destroy_timer(timer)
    # it still steps: the commands were answers, not the return of a run that hears nothing
    assert bench.ask(False)[1].startswith('ended: ')
    assert bench.ask(False)[1] == LOST


def test_another_commander_ends_it_at_once_and_rejects_the_next(shared_bench: Bench) -> None:
    bench, ros = shared_bench, shared_bench.ros
    assert bench.start()[0]
    bench.answer()
    other = ros.node.create_publisher(Temperature, JACKET, topics.LOOP_QOS)
    status = bench.status('aborted')
    assert status.level == DiagnosticStatus.ERROR
    # found, perhaps, before its name is
    assert status.message.startswith(('aborted: /bench sends', 'aborted: another node sends'))
    assert JACKET in status.message
    ros.wait_until(lambda: ros.node.count_publishers(JACKET) == 1)
    assert ros.wait_until(lambda: '/bench publishes' in (answer := bench.start())[1]
                          and answer) == (
        False, 'rejected: /bench publishes on /unit_1/jacket: stop it, or choose another '
        'experiment_signal')
    ros.node.destroy_publisher(other)


def test_one_input_in_manual_mode_until_the_controller_moves_it_elsewhere(
        shared_bench: Bench) -> None:
    bench, ros = shared_bench, shared_bench.ros
    manual = ros.listen(Temperature, '/unit_1/manual_coolant_setpoint')
    controller = ros.node.create_publisher(Temperature, JACKET, topics.LOOP_QOS)
    bench.set(experiment_signal='manual')
    # until the graph shows the controller to the trainer
    ros.wait_until(lambda: bench.start() == (True, 'started on /unit_1/manual_coolant_setpoint'))

    def request() -> Temperature:
        bench.measure()
        ros.wait_until(lambda: manual and seconds(manual[-1]) == bench.time)
        return manual[-1]

    # over more than one step
    while len(manual) < 2 or np.ptp([message.temperature for message in manual]) < 2.0:
        controller.publish(request())
    assert value(bench.status('running'), 'topic') == '/unit_1/manual_coolant_setpoint'

    timer = ros.node.create_timer(0.05, lambda: controller.publish(
        temperature(manual[-1].temperature + 5.0, bench.time)))
    status = bench.status('switch it to manual mode')
    assert status.level == DiagnosticStatus.ERROR
    ros.node.destroy_timer(timer)
    ros.node.destroy_publisher(controller)
    bench.ask(False)


def test_process_that_ends_without_measurements_leaves_the_inputs_where_they_are(
        shared_bench: Bench) -> None:
    bench, ros = shared_bench, shared_bench.ros
    # until the graph tells the trainer that no other commands
    ros.wait_until(lambda: bench.start()[0])
    while abs(last := bench.answer()) > SAFE - 3.0:
        pass
    process, = ros.processes
    assert process.stop(signal.SIGTERM) == 0
    assert bench.commands[-1].temperature == last
    assert 'held there' in process.output()


def test_reactor_that_leaves_its_bounds_and_trainer_that_ends_leave_the_safe_coolant(
        ros: Harness, tmp_path: Path) -> None:
    bag = tmp_path / 'run.mcap'
    commands = ros.listen(Temperature, reactor.COOLANT_SETPOINT)
    measured = start_with_plant(
        ros, 3, **{'experiment_length': 60000.0}, record_at_start=True, output=bag)
    ros.wait_until(lambda: len(commands) > 50)
    ros.set_parameters('plant', **{'constants.feed_temperature': -20.0})
    status = ros.wait_for_status(STATUS, lambda s: s.level == DiagnosticStatus.ERROR)
    assert status.message.startswith('aborted: the temperature ')
    assert 'is outside the bounds of the experiment, 31.85 degC to 53.85 degC' in status.message
    assert '; coolant to 18.85 degC' in status.message
    # 10 K at 1 K/s, and then for good
    first = ros.wait_until(lambda: next(
        (k for k, message in enumerate(measured) if message.temperature < 31.85), None))
    ros.wait_until(lambda: len(commands) > first + 50)
    assert {round(message.temperature, 9) for message in commands[first + 12:]} == {SAFE}

    ros.set_parameters('plant', **{
        'constants.feed_temperature': reactor.constant('feed_temperature')})
    assert ros.trigger('plant/reset').success
    # which has set the coolant back, too: the next steps begin where the trainer holds it again
    reset = len(commands)
    ros.wait_until(lambda: len(commands) > reset + 5)
    assert ros.set_bool(SERVICE, True).success
    ros.wait_until(lambda: abs(commands[-1].temperature - SAFE) > 2.0)
    last = seconds(commands[-1])
    assert ros.processes[0].stop() == 0
    ros.wait_for_status('plant: simulation', lambda s: (
        float(value(s, 'time [s]')) > last
        and float(value(s, 'coolant [degC]')) == pytest.approx(SAFE)))
    # from the present input on, and at the end of the process
    recorded = [entry.message.temperature for entry in read_messages(bag, ['/coolant_setpoint'])]
    assert recorded[-1] == pytest.approx(SAFE)
    assert max(abs(b - a) for a, b in pairwise([to_celsius(PRESENT), *recorded])) <= 1.0 + 1e-9
    assert 'Traceback' not in ros.printed()
