# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The plant as a process: its measurements, its time, and what it does with commands."""

from collections.abc import Callable, Mapping
from itertools import pairwise
import math
import time
from types import SimpleNamespace

from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np
import pytest
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.node import Node
from sensor_msgs.msg import JointState, Temperature

from koopman_ros.core.units import LAST_STAMP_SECONDS, NANOSECONDS, seconds_text
from koopman_ros.demo import reactor
from koopman_ros.nodes import plant as plant_module
from koopman_ros.nodes.plant import PlantNode
from koopman_ros.parameters.plant import PlantTable
from koopman_ros.parameters.table import ConfigurationError
from koopman_ros.plants import sensor_noise
from koopman_ros.ros import topics
from koopman_ros.ros.simulated_plant import Analyser
from koopman_ros.ros.time_conversion import stamp_nanoseconds
from koopman_ros.testing import Harness
from support.nodes import RunNode, seconds, temperature, value

STATUS = 'plant: simulation'
NOMINAL_COOLANT = 26.85  # degC
SEED = 3
TABLE = PlantTable()


class Bench:
    """A lock-step plant whose every measurement the test answers with a coolant."""

    def __init__(self, ros: Harness, run_node: Callable[..., object],
                 before: Callable[[], object] = lambda: None, **parameters: object) -> None:
        self.ros = ros
        self.coolant = NOMINAL_COOLANT
        self.answering = True
        self.measured: list[Temperature] = []
        self.commanded: dict[float, float] = {}  # by the stamp that is answered
        self.sent_ns: list[int] = []  # when each was measured
        ros.node.create_subscription(
            Temperature, reactor.TEMPERATURE, self._on_measurement, topics.LOOP_QOS)
        run_node(PlantNode, {
            'lockstep': True, 'speed': 0.0, 'lockstep_timeout': 3600.0, **parameters})
        before()
        self._commands = ros.node.create_publisher(
            Temperature, reactor.COOLANT_SETPOINT, topics.LOOP_QOS)

    def _on_measurement(self, message: Temperature, info: Mapping[str, int]) -> None:
        self.sent_ns.append(info['source_timestamp'])
        self._answer(message)

    def _answer(self, message: Temperature) -> None:
        self.measured.append(message)
        if self.answering:
            self.commanded[seconds(message)] = self.coolant
            self._commands.publish(
                Temperature(header=message.header, temperature=self.coolant))

    def pause(self) -> float:
        self.answering = False
        self.ros.wait_until(lambda: seconds(self.measured[-1]) not in self.commanded)
        return seconds(self.measured[-1])

    def resume(self) -> None:
        """Answer again, beginning with the last measurement."""
        self.answering = True
        self._answer(self.measured.pop())

    def set(self, **parameters: float) -> None:
        for result in self.ros.set_parameters('plant', **parameters):
            assert result.successful, result.reason

    def status(self, condition: Callable[[DiagnosticStatus], bool]) -> DiagnosticStatus:
        return self.ros.wait_for_status(STATUS, condition)

    def start_afresh(self) -> None:
        """Bring the plant back to its steady state, and forget the rest."""
        self.coolant = NOMINAL_COOLANT
        self.ros.trigger('plant/reset')
        self.wait_for_more(3)
        del self.measured[:], self.ros.statuses[:]
        self.commanded.clear()

    def wait_for(self, condition: Callable[[float], bool]) -> None:
        self.ros.wait_until(lambda: self.measured and condition(self.measured[-1].temperature))

    def wait_for_more(self, count: int) -> list[Temperature]:
        present = len(self.measured)
        self.ros.wait_until(lambda: len(self.measured) >= present + count)
        return self.measured[present:present + count]


@pytest.fixture(scope='module')
def shared_bench(shared_ros: Harness) -> Bench:
    # no quicker: it works on while something else is waited for
    return Bench(shared_ros, lambda _, parameters: shared_ros.start('plant', parameters),
                 seed=SEED, speed=100.0)


@pytest.fixture
def bench(shared_bench: Bench) -> Bench:
    shared_bench.start_afresh()
    return shared_bench


