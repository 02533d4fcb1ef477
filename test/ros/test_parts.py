# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Parts of nodes: what goes with them; what a recorder and a plan write."""

from collections.abc import Callable
from dataclasses import replace
import math
from pathlib import Path
import threading
import time
from types import SimpleNamespace
from typing import Any

from builtin_interfaces.msg import Time
import numpy as np
import pytest
from rclpy.duration import Duration
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription
from rclpy.task import Future
from rclpy.utilities import get_rmw_implementation_identifier
from sensor_msgs.msg import Temperature

from koopman_ros.control import Controller, Mode, State, StepReport
from koopman_ros.control.laws import Plan
from koopman_ros.core.paths import model_path
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.demo import reactor
from koopman_ros.model import load, RateBand
from koopman_ros.nodes.controller import ControllerNode
from koopman_ros.nodes.plant import PlantNode
from koopman_ros.nodes.trainer import TrainerNode
from koopman_ros.parameters.controller import built, table_of
from koopman_ros.parameters.signal_topics import Signals, signals_of
from koopman_ros.records import BagWriter, read_messages
from koopman_ros.ros import recorder, topics
from koopman_ros.ros.controller_messages import active_constraints, planned
from koopman_ros.ros.controller_status import Counts, statuses
from koopman_ros.ros.diagnostics import Severity
from koopman_ros.ros.managed import ManagedNode
from koopman_ros.ros.missed_messages import MissedMessages
from koopman_ros.ros.rclpy_internals import take_message
from koopman_ros.ros.recorder import receipt_ns, Recorder
from koopman_ros.ros.remote_node import repeated
from koopman_ros.ros.signals import MeasuredInputs, SignalSample
from koopman_ros.testing import Harness
from support.nodes import temperature, TIMEOUT

NAMES = (reactor.TEMPERATURE, reactor.SETPOINT, reactor.COOLANT_SETPOINT)


@pytest.mark.parametrize('create', [PlantNode, ControllerNode, TrainerNode])
def test_clean_up_removes_everything_that_a_node_created(
        shared_ros: Harness, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
        create: Callable[..., ManagedNode]) -> None:
    # a training that loads no library, and ends when it is asked to
    monkeypatch.setattr('koopman_ros.execution.training.TrainingJob.command', lambda *_: (
        'sh', '-c', 'cat > /dev/null'))
    node = create(context=shared_ros.node.context, cli_args=[
        '--ros-args', '-p', f'output:={tmp_path}/bag', '-p', f'bags:=[{tmp_path}/missing]'])

    def created() -> tuple[object, ...]:
        return (*map(set, (node.publishers, node.subscriptions, node.services, node.timers)),
                set(threading.enumerate()), tuple(node.diagnostics.tasks))

    before = created()
    node.start()
    if isinstance(node, TrainerNode):
        assert node._experiment is not None
        assert node._training is not None
        assert node._experiment._start() == ''
        node._training.start()
    assert created() != before
    assert node.trigger_deactivate() == TransitionCallbackReturn.SUCCESS
    assert node.trigger_cleanup() == TransitionCallbackReturn.SUCCESS
    assert created() == before
    node.destroy_node()


def stamped_at_the_take(subscription: Subscription, raw: bool) -> Any:
    """Take a message as rmw_cyclonedds does, which says that it was received just now."""
    taken = take_message(subscription, raw)
    return taken and (taken[0], {**taken[1], 'received_timestamp': time.time_ns()})


@pytest.mark.parametrize('at_the_take', [False, True])
def test_batch_is_recorded_in_the_order_of_sending(
        ros: Harness, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at_the_take: bool
        ) -> None:
    if at_the_take:
        monkeypatch.setattr(recorder, 'take_message', stamped_at_the_take)
        monkeypatch.setattr(recorder, '_STAMPED_AT_TAKE', (get_rmw_implementation_identifier(),))
    publishers = [ros.node.create_publisher(Temperature, name, topics.LOOP_QOS) for name in NAMES]
    recording = Recorder(ros.node, BagWriter(tmp_path / 'run.mcap'), NAMES,
                         dict.fromkeys(NAMES, (Temperature, topics.LOOP_QOS)))
    ros.wait_until(lambda: all(p.get_subscription_count() for p in publishers))
    recording.take()
    sent = []
    for k in range(90):
        publisher = publishers[(k * k) % 7 % 3]
        publisher.publish(temperature(float(k)))
        # one after the other, for a middleware that tells when they arrived
        assert publisher.wait_for_all_acked(Duration(seconds=TIMEOUT))
        sent.append((publisher.topic_name, float(k)))
    before = time.time_ns()
    recording.take()
    recording.close()
    messages = list(read_messages(tmp_path / 'run.mcap'))
    assert [(m.topic, m.message.temperature) for m in messages] == sent
    logged = [m.log_time_ns for m in messages]
    assert logged == sorted(logged)
    # the times are not those at which the batch was taken
    assert logged[-1] < before
    assert all(m.publish_time_ns <= m.log_time_ns for m in messages)


def test_only_gaps_in_the_numbers_of_the_one_publisher_are_missed_messages(ros: Harness) -> None:
    topic = '/temperature'
    missed = MissedMessages(ros.node)

    def receive(*numbers: int) -> dict[str, int]:
        for number in numbers:
            missed.on_message(topic, {'publication_sequence_number': number})
        return missed.counts

    def publish(count: int) -> None:
        # in silence
        while ros.node.count_publishers(topic) < count:
            publishers.append(ros.node.create_publisher(Temperature, topic, topics.LOOP_QOS))
            ros.wait_until(lambda: ros.node.count_publishers(topic) == len(publishers))
            missed.look_for_publishers(topic)

    def leave_one() -> None:
        while len(publishers) > 1:
            ros.node.destroy_publisher(publishers.pop(0))
            ros.wait_until(lambda: ros.node.count_publishers(topic) == len(publishers))
            missed.look_for_publishers(topic)

    publishers: list[Publisher] = []
    publish(1)
    assert receive(7, 8) == {}
    assert receive(12, 13) == {topic: 3}
    publish(3)
    assert receive(500, 14, 501, 15) == {topic: 3}
    leave_one()
    publish(2)
    leave_one()
    assert receive(40, 41) == {topic: 3}
    assert receive(44) == {topic: 5}
    missed.on_message(topic, {})


@pytest.mark.parametrize(('at_take', 'received', 'source', 'found'), [
    (False, 70, 60, 70),
    (False, 101, 60, 101),  # while the topic was read
    (True, 100, 60, 60),
    (True, 101, 60, 60),
    (False, 0, 60, 60),  # not at all
    (True, 101, 0, 101),
    (False, 0, 0, 100),
    (True, 101, 49.5, 49.5),  # on its way when nothing had come yet
    (True, 101, 20, 50),  # by a sender whose clock is late
    (True, 101, 900, 101),  # or early
])
def test_time_of_receipt(at_take: bool, received: float, source: float, found: float) -> None:
    info = {'received_timestamp': round(received * NANOSECONDS),
            'source_timestamp': round(source * NANOSECONDS)}
    assert receipt_ns(info, take_ns=100 * NANOSECONDS, empty_ns=50 * NANOSECONDS,
                      at_take=at_take) == round(found * NANOSECONDS)


def test_a_plan_has_the_controlled_states_and_all_inputs_and_limits_of_every_state() -> None:
    """Of three states the second is not measured and the third is controlled."""
    every = {'level': 'm', 'latent': '1', 'warmth': 'K'}
    signals = Signals({'level': 'm', 'warmth': 'K'}, {'pump': 'V', 'heater': 'K'}, ('warmth',),
                      every)
    plan = Plan(np.array([0.0, 0.5, 2.25]), np.arange(9.0).reshape(3, 3) + 273.15,
                np.array([[1.0, 300.0], [2.0, 310.0]]), np.array([0.0, 1.0]),
                np.array([-1.0, 0.0]), np.array([0.0, 0.0, -1.0]))
    message = planned(signals, plan, Time(sec=7), 'plant')
    assert list(message.joint_names) == ['warmth [degC]', 'pump [V]', 'heater [degC]']
    np.testing.assert_allclose([point.positions for point in message.points], [
        [2.0, 1.0, 26.85], [5.0, 2.0, 36.85], [8.0, 2.0, 36.85]])
    assert [(point.time_from_start.sec, point.time_from_start.nanosec)
            for point in message.points] == [(0, 0), (0, 500_000_000), (2, 250_000_000)]
    assert (message.header.stamp.sec, message.header.frame_id) == (7, 'plant')
    limits = active_constraints(signals, plan, Time(sec=7), 'plant')
    assert dict(zip(limits.name, limits.position, strict=True)) == {
        'at_range_pump [-1 lower, 1 upper]': 0.0, 'at_range_heater [-1 lower, 1 upper]': 1.0,
        'at_rate_pump [-1 falling, 1 rising]': -1.0, 'at_rate_heater [-1 falling, 1 rising]': 0.0,
        'at_limit_level [-1 lower, 1 upper]': 0.0, 'at_limit_latent [-1 lower, 1 upper]': 0.0,
        'at_limit_warmth [-1 lower, 1 upper]': -1.0}