def test_sensor_is_noisy_biased_and_coarse_as_it_is_set_while_it_runs(bench: Bench) -> None:
    (steady,) = bench.wait_for_more(1)
    assert steady.variance == 0.0
    bench.set(**{'temperature.measurement_noise': 0.5})
    bench.ros.wait_until(lambda: bench.measured[-1].variance > 0.0)
    measured = bench.wait_for_more(50)
    assert {message.variance for message in measured} == {0.25}
    # the first sample is that of 1 s
    assert [message.temperature for message in measured] == pytest.approx(
        [steady.temperature + sensor_noise(0.5, SEED, round(seconds(message)) - 1)
         for message in measured], abs=1e-6)

    bench.set(**{'temperature.measurement_noise': 0.0, 'temperature.bias': 2.0})
    bench.wait_for(lambda celsius: celsius == pytest.approx(steady.temperature + 2.0, abs=1e-6))
    biased = seconds(bench.measured[-1])
    status = bench.status(lambda s: float(value(s, 'time [s]')) >= biased)
    assert float(value(status, 'temperature [degC]')) == pytest.approx(
        steady.temperature, abs=1e-6)

    bench.set(**{'temperature.bias': 0.0, 'temperature.resolution': 0.25})
    bench.ros.wait_until(lambda: bench.measured[-1].variance > 0.0)
    bench.coolant = 25.0
    measured = bench.wait_for_more(50)
    assert {message.temperature % 0.25 for message in measured} == {0.0}
    assert {message.variance for message in measured} == {0.25 ** 2 / 12.0}
    assert len({message.temperature for message in measured}) > 3


def test_real_time_stamps_are_the_wall_clock_and_silence_is_reported_while_it_lasts(
        ros: Harness, run_node: RunNode, capfd: pytest.CaptureFixture[str]) -> None:
    """Of a plant, here, that has no steady state to start from."""
    heard = ros.listen(Temperature, reactor.TEMPERATURE)
    run_node(PlantNode, {'sample_period': 0.1, 'constants.heat_transfer_coefficient': 0.0})
    ros.wait_until(lambda: len(heard) >= 5)
    # the clock last, since further messages arrive meanwhile
    stamps = [stamp_nanoseconds(message.header.stamp) for message in heard]
    now = time.time_ns()
    assert heard[0].temperature == pytest.approx(51.7, abs=1.0)
    assert 'the plant starts at' in capfd.readouterr().err
    assert 0 <= now - stamps[-1] < 5_000_000_000
    assert all((late - early) % 100_000_000 == 0 and late > early
               for early, late in pairwise(stamps))
    assert ros.node.count_publishers(topics.CLOCK) == 0
    # or it would run away before long
    ros.set_parameters('plant', **{'constants.heat_transfer_coefficient': reactor.constant(
        'heat_transfer_coefficient')})
    # also where none ever came
    ros.wait_for_status(STATUS, lambda s: s.level == DiagnosticStatus.WARN and (
        'no command is received' in s.message))
    command = ros.speak(Temperature, reactor.COOLANT_SETPOINT, to='plant')
    command.publish(temperature(26.0))
    ros.wait_for_status(STATUS, lambda s: s.message == 'running' and float(
        value(s, 'coolant command [degC]')) == pytest.approx(26.0))


def test_lockstep_waits_for_a_controller_and_is_paced(ros: Harness, run_node: RunNode) -> None:
    """Of the two-state reactor, which stays at its steady state."""
    def wait() -> None:
        ros.wait_for_status(STATUS, lambda s: s.level == DiagnosticStatus.WARN and (
            s.message == 'waiting for a controller or trainer to subscribe'))

    concentrations = ros.listen(JointState, reactor.CONCENTRATION)
    bench = Bench(ros, run_node, wait, system='two_state', speed=20.0, sample_period=0.5,
                  start_time=7.0)
    measured = bench.wait_for_more(21)
    assert [seconds(message) for message in measured] == [7.0 + 0.5 * k for k in range(21)]
    assert [message.temperature for message in measured] == pytest.approx(
        [measured[0].temperature] * 21, abs=1e-6)
    # 10 s of plant time at twenty times real time, the first tick maybe at once, or late by one
    assert bench.sent_ns[20] - bench.sent_ns[0] >= 0.449e9
    ros.wait_until(lambda: len(concentrations) >= 20)
    for message in concentrations:
        assert message.name == ['reactant_concentration [mol/L]']
        assert list(message.position) == pytest.approx([0.87725294608097], abs=1e-8)
    # of one measurement one topic is heard first
    stamps = {seconds(message) for message in concentrations[:20]}
    ros.wait_until(lambda: stamps <= {seconds(message) for message in bench.measured})