def measured(mode: Mode) -> tuple[Controller, State, StepReport]:
    """Return a controller of the reactor after three measurements, its state and last report."""
    model = load(model_path('reactor_nz4'))
    own = built(table_of(model, {'system': 'reactor'}).snapshot({}), model)
    state = own.set_mode(State(), mode)
    for k in range(1, 4):
        state, _, report = own.step(state, model.states.center, k * 10 ** 9)
    return own, state, report


def context(own: Controller, state: State, report: StepReport, silence: float = 0.0,
            measurements: int = 3) -> Any:
    """Return what statuses are made of."""
    return SimpleNamespace(
        report=report, state=state, controller=own, signals=signals_of(own.model),
        reason='a reason', measured=own.model.states.center, setpoint_received=True,
        parameters=SimpleNamespace(
            max_measurement_age=5.0, measurement_timeout=0.0, tuning=own.tuning),
        complaint='', awaited='', unheard=(), unheard_for=0.0, request='', model_rejected='',
        input='coolant', counts=Counts(measurements=measurements), model=dict,
        assembler=SimpleNamespace(
            awaited='', late={}, missing={}, duplicated={}),
        timing=SimpleNamespace(silence=silence, wall_silence=0.0, paused=False,
                               without_clock=False, age=math.nan, busy=False, answer_seconds=0.0,
                               silence_cause=lambda _: None))


@pytest.mark.parametrize(('silence', 'warned'), [(0.6, False), (1.4, False), (2.5, True)])
def test_a_manual_command_between_two_measurements_is_no_missing_measurement(
        silence: float, warned: bool) -> None:
    own, state, _ = measured(Mode.MANUAL)
    state = own.request_manual_input(state, own.model.inputs.center + 1.0)[0]
    state, _, report = own.hold(state, int((3.0 + silence) * 1e9), None)
    found = statuses(context(own, state, report, silence))['measurements']
    assert (found.level is Severity.WARN) is warned


def test_the_inputs_assumed_before_the_start_are_reported() -> None:
    model = load(model_path('reactor_nz4'))
    own = built(table_of(model, {'system': 'reactor'}).snapshot({
        'coolant_temperature.dead_time': 2.5}), model)
    state, messages = State(), []
    for k in range(1, 5):
        state, _, report = own.step(state, model.states.center, k * NANOSECONDS)
        messages.append(statuses(context(own, state, report))['control'].message)
    assert ['before the start is assumed' in text for text in messages] == [True] * 3 + [False]