def test_an_analyser_measures_rarely_and_its_values_come_late() -> None:
    sent: list[tuple[int, int, float]] = []
    publisher = SimpleNamespace(send=lambda values, stamp, _: sent.append(
        (now, stamp.sec, float(values[0]))))
    analyser = Analyser(publisher, 1, 180 * 10 ** 9, 120 * 10 ** 9)
    for now in range(0, 600, 7):
        analyser.sample(now * 10 ** 9, np.array([-1.0, float(now)]), 'plant')
    assert [(stamp, shown) for _, stamp, shown in sent] == [(0, 0.0), (182, 182.0), (364, 364.0)]
    assert [came - stamp for came, stamp, _ in sent] == [126, 126, 126]


def test_a_valve_of_equal_percentage_needs_its_range() -> None:
    table = PlantTable({'system': 'heated_line'})
    assert 'set valve.min and valve.max' in table.check(table.amended(
        table.snapshot({}), **{'valve.max': 1e9}))


def test_reset_returns_to_the_start_until_the_duration_is_over(
        ros: Harness, run_node: RunNode) -> None:
    bench = Bench(ros, run_node, start_time=10.0, duration=210.0, sample_period=0.7,
                  **{'temperature.initial_offset': -5.0})
    initial = bench.wait_for_more(1)[0].temperature
    bench.wait_for(lambda celsius: celsius > initial + 1.0)
    bench.pause()
    assert ros.trigger('plant/reset').message == (
        f'reset to temperature {initial:.6g} degC, coolant {NOMINAL_COOLANT:.6g} degC')
    bench.resume()
    assert bench.wait_for_more(1)[0].temperature == pytest.approx(initial, abs=0.5)
    bench.status(lambda s: s.message == 'finished: simulated duration reached')
    ros.wait_until(lambda: len(bench.measured) >= 301)
    assert [seconds(message) for message in bench.measured] == pytest.approx(
        [10.0 + 0.7 * k for k in range(301)], abs=1e-9)
    assert not ros.trigger('plant/reset').success


def test_replay_stops_at_the_last_stamp(ros: Harness, run_node: RunNode) -> None:
    bench = Bench(ros, run_node, start_time=LAST_STAMP_SECONDS - 7.0)
    status = bench.status(lambda s: s.level == DiagnosticStatus.ERROR)
    assert 'smaller start_time' in status.message
    # all digits
    assert value(status, 'time [s]') == '2147483647'
    ros.wait_until(lambda: bench.measured[-1].header.stamp.sec == LAST_STAMP_SECONDS)
    assert not ros.trigger('plant/reset').success


def test_stamps_and_frames_that_a_message_can_hold() -> None:
    for parameters in ({'start_time': 2147483647.0}, {'frame_id': 'x' * 256}):
        assert TABLE.check(TABLE.snapshot(parameters)) == ''
    with pytest.raises(ConfigurationError, match=r'must be in \[0.001, 2147483647\] s'):
        TABLE.snapshot({'start_time': 2147483648.0})
    for parameters, words in (
            ({'start_time': 2e9, 'duration': 1e9}, 'start_time + duration = 3000000000 s must be'),
            ({'frame_id': 'x' * 50_000}, 'frame_id has 50000 characters, the maximum is 256')):
        assert words in TABLE.check(TABLE.snapshot(parameters))


def test_time_is_written_with_all_digits() -> None:
    assert [seconds_text(ns) for ns in (0, 1_700_000_000_250_000_001, -500_000_000)] == [
        '0', '1700000000.250000001', '-0.5']


def test_the_applied_coolant_is_published_before_each_measurement_and_latched(
        bench: Bench) -> None:
    sent: dict[str, list[tuple[float, int, float]]] = {'coolant': [], 'measured': []}
    for name, topic in (
            ('coolant', reactor.COOLANT_TEMPERATURE), ('measured', reactor.TEMPERATURE)):
        bench.ros.node.create_subscription(
            Temperature, topic, lambda message, info, name=name: sent[name].append(
                (seconds(message), info['source_timestamp'], message.temperature)),
            topics.LOOP_QOS)
    bench.ros.meet('plant')
    bench.coolant = 25.0
    bench.ros.wait_until(lambda: min(map(len, sent.values())) >= 20)
    coolants = {stamp: (at, celsius) for stamp, at, celsius in sent['coolant']}
    told = [(stamp, coolants[stamp][0], at) for stamp, at, _ in sent['measured'][:15]]
    assert all(coolant_at <= measured_at for _, coolant_at, measured_at in told)
    # what acted until then is the answer to the measurement before
    for stamp, *_ in told[1:]:
        assert coolants[stamp][1] == pytest.approx(bench.commanded[stamp - 1.0], abs=1e-9)
    bench.wait_for_more(3)
    bench.pause()
    late = bench.ros.listen(Temperature, reactor.COOLANT_TEMPERATURE, topics.LATCHED_QOS)
    bench.ros.wait_until(lambda: late and late[-1].header == bench.measured[-1].header)
    assert late[-1].temperature == pytest.approx(25.0)
    bench.resume()


@pytest.mark.parametrize(('parameters', 'expected'), [
    ({'coolant_temperature.lag': 8.0},
     lambda n: 20.0 + (NOMINAL_COOLANT - 20.0) * math.exp(-n / 8.0)),
    # in force for the first time in the hold that ends three samples later
    ({'coolant_temperature.delay': 2.0}, lambda n: NOMINAL_COOLANT if n < 3 else 20.0),
    # a range that narrows leaves the command
    ({'coolant_temperature.min': 22.5}, lambda n: NOMINAL_COOLANT if n == 0 else 22.5),
])
def test_coolant_follows_its_command_as_the_actuator_lets_it(
        bench: Bench, parameters: dict[str, float], expected: Callable[[int], float]) -> None:
    bench.set(**parameters)
    heard = bench.ros.listen(Temperature, reactor.COOLANT_TEMPERATURE)
    bench.ros.meet('plant')
    bench.wait_for_more(3)
    bench.coolant = 20.0
    last = seconds(bench.wait_for_more(30)[-1])
    bench.ros.wait_until(lambda: heard and seconds(heard[-1]) >= last)
    in_force = {seconds(message): message.temperature for message in heard}
    step = next(stamp for stamp, celsius in bench.commanded.items() if celsius == 20.0)
    assert [in_force[step + n] for n in range(20)] == pytest.approx(
        [expected(n) for n in range(20)], abs=1e-6)


def test_command_beyond_the_range_is_limited_and_one_that_is_no_number_rejected(
        bench: Bench) -> None:
    bench.coolant = -200.0
    bench.wait_for_more(5)
    bench.coolant = math.nan
    status = bench.status(lambda s: s.level == DiagnosticStatus.WARN and (
        s.message.startswith('coolant command nan degC')))
    assert int(value(status, 'rejected commands')) >= 1
    assert float(value(status, 'coolant [degC]')) == pytest.approx(-20.0)
    bench.coolant = NOMINAL_COOLANT
    bench.status(lambda s: s.level == DiagnosticStatus.OK)


def test_command_that_answers_no_open_measurement_is_not_taken(bench: Bench) -> None:
    bench.wait_for_more(5)
    stamp = bench.pause()
    strangers = bench.ros.speak(Temperature, reactor.COOLANT_SETPOINT, to='plant')
    strangers.publish(temperature(10.0, stamp - 1.0))
    status = bench.status(lambda s: value(s, 'foreign commands') == '1')
    assert float(value(status, 'coolant [degC]')) == pytest.approx(NOMINAL_COOLANT)
    assert seconds(bench.measured[-1]) == stamp
    strangers.publish(temperature(25.0, stamp))
    assert seconds(bench.wait_for_more(1)[0]) == stamp + 1.0
    bench.ros.node.destroy_publisher(strangers)
    bench.resume()


def test_runaway_stops_the_plant_and_reset_recovers_it(bench: Bench) -> None:
    bench.coolant = 40.0
    status = bench.status(lambda s: s.level == DiagnosticStatus.ERROR)
    assert status.message.startswith('stopped: ')
    assert status.message.endswith('; call ~/reset')
    bench.coolant = NOMINAL_COOLANT
    assert bench.ros.trigger('plant/reset').success
    bench.wait_for(lambda celsius: celsius < 55.0)
    for message in bench.wait_for_more(20):
        assert message.temperature == pytest.approx(bench.measured[0].temperature, abs=0.01)
    bench.status(lambda s: s.level == DiagnosticStatus.OK)


def test_constants_of_the_reactor_change_while_it_runs_except_fixed_ones(bench: Bench) -> None:
    steady = bench.wait_for_more(1)[0].temperature
    bench.set(**{'constants.concentration': 850.0})
    bench.wait_for(lambda celsius: celsius < steady - 0.5)
    (result,) = bench.ros.set_parameters('plant', speed=2.0)
    assert not result.successful
    assert 'read-only parameter: speed' in result.reason
    assert bench.ros.get_parameters('plant', 'constants.concentration', 'speed') == [850.0, 100.0]