def test_a_held_disturbance_is_a_warning_and_its_value_a_figure() -> None:
    model = load(model_path('reactor_feed'))
    signals = signals_of(model)
    own = built(table_of(model, {'system': 'reactor'}).snapshot({}), model)
    heard = MeasuredInputs(signals.disturbances)
    assert MeasuredInputs(()).with_ages(0) == (None, None)
    state = State()
    waiting = statuses(context(own, state, StepReport(
        Mode.AUTOMATIC, own.order.levels[0]), measurements=0))
    assert math.isnan(waiting['control'].values()['feed_temperature [degC]'])
    for k, (kelvin, words, expected) in enumerate((
            (None, 'no measurement of feed_temperature yet: its nominal value 76.85 degC', 76.85),
            (351.0, '', 77.85),
            (math.nan, 'the measured feed_temperature is nan, not finite', 77.85),
            (365.0, '', 91.85)), 1):
        if kelvin is not None:
            heard.take(SignalSample(Time(sec=k), '', {'feed_temperature': kelvin}, True))
        state, _, report = own.step(state, model.states.center, k * NANOSECONDS, None, None,
                                    *heard.with_ages(k * NANOSECONDS))
        found = statuses(context(own, state, report, measurements=k))
        assert found['measurements'].message.startswith(words or 'in order')
        outside = 'feed_temperature is outside the trained range [66.883, 86.6989] degC'
        assert (outside in found['model'].message) is (kelvin == 365.0)
        assert found['control'].level is (
            Severity.OK if kelvin == 351.0 else Severity.WARN)
        assert found['control'].values()['feed_temperature [degC]'] == pytest.approx(expected)


@pytest.mark.parametrize(('depth', 'severity'), [
    (0, Severity.OK), (1, Severity.WARN), (2, Severity.ERROR), (3, Severity.ERROR)])
def test_another_law_is_a_warning_and_no_law_an_error(depth: int, severity: Severity) -> None:
    own, state, report = measured(Mode.AUTOMATIC)
    lower = replace(report, level=own.order.levels[depth], depth=depth)
    assert statuses(context(own, state, lower))['control'].level is severity


def test_automatic_mode_is_in_order_before_its_first_command() -> None:
    own, state, report = measured(Mode.MANUAL)
    found = statuses(context(own, own.set_mode(state, Mode.AUTOMATIC), report))['control']
    assert (found.level, found.message) == (Severity.OK, 'automatic')


@pytest.mark.parametrize(('degrees', 'outside', 'words'), [
    (45.0, 0.07, ''), (45.0, 0.11, 'far from the training data'),
    (54.5, 0.06, 'outside the trained range'), (45.0, 0.0, '')])
def test_a_state_within_the_ranges_is_far_from_the_data_beyond_the_margin(
        degrees: float, outside: float, words: str) -> None:
    own, state, report = measured(Mode.AUTOMATIC)
    now = context(own, state, replace(
        report, measurement=report.measurement._replace(outside=outside)))
    now.measured = np.array([degrees + 273.15])
    found = statuses(now)['model']
    assert found.level is (Severity.WARN if words else Severity.OK)
    assert words in found.message


def test_a_disturbance_at_its_bound_is_a_warning_of_the_model() -> None:
    own, state, report = measured(Mode.AUTOMATIC)
    assert statuses(context(own, state, report))['model'].level is Severity.OK
    large = replace(report.estimate.estimate, w=own.best.estimator.bounded(np.array([1e3])))
    found = statuses(context(own, state, replace(
        report, estimate=report.estimate._replace(estimate=large))))
    assert (found['model'].level, found['control'].level) == (Severity.WARN,) * 2
    assert 'at its bound' in found['model'].message


@pytest.mark.parametrize(('share', 'warned'), [(0.9, False), (-1.1, True)])
def test_a_rate_beyond_the_band_of_the_record_is_a_warning_of_the_model(
        share: float, warned: bool) -> None:
    model = load(model_path('reactor_nz4'))
    model = replace(model, rate_band=RateBand(np.array([0.1]), *np.zeros((4, 2, 1))))
    own = built(table_of(model, {'system': 'reactor'}).snapshot({}), model)
    state, _, report = own.step(State(), model.states.center, NANOSECONDS)
    estimate = replace(report.estimate.estimate, w=np.array([0.1 * share]))
    found = statuses(context(own, state, replace(
        report, estimate=report.estimate._replace(estimate=estimate))))['model']
    assert (found.level is Severity.WARN) is warned
    assert ('the rate of temperature differs' in found.message) is warned


def test_a_request_is_repeated_until_one_is_answered() -> None:
    sent: list[Future] = []

    def request() -> Future:
        sent.append(Future())
        return sent[-1]

    response = repeated(request, 60.0)
    assert (response(), response(), len(sent)) == (None, None, 1)
    response = repeated(request, 0.0)
    assert (response(), response(), len(sent)) == (None, None, 3)
    # the response to the one before the last is late
    sent[1].set_result('late')
    assert response() is sent[1]