def test_other_publishers_are_named_while_they_exist(bench: Bench) -> None:
    bench.status(lambda s: s.level == DiagnosticStatus.OK)
    intruder = Node('intruder', context=bench.ros.node.context, namespace='/elsewhere')
    for topic in (reactor.COOLANT_SETPOINT, reactor.TEMPERATURE):
        intruder.create_publisher(Temperature, f'/{topic}', topics.LOOP_QOS)
    # names come a moment after their topics
    status = bench.ros.wait_for_status(STATUS, lambda s: (
        s.message.count('stop all but one') == 2 and 'another node' not in s.message))
    assert status.message == (
        '2 nodes command the coolant: /bench, /elsewhere/intruder; stop all but one; '
        '2 nodes publish the temperature: /elsewhere/intruder, /plant; stop all but one')
    intruder.destroy_node()
    bench.status(lambda s: (s.level, s.message) == (DiagnosticStatus.OK, 'running'))


def test_a_second_publisher_of_one_name_is_named_once_it_sends(bench: Bench) -> None:
    """The middleware knows one that was killed until its lease has expired."""
    bench.wait_for_more(1)
    silent = bench.ros.node.create_publisher(
        Temperature, reactor.COOLANT_SETPOINT, topics.LOOP_QOS)
    other = Node('other', context=bench.ros.node.context)
    other.create_publisher(Temperature, f'/{reactor.COOLANT_SETPOINT}', topics.LOOP_QOS)
    # the plant has found both
    status = bench.status(lambda s: '/other' in s.message and 'another node' not in s.message)
    assert status.message == '2 nodes command the coolant: /bench, /other; stop all but one'
    other.destroy_node()
    bench.status(lambda s: s.level == DiagnosticStatus.OK)

    def send() -> bool:
        silent.publish(Temperature(header=bench.measured[-1].header, temperature=bench.coolant))
        return '/bench, /bench' in bench.ros.last_status(STATUS).message

    bench.ros.wait_until(send)
    assert 'has died' not in bench.ros.last_status(STATUS).message
    bench.ros.node.destroy_publisher(silent)
    bench.status(lambda s: (s.level, s.message) == (DiagnosticStatus.OK, 'running'))


def test_the_time_of_an_inactive_plant_does_not_advance(
        shared_ros: Harness, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr(plant_module, 'time', SimpleNamespace(
        monotonic=lambda: clock.now, time_ns=time.time_ns))
    context = shared_ros.node.context
    node = PlantNode(context=context, cli_args=[
        '--ros-args', '-p', 'speed:=5.0', '-r', '__ns:=/still'])
    node.start()
    measured = shared_ros.listen(Temperature, '/still/temperature')
    shared_ros.wait_until(lambda: node.count_subscribers('/still/temperature'))

    def tick(seconds: float) -> None:
        clock.now += seconds
        node._step_in_time()

    for _ in range(4):
        tick(0.2)
    assert node.trigger_deactivate() == TransitionCallbackReturn.SUCCESS
    tick(0.1)
    clock.now += 30.0
    tick(0.1)
    assert node.trigger_activate() == TransitionCallbackReturn.SUCCESS
    for _ in range(4):
        tick(0.2)
    shared_ros.wait_until(lambda: len(measured) >= 8)
    node.destroy_node()
    assert [seconds(late) - seconds(early) for early, late in pairwise(measured)] == [1.0] * 7


def test_stamps_are_never_ahead_of_the_clock(
        shared_ros: Harness, monkeypatch: pytest.MonkeyPatch) -> None:
    """In real time, where a busy machine is late by more than half a period."""
    clock = SimpleNamespace(now=1000.0)
    monkeypatch.setattr(plant_module, 'time', SimpleNamespace(
        monotonic=lambda: clock.now, time_ns=lambda: round(clock.now * NANOSECONDS)))
    node = PlantNode(context=shared_ros.node.context, cli_args=['--ros-args', '-r', '__ns:=/late'])
    node.start()
    measured = shared_ros.listen(Temperature, '/late/temperature')
    shared_ros.wait_until(lambda: node.count_subscribers('/late/temperature'))
    for wait in (0.0, 1.6, 0.4, 1.0, 2.7, 0.3):
        clock.now += wait
        node._step_in_time()
    shared_ros.wait_until(lambda: len(measured) >= 6)
    node.destroy_node()
    assert [seconds(message) for message in measured] == [
        1000.0, 1001.0, 1002.0, 1003.0, 1005.0, 1006.0]
